"""The paper's rule: whitened eigenvalues above 1, divided by 6 (eqs. 25-27)."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["paper_count"]


def paper_count(
    eigenvalues: Float[Tensor, " d"], samples: int, frames: int
) -> tuple[int, Float[Tensor, " d"], Float[Tensor, " d"]]:
    """Count the eigenvalues of ``C^-1/2 R C^-1/2`` that exceed 1, exactly as the paper prints it.

    The count does not converge to 6K: of the noise eigenvalues, which spread by the Marchenko-Pastur law, nearly
    half stay above 1 however many frames there are. It is offered to show that, and for comparison.

    Args:
        eigenvalues: of the vector layout, ``singular^2 / samples``.
        samples: what the eigenvalues are divided by.
        frames: what the paper divides by.

    Returns:
        (count, eigenvalues, threshold), the eigenvalues as the paper scales them.

    Example:
        >>> import torch
        >>> paper_count(torch.tensor([5.0, 1.2, 0.4]), 10, 10)[0]
        2
    """
    values = eigenvalues * (samples / frames)
    return int((values > 1).sum()), values, torch.ones_like(values)
