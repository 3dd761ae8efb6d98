"""Singular values pulled towards zero: the step of every nuclear-norm minimisation."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["shrink_singular_values"]


def shrink_singular_values(
    matrix: Float[Tensor, "*b rows columns"], threshold: float | Float[Tensor, "*b"]
) -> Float[Tensor, "*b rows columns"]:
    """Subtract ``threshold`` from every singular value and cut at zero: the proximal map of the nuclear norm.

    Works on the Gram matrix of the shorter side, an order faster than an SVD; singular values below the square root
    of the machine precision times the largest are not resolved, and must be below the threshold to be right.

    Example:
        >>> import torch
        >>> shrink_singular_values(torch.diag(torch.tensor([3.0, 1.0, 0.5])), 1.0).diagonal().round(decimals=5).tolist()
        [2.0, 0.0, 0.0]
    """
    wide = matrix.shape[-2] <= matrix.shape[-1]
    square, vectors = torch.linalg.eigh(matrix @ matrix.mT if wide else matrix.mT @ matrix)
    values = square.clamp_min(torch.finfo(matrix.dtype).tiny).sqrt()
    keep = (1 - torch.as_tensor(threshold, dtype=matrix.dtype, device=matrix.device)[..., None] / values).clamp_min(0)
    shrink = (vectors * keep[..., None, :]) @ vectors.mT
    return shrink @ matrix if wide else matrix @ shrink
