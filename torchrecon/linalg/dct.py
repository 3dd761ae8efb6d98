"""Cosine bases of time: smooth trajectories from few numbers."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["dct_basis"]


def dct_basis(
    frames: int, count: int, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, "frames count"]:
    """The first ``count`` vectors of the orthonormal cosine transform (DCT-II), slowest first, as columns.

    Column k is proportional to ``cos(pi k (f + 1/2) / frames)``; column 0 is constant.

    Example:
        >>> import torch
        >>> basis = dct_basis(8, 3)
        >>> torch.allclose(basis.T @ basis, torch.eye(3), atol=1e-6)
        True
    """
    phase = (torch.arange(frames, dtype=dtype or torch.get_default_dtype(), device=device) + 0.5) * torch.pi / frames
    basis = torch.cos(phase[:, None] * torch.arange(count, dtype=phase.dtype, device=device)) * (2 / frames) ** 0.5
    basis[:, :1] *= 0.5**0.5
    return basis
