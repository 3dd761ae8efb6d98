"""Non-rigid structure from motion: one method a file, one contract for all (see ``base``)."""

from __future__ import annotations

from difflib import get_close_matches

from torchrecon.errors import ReconError
from torchrecon.measurement import Solver
from torchrecon.nrsfm.auto import auto
from torchrecon.nrsfm.bmm import bmm
from torchrecon.nrsfm.consensus import consensus
from torchrecon.nrsfm.csf import csf
from torchrecon.nrsfm.em_ppca import em_ppca
from torchrecon.nrsfm.lowrank import logdet
from torchrecon.nrsfm.marginal import marginal
from torchrecon.nrsfm.pnd2 import pnd2
from torchrecon.nrsfm.pta import pta
from torchrecon.nrsfm.rigid import rigid
from torchrecon.nrsfm.trajectory import trajectory

__all__ = [
    "SOLVERS",
    "auto",
    "bmm",
    "consensus",
    "csf",
    "em_ppca",
    "get_solver",
    "logdet",
    "marginal",
    "pnd2",
    "pta",
    "rigid",
    "trajectory",
]

SOLVERS: dict[str, Solver] = {
    "auto": auto,
    "bmm": bmm,
    "consensus": consensus,
    "csf": csf,
    "em_ppca": em_ppca,
    "logdet": logdet,
    "marginal": marginal,
    "pnd2": pnd2,
    "pta": pta,
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
