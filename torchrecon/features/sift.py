"""SIFT: difference-of-Gaussian scale space, gradients, keypoints and descriptors (paper, eqs. 1-5).

The scale space and the detector are Kornia's (sub-pixel scale-space detection with descriptors from the same
pyramid). Added here: rejection of weak and of edge-like extrema, which Kornia leaves out, the pixel-difference
gradients of the paper, and the description of given points.

Convention:
    Angles of gradients are mathematical (counter-clockwise as seen, that is y up): a grey value that grows to the
    right has orientation 0, one that grows upwards pi/2. The printed eq. (5) is constant; its source
    (Lowe, ICCV 1999) is ``atan2(L_ij - L_{i+1,j}, L_{i,j+1} - L_ij)`` with i the row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.features.extrema import scale_space_extrema
from torchrecon.features.patches import gaussian_blur, image_pyramid, patch_grid, sample_image

__all__ = [
    "Keypoints",
    "SiftParams",
    "describe_points",
    "detect_sift",
    "difference_of_gaussians",
    "dog_pyramid",
    "gaussian",
    "gradient_polar",
    "smooth",
]

GradMode = Literal["lowe1999", "central"]


@dataclass(frozen=True)
class SiftParams:
    """Parameters of detection and description.

    Attributes:
        max_keypoints: strongest extrema kept per image before the rejections.
        contrast: smallest |D| of an extremum, grey values in [0, 1]; 0.04/3 is OpenCV's, Lowe 2004 takes 0.03.
        edge_ratio: largest ratio of the principal curvatures of D (r of Lowe 2004); 10.
        min_sigma: smallest scale kept, pixels.
        grad_mode: gradients of the descriptor: ``central`` differences (Kornia's pyramid descriptor) or
            ``lowe1999`` pixel differences (paper, eqs. 4-5).
        root: RootSIFT: square root of the L1-normalised descriptor.
    """

    max_keypoints: int = 1000
    contrast: float = 0.04 / 3
    edge_ratio: float = 10.0
    min_sigma: float = 0.0
    grad_mode: GradMode = "central"
    root: bool = True


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of a batch of images, padded to one number; only rows with ``valid`` are to be read.

    Attributes:
        xy: (batch, points, 2) pixels.
        sigma: (batch, points) scale, pixels.
        orientation: (batch, points) radians, Kornia's sense.
        response: (batch, points) |D| at the extremum.
        descriptor: (batch, points, 128) unit length.
        valid: (batch, points).
    """

    xy: Float[Tensor, "batch points 2"]
    sigma: Float[Tensor, "batch points"]
    orientation: Float[Tensor, "batch points"]
    response: Float[Tensor, "batch points"]
    descriptor: Float[Tensor, "batch points 128"]
    valid: Bool[Tensor, "batch points"]


def gaussian(sigma: float, radius: int, dtype: torch.dtype | None = None) -> Float[Tensor, "side side"]:
    """G(x, y, s) = exp(-(x^2 + y^2) / (2 s^2)) / (2 pi s^2) on the pixel raster (paper, eq. 3).

    Args:
        sigma: s, pixels; each call takes its own scale (the print keeps k on the left side only).
        radius: half width of the raster, pixels.
        dtype: of the result.

    Example:
        >>> round(float(gaussian(1.0, 4).sum()), 3)
        1.0
    """
    if sigma <= 0:
        raise ReconError(f"sigma: {sigma} is not positive")
    x = torch.arange(-radius, radius + 1, dtype=dtype or torch.get_default_dtype())
    squared = x[:, None] ** 2 + x[None] ** 2
    return torch.exp(-squared / (2 * sigma**2)) / (2 * math.pi * sigma**2)


def smooth(image: Float[Tensor, "height width"], sigma: float) -> Float[Tensor, "height width"]:
    """L(x, y, s) = G(x, y, s) * I(x, y), borders repeated (paper, eq. 2)."""
    return gaussian_blur(image, sigma)


def difference_of_gaussians(
    image: Float[Tensor, "height width"], sigma: float, k: float = 2 ** (1 / 3)
) -> Float[Tensor, "height width"]:
    """D(x, y, s) = L(x, y, k s) - L(x, y, s) (paper, eq. 1, whose print subtracts L from itself).

    Example:
        >>> import torch
        >>> float(difference_of_gaussians(torch.ones(9, 9), 1.6).abs().max()) < 1e-6
        True
    """
    return smooth(image, k * sigma) - smooth(image, sigma)


def dog_pyramid(
    images: Float[Tensor, "batch 1 height width"], n_scales: int = 3, sigma0: float = 1.6, double_image: bool = False
) -> tuple[list[Tensor], list[Tensor], list[float]]:
    """Gaussian and difference-of-Gaussian pyramids (paper, eqs. 1-3) on Kornia's scale pyramid.

    Args:
        images: grey values in [0, 1].
        n_scales: scales per octave; the factor between two is k = 2^(1/n_scales).
        sigma0: blur of the first level, pixels of its octave.
        double_image: start with an octave at twice the resolution.

    Returns:
        per octave D (batch, n_scales + 2, h, w); per octave the sigma of the finer level of each D, in pixels of
        the input (n_scales + 2,); per octave its pixel spacing in the input.
    """
    from kornia.geometry import ScalePyramid

    levels, sigmas, spacings = ScalePyramid(n_scales, sigma0, 16, double_image).to(images)(images)
    differences = [level[:, 0, 1:] - level[:, 0, :-1] for level in levels]
    spacing = [float(s[0, 0]) for s in spacings]
    return differences, [s[0, :-1] * d for s, d in zip(sigmas, spacing, strict=True)], spacing


def gradient_polar(
    image: Float[Tensor, "*batch height width"], mode: GradMode = "central"
) -> tuple[Float[Tensor, "*batch height width"], Float[Tensor, "*batch height width"]]:
    """Gradient magnitude and orientation of every pixel (paper, eqs. 4 and 5).

    Args:
        image: L, grey values; the border is repeated.
        mode: ``lowe1999``: ``M = sqrt((L_ij - L_{i+1,j})^2 + (L_ij - L_{i,j+1})^2)`` and
            ``R = atan2(L_ij - L_{i+1,j}, L_{i,j+1} - L_ij)``, i the row; the gradient of the point half a pixel
            right and below. ``central``: the same of central differences.

    Returns:
        magnitude, grey values per pixel; orientation, radians in (-pi, pi].

    Example:
        >>> import torch
        >>> right = torch.arange(6.0).expand(4, 6)
        >>> magnitude, angle = gradient_polar(right, "lowe1999")
        >>> float(magnitude[1, 1]), float(angle[1, 1])
        (1.0, 0.0)
    """
    if mode not in ("lowe1999", "central"):
        raise ReconError(f"grad_mode: {mode!r} is not known; use 'lowe1999' or 'central'")
    below = torch.cat([image[..., 1:, :], image[..., -1:, :]], -2)
    right = torch.cat([image[..., :, 1:], image[..., :, -1:]], -1)
    if mode == "lowe1999":
        up, along = image - below, right - image
    else:
        above = torch.cat([image[..., :1, :], image[..., :-1, :]], -2)
        left = torch.cat([image[..., :, :1], image[..., :, :-1]], -1)
        up, along = (above - below) / 2, (right - left) / 2
    return torch.hypot(up, along), torch.atan2(up, along)


@lru_cache(maxsize=8)
def _extractor(max_keypoints: int, root: bool, device: torch.device) -> Any:
    from kornia.feature import SIFTFeatureScaleSpace

    return SIFTFeatureScaleSpace(max_keypoints, rootsift=root, device=device, descriptor_backend="pyramid").eval()


def _curvature_ratio_ok(image: Tensor, xy: Tensor, sigma: Tensor, ratio: float) -> Tensor:
    """Lowe's edge test, trace^2 / det < (r + 1)^2 / r, of the Hessian of D at each keypoint's own scale.

    The second derivatives of D are inner products of the image, sampled in steps of half a sigma, with the second
    derivatives of G(k s) - G(s), so one fixed set of three kernels serves all scales.
    """
    levels = 1 + max(0, int(math.log2(max(min(image.shape) / 16, 1))))
    pyramid = image_pyramid(image, levels, sigma=0.0)
    grid = patch_grid(8, xy) / 2  # in units of sigma, out to 4 sigma
    x, y = grid.unbind(-1)
    squared = x**2 + y**2

    def second(s: float) -> Tensor:
        g = torch.exp(-squared / (2 * s**2)) / s**2
        return torch.stack([(x**2 / s**4 - 1 / s**2) * g, (y**2 / s**4 - 1 / s**2) * g, x * y / s**4 * g], -1)

    kernels = second(2 ** (1 / 3)) - second(1.0)
    level = torch.log2(sigma / 1.6).floor().clamp(0, levels - 1).long()
    good = torch.zeros(len(xy), dtype=torch.bool, device=xy.device)
    for index in range(levels):
        here = level == index
        if here.any():
            points = (xy[here][:, None] + sigma[here][:, None, None] * grid) / 2**index
            xx, yy, cross = (sample_image(pyramid[index], points) @ kernels).unbind(-1)
            trace, determinant = xx + yy, xx * yy - cross**2
            good[here] = (determinant > 0) & (trace**2 * ratio < (ratio + 1) ** 2 * determinant)
    return good


def _sparse_lafs(images: Tensor, masks: Tensor | None, params: SiftParams) -> tuple[Tensor, Tensor]:
    """What Kornia's detector returns, frames and |D| padded with zeros, of the extrema above the contrast."""
    lafs = images.new_zeros(len(images), params.max_keypoints, 2, 3)
    responses = images.new_zeros(len(images), params.max_keypoints)
    for index, image in enumerate(images[:, 0]):
        mask = None if masks is None else masks[index]
        found = scale_space_extrema(image, params.contrast, mask)
        xy, sigma, response = (v[: params.max_keypoints] for v in found)
        lafs[index, : len(xy), :, :2] = 6.0 * sigma[:, None, None] * torch.eye(2, dtype=images.dtype)
        lafs[index, : len(xy), :, 2] = xy
        responses[index, : len(xy)] = response
    return lafs, responses


def detect_sift(
    images: Float[Tensor, "batch 1 height width"],
    masks: Bool[Tensor, "batch height width"] | None = None,
    params: SiftParams = SiftParams(),
    describe: bool = True,
) -> Keypoints:
    """Detect and describe SIFT keypoints, strongest first.

    Args:
        images: grey values in [0, 1], at least 32 x 32 pixels.
        masks: keypoints are kept where true.
        params: thresholds.
        describe: without it orientations and descriptors are zero, which saves four fifths of the time on the CPU.

    Raises:
        ReconError: images smaller than 32 pixels.

    Example:
        >>> import torch
        >>> y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
        >>> blob = torch.exp(-((x - 30) ** 2 + (y - 33) ** 2) / (2 * 4.0**2))[None, None]
        >>> found = detect_sift(blob)
        >>> [round(v) for v in found.xy[0, 0].tolist()], int(found.valid.sum())
        ([30, 33], 1)
    """
    height, width = images.shape[-2:]
    if min(height, width) < 32:
        raise ReconError(f"images: {height} x {width} pixels; SIFT needs at least 32 x 32")
    from kornia.feature import get_laf_orientation, get_laf_scale, laf_is_filled

    work = images.to(torch.float32)
    region = None if masks is None else masks[:, None].to(torch.float32)
    with torch.no_grad():
        extractor = _extractor(params.max_keypoints, params.root, work.device)
        if describe:
            lafs, responses, descriptors = extractor(work, region)
        elif work.device.type == "cpu":
            lafs, responses = _sparse_lafs(work, masks, params)
            descriptors = lafs.new_zeros(*lafs.shape[:2], 128)
        else:
            lafs, responses = extractor.detector(work, region)
            descriptors = lafs.new_zeros(*lafs.shape[:2], 128)
    xy = lafs[..., 2]
    sigma = get_laf_scale(lafs)[..., 0, 0] / 6.0
    orientation = torch.deg2rad(get_laf_orientation(lafs)[..., 0])
    response = responses.reshape(xy.shape[:2])
    valid = laf_is_filled(lafs) & (response >= params.contrast) & (sigma >= params.min_sigma)
    for index in range(len(images)):
        chosen = valid[index].nonzero()[:, 0]
        image = work[index, 0]
        ok = _curvature_ratio_ok(image, xy[index, chosen], sigma[index, chosen], params.edge_ratio)
        if masks is not None:
            # Kornia's mask acts on the extrema of a level; sub-pixel refinement may leave it again
            nearest = xy[index, chosen].round().long()
            ok &= masks[index][nearest[:, 1].clamp(0, height - 1), nearest[:, 0].clamp(0, width - 1)]
        valid[index, chosen[~ok]] = False
    if describe and params.grad_mode == "lowe1999":
        parts = [
            describe_points(work[i, 0], xy[i], sigma[i], orientation[i], grad_mode="lowe1999", root=params.root)
            for i in range(len(images))
        ]
        descriptors = torch.stack(parts)
    order = torch.argsort(torch.where(valid, -response, torch.inf), dim=1, stable=True)
    order = order[:, : max(1, int(valid.sum(1).max()))]

    def take(values: Tensor) -> Tensor:
        index = order.reshape(order.shape + (1,) * (values.ndim - 2)).expand(order.shape + values.shape[2:])
        return values.gather(1, index)

    return Keypoints(
        xy=take(xy).to(images.dtype),
        sigma=take(sigma).to(images.dtype),
        orientation=take(orientation).to(images.dtype),
        response=take(response).to(images.dtype),
        descriptor=take(descriptors.reshape(*xy.shape[:2], 128)).to(images.dtype),
        valid=take(valid),
    )


@lru_cache(maxsize=4)
def _spatial_bins(side: int) -> Tensor:
    """(side^2, 16) weights of a sample in the 4 x 4 cells: bilinear between cell centres, times a Gaussian."""
    position = (torch.arange(side, dtype=torch.float32) + 0.5) / side * 4 - 0.5
    cells = (1 - (position[:, None] - torch.arange(4.0)[None]).abs()).clamp_min(0)
    window = torch.exp(-0.5 * ((position - 1.5) / 2.0) ** 2)
    cells = cells * window[:, None]
    return torch.einsum("yi,xj->yxij", cells, cells).reshape(side * side, 16)


def describe_points(
    image: Float[Tensor, "height width"],
    xy: Float[Tensor, "points 2"],
    sigma: Float[Tensor, " points"],
    orientation: Float[Tensor, " points"] | None = None,
    grad_mode: GradMode = "central",
    root: bool = True,
) -> Float[Tensor, "points 128"]:
    """SIFT descriptors at given points, for matching inside gates.

    4 x 4 cells of 8 orientations over 12 sigma x 12 sigma, Gaussian window, clipped at 0.2. They are comparable with
    one another, not with those of :func:`detect_sift`, which come from Kornia's pyramid.

    Args:
        image: grey values.
        xy: pixels.
        sigma: scale of each point, pixels.
        orientation: radians, rotation of the patch in Kornia's sense (a LAF angle); default upright.
        grad_mode: see :func:`gradient_polar`.
        root: RootSIFT.
    """
    from kornia.feature import extract_patches_from_pyramid, laf_from_center_scale_ori

    work, side = image.to(torch.float32)[None, None], 32
    angle = torch.zeros_like(sigma) if orientation is None else torch.rad2deg(orientation)
    lafs = laf_from_center_scale_ori(
        xy[None].float(), (6.0 * sigma.float().clamp_min(0.1))[None, :, None, None], angle[None, :, None].float()
    )
    patches = extract_patches_from_pyramid(work, lafs, side)[0, :, 0]
    magnitude, direction = gradient_polar(patches, grad_mode)
    turns = torch.remainder(direction.flatten(1) / (2 * math.pi), 1.0) * 8
    away = (turns[:, None] - torch.arange(8.0, device=turns.device)[None, :, None]).abs()
    soft = (1 - torch.minimum(away, 8 - away)).clamp_min(0) * magnitude.flatten(1)[:, None]
    histogram = (soft @ _spatial_bins(side).to(soft)).mT.flatten(1)
    unit = torch.nn.functional.normalize(histogram, dim=-1).clamp_max(0.2)
    unit = torch.nn.functional.normalize(unit, dim=-1)
    if root:
        unit = torch.sqrt(torch.nn.functional.normalize(unit, p=1.0, dim=-1))
    return unit.to(image.dtype)
