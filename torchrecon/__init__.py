"""Tracked points on something that bends, in; its 3D shape over time, out.

Names are loaded on first use: ``import torchrecon`` alone loads nothing heavy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrecon.errors import ReconError
    from torchrecon.io.tracks import load_tracks
    from torchrecon.measurement import RankEstimate, Reconstruction, Status, Tracks
    from torchrecon.pipeline.reconstructor import Reconstructor, reconstruct
    from torchrecon.rank import estimate_rank

__version__ = "0.1.0"

__all__ = [
    "RankEstimate",
    "ReconError",
    "Reconstruction",
    "Reconstructor",
    "Status",
    "Tracks",
    "estimate_rank",
    "load_tracks",
    "reconstruct",
]

_HOME = {
    "RankEstimate": "torchrecon.measurement.rank_estimate",
    "ReconError": "torchrecon.errors",
    "Reconstruction": "torchrecon.measurement.reconstruction",
    "Reconstructor": "torchrecon.pipeline.reconstructor",
    "Status": "torchrecon.measurement.reconstruction",
    "Tracks": "torchrecon.measurement.tracks",
    "estimate_rank": "torchrecon.rank",
    "load_tracks": "torchrecon.io.tracks",
    "reconstruct": "torchrecon.pipeline.reconstructor",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'torchrecon' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
