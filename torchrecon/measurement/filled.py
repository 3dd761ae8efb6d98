"""Tracks whose gaps carry an estimate."""

from __future__ import annotations

from dataclasses import dataclass

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["FilledTracks"]


@dataclass(frozen=True, eq=False)
class FilledTracks:
    """Every entry of the tracks with a value and a covariance; filled values are not measurements.

    Attributes:
        xy: (*batch, frames, points, 2) pixels; measured entries are unchanged.
        covariance: (*batch, frames, points, 2, 2) px^2; grows into a gap.
        filled: (*batch, frames, points) true where the value is an estimate.
        low_confidence: (*batch, frames, points) true where the estimate should not be relied on.
    """

    xy: Float[Tensor, "*batch frames points 2"]
    covariance: Float[Tensor, "*batch frames points 2 2"]
    filled: Bool[Tensor, "*batch frames points"]
    low_confidence: Bool[Tensor, "*batch frames points"]
