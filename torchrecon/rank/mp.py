"""Marchenko-Pastur rule: eigenvalues above the asymptotic edge of the noise."""

from __future__ import annotations

import math

from torchrecon._typing import Float, Tensor
from torchrecon.linalg.noise_edge import kritchman_nadler_noise

__all__ = ["mp_count"]


def mp_count(eigenvalues: Float[Tensor, " d"], samples: int, noise: float | None) -> tuple[int, Float[Tensor, " d"]]:
    """Count eigenvalues above ``noise (1 + sqrt(d / n))^2``, d and the unknown noise taken anew after each signal.

    Without the Tracy-Widom width the largest noise eigenvalue passes about every second time when d is small.

    Example:
        >>> import torch
        >>> mp_count(torch.tensor([9.0, 1.1, 1.0, 0.9]), 400, 1.0)[0]
        1
    """
    d = len(eigenvalues)
    edges, count, open_ = [], 0, True
    for k in range(d):
        scale = kritchman_nadler_noise(eigenvalues, samples, k) if noise is None else noise
        edges.append(scale * (1 + math.sqrt((d - k) / samples)) ** 2)
        open_ = open_ and k < d - 1 and float(eigenvalues[k]) > edges[k]
        count += open_
    return count, eigenvalues.new_tensor(edges)
