"""The noise covariance C of a whole frame and its inverse (paper, eqs. 23-24), as P blocks of 2x2.

Points are independent, so the 2P x 2P matrix of (23) in the order ``[u_1 .. u_P, v_1 .. v_P]`` holds four diagonal
blocks and its inverse (24) holds the inverses of P small matrices. Neither is ever formed.
"""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["inverse_blocks", "mean_blocks"]


def mean_blocks(
    covariance: Float[Tensor, "*batch frames points 2 2"], visible: Bool[Tensor, "*batch frames points"] | None = None
) -> Float[Tensor, "*batch points 2 2"]:
    """C of (23): the mean over the frames of each point's covariance, over the frames where it was seen.

    The mean is right for the second moments of (20), where the covariances of the frames add up linearly.

    Args:
        covariance: px^2.
        visible: default: all entries.

    Raises:
        ReconError: a point that is never seen.

    Example:
        >>> import torch
        >>> q = torch.eye(2).expand(3, 5, 2, 2) * torch.tensor([1.0, 2.0, 6.0])[:, None, None, None]
        >>> mean_blocks(q)[0].tolist()
        [[3.0, 0.0], [0.0, 3.0]]
    """
    if visible is None:
        return covariance.mean(-4)
    count = visible.sum(-2)
    if (count == 0).any():
        raise ReconError(f"visible: point {int((count == 0).nonzero()[0, -1])} is never seen; drop it")
    kept = torch.where(visible[..., None, None], covariance, torch.zeros_like(covariance))
    return kept.sum(-4) / count[..., None, None]


def inverse_blocks(blocks: Float[Tensor, "*batch points 2 2"]) -> Float[Tensor, "*batch points 2 2"]:
    """C^-1 of (24), block by block.

    Args:
        blocks: px^2, each symmetric positive definite.

    Raises:
        ReconError: a block that is not positive definite.

    Example:
        >>> import torch
        >>> inverse_blocks(torch.tensor([[[2.0, 0.0], [0.0, 4.0]]])).tolist()
        [[[0.5, -0.0], [-0.0, 0.25]]]
    """
    a, b, d = blocks[..., 0, 0], blocks[..., 0, 1], blocks[..., 1, 1]
    determinant = a * d - b * b
    wrong = ~((a > 0) & (determinant > 0))
    if wrong.any():
        where = tuple(int(i) for i in wrong.nonzero()[0])
        raise ReconError(f"covariance: block {where} is not positive definite; its inverse does not exist")
    rows = [torch.stack([d, -b], -1), torch.stack([-b, a], -1)]
    return torch.stack(rows, -2) / determinant[..., None, None]
