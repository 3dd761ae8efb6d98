"""Depth at tracked points, refused where the surface breaks off."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError

__all__ = ["SampleParams", "sample_depth"]


@dataclass(frozen=True)
class SampleParams:
    """Parameters of :func:`sample_depth`.

    Attributes:
        radius: half width of the window of the plane fit, pixels.
        jump: depth difference of neighbouring pixels that is a discontinuity, metres.
        jump_relative: the same as a fraction of the depth; the larger of the two counts.
        noise_floor: smallest standard deviation that is reported, metres.
        around: where the surface under a position is not clear, depth and variance are those of all pixels about it
            in a Gaussian window of this standard deviation, pixels; 0: such positions have none.
    """

    radius: int = 2
    jump: float = 0.04
    jump_relative: float = 0.01
    noise_floor: float = 0.001
    around: float = 0.0


def sample_depth(
    depth: Float[Tensor, "*b height width"], xy: Float[Tensor, "*b points 2"], params: SampleParams | None = None
) -> tuple[Float[Tensor, "*b points"], Float[Tensor, "*b points"]]:
    """Depth under sub-pixel positions, by a plane through the pixels of the same surface.

    The result is NaN where the position is outside the image or NaN, where its nearest pixel has no depth, where the
    depth jumps between that pixel and one that touches it (the position could lie on either surface), and where fewer
    than six pixels belong to the surface; with ``params.around`` it is then that of the pixels around, with a variance
    that spans the surfaces among them. Pixels of the window that are further than a jump from the centre pixel, per
    pixel of distance, are not used.

    Args:
        depth: metres; NaN, zero and negative mean "none".
        xy: pixels, integer pixel centres.

    Returns:
        (depth, variance): metres and m^2. The variance is that of one pixel about the plane, not divided by the
        number of pixels, since the noise of depth sensors is correlated over a few pixels.

    Example:
        >>> import torch
        >>> depth = torch.full((8, 10), 3.0)
        >>> depth[:, 6:] = 5.0
        >>> z, _ = sample_depth(depth, torch.tensor([[2.3, 4.0], [5.4, 4.0], [20.0, 4.0]]))
        >>> [round(x, 3) for x in z.tolist()]
        [3.0, nan, nan]
    """
    params = params or SampleParams()
    if params.radius < 1:
        raise ReconError(f"radius: {params.radius}; a window of at least one pixel on each side is needed")
    nan = depth.new_tensor(float("nan"))
    depth = torch.where(depth > 0, depth, nan)
    window, u, v = _window(depth, xy, params.radius)
    middle = [window.shape[-1] // 2]
    centre = window[..., middle]
    ring = torch.maximum((u - u[..., middle]).abs(), (v - v[..., middle]).abs())
    limit = torch.clamp(params.jump_relative * centre, min=params.jump)
    difference = (window - centre).abs()
    broken = ((difference > limit) & (ring <= 1)).any(-1)
    # comparisons with NaN are false, so pixels without depth drop out here
    use = difference <= limit * ring.clamp(min=1)

    weight = use.to(depth.dtype)
    rest_u = u.to(xy.dtype) - torch.nan_to_num(xy[..., :1])
    rest_v = v.to(xy.dtype) - torch.nan_to_num(xy[..., 1:])
    design = torch.stack([torch.ones_like(rest_u), rest_u, rest_v], -1).to(depth.dtype) * weight[..., None]
    rise = torch.where(use, window - centre, torch.zeros_like(window))
    normal = design.transpose(-1, -2) @ design
    # the ridge decides only where the pixels lie on a line and a slope is not determined
    normal = normal + 1e-6 * torch.eye(3, dtype=depth.dtype, device=depth.device)
    plane = torch.linalg.solve(normal, (design * rise[..., None]).sum(-2))
    residual = (rise - (design @ plane[..., None])[..., 0]) * weight
    count = weight.sum(-1)
    variance = (residual**2).sum(-1) / (count - 3).clamp(min=1)
    good = ~broken & (count >= 6) & torch.isfinite(centre[..., 0])
    value = torch.where(good, centre[..., 0] + plane[..., 0], nan)
    variance = torch.where(good, variance.clamp(min=params.noise_floor**2), nan)
    if params.around > 0:
        near, spread = _around(depth, xy, params)
        value, variance = torch.where(good, value, near), torch.where(good, variance, spread)
    return value, variance


def _window(
    depth: Float[Tensor, "*b height width"], xy: Float[Tensor, "*b points 2"], radius: int
) -> tuple[Float[Tensor, "*b points window"], Int[Tensor, "*b points window"], Int[Tensor, "*b points window"]]:
    """Depth of the pixels about positions, row by row, NaN outside the image, and their columns and rows."""
    height, width = depth.shape[-2:]
    nearest = torch.nan_to_num(xy, nan=-1e6).round().long()
    reach = torch.arange(-radius, radius + 1, device=depth.device)
    dv, du = (grid.flatten() for grid in torch.meshgrid(reach, reach, indexing="ij"))
    u, v = nearest[..., 0, None] + du, nearest[..., 1, None] + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
    window = torch.gather(depth.flatten(-2), -1, index.flatten(-2)).view(index.shape)
    return torch.where(inside, window, torch.nan), u, v


def _around(
    depth: Float[Tensor, "*b height width"], xy: Float[Tensor, "*b points 2"], params: SampleParams
) -> tuple[Float[Tensor, "*b points"], Float[Tensor, "*b points"]]:
    """Mean and variance of the depth in a Gaussian window; NaN where not even a twentieth of its weight has one."""
    window, u, v = _window(depth, xy, math.ceil(3 * params.around))
    away = (u - xy[..., :1]).square() + (v - xy[..., 1:]).square()
    bell = torch.exp(-torch.nan_to_num(away, nan=0.0) / (2 * params.around**2))
    weight = torch.where(torch.isfinite(window), bell, torch.zeros_like(bell))
    total = weight.sum(-1)
    there = total > 0.05 * 2 * math.pi * params.around**2
    share = weight / total.clamp_min(torch.finfo(total.dtype).tiny)[..., None]
    clean = torch.nan_to_num(window)
    mean = (share * clean).sum(-1)
    variance = (share * (clean - mean[..., None]).square()).sum(-1) + params.noise_floor**2
    return torch.where(there, mean, torch.nan), torch.where(there, variance, torch.nan)
