"""Minimum description length (Wax and Kailath 1985): scale free, asymptotic in the number of samples."""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["mdl_count"]


def mdl_count(eigenvalues: Float[Tensor, " d"], samples: int) -> tuple[int, Float[Tensor, " d"]]:
    """The k that minimises the description length of k signals in white noise of unknown scale.

    Returns:
        (count, threshold): the threshold is the eigenvalue that would just not count, the same for all.

    Example:
        >>> import torch
        >>> mdl_count(torch.tensor([9.0, 1.05, 1.0, 0.95]), 400)[0]
        1
    """
    d = len(eigenvalues)
    values = eigenvalues.clamp(min=torch.finfo(eigenvalues.dtype).tiny)
    lengths = []
    for k in range(d):
        rest = values[k:]
        ratio = float(rest.log().mean() - rest.mean().log())
        lengths.append(-samples * (d - k) * ratio + 0.5 * k * (2 * d - k) * math.log(samples))
    count = min(range(d), key=lengths.__getitem__)
    return count, torch.full_like(values, float(values[count]))
