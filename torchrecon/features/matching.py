"""Descriptor matching: nearest neighbours with the ratio test, mutual, inside gates."""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Float, Int, Tensor

__all__ = ["match_descriptors"]


def match_descriptors(
    first: Float[Tensor, "n dim"],
    second: Float[Tensor, "m dim"],
    ratio: float = 0.8,
    mutual: bool = True,
    allowed: Bool[Tensor, "n m"] | None = None,
) -> tuple[Int[Tensor, "matches 2"], Float[Tensor, " matches"]]:
    """Pairs (i, j) of descriptors that are nearest to each other and clearly nearer than the second nearest.

    Args:
        first: descriptors of one image.
        second: descriptors of the other.
        ratio: nearest distance over second nearest must be below this (Lowe 2004: 0.8); 1 switches it off.
        mutual: i must also be the nearest of j.
        allowed: pairs inside the gate; others are not considered, neither as match nor as second nearest.

    Returns:
        index pairs, sorted by i; their distances.

    Example:
        >>> import torch
        >>> a = torch.eye(4)[:3]
        >>> match_descriptors(a, a[[2, 0]])[0].tolist()
        [[0, 1], [2, 0]]
    """
    if first.shape[0] == 0 or second.shape[0] == 0:
        return torch.zeros(0, 2, dtype=torch.long, device=first.device), first.new_zeros(0)
    distance = torch.cdist(first, second)
    if allowed is not None:
        distance = distance.masked_fill(~allowed, torch.inf)
    nearest, index = distance.min(1)
    good = torch.isfinite(nearest)
    if second.shape[0] > 1:
        runner_up = distance.topk(2, dim=1, largest=False).values[:, 1]
        good &= nearest < ratio * runner_up
    if mutual:
        back = distance.min(0).indices
        good &= back[index] == torch.arange(len(first), device=first.device)
    rows = good.nonzero()[:, 0]
    return torch.stack([rows, index[rows]], -1), nearest[rows]
