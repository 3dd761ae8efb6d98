"""Non-rigid structure from motion: one method a file, one contract for all (see ``base``)."""

from __future__ import annotations

from difflib import get_close_matches

from torchrecon.errors import ReconError
from torchrecon.measurement import Solver
from torchrecon.nrsfm.auto import auto
from torchrecon.nrsfm.consensus import consensus
from torchrecon.nrsfm.lowrank import logdet
from torchrecon.nrsfm.pnd2 import pnd2
from torchrecon.nrsfm.rigid import rigid
from torchrecon.nrsfm.trajectory import trajectory

__all__ = ["SOLVERS", "auto", "consensus", "get_solver", "logdet", "pnd2", "rigid", "trajectory"]

SOLVERS: dict[str, Solver] = {
    "auto": auto,
    "consensus": consensus,
    "logdet": logdet,
    "pnd2": pnd2,
    "rigid": rigid,
    "trajectory": trajectory,
}


def get_solver(name: str) -> Solver:
    """The solver of that name; raises ReconError that lists the names.

    Example:
        >>> get_solver("rigid").__name__
        'rigid'
    """
    if name not in SOLVERS:
        close = get_close_matches(name, SOLVERS, 1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ReconError(f"solver: {name!r} is not known{hint} Known are {', '.join(sorted(SOLVERS))}")
    return SOLVERS[name]
