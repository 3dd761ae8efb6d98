"""Sub-pixel alignment of patches with stored templates by Gauss-Newton, batched over points, and an exhaustive search.

Both are insensitive to gain and offset of the grey values: patches are compared after subtracting their weighted
mean and dividing by their weighted standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.features.patches import patch_grid, sample_image

__all__ = [
    "Templates",
    "align_window",
    "identity_warp",
    "make_templates",
    "search_translation",
    "window_weights",
]

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

    Slower than steps along the gradient, but it needs no start inside their basin of attraction: for points whose
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
        steepest: (points, samples, 12) change of the values with the warp (row by row, units of ``half``), x and y.
        pull: (points, 12, samples) least-squares map from a residual to a step.
        unbend: (points, 12, 6) what the step gains where the window is bent already: the prior pulls it straight.
        slide: (points, 2, samples) the same for a window that keeps its shape.
        structure: (points, 2, 2) sum of w g g^T over the window, grey values per pixel squared.
        structure2: (points, 2, 2) sum of w^2 g g^T.
        deviation: (points,) grey-value standard deviation of the window.
    """

    values: Tensor
    weights: Tensor
    steepest: Tensor
    pull: Tensor
    unbend: Tensor
    slide: Tensor
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


def _monomials(half: int, like: Tensor) -> Float[Tensor, "samples 5"]:
    """x, y, x^2, x y, y^2 of a patch's offsets, pixels; the squares in units of ``half`` so that all are alike."""
    x, y = patch_grid(half, like).unbind(-1)
    return torch.stack([x, y, x * x / half, x * y / half, y * y / half], -1)


def identity_warp(count: int, like: Tensor) -> Float[Tensor, "points 2 5"]:
    """Warps that leave windows as they are."""
    return torch.eye(2, 5, dtype=like.dtype, device=like.device).repeat(count, 1, 1)


def make_templates(
    image: Float[Tensor, "height width"],
    xy: Float[Tensor, "points 2"],
    half: int,
    weights: Float[Tensor, "points samples"] | None = None,
    deformation_damping: float = 0.02,
    bending_damping: float = 0.02,
    stiffness: float = 2.0,
) -> Templates:
    """Cut templates around points.

    Args:
        image: level 0 of the pyramid.
        xy: pixels.
        half: half width of the window, pixels.
        weights: which samples belong to the object, in [0, 1]; default all.
        deformation_damping: damping of the four affine parameters in a step, as a fraction of the strongest
            direction; keeps a window of little texture from shearing at will.
        bending_damping: the same of the six second-order parameters.
        stiffness: prior that holds a window straight: what a bend of one pixel at its edge costs, in squared
            standard deviations of the template summed over the window. Where the texture does not show a bend, noise
            would make one, and the centre shifts with it.
    """
    window = window_weights(half, xy)
    weight = window.expand(len(xy), -1).clone() if weights is None else window * weights
    patch, gradient = _patch_with_gradient(image, xy, half)
    values, deviation = _standardise(patch, weight)
    offset = _monomials(half, xy) / half
    gradient = gradient / deviation[:, None, None]
    columns = (gradient[..., :, None] * offset[:, None]).flatten(-2)  # the x row of the warp, then the y row
    steepest = _project_out(torch.cat([columns, gradient], -1), values, weight)
    gradient = gradient * deviation[:, None, None]
    weighted = steepest * weight[..., None]
    hessian = weighted.mT @ steepest
    strongest = hessian.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(_TINY)
    row = [deformation_damping] * 2 + [bending_damping] * 3
    damping = hessian.new_tensor(row * 2 + [1e-4] * 2)
    straight = hessian.new_tensor(([0.0] * 2 + [stiffness] * 3) * 2 + [0.0] * 2)
    inverse = torch.linalg.inv(hessian + torch.diag_embed(strongest[:, None] * damping + straight))
    pull, unbend = inverse @ weighted.mT, stiffness * inverse[..., [2, 3, 4, 7, 8, 9]]
    shift = hessian[:, 10:, 10:] + 1e-3 * strongest[:, None, None] * torch.eye(2, dtype=xy.dtype, device=xy.device)
    slide = torch.linalg.inv(shift) @ weighted.mT[:, 10:]
    outer = gradient[..., :, None] * gradient[..., None, :]
    return Templates(
        values=values,
        weights=weight,
        steepest=steepest,
        pull=pull,
        unbend=unbend,
        slide=slide,
        structure=(weight[..., None, None] * outer).sum(1),
        structure2=((weight**2)[..., None, None] * outer).sum(1),
        deviation=deviation,
    )


def align_window(
    templates: Templates,
    image: Float[Tensor, "height width"],
    xy: Float[Tensor, "points 2"],
    warp: Float[Tensor, "points 2 5"],
    half: int,
    iterations: int = 6,
    deforms: bool = True,
) -> tuple[
    Float[Tensor, "points 2"], Float[Tensor, "points 2 5"], Float[Tensor, " points"], Float[Tensor, "points samples"]
]:
    """Refine position and deformation of templates in an image by Gauss-Newton.

    The warp is affine with second-order terms: a window on a limb sees a bent surface, and an affine fit to what its
    turn does to the window shifts the centre by more the further it has turned.

    Args:
        templates: from :func:`make_templates`, with the same ``half``.
        image: level 0 of the pyramid of the current frame.
        xy: where to start, pixels.
        warp: template -> image deformation to start from: factors of x, y, x^2, x y, y^2 (squares over ``half``).
        half: half width of the window, pixels.
        iterations: steps.
        deforms: without it the warp stays as it is and only the position is refined.

    Returns:
        position; warp; correlation (-1..1); residual in standard deviations of the template.

    Source: the inverse compositional form (Baker and Matthews, IJCV 2004) of Lucas and Kanade, IJCAI 1981.
    """
    grid = _monomials(half, xy)
    centre, affine, bent = xy.clone(), warp[..., :2], warp[..., 2:]

    def residual() -> tuple[Tensor, Tensor]:
        points = centre[:, None] + grid @ torch.cat([affine, bent], -1).mT
        current, _ = _standardise(sample_image(image, points), templates.weights)
        return current, current - templates.values

    eye = torch.eye(2, dtype=xy.dtype, device=xy.device)
    for _ in range(iterations):
        if not deforms:
            step = (templates.slide @ residual()[1][..., None])[..., 0].clamp(-half / 2, half / 2)
            centre = centre - (affine @ step[..., None])[..., 0]
            continue
        # The step that would straighten the window; a window that has collapsed to a line has none, and its stretch
        # rules it out.
        back = torch.linalg.solve_ex(affine, bent)[0].flatten(-2) * half
        back = torch.where(torch.isfinite(back), back, torch.zeros_like(back))
        step = templates.pull @ residual()[1][..., None] + templates.unbend @ back[..., None]
        step = step[..., 0].clamp(-half / 2, half / 2)
        change = step[:, :10].reshape(-1, 2, 5) / half
        increment = change[..., :2] + eye
        # W o W(step)^-1: the step moves the template, so its inverse moves the image window
        determinant = increment[:, 0, 0] * increment[:, 1, 1] - increment[:, 0, 1] * increment[:, 1, 0]
        safe = torch.where(determinant.abs() < 0.1, torch.ones_like(determinant), determinant)
        adjugate = torch.stack(
            [increment[:, 1, 1], -increment[:, 0, 1], -increment[:, 1, 0], increment[:, 0, 0]], -1
        ).reshape(-1, 2, 2)
        bent = bent - affine @ change[..., 2:]  # to first order; exact where the steps end
        affine = affine @ (adjugate / safe[:, None, None])
        centre = centre - (affine @ step[:, 10:, None])[..., 0]
    current, rest = residual()
    total = templates.weights.sum(-1).clamp_min(_TINY)
    score = (templates.weights * current * templates.values).sum(-1) / total
    return centre, torch.cat([affine, bent], -1), score, rest
