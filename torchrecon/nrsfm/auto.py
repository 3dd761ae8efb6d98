"""The default solver: picks what the tracks allow, one configuration for everything."""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Int, Tensor
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.marginal import solve_marginal
from torchrecon.nrsfm.trajectory import solve_trajectories

__all__ = ["auto", "meet"]

SHARED_FRAMES, SHARED_SHARE, SHARED_PAIRS = 8, 0.1, 0.9
SAMPLE = 500  # points from which the pairs are taken


def meet(visible: Bool[Tensor, "frames points"]) -> bool:
    """Whether most pairs of points are seen together often enough to share one family of shapes.

    True where 90 % of the pairs share at least 8 frames and a tenth of all; tracks that are born and die on a turning
    body do not.

    Example:
        >>> import torch
        >>> bands = (torch.arange(60)[:, None] - torch.arange(0, 60, 2)).abs() < 8
        >>> meet(torch.ones(60, 30, dtype=torch.bool)), meet(bands)
        (True, False)
    """
    seen = visible[:, visible.any(0)]
    seen = seen[:, :: max(1, seen.shape[1] // SAMPLE)].to(torch.float64)
    needed = min(len(seen), max(SHARED_FRAMES, SHARED_SHARE * len(seen)))
    return bool((seen.mT @ seen >= needed).double().mean() >= SHARED_PAIRS)


def auto(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Orthographic tracks of points that are mostly seen together: marginal likelihood of low-rank shapes; anything
    else, bands of short tracks, pinholes and measured depth: Gaussian-process trajectories."""

    def solve_one(item: Tracks, k: int, source: torch.Generator) -> Reconstruction:
        if item.intrinsics is None and meet(item.visible):
            return solve_marginal(item, k, source)
        return solve_trajectories(item, k, source)

    return solve_items(tracks, rank, solve_one, generator)
