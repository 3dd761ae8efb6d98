"""Equations (1)-(5) and the keypoints built on them, against closed forms and OpenCV."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F

from torchrecon.errors import ReconError
from torchrecon.features.extrema import scale_space_extrema
from torchrecon.features.matching import match_descriptors
from torchrecon.features.sift import (
    SiftParams,
    describe_points,
    detect_sift,
    difference_of_gaussians,
    dog_pyramid,
    gaussian,
    gradient_polar,
    smooth,
)


def _texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Blobs of many sizes: sums of smoothed noise, in [0, 1]."""
    g = torch.Generator().manual_seed(seed)
    image = torch.zeros(1, 1, height, width)
    for cells in (4, 8, 16, 32):
        noise = torch.rand(1, 1, max(2, height // cells), max(2, width // cells), generator=g)
        image += F.interpolate(noise, size=(height, width), mode="bicubic", align_corners=True) * cells**0.5
    image = image[0, 0] - image.min()
    return image / image.max()


def _warp(image: torch.Tensor, matrix: np.ndarray, size: tuple[int, int]) -> torch.Tensor:
    """Image under x' = A x + t, resampled by area-correct cubic interpolation of OpenCV."""
    warped = cv2.warpAffine(
        image.numpy(), matrix, (size[1], size[0]), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return torch.from_numpy(warped)


def _rotation(degrees: float, scale: float, size: tuple[int, int]) -> np.ndarray:
    """Turn and scale about the centre; the output has the size times the scale."""
    height, width = size
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, scale)
    matrix[:, 2] += np.array([(width * scale - 1) / 2, (height * scale - 1) / 2]) - [(width - 1) / 2, (height - 1) / 2]
    return matrix


def test_eq1_difference_of_gaussians_is_l_of_ks_minus_l_of_s():
    image = _texture(40, 50)
    k, sigma = 2 ** (1 / 3), 1.6
    difference = difference_of_gaussians(image, sigma, k)
    assert float(difference.abs().max()) > 1e-3  # the printed equation would be zero everywhere
    torch.testing.assert_close(difference, smooth(image, k * sigma) - smooth(image, sigma))
    assert float(difference_of_gaussians(torch.full((30, 30), 0.7), sigma).abs().max()) < 1e-12


def test_eq1_pyramid_of_a_constant_image_is_zero_and_scales_are_k_apart():
    octaves, sigmas, spacing = dog_pyramid(torch.full((1, 1, 64, 80), 0.3))
    assert all(float(octave.abs().max()) < 1e-6 for octave in octaves)
    assert octaves[0].shape[1] == sigmas[0].numel() == 5
    torch.testing.assert_close(sigmas[0][1:] / sigmas[0][:-1], torch.full((4,), 2 ** (1 / 3)))
    assert spacing[1] == 2 * spacing[0]
    assert float(sigmas[1][0]) == pytest.approx(2 * float(sigmas[0][0]))


@pytest.mark.parametrize("t", [2.5, 4.0, 6.0])
def test_eq1_response_of_a_gaussian_blob_peaks_at_its_own_scale(t):
    axis = torch.arange(-40.0, 41.0)
    blob = torch.exp(-(axis[:, None] ** 2 + axis[None] ** 2) / (2 * t**2))
    k = 2 ** (1 / 3)
    scales = t * torch.logspace(-0.3, 0.3, 25)
    response = torch.stack([difference_of_gaussians(blob, float(s), k)[40, 40].abs() for s in scales])
    best = float(scales[response.argmax()]) * math.sqrt(k)  # the pair s, k s stands for the scale between them
    assert best == pytest.approx(t, rel=0.1)


def test_eq2_smoothing_is_convolution_with_the_gaussian():
    image = torch.zeros(31, 31)
    image[15, 15] = 1.0
    torch.testing.assert_close(smooth(image, 2.0), gaussian(2.0, 15), atol=2e-5, rtol=0)
    textured = _texture(60, 60)
    twice, once = smooth(smooth(textured, 1.2), 1.6), smooth(textured, 2.0)  # variances add
    torch.testing.assert_close(twice[15:-15, 15:-15], once[15:-15, 15:-15], atol=1e-3, rtol=0)


def test_eq3_gaussian_has_unit_sum_and_variance_sigma_squared():
    sigma, radius = 2.3, 20
    g = gaussian(sigma, radius)
    x = torch.arange(-radius, radius + 1.0)
    assert float(g.sum()) == pytest.approx(1.0, abs=1e-6)
    assert float((g.sum(0) * x**2).sum()) == pytest.approx(sigma**2, rel=1e-5)
    assert float(g[radius, radius]) == pytest.approx(1 / (2 * math.pi * sigma**2))
    with pytest.raises(ReconError, match="sigma"):
        gaussian(0.0, 3)


@pytest.mark.parametrize("mode", ["lowe1999", "central"])
@pytest.mark.parametrize(("a", "b"), [(0.3, 0.0), (0.0, 0.2), (-0.1, 0.25), (0.2, -0.3)])
def test_eq4_magnitude_of_a_plane_is_its_slope(mode, a, b):
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(12.0), indexing="ij")
    magnitude, _ = gradient_polar(a * x + b * y, mode)
    expected = torch.full_like(magnitude[1:-1, 1:-1], math.hypot(a, b))
    torch.testing.assert_close(magnitude[1:-1, 1:-1], expected)


@pytest.mark.parametrize("mode", ["lowe1999", "central"])
@pytest.mark.parametrize(("a", "b"), [(0.3, 0.0), (0.0, 0.2), (-0.1, 0.25), (0.2, -0.3)])
def test_eq5_orientation_of_a_plane_is_one_angle(mode, a, b):
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(12.0), indexing="ij")
    _, angle = gradient_polar(a * x + b * y, mode)
    expected = math.atan2(-b, a)  # rows count downwards, angles upwards
    torch.testing.assert_close(angle[1:-1, 1:-1], torch.full_like(angle[1:-1, 1:-1], expected))


def test_eq4_eq5_lowe1999_is_the_pixel_difference_form():
    image = torch.tensor([[1.0, 4.0], [3.0, 9.0]])
    magnitude, angle = gradient_polar(image, "lowe1999")
    assert float(magnitude[0, 0]) == pytest.approx(math.hypot(1 - 3, 1 - 4))
    assert float(angle[0, 0]) == pytest.approx(math.atan2(1 - 3, 4 - 1))


@pytest.mark.parametrize("grad_mode", ["central", "lowe1999"])
@pytest.mark.parametrize(("degrees", "scale"), [(30.0, 1.0), (90.0, 1.0), (0.0, 2.0)])
def test_descriptors_survive_rotation_and_scale(grad_mode, degrees, scale):
    image = _texture(160, 160)
    matrix = _rotation(degrees, scale, (160, 160))
    other = _warp(image, matrix, (int(160 * scale), int(160 * scale)))
    params = SiftParams(grad_mode=grad_mode, max_keypoints=400)
    first, second = detect_sift(image[None, None], params=params), detect_sift(other[None, None], params=params)
    d1, d2 = first.descriptor[0][first.valid[0]], second.descriptor[0][second.valid[0]]
    pairs, _ = match_descriptors(d1, d2, ratio=0.8)
    xy1, xy2 = first.xy[0][first.valid[0]][pairs[:, 0]], second.xy[0][second.valid[0]][pairs[:, 1]]
    mapped = xy1 @ torch.from_numpy(matrix[:, :2]).T + torch.from_numpy(matrix[:, 2])
    correct = (mapped - xy2).norm(dim=-1) < 3.0
    assert len(pairs) >= 30
    assert float(correct.double().mean()) >= 0.9


def test_keypoints_agree_with_opencv():
    image = _texture(200, 240, seed=3)
    found = detect_sift(image[None, None], params=SiftParams(max_keypoints=3000, contrast=0.0))
    ours = found.xy[0][found.valid[0]].numpy()
    sift = cv2.SIFT_create(contrastThreshold=0.04, edgeThreshold=10)
    theirs = np.array([k.pt for k in sift.detect((image.numpy() * 255).round().astype(np.uint8), None)])
    assert len(theirs) > 50
    nearest = np.linalg.norm(theirs[:, None] - ours[None], axis=-1).min(1)
    assert (nearest < 1.5).mean() >= 0.8


def test_sparse_extrema_are_those_of_kornias_detector():
    # Kornia refines every extremum and drops none; the sparse detector never looks at the weak ones.
    from kornia.feature import SIFTFeatureScaleSpace, get_laf_scale

    image = _texture(160, 200, seed=3).float()
    lafs, responses = SIFTFeatureScaleSpace(5000, descriptor_backend="pyramid").detector(image[None, None])
    strong = responses[0] >= 0.01
    expected = torch.cat([lafs[0, strong, :, 2], get_laf_scale(lafs)[0, strong, 0] / 6], -1).double()
    xy, sigma, response = scale_space_extrema(image, 0.01)
    found = torch.cat([xy, sigma[:, None]], -1).double()
    distance = torch.cdist(found, expected)
    # One that lies half way between two voxels converges or goes to and fro with the rounding of a blur, and then
    # stands in one list alone; every other one stands in both.
    alone = torch.cat([found[distance.amin(1) >= 0.01], expected[distance.amin(0) >= 0.01]])
    assert len(expected) > 200
    assert len(alone) <= 2
    level = 3 * torch.log2(alone[:, 2] / 0.8)  # octave o has voxels of 0.5 2^o pixels; intervals 0.5 to 3.5 are its own
    voxels = alone[:, :2] / (0.5 * 2 ** ((level - 0.5) / 3).floor())[:, None]
    offset = torch.cat([voxels, level[:, None]], 1).remainder(1) - 0.5
    assert bool((offset.abs().amin(1) < 2e-3).all())
    assert bool((response[:-1] >= response[1:]).all())


def test_edges_and_weak_extrema_are_rejected():
    y, x = torch.meshgrid(torch.arange(96.0), torch.arange(96.0), indexing="ij")
    ridge = 0.5 + 0.4 * torch.exp(-((x - 48) ** 2) / (2 * 3.0**2)) * (1 + 0.05 * torch.sin(y / 6))
    everything = int(detect_sift(ridge[None, None], params=SiftParams(edge_ratio=1e6, contrast=0.0)).valid.sum())
    assert everything > 0
    assert int(detect_sift(ridge[None, None], params=SiftParams(edge_ratio=3.0, contrast=0.0)).valid.sum()) == 0
    blob = 0.05 * torch.exp(-((x - 40) ** 2 + (y - 50) ** 2) / (2 * 4.0**2))
    assert int(detect_sift(blob[None, None], params=SiftParams(contrast=0.002)).valid.sum()) == 1
    assert int(detect_sift(blob[None, None], params=SiftParams(contrast=0.03)).valid.sum()) == 0


def test_mask_and_batch():
    images = torch.stack([_texture(96, 96, seed=1), _texture(96, 96, seed=2)])[:, None]
    masks = torch.zeros(2, 96, 96, dtype=torch.bool)
    masks[0, :, :48] = True
    masks[1, 30:, :] = True
    both = detect_sift(images, masks)
    for index in range(2):
        xy = both.xy[index][both.valid[index]]
        nearest = xy.round().long()
        assert len(xy) > 0
        assert bool(masks[index, nearest[:, 1], nearest[:, 0]].all())
        alone = detect_sift(images[index : index + 1], masks[index : index + 1])
        assert len(alone.xy[0][alone.valid[0]]) == len(xy)
    flat = detect_sift(torch.full((1, 1, 64, 64), 0.5))
    assert int(flat.valid.sum()) == 0
    with pytest.raises(ReconError, match="32"):
        detect_sift(torch.zeros(1, 1, 20, 64))


def test_given_points_are_described_alike_at_the_same_place():
    image = _texture(120, 120, seed=4)
    shifted = torch.roll(image, (3, 5), (0, 1))
    xy = torch.tensor([[40.0, 50.0], [70.0, 45.0], [60.0, 80.0]])
    sigma = torch.full((3,), 2.0)
    first = describe_points(image, xy, sigma)
    second = describe_points(shifted, xy + torch.tensor([5.0, 3.0]), sigma)
    torch.testing.assert_close(first.norm(dim=-1), torch.ones(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(first, second, atol=0.05, rtol=0)
    pairs, _ = match_descriptors(first, second, ratio=1.0)
    assert pairs.tolist() == [[0, 0], [1, 1], [2, 2]]


def test_matching_respects_gate_and_empty_input():
    a = torch.eye(3)
    allowed = torch.tensor([[False, True, True], [True, True, True], [True, True, True]])
    pairs, _ = match_descriptors(a, a, ratio=1.0, allowed=allowed)
    assert [0, 0] not in pairs.tolist()
    empty, distance = match_descriptors(a[:0], a)
    assert empty.shape == (0, 2)
    assert distance.shape == (0,)
