"""Points to pictures: a sum of Gaussians, differentiable in positions and weights.

A picture made this way needs no names, no edges and no fixed number of points, so shapes from any method, or from
the truth, become comparable pictures.
"""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["splat"]


def splat(
    xy: Float[Tensor, "*batch points 2"],
    weights: Float[Tensor, "*batch points"],
    size: tuple[int, int],
    sigma: float = 1.0,
) -> Float[Tensor, "*batch height width"]:
    """Spread the weight of each point over the pixels as a Gaussian.

    Each pixel takes the integral of the Gaussian over its square, so the picture sums to the weight that falls
    inside it, exactly, for any ``sigma``. Points of weight 0 are not read: they may be NaN.

    Args:
        xy: positions, x right, y down, pixels; integer coordinates are pixel centres.
        weights: mass of each point, any unit.
        size: (height, width) of the pictures.
        sigma: standard deviation of the Gaussian, pixels, > 0.

    Returns:
        Pictures in the unit of ``weights`` per pixel.

    Raises:
        ReconError: ``sigma`` or ``size`` is not positive.

    Example:
        >>> picture = splat(torch.tensor([[4.0, 2.0]]), torch.ones(1), (5, 9), sigma=0.5)
        >>> divmod(int(picture.argmax()), 9), round(float(picture.sum()), 3)
        ((2, 4), 1.0)
    """
    height, width = size
    if not (sigma > 0 and height > 0 and width > 0):
        raise ReconError(f"splat: sigma {sigma} and size {size} must be positive")
    used = weights != 0
    xy = torch.where(used[..., None], xy, torch.zeros_like(xy))
    along_x = _pixel_shares(xy[..., 0], width, sigma)
    along_y = _pixel_shares(xy[..., 1], height, sigma)
    # A Gaussian is a product of its axes, so the sum over points is one matrix product per picture.
    return (along_y * weights[..., None, :]) @ along_x.transpose(-1, -2)


def _pixel_shares(
    position: Float[Tensor, "*batch points"], count: int, sigma: float
) -> Float[Tensor, "*batch pixels points"]:
    """The share of a unit Gaussian at ``position`` that falls into each of ``count`` pixels of one axis."""
    edges = torch.arange(count + 1, dtype=position.dtype, device=position.device) - 0.5
    below = torch.special.erf((edges[:, None] - position[..., None, :]) / (sigma * math.sqrt(2.0))) / 2
    shares: Tensor = below.diff(dim=-2)
    return shares
