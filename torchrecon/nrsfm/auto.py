"""The default solver: picks what the tracks allow, one configuration for everything."""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Int, Tensor
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.bridging import bridging
from torchrecon.nrsfm.dense import DenseParams, solve_dense
from torchrecon.nrsfm.marginal import solve_marginal
from torchrecon.nrsfm.trajectory import solve_trajectories
from torchrecon.nrsfm.windows import WindowParams, solve_windows

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
    """Orthographic tracks of points that are mostly seen together: marginal likelihood of low-rank shapes, in windows
    where they are long and through a sample of the points where those are many; anything else, bands of short tracks,
    pinholes and measured depth: Gaussian-process trajectories."""
    return solve_items(tracks, rank, _solve_one, generator)


def _solve_one(item: Tracks, rank: int, generator: torch.Generator) -> Reconstruction:
    if item.intrinsics is not None or not meet(item.visible):
        return solve_trajectories(item, rank, generator)
    return bridging(_in_windows)(item, rank, generator)


def _in_windows(item: Tracks, rank: int, generator: torch.Generator) -> Reconstruction:
    if item.frames > WindowParams().longest:
        return solve_windows(item, rank, generator, _together)
    return _together(item, rank, generator)


def _together(item: Tracks, rank: int, generator: torch.Generator) -> Reconstruction:
    if item.points > DenseParams().most:
        return solve_dense(item, rank, generator, solve_marginal)
    return solve_marginal(item, rank, generator)
