"""Labelled markers in 3D, and the TRC files of OpenSim that hold them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["METRES", "Markers", "read_trc"]

METRES = {"mm": 0.001, "cm": 0.01, "dm": 0.1, "m": 1.0, "in": 0.0254, "ft": 0.3048}
_MAX_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class Markers:
    """Labelled markers, metres, in the laboratory's axes; NaN where a marker was not seen.

    Attributes:
        positions: metres.
        names: of the markers.
        fps: frames per second.
        up: axis of the laboratory that points up, x, y or z, where the file or its format says so.
    """

    positions: Float[Tensor, "frames markers 3"]
    names: tuple[str, ...]
    fps: float
    up: str = "z"


def read_trc(path: str | Path) -> Markers:
    """Markers of a TRC file (OpenSim, Motion Analysis); y is up, an empty field is a marker that was not seen.

    Raises:
        ReconError: no such file, the header is not TRC's, an unknown unit, a row that does not fit; the line is named.

    Example:
        >>> import tempfile
        >>> head = ["PathFileType\\t4", "DataRate\\tUnits", "50\\tmm", "Frame#\\tTime\\tHEEL", "\\t\\tX1\\tY1\\tZ1"]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "a.trc"
        ...     _ = file.write_text("\\n".join([*head, "1\\t0.0\\t1000\\t250\\t0"]))
        ...     read_trc(file).positions.tolist()
        [[[1.0, 0.25, 0.0]]]
    """
    file = Path(path)
    if not file.is_file():
        raise ReconError(f"{file}: there is no such file; give the path of a TRC file")
    if file.stat().st_size > _MAX_BYTES:
        raise ReconError(f"{file}: larger than {_MAX_BYTES} bytes; cut the recording into pieces")
    lines = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        raise ReconError(f"{file}: does not begin with the five header lines of TRC; export it again")
    head = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    unit = head.get("Units", "mm").lower()
    if unit not in METRES:
        raise ReconError(f"{file}: line 3: Units is {unit[:40]!r}; known are {', '.join(METRES)}")
    try:
        rate = float(head["DataRate"])
    except (KeyError, ValueError) as error:
        raise ReconError(f"{file}: line 3: DataRate is missing or no number") from error
    if not (math.isfinite(rate) and rate > 0):
        raise ReconError(f"{file}: line 3: DataRate is {rate}; it must be positive")
    names = tuple(name.strip() for name in lines[3].split("\t")[2:] if name.strip())
    if not names:
        raise ReconError(f"{file}: line 4 names no marker")
    rows = []
    for number, line in enumerate(lines[5:], 6):
        if line.strip():
            rows.append(_row(file, number, line.split("\t"), len(names)))
    if not rows:
        raise ReconError(f"{file}: holds no frame; the file is cut off")
    positions = torch.from_numpy(METRES[unit] * np.array(rows).reshape(len(rows), len(names), 3))
    return Markers(positions.to(torch.get_default_dtype()), names, rate, up="y")


def _row(file: Path, number: int, cells: list[str], markers: int) -> np.ndarray:
    values = cells[2:]
    values = values[: 3 * markers] + [""] * (3 * markers - len(values))
    if any(cell.strip() for cell in cells[2 + 3 * markers :]):
        raise ReconError(f"{file}: line {number} has {len(cells)} fields; {2 + 3 * markers} are needed")
    try:
        return np.array([float(cell) if cell.strip() else np.nan for cell in values])
    except ValueError as error:
        raise ReconError(f"{file}: line {number} holds something that is no number; repair the file") from error
