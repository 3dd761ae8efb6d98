"""Sub-pixel alignment of patches by Gauss-Newton, batched over points: translation from frame to frame, affine
against a stored template, and the covariance of the position that results.

Both are insensitive to gain and offset of the grey values: patches are compared after subtracting their weighted
mean and dividing by their weighted standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.features.patches import patch_grid, sample_image

__all__ = ["Templates", "align_affine", "align_translation", "make_templates", "search_translation", "window_weights"]

_TINY = 1e-6  # grey-value scale below which a patch counts as flat; 8-bit steps are 4e-3


def window_weights(half: int, like: Tensor) -> Float[Tensor, " samples"]:
    """Gaussian window over the patch, standard deviation 0.6 of its half width."""
    grid = patch_grid(half, like)
    return torch.exp(-0.5 * (grid**2).sum(-1) / (0.6 * half) ** 2)


def _standardise(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted zero mean and unit variance along the last dimension, and the standard deviation divided out."""
    total = weights.sum(-1, keepdim=True).clamp_min(_TINY)
    centred = values - (weights * values).sum(-1, keepdim=True) / total
    deviation = torch.sqrt((weights * centred**2).sum(-1, keepdim=True) / total).clamp_min(_TINY)
    return centred / deviation, deviation[..., 0]


def _patch_with_gradient(image: Tensor, centre: Tensor, half: int) -> tuple[Tensor, Tensor]:
    """Patch (N, M) and its central differences (N, M, 2), sampled on the pixel raster shifted to ``centre``."""
    side = 2 * half + 3
    points = centre[:, None] + patch_grid(half + 1, centre)
    wide = sample_image(image, points).reshape(-1, side, side)
    gradient_x = (wide[:, 1:-1, 2:] - wide[:, 1:-1, :-2]) / 2
    gradient_y = (wide[:, 2:, 1:-1] - wide[:, :-2, 1:-1]) / 2
    return wide[:, 1:-1, 1:-1].flatten(1), torch.stack([gradient_x.flatten(1), gradient_y.flatten(1)], -1)


def _project_out(steepest: Tensor, template: Tensor, weights: Tensor) -> Tensor:
    """Remove from the steepest-descent images (N, M, k) what a change of gain or offset would explain."""
    total = weights.sum(-1)[:, None].clamp_min(_TINY)
    steepest = steepest - ((weights[..., None] * steepest).sum(1) / total)[:, None]
    along = (weights[..., None] * steepest * template[..., None]).sum(1) / total
    return steepest - along[:, None] * template[..., None]


def align_translation(
    source: list[Tensor],
    target: list[Tensor],
    xy: Float[Tensor, "points 2"],
    guess: Float[Tensor, "points 2"],
    half: int,
    iterations: int = 6,
    weights: list[Tensor] | None = None,
) -> tuple[Float[Tensor, "points 2"], Float[Tensor, " points"]]:
    """Find the patches around ``xy`` of one pyramid in another, coarse to fine, by translation alone.

    Args:
        source: pyramid of the frame in which the points are known.
        target: pyramid of the frame in which they are looked for.
        xy: positions in ``source``, pixels of level 0.
        guess: where to start in ``target``.
        half: half width of the window in pixels of each level.
        iterations: Gauss-Newton steps per level.
        weights: per level (points, samples) in [0, 1], which samples belong to the object; default all.

    Returns:
        position in ``target``; correlation (-1..1) of the two windows there.

    Source: Lucas and Kanade, IJCAI 1981; inverse compositional form of Baker and Matthews, IJCV 2004.
    """
    window = window_weights(half, xy)
    position = guess.clone()
    score = xy.new_zeros(len(xy))
    for level in reversed(range(len(source))):
        scale = 2.0**-level
        weight = window.expand(len(xy), -1) if weights is None else window * weights[level]
        patch, gradient = _patch_with_gradient(source[level], xy * scale, half)
        template, deviation = _standardise(patch, weight)
        steepest = _project_out(gradient / deviation[:, None, None], template, weight)
        weighted = steepest * weight[..., None]
        hessian = weighted.mT @ steepest
        damping = 1e-3 * hessian.diagonal(dim1=-2, dim2=-1).mean(-1).clamp_min(_TINY)
        inverse = torch.linalg.inv(hessian + damping[:, None, None] * torch.eye(2, dtype=xy.dtype, device=xy.device))
        pull = inverse @ weighted.mT
        grid = patch_grid(half, xy)
        centre = position * scale
        for _ in range(iterations):
            current, _ = _standardise(sample_image(target[level], centre[:, None] + grid), weight)
            step = (pull @ (current - template)[..., None])[..., 0]
            centre = centre - step.clamp(-half / 2, half / 2)
        position = centre / scale
        if level == 0:
            current, _ = _standardise(sample_image(target[0], centre[:, None] + grid), weight)
            score = (weight * current * template).sum(-1) / weight.sum(-1).clamp_min(_TINY)
    return position, score


def search_translation(
    source: Float[Tensor, "height width"],
    target: Float[Tensor, "rows columns"],
    xy: Float[Tensor, "points 2"],
    guess: Float[Tensor, "points 2"],
    half: int,
    reach: int,
    weights: Float[Tensor, "points samples"] | None = None,
) -> Float[Tensor, "points 2"]:
    """Where in ``target`` the patches around ``xy`` of ``source`` fit best, by trying every whole-pixel shift.

    Slower than :func:`align_translation`, but it needs no start inside the basin of attraction: for points whose
    motion is not known yet and for those that were lost.

    Args:
        source, target: images, the same level of two pyramids.
        xy: positions in ``source``, pixels.
        guess: centres of the searches in ``target``.
        half: half width of the window, pixels.
        reach: largest shift from ``guess`` along each axis, pixels.
        weights: which samples belong to the object, in [0, 1]; default all.

    Example:
        >>> import torch
        >>> image = torch.rand(30, 40, generator=torch.Generator().manual_seed(0))
        >>> here = torch.tensor([[20.0, 15.0]])
        >>> search_translation(image, image, here, here + torch.tensor([3.0, -2.0]), 3, 4).tolist()
        [[20.0, 15.0]]
    """
    window = window_weights(half, xy).expand(len(xy), -1)
    weight = window if weights is None else window * weights
    template, _ = _standardise(sample_image(source, xy[:, None] + patch_grid(half, xy)), weight)
    side = 2 * (half + reach) + 1
    wide = sample_image(target, guess[:, None] + patch_grid(half + reach, xy)).reshape(len(xy), 1, side, side)
    # One correlation per point, as a grouped convolution: sums of w t v, w v and w v^2 over every window.
    size = 2 * half + 1

    def slide(image: Tensor, kernel: Tensor) -> Tensor:
        kernels = kernel.reshape(len(xy), 1, size, size)
        return F.conv2d(image.transpose(0, 1), kernels, groups=len(xy))[0].flatten(1)

    total = weight.sum(-1, keepdim=True).clamp_min(_TINY)
    mean = slide(wide, weight) / total
    spread = (slide(wide.square(), weight) / total - mean.square()).clamp_min(_TINY**2).sqrt()
    best = (slide(wide, weight * template) / total / spread).argmax(1)
    return guess + patch_grid(reach, xy)[best]


@dataclass(frozen=True, eq=False)
class Templates:
    """Stored patches with everything that their alignment needs again and again.

    Attributes:
        values: (points, samples) standardised grey values.
        weights: (points, samples) window times object mask.
        steepest: (points, samples, 6) change of the values with (A11, A12, A21, A22, x, y), A in units of ``half``.
        pull: (points, 6, samples) least-squares map from a residual to a step.
        structure: (points, 2, 2) sum of w g g^T over the window, grey values per pixel squared.
        structure2: (points, 2, 2) sum of w^2 g g^T.
        deviation: (points,) grey-value standard deviation of the window.
    """

    values: Tensor
    weights: Tensor
    steepest: Tensor
    pull: Tensor
    structure: Tensor
    structure2: Tensor
    deviation: Tensor

    def select(self, keep: Tensor) -> Templates:
        """The templates at an index or boolean mask."""
        return Templates(*(getattr(self, f.name)[keep] for f in fields(self)))

    @staticmethod
    def join(first: Templates, second: Templates) -> Templates:
        """The templates of both, in this order."""
        return Templates(*(torch.cat([getattr(first, f.name), getattr(second, f.name)]) for f in fields(first)))

    def replace_where(self, choose: Bool[Tensor, " points"], other: Templates) -> Templates:
        """Take ``other`` (as many as ``choose`` marks, in order) where ``choose`` is true."""
        parts = []
        for f in fields(self):
            mine = getattr(self, f.name).clone()
            mine[choose] = getattr(other, f.name)
            parts.append(mine)
        return Templates(*parts)


def make_templates(
    image: Float[Tensor, "height width"],
    xy: Float[Tensor, "points 2"],
    half: int,
    weights: Float[Tensor, "points samples"] | None = None,
    deformation_damping: float = 0.02,
) -> Templates:
    """Cut templates around points.

    Args:
        image: level 0 of the pyramid.
        xy: pixels.
        half: half width of the window, pixels.
        weights: which samples belong to the object, in [0, 1]; default all.
        deformation_damping: damping of the four affine parameters in a step, as a fraction of the strongest
            direction; keeps a window of little texture from shearing at will.
    """
    window = window_weights(half, xy)
    weight = window.expand(len(xy), -1).clone() if weights is None else window * weights
    patch, gradient = _patch_with_gradient(image, xy, half)
    values, deviation = _standardise(patch, weight)
    offset = patch_grid(half, xy) / half
    gx, gy = gradient[..., 0] / deviation[:, None], gradient[..., 1] / deviation[:, None]
    columns = [gx * offset[:, 0], gx * offset[:, 1], gy * offset[:, 0], gy * offset[:, 1], gx, gy]
    steepest = _project_out(torch.stack(columns, -1), values, weight)
    weighted = steepest * weight[..., None]
    hessian = weighted.mT @ steepest
    strongest = hessian.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(_TINY)
    damping = hessian.new_tensor([deformation_damping] * 4 + [1e-4] * 2)
    pull = torch.linalg.inv(hessian + torch.diag_embed(strongest[:, None] * damping)) @ weighted.mT
    outer = gradient[..., :, None] * gradient[..., None, :]
    return Templates(
        values=values,
        weights=weight,
        steepest=steepest,
        pull=pull,
        structure=(weight[..., None, None] * outer).sum(1),
        structure2=((weight**2)[..., None, None] * outer).sum(1),
        deviation=deviation,
    )


def align_affine(
    templates: Templates,
    image: Float[Tensor, "height width"],
    xy: Float[Tensor, "points 2"],
    affine: Float[Tensor, "points 2 2"],
    half: int,
    iterations: int = 6,
) -> tuple[
    Float[Tensor, "points 2"], Float[Tensor, "points 2 2"], Float[Tensor, " points"], Float[Tensor, "points samples"]
]:
    """Refine position and affine deformation of templates in an image (inverse compositional Gauss-Newton).

    Args:
        templates: from :func:`make_templates`, with the same ``half``.
        image: level 0 of the pyramid of the current frame.
        xy: where to start, pixels.
        affine: template -> image deformation to start from.
        half: half width of the window, pixels.
        iterations: steps.

    Returns:
        position; affine; correlation (-1..1); residual in standard deviations of the template.
    """
    grid = patch_grid(half, xy)
    centre, deform = xy.clone(), affine.clone()
    for _ in range(iterations):
        points = centre[:, None] + grid @ deform.mT
        current, _ = _standardise(sample_image(image, points), templates.weights)
        step = (templates.pull @ (current - templates.values)[..., None])[..., 0].clamp(-half / 2, half / 2)
        increment = step[:, :4].reshape(-1, 2, 2) / half
        increment = increment + torch.eye(2, dtype=xy.dtype, device=xy.device)
        # W o W(step)^-1: the step moves the template, so its inverse moves the image window
        determinant = increment[:, 0, 0] * increment[:, 1, 1] - increment[:, 0, 1] * increment[:, 1, 0]
        safe = torch.where(determinant.abs() < 0.1, torch.ones_like(determinant), determinant)
        adjugate = torch.stack(
            [increment[:, 1, 1], -increment[:, 0, 1], -increment[:, 1, 0], increment[:, 0, 0]], -1
        ).reshape(-1, 2, 2)
        deform = deform @ (adjugate / safe[:, None, None])
        centre = centre - (deform @ step[:, 4:, None])[..., 0]
    points = centre[:, None] + grid @ deform.mT
    current, _ = _standardise(sample_image(image, points), templates.weights)
    total = templates.weights.sum(-1).clamp_min(_TINY)
    score = (templates.weights * current * templates.values).sum(-1) / total
    return centre, deform, score, current - templates.values
