"""The paper's covariance of a tracked point: the inverse of the brightness Hessian (eq. 22), made usable."""

from __future__ import annotations

from dataclasses import dataclass

import kornia
import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.noise.structure_tensor import clamp_covariance, grey_image

__all__ = ["HessianParams", "hessian_covariance"]


@dataclass(frozen=True)
class HessianParams:
    """Parameters of :func:`hessian_covariance`.

    Attributes:
        smoothing: standard deviation of the Gaussian before differentiation, pixels.
        grey_levels: what one unit of the image's intensity is in grey levels of an 8-bit image; the unit of Q
            depends on it, which the paper does not state.
        min_std: smallest standard deviation that is reported, pixels.
        max_std: largest one, pixels.
    """

    smoothing: float = 1.5
    grey_levels: float = 255.0
    min_std: float = 0.05
    max_std: float = 10.0


def hessian_covariance(
    image: Float[Tensor, "channels height width"],
    xy: Float[Tensor, "points 2"],
    params: HessianParams | None = None,
) -> tuple[Float[Tensor, "points 2 2"], Bool[Tensor, " points"]]:
    """``Q = H^-1`` with the absolute eigenvalues of the brightness Hessian (paper, eq. 22). A heuristic.

    As printed, H is negative definite at a bright blob and indefinite at a corner or an edge, so its inverse is no
    covariance; here the eigenvalues are replaced by their absolute values. The scale is that of the image's
    intensities, not of its noise: use :func:`torchrecon.noise.structure_tensor_covariance` for a covariance that
    means something, this one to see what the paper's does.

    Args:
        image: intensities in [0, 1] (see ``grey_levels``).
        xy: pixels; a NaN position gives a NaN covariance.

    Returns:
        (covariance, capped): px^2, symmetric positive definite; ``capped`` where H is almost singular.

    Example:
        >>> import torch
        >>> v, u = torch.meshgrid(torch.arange(41.0), torch.arange(41.0), indexing="ij")
        >>> blob = torch.exp(-((u - 20) ** 2 + (v - 20) ** 2) / (2 * 4.0**2))[None]
        >>> q, _ = hessian_covariance(blob, torch.tensor([[20.0, 20.0]]), HessianParams(smoothing=0.0))
        >>> round(float(q[0, 0, 0]) * 255 / 16, 1)
        1.0
    """
    params = params or HessianParams()
    if params.smoothing < 0:
        raise ReconError(f"smoothing: {params.smoothing} px is negative")
    level = grey_image(image) * params.grey_levels
    if params.smoothing > 0:
        size = 2 * int(3 * params.smoothing + 0.5) + 1
        level = kornia.filters.gaussian_blur2d(level, (size, size), (params.smoothing, params.smoothing))
    second = kornia.filters.spatial_gradient(level, "diff", order=2, normalized=True)[:, 0]
    height, width = level.shape[-2:]
    known = torch.isfinite(xy).all(-1)
    position = torch.where(known[:, None], xy, xy.new_zeros(2))
    span = position.new_tensor([max(width - 1, 1), max(height - 1, 1)])
    grid = (2 * position / span - 1)[None, :, None].to(second)
    xx, xy_, yy = torch.nn.functional.grid_sample(second, grid, padding_mode="border", align_corners=True)[0, :, :, 0]
    hessian = torch.stack([torch.stack([xx, xy_], -1), torch.stack([xy_, yy], -1)], -2)
    values, vectors = torch.linalg.eigh(hessian)
    # far below any cap, so that a flat patch becomes "capped" instead of a division by zero
    inverse = 1 / values.abs().clamp(min=1e-3 / params.max_std**2)
    covariance, capped = clamp_covariance(
        (vectors * inverse[..., None, :]) @ vectors.transpose(-1, -2), params.min_std, params.max_std
    )
    return torch.where(known[:, None, None], covariance, covariance.new_tensor(float("nan"))), capped & known
