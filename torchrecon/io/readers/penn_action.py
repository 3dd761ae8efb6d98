"""Penn Action labels: a .mat with ``x y visibility`` (frames, 13) and ``dimensions``.

Source: Zhang, Zhu and Derpanis 2013. Coordinates count from 1 as MATLAB does; pixels here count from 0.
"""

from __future__ import annotations

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build
from torchrecon.io.readers.layouts import PENN_13
from torchrecon.io.readers.people import alone
from torchrecon.io.readers.source import Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["PENN_ACTION", "read_penn_action"]


def _sniff(source: Source) -> bool:
    return source.kind == "mat" and {"x", "y", "visibility"} <= source.arrays.keys()


def read_penn_action(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Thirteen joints a frame; joints flagged as not visible are not used.

    Raises:
        ReconError: shapes that do not fit one another.
    """
    options = options or ReadOptions()
    alone(source, options)
    x, y, seen = (numbers(source, source.arrays[key], key) for key in ("x", "y", "visibility"))
    if x.ndim != 2 or x.shape != y.shape or x.shape != seen.shape:
        raise source.error(f"x {x.shape}, y {y.shape}, visibility {seen.shape}: one shape (frames, joints) is needed")
    xy = np.stack([x, y], -1) - 1.0
    return build(source, options, xy, (seen > 0).astype(np.float64), layout=PENN_13)


PENN_ACTION = Format("Penn Action", _sniff, read_penn_action)
