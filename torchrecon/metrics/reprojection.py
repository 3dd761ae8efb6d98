"""Do points of a reconstruction fall where the camera saw them? Higher is better; unit: per cent."""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement.camera import normalised_coordinates

__all__ = ["matching_degree", "place_in_view"]


def place_in_view(
    points3d: Float[Tensor, "*batch frames points 3"],
    xy: Float[Tensor, "*batch frames points 2"],
    seen: Bool[Tensor, "*batch frames points"],
    intrinsics: Float[Tensor, "*batch 3 3"],
) -> Float[Tensor, "*batch frames 3"]:
    """The translation of each frame that brings its shape onto what was seen of it, without any truth.

    Linear least squares: ``n (z + t_z) = x + t_x`` for normalised image coordinates ``n``, likewise for y. Neither
    rotation nor scale is touched; an answer in another unit is placed at another distance.

    Args:
        points3d: camera axes, any one unit; read where ``seen``.
        xy: pixels, read where ``seen``.

    Raises:
        ReconError: a seen entry is not finite, or a frame has fewer than two seen points.

    Example:
        >>> import torch
        >>> shape = torch.randn(1, 5, 3, generator=torch.Generator().manual_seed(0))
        >>> k = torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
        >>> image = (shape + torch.tensor([0.0, 1.0, 9.0])) @ k.mT
        >>> placed = place_in_view(shape, image[..., :2] / image[..., 2:], torch.ones(1, 5, dtype=torch.bool), k)
        >>> bool(torch.allclose(placed, torch.tensor([0.0, 1.0, 9.0]), atol=1e-3))
        True
    """
    finite = torch.isfinite(points3d).all(-1) & torch.isfinite(xy).all(-1)
    if (seen & ~finite).any():
        where = tuple(int(i) for i in (seen & ~finite).nonzero()[0])
        raise ReconError(f"points3d: entry {where} is seen and not finite; leave it out of seen")
    if (seen.sum(-1) < 2).any():
        where = tuple(int(i) for i in (seen.sum(-1) < 2).nonzero()[0])
        raise ReconError(f"seen: frame {where} shows fewer than two points; it cannot be placed")
    mask = seen[..., None]
    plane = torch.where(mask, normalised_coordinates(xy, intrinsics[..., None, None, :, :]), torch.zeros_like(xy))
    shape = torch.where(mask, points3d, torch.zeros_like(points3d))
    weight = mask.to(xy.dtype)
    # Two equations a point: t_x - n_x t_z = n_x z - x, and the same in y.
    right = plane * shape[..., 2:] - shape[..., :2]
    across = -plane.sum(-2)
    count = weight.sum(-2)
    zero = torch.zeros_like(count[..., 0])
    rows = [
        torch.stack([count[..., 0], zero, across[..., 0]], -1),
        torch.stack([zero, count[..., 0], across[..., 1]], -1),
        torch.stack([across[..., 0], across[..., 1], plane.square().sum((-1, -2))], -1),
    ]
    target = torch.cat([right.sum(-2), -(plane * right).sum((-1, -2))[..., None]], -1)
    return torch.linalg.solve(torch.stack(rows, -2), target[..., None])[..., 0]


def matching_degree(
    projected: Float[Tensor, "*batch points 2"],
    truth: Float[Tensor, "*batch points 2"],
    chosen: Bool[Tensor, "*batch points"],
    threshold: float = 3.0,
) -> Float[Tensor, "*batch"]:
    """Share of points that a reconstruction projects to within 3 px of where they are ("pixel matching degree").

    Alignment: none. Meant for points that were left out of the solve: what was given matches itself.

    Args:
        projected: pixels; a point without a finite position is a miss.
        truth: pixels, read where ``chosen``.
        chosen: points that count.
        threshold: pixels.

    Returns:
        Per cent; NaN where no point is chosen.

    Example:
        >>> import torch
        >>> off = torch.tensor([[0.0, 2.9], [3.1, 0.0], [torch.nan, 0.0], [9.0, 9.0]])
        >>> round(float(matching_degree(off, torch.zeros(4, 2), torch.tensor([True, True, True, False]))), 2)
        33.33
    """
    near = (projected - truth).square().sum(-1).sqrt() <= threshold
    return 100.0 * (near & chosen).sum(-1) / chosen.sum(-1).to(truth.dtype)
