"""Optimal hard threshold of singular values (Gavish and Donoho 2014): the count that denoises best."""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.rank.tracy_widom import median_noise

__all__ = ["gavish_donoho_count"]


def gavish_donoho_count(
    eigenvalues: Float[Tensor, " d"], samples: int, noise: float | None
) -> tuple[int, Float[Tensor, " d"]]:
    """Count eigenvalues above ``noise lambda(d / n)^2``, lambda^2 being 16/3 for a square matrix.

    A basis between the edge of the noise and this threshold is real, but keeping it adds more noise to the completed
    matrix than it explains; so this rule counts less than the tests do.

    Args:
        eigenvalues: descending, whitened.
        samples: n.
        noise: variance of the whitened noise; None reads it off the median eigenvalue.

    Example:
        >>> import torch
        >>> gavish_donoho_count(torch.tensor([9.0, 2.0, 1.0, 0.9]), 400, 1.0)[0]
        1
    """
    ratio = len(eigenvalues) / samples
    square = 2 * (ratio + 1) + 8 * ratio / (ratio + 1 + math.sqrt(ratio**2 + 14 * ratio + 1))
    scale = median_noise(eigenvalues, samples) if noise is None else noise
    threshold = torch.full_like(eigenvalues, scale * square)
    return min(int((eigenvalues > threshold).sum()), len(eigenvalues) - 1), threshold
