"""What every format is written from: points over time with a rate, names, bones and a unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrecon.errors import ReconError

__all__ = ["Motion"]


def _clean(names: Sequence[str]) -> tuple[str, ...]:
    """Names that every text format can hold: no white space or braces, none twice, none empty."""
    taken: set[str] = set()
    clean = []
    for index, name in enumerate(names):
        stem = re.sub(r"[^\w.+-]+", "_", name).strip("_") or f"p{index}"
        unique, copy = stem, 2
        while unique in taken:
            unique, copy = f"{stem}_{copy}", copy + 1
        taken.add(unique)
        clean.append(unique)
    return tuple(clean)


@dataclass(frozen=True, eq=False)
class Motion:
    """Points over time, ready to be written.

    Attributes:
        points: (frames, points, 3) in camera axes: x right, y down, z away.
        fps: frames per second.
        names: one per point; made safe for text formats. Empty: ``p0``, ``p1``, ...
        edges: pairs of point indices that are joined by a bone; empty where none are known.
        unit: ``m``, ``px``, or ``unit`` where the scale is arbitrary.

    Raises:
        ReconError: a rate that is not positive, entries that are not finite, names or edges that do not fit.

    Example:
        >>> Motion(np.zeros((2, 3, 3)), names=("left hip", "", "left hip")).names
        ('left_hip', 'p1', 'left_hip_2')
    """

    points: NDArray[np.float64]
    fps: float = 25.0
    names: tuple[str, ...] = ()
    edges: tuple[tuple[int, int], ...] = ()
    unit: str = "unit"

    def __post_init__(self) -> None:
        count = self.points.shape[1]
        if not 0 < self.fps < float("inf"):
            raise ReconError(f"export: fps {self.fps} is not a positive rate")
        wrong = np.argwhere(~np.isfinite(self.points).all(-1))
        if len(wrong):
            raise ReconError(f"export: points3d of frame {wrong[0][0]}, point {wrong[0][1]} is not finite; no format")
        if self.names and len(self.names) != count:
            raise ReconError(f"export: {len(self.names)} names for {count} points")
        for edge in self.edges:
            if len(edge) != 2 or not all(0 <= end < count for end in edge):
                raise ReconError(f"export: edge {tuple(edge)} names a point outside 0..{count - 1}")
        object.__setattr__(self, "names", _clean(self.names or [f"p{i}" for i in range(count)]))
        joined = dict.fromkeys((min(a, b), max(a, b)) for a, b in self.edges if a != b)
        object.__setattr__(self, "edges", tuple(joined))

    @property
    def upright(self) -> NDArray[np.float64]:
        """The points with y up and z towards the camera, as most 3D programs have it: a half turn about x."""
        return self.points * np.array([1.0, -1.0, -1.0])
