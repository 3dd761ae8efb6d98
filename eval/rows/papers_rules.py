"""Paper's rules: K by eqs. 25-27, gaps by the alpha-beta-gamma filter, Hessian covariance, filled values as measured.

The paper has no reconstruction equation. What it does say is followed to the letter: the covariance of (22), the
prediction of (28)-(30) in place of every missing entry, the count of eigenvalues above one; then the library's
factorisation is given the complete matrix and that K.
"""

from __future__ import annotations

from dataclasses import replace

import torch

import torchrecon as tr
from eval.rows.base import Context, RowOutput, without_depth
from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks

__all__ = ["complete", "solve"]


def complete(tracks: Tracks, context: Context) -> Tracks:
    """Every entry with a value and the paper's covariance, filled values marked as measurements."""
    if context.filled is None:
        raise ReconError("paper's rules: need complete matrices; pass context.filled")
    return replace(
        without_depth(tracks),
        xy=context.filled.xy,
        visible=torch.ones_like(tracks.visible),
        covariance=context.filled.covariance,
    )


def solve(tracks: Tracks, context: Context) -> RowOutput:
    """The row."""
    whole = complete(tracks, context)
    estimate = tr.estimate_rank(whole, rule="paper")
    answer = tr.reconstruct(whole, rank=int(estimate.rank), generator=torch.Generator().manual_seed(context.seed))
    return RowOutput(answer.points3d, tracks.visible, f"K = {estimate.rank}; {answer.status}")
