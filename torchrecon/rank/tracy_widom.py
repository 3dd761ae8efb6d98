"""Sequential Tracy-Widom test with a known noise scale, or with one read off the median eigenvalue."""

from __future__ import annotations

import numpy as np

from torchrecon._typing import Float, Tensor
from torchrecon.linalg.noise_edge import count_signals

__all__ = ["median_noise", "tracy_widom_count"]


def median_noise(eigenvalues: Float[Tensor, " d"], samples: int) -> float:
    """Noise variance from the median eigenvalue and the median of the Marchenko-Pastur law (Gavish and Donoho).

    It is not disturbed by signals as long as they are fewer than about a fifth of the eigenvalues.

    Example:
        >>> import torch
        >>> values = torch.linalg.svdvals(2 * torch.randn(800, 200, generator=torch.Generator().manual_seed(0)))
        >>> round(median_noise(values**2 / 800, 800), 1)
        4.0
    """
    ratio = len(eigenvalues) / samples
    low, high = (1 - ratio**0.5) ** 2, (1 + ratio**0.5) ** 2
    # substitution x = middle + half cos(t) takes the square-root ends out of the density
    t = np.linspace(0, np.pi, 4001)
    x = (low + high) / 2 - (high - low) / 2 * np.cos(t)
    density = np.where(x > 0, np.sin(t) ** 2 / np.maximum(x, 1e-12), 0.0)
    mass = np.cumsum(density)
    middle = float(np.interp(0.5, mass / mass[-1], x))
    return float(eigenvalues.median()) / middle


def tracy_widom_count(
    eigenvalues: Float[Tensor, " d"], samples: int, noise: float | None
) -> tuple[int, Float[Tensor, " d"]]:
    """Count leading eigenvalues above the 95 % Tracy-Widom edge of those that remain.

    Args:
        eigenvalues: descending, whitened.
        samples: n.
        noise: variance of the whitened noise, 1 where the covariance is trusted; None: :func:`median_noise`.
    """
    scale = median_noise(eigenvalues, samples) if noise is None else noise
    return count_signals(eigenvalues, samples, scale)
