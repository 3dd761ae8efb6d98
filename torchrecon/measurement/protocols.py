"""The callables that stages hand to one another."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch

from torchrecon._typing import Int, Tensor
from torchrecon.measurement.belief import ShapeBelief
from torchrecon.measurement.filled import FilledTracks
from torchrecon.measurement.rank_estimate import RankEstimate
from torchrecon.measurement.reconstruction import Reconstruction
from torchrecon.measurement.tracks import Tracks

__all__ = ["GapFiller", "RankRule", "ShapePrior", "Solver"]


@runtime_checkable
class Solver(Protocol):
    """From tracks and a number of shape bases to 3D: every file in ``torchrecon.nrsfm`` offers one."""

    def __call__(
        self, tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
    ) -> Reconstruction: ...


@runtime_checkable
class RankRule(Protocol):
    """From tracks to the number of shape bases: every file in ``torchrecon.rank`` offers one."""

    def __call__(self, tracks: Tracks) -> RankEstimate: ...


@runtime_checkable
class GapFiller(Protocol):
    """From tracks with gaps to a value and a covariance for every entry: every file in ``torchrecon.gaps``."""

    def __call__(self, tracks: Tracks) -> FilledTracks: ...


@runtime_checkable
class ShapePrior(Protocol):
    """From the tracks of one sequence to a Gaussian over its points: ``torchrecon.models.prior`` offers one."""

    def __call__(self, tracks: Tracks) -> ShapeBelief: ...
