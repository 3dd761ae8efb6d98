"""Eqs. 21-24: the covariance of a tracked point, and of a frame."""

from __future__ import annotations

import kornia
import numpy as np
import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks
from torchrecon.noise import (
    HessianParams,
    StructureTensorParams,
    hessian_covariance,
    image_noise,
    inverse_blocks,
    mean_blocks,
    residual_covariance,
    structure_tensor_covariance,
)


def _texture(size: int = 61, seed: int = 0, smoothing: float = 2.0) -> torch.Tensor:
    noise = torch.randn(1, 1, size, size, generator=torch.Generator().manual_seed(seed))
    smooth = kornia.filters.gaussian_blur2d(noise, (13, 13), (smoothing, smoothing))
    return 0.5 + 0.15 * (smooth / smooth.std())[0]


def _reference_match(template: torch.Tensor, images: torch.Tensor, window: float, radius: int) -> torch.Tensor:
    """Gauss-Newton SSD matching of the middle patch, one patch per trial, with bilinear interpolation."""
    size = template.shape[-1]
    middle = size // 2
    reach = torch.arange(-radius, radius + 1).to(template)
    dv, du = torch.meshgrid(reach, reach, indexing="ij")
    weight = torch.exp(-(du**2 + dv**2) / (2 * window**2)).flatten()

    def sample(maps: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        grid = torch.stack([du + middle, dv + middle], -1) + shift[:, None, None, :]
        return torch.nn.functional.grid_sample(maps, 2 * grid / (size - 1) - 1, align_corners=True).flatten(2)

    shift = torch.zeros(images.shape[0], 2)
    gradients = kornia.filters.spatial_gradient(images, normalized=True)[:, 0]
    target = sample(template, shift)[:, 0]
    for _ in range(6):
        g = sample(gradients, shift)
        r = target - sample(images, shift)[:, 0]
        j = torch.einsum("nap,nbp,p->nab", g, g, weight)
        shift = shift + torch.linalg.solve(j, torch.einsum("nap,np,p->na", g, r, weight))
    return shift


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_eq22_structure_tensor_agrees_with_monte_carlo_matching(seed: int) -> None:
    clean = _texture(seed=seed)
    sigma, trials = 0.01, 1500
    g = torch.Generator().manual_seed(seed)
    templates = clean + sigma * torch.randn(trials, 1, 61, 61, generator=g)
    images = clean + sigma * torch.randn(trials, 1, 61, 61, generator=g)
    shift = _reference_match(templates, images, 4.0, 10)
    measured = torch.cov(shift.T)
    q, capped = structure_tensor_covariance(
        clean, torch.tensor([[30.0, 30.0]]), StructureTensorParams(noise=sigma, min_std=1e-4)
    )
    assert not capped.any()
    assert float((q[0] - measured).norm() / measured.norm()) < 0.15
    chi2 = torch.einsum("na,ab,nb->n", shift, torch.linalg.inv(q[0]), shift)
    assert abs(float(chi2.mean()) / 2 - 1) < 0.1


def test_eq21_one_covariance_per_point_and_nan_for_no_point() -> None:
    xy = torch.tensor([[30.0, 30.0], [20.3, 41.7], [float("nan")] * 2, [400.0, 3.0]])
    for function in (structure_tensor_covariance, hessian_covariance):
        q, capped = function(_texture(), xy)
        assert q.shape == (4, 2, 2)
        assert q[2].isnan().all()
        assert not capped[2]
        good = q[[0, 1, 3]]
        assert torch.equal(good, good.transpose(-1, -2))
        assert (torch.linalg.eigvalsh(good) > 0).all()
    assert structure_tensor_covariance(_texture(), xy)[1][3]  # outside the image nothing is known


def test_eq22_noise_scale_and_rotation_rules() -> None:
    image = _texture()
    middle = torch.tensor([[30.0, 30.0]])
    params = StructureTensorParams(noise=0.002, min_std=1e-5)
    q, _ = structure_tensor_covariance(image, middle, params)
    # (the subtraction of what noise adds to J makes the rule exact only in the limit of little noise)
    double, _ = structure_tensor_covariance(image, middle, StructureTensorParams(noise=0.004, min_std=1e-5))
    torch.testing.assert_close(double, 4 * q, rtol=1e-2, atol=0)
    brighter, _ = structure_tensor_covariance(2 * image, middle, StructureTensorParams(noise=0.004, min_std=1e-5))
    torch.testing.assert_close(brighter, q)
    turned, _ = structure_tensor_covariance(image.rot90(1, (1, 2)), middle, params)
    turn = torch.tensor([[0.0, 1.0], [-1.0, 0.0]])
    torch.testing.assert_close(turned[0], turn @ q[0] @ turn.T)


def test_eq22_edges_and_flat_patches_are_capped() -> None:
    g = torch.Generator().manual_seed(0)
    edge = torch.zeros(1, 61, 61)
    edge[:, :, 31:] = 0.8
    for image, flags in ((edge, 1), (torch.full((1, 61, 61), 0.5), 2)):
        noisy = image + 0.01 * torch.randn(1, 61, 61, generator=g)
        q, capped = structure_tensor_covariance(noisy, torch.tensor([[30.5, 30.0]]))
        assert capped[0]
        values = torch.linalg.eigvalsh(q[0])
        assert int((values > 1.0).sum()) == flags
        assert float(values[-1]) == pytest.approx(100.0)


def test_eq22_hessian_as_printed_is_no_covariance_and_ours_is() -> None:
    v, u = torch.meshgrid(torch.arange(61.0), torch.arange(61.0), indexing="ij")
    blob = torch.exp(-((u - 30) ** 2 / (2 * 5.0**2) + (v - 30) ** 2 / (2 * 3.0**2)))[None]
    q, capped = hessian_covariance(blob, torch.tensor([[30.0, 30.0]]), HessianParams(smoothing=0.0, grey_levels=1.0))
    assert not capped[0]
    # the Hessian of the blob at its centre is -diag(1/25, 1/9), its inverse is -diag(25, 9)
    torch.testing.assert_close(q[0], torch.diag(torch.tensor([25.0, 9.0])), rtol=0.06, atol=1e-6)
    flat, capped = hessian_covariance(torch.zeros(3, 61, 61), torch.tensor([[30.0, 30.0]]))
    assert capped[0]
    torch.testing.assert_close(flat[0], 100 * torch.eye(2))


def test_image_noise_is_recovered_under_texture() -> None:
    g = torch.Generator().manual_seed(3)
    image = _texture(201, smoothing=3.0) + 0.02 * torch.randn(1, 201, 201, generator=g)
    assert float(image_noise(image)) == pytest.approx(0.02, rel=0.1)
    mask = torch.zeros(201, 201, dtype=torch.bool)
    with pytest.raises(ReconError, match="mask"):
        image_noise(image, mask)
    with pytest.raises(ReconError, match="channels"):
        image_noise(torch.zeros(2, 9, 9))


def _random_blocks(points: int) -> torch.Tensor:
    a = torch.randn(7, points, 2, 2, generator=torch.Generator().manual_seed(1))
    return a @ a.transpose(-1, -2) + 0.1 * torch.eye(2)


def _reference_dense(blocks: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """C1 .. C4 of (23), written out."""
    n = blocks.numpy()
    return np.diag(n[:, 0, 0]), np.diag(n[:, 0, 1]), np.diag(n[:, 1, 0]), np.diag(n[:, 1, 1])


def test_eq23_mean_over_the_frames_a_point_was_seen_in() -> None:
    q = _random_blocks(5)
    torch.testing.assert_close(mean_blocks(q), q.mean(0))
    visible = torch.ones(7, 5, dtype=torch.bool)
    visible[2:, 3] = False
    hidden = torch.where(visible[..., None, None], q, torch.tensor(float("nan")))
    mean = mean_blocks(hidden, visible)
    torch.testing.assert_close(mean[3], q[:2, 3].mean(0))
    c1, c2, c3, c4 = _reference_dense(mean)
    dense = np.block([[c1, c2], [c3, c4]])
    assert np.linalg.eigvalsh(dense).min() > 0
    with pytest.raises(ReconError, match="point 3"):
        mean_blocks(q, torch.zeros(7, 5, dtype=torch.bool) | (torch.arange(5) != 3))


def test_eq24_block_inverse_equals_the_printed_dense_formula() -> None:
    blocks = _random_blocks(6)[0]
    c1, c2, c3, c4 = _reference_dense(blocks)
    i = np.linalg.inv
    printed = np.block(
        [
            [i(c1 - c2 @ i(c4) @ c3), -i(c1 - c2 @ i(c4) @ c3) @ c2 @ i(c4)],
            [-i(c4 - c3 @ i(c1) @ c2) @ c3 @ i(c1), i(c4 - c3 @ i(c1) @ c2)],
        ]
    )
    np.testing.assert_allclose(np.block(_grid(inverse_blocks(blocks))), printed, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(printed @ np.block([[c1, c2], [c3, c4]]), np.eye(12), atol=1e-9)
    assert inverse_blocks(_random_blocks(6)).shape == (7, 6, 2, 2)
    with pytest.raises(ReconError, match="positive definite"):
        inverse_blocks(torch.tensor([[[1.0, 2.0], [2.0, 1.0]]]))


def _grid(blocks: torch.Tensor) -> list[list[np.ndarray]]:
    c1, c2, c3, c4 = _reference_dense(blocks)
    return [[c1, c2], [c3, c4]]


def _low_rank_tracks(rank: int, noise: float, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(80) / 80
    phase = 2 * torch.pi * torch.rand(2, rank, generator=g)
    rows = torch.cos(2 * torch.pi * t[:, None, None] * (1 + torch.arange(rank)) / 2 + phase)
    xy = torch.einsum("fck,pk->fpc", rows, 30 * torch.randn(60, rank, generator=g)) + 100 * t[:, None, None]
    return xy + noise * torch.randn(xy.shape, generator=g)


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("noise", [0.3, 2.0])
def test_residual_covariance_recovers_the_noise(noise: float, missing: float) -> None:
    found = []
    for seed, rank in enumerate((3, 6, 9)):
        xy = _low_rank_tracks(rank, noise, seed)
        visible = torch.rand(80, 60, generator=torch.Generator().manual_seed(seed)) >= missing
        q = residual_covariance(Tracks(xy, visible))
        assert q.shape == (80, 60, 2, 2)
        assert torch.equal(q, q[0, 0, 0, 0] * torch.eye(2).expand(80, 60, 2, 2))
        found.append(float(q[0, 0, 0, 0]) ** 0.5 / noise)
    assert all(0.85 < ratio < 1.15 for ratio in found), found


def test_residual_covariance_shrugs_off_a_few_lost_tracks_and_refuses_too_little() -> None:
    xy = _low_rank_tracks(3, 0.5, 0)
    xy[40:, :2] += 60.0
    batch = residual_covariance(Tracks(torch.stack([xy, _low_rank_tracks(3, 1.0, 1)])))
    std = batch[:, 0, 0, 0, 0].sqrt()
    assert float(std[0]) < 1.0
    assert float(std[1]) == pytest.approx(1.0, rel=0.1)
    with pytest.raises(ReconError, match="too few"):
        residual_covariance(Tracks(torch.rand(3, 4, 2)))
