"""Edge-preserving smoothing of a depth map with holes (paper, eqs. 13-16)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch.utils.checkpoint import checkpoint

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["BilateralParams", "bilateral_depth"]


@dataclass(frozen=True)
class BilateralParams:
    """Parameters of :func:`bilateral_depth`.

    Attributes:
        s_space: standard deviation of the spatial kernel, pixels.
        s_range: standard deviation of the range kernel, metres.
        radius: half width of the square window, pixels; None means ``ceil(3 s_space)``.
        paper_literal_sigma: read ``s_space`` and ``s_range`` as the paper prints (15) and (16), where sigma is not
            squared: they are then variances, px^2 and m^2.
    """

    s_space: float = 1.5
    s_range: float = 0.05
    radius: int | None = None
    paper_literal_sigma: bool = False


def bilateral_depth(
    depth: Float[Tensor, "*b height width"],
    valid: Bool[Tensor, "*b height width"] | None = None,
    params: BilateralParams | None = None,
) -> Float[Tensor, "*b height width"]:
    """Bilateral filter whose weights are zero for pixels without depth.

    The paper prints the numerator of (13) with the value at the centre pixel, which makes the filter the identity;
    here it is the value of the neighbour, and ``*`` in (14) is a product:
    ``g(p) = sum_q f(q) w(p, q) / sum_q w(p, q)`` with
    ``w(p, q) = exp(-|p - q|^2 / (2 s_space^2)) exp(-(f(p) - f(q))^2 / (2 s_range^2))``, q over the valid pixels of a
    square window. On a full mask it is ``kornia.filters.bilateral_blur`` (reflected border). It never fills a hole:
    pixels that are not valid come out as NaN. Filter the depth map first, then back-project.

    Args:
        depth: metres; values of invalid pixels are never read.
        valid: default: finite and positive depth.
        params: see :class:`BilateralParams`.

    Returns:
        metres. Differentiable; with gradients the memory is that of one row of the window, not of all its taps.

    Raises:
        ReconError: a kernel width that is not positive, or a window larger than the image.

    Example:
        >>> import torch
        >>> depth = torch.full((9, 9), 2.0)
        >>> depth[4, 4] = float("nan")
        >>> out = bilateral_depth(depth)
        >>> bool(out[4, 4].isnan()), round(float(out[4, 5]), 6)
        (True, 2.0)
    """
    params = params or BilateralParams()
    space, span = _denominators(params)
    radius = params.radius
    if radius is None:
        radius = math.ceil(3 * math.sqrt(space / 2))
    height, width = depth.shape[-2:]
    if radius < 0 or radius >= min(height, width):
        raise ReconError(f"radius: a window of {radius} px on each side does not fit a {height} x {width} depth map")
    if valid is None:
        valid = torch.isfinite(depth) & (depth > 0)
    clean = torch.where(valid, depth, torch.zeros_like(depth)).reshape(-1, 1, height, width)
    mask = valid.to(depth.dtype).reshape(-1, 1, height, width)
    pad = (radius,) * 4
    values = torch.nn.functional.pad(clean, pad, mode="reflect")
    weights = torch.nn.functional.pad(mask, pad, mode="reflect")

    def row(centre: Tensor, values: Tensor, weights: Tensor, dy: int) -> tuple[Tensor, Tensor]:
        total, norm = torch.zeros_like(centre), torch.zeros_like(centre)
        for dx in range(-radius, radius + 1):
            window = (..., slice(radius + dy, radius + dy + height), slice(radius + dx, radius + dx + width))
            neighbour = values[window]
            near = math.exp(-(dx * dx + dy * dy) / space)
            w = near * weights[window] * torch.exp(-((neighbour - centre) ** 2) / span)
            total, norm = total + w * neighbour, norm + w
        return total, norm

    total, norm = torch.zeros_like(clean), torch.zeros_like(clean)
    for dy in range(-radius, radius + 1):
        if clean.requires_grad and torch.is_grad_enabled():
            part, weight = checkpoint(row, clean, values, weights, dy, use_reentrant=False)
        else:
            part, weight = row(clean, values, weights, dy)
        total, norm = total + part, norm + weight
    # a valid pixel always has its own weight 1, so the division is safe exactly where the result is used
    smooth = total / torch.where(mask > 0, norm, torch.ones_like(norm))
    return torch.where(valid, smooth.reshape(depth.shape), depth.new_tensor(float("nan")))


def _denominators(params: BilateralParams) -> tuple[float, float]:
    """What (15) and (16) divide by: px^2 and m^2."""
    for name in ("s_space", "s_range"):
        if not getattr(params, name) > 0:
            raise ReconError(f"{name}: {getattr(params, name)} is not positive")
    if params.paper_literal_sigma:
        return 2 * params.s_space, 2 * params.s_range
    return 2 * params.s_space**2, 2 * params.s_range**2
