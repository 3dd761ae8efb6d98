"""The default solver: picks what the tracks allow, one configuration for everything."""

from __future__ import annotations

import torch

from torchrecon._typing import Int, Tensor
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.lowrank import solve_complete
from torchrecon.nrsfm.trajectory import solve_trajectories

__all__ = ["auto"]


def auto(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Complete orthographic tracks: log-determinant descent; anything else: Gaussian-process trajectories."""

    def solve_one(item: Tracks, k: int, source: torch.Generator) -> Reconstruction:
        if bool(item.visible.all()) and item.intrinsics is None:
            return solve_complete(item, k, source)
        return solve_trajectories(item, k, source)

    return solve_items(tracks, rank, solve_one, generator)
