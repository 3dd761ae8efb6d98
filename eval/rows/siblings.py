"""Other solvers of the library on complete matrices: gaps filled as for the paper's rules, filled values as measured.

They are defined for tracks without gaps. Tracks on a turning body are mostly gaps, so what these rows show is what
filling costs, not what the methods are worth on complete tracks (``python -m eval.nrsfm`` shows that). K is estimated
from the filled matrix, by the rule that is the library's default.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

import torchrecon as tr
from eval.rows.base import Context, RowOutput
from eval.rows.papers_rules import complete
from torchrecon.measurement import Tracks

__all__ = ["solve_with"]


def solve_with(solver: str) -> Callable[[Tracks, Context], RowOutput]:
    """The row of a solver by its name."""

    def solve(tracks: Tracks, context: Context) -> RowOutput:
        whole = complete(tracks, context)
        answer = tr.reconstruct(whole, solver=solver, generator=torch.Generator().manual_seed(context.seed))
        return RowOutput(answer.points3d, tracks.visible, f"K = {answer.rank}; {answer.status}")

    return solve
