"""C3D marker files.

Read from the format's description (The C3D File Format, c3d.org), without a library: the compiled ones can be made to
crash the process by a damaged file. A file is blocks of 512 bytes: a header, the parameters, then the frames.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import torch

from torchrecon.data.markers import METRES, Markers
from torchrecon.errors import ReconError

__all__ = ["read_c3d"]

_BLOCK = 512
_INTEL, _DEC, _MIPS = 84, 85, 86
_MAX_BYTES = 1 << 28


def read_c3d(path: str | Path) -> Markers:
    """Markers of a C3D file, integer or floating point, of any of the three kinds of processor.

    The vertical axis is that of ``POINT:Y_SCREEN`` where the file has it, else z.

    Raises:
        ReconError: no such file, damaged or cut off, no markers, an unknown unit or rate.
    """
    file = Path(path)
    if not file.is_file():
        raise ReconError(f"{file}: there is no such file; give the path of a C3D file")
    if file.stat().st_size > _MAX_BYTES:
        raise ReconError(f"{file}: larger than {_MAX_BYTES} bytes; cut the recording into pieces")
    try:
        return _parse(file, file.read_bytes())
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        if isinstance(error, ReconError):
            raise
        raise ReconError(f"{file}: cannot read it as C3D ({error}); repair or export the file again") from error


def _parse(file: Path, data: bytes) -> Markers:
    if len(data) < 2 * _BLOCK or data[1] != 0x50:
        raise ValueError("its header is missing")
    at = (data[0] - 1) * _BLOCK
    processor = data[at + 3]
    if processor not in (_INTEL, _DEC, _MIPS):
        raise ValueError(f"processor type {processor} is unknown")
    order = ">" if processor == _MIPS else "<"
    point = _parameters(data, at, order, processor)
    markers, analog, first, last = struct.unpack_from(order + "4H", data, 2)
    frames = _frames(point, first, last)
    if markers == 0 or frames < 1:
        raise ReconError(f"{file}: it holds no markers; choose a recording with 3D points")
    scale = _number(point.get("POINT:SCALE"), float(_floats(data[12:16], order, processor)[0]))
    start = (struct.unpack_from(order + "H", data, 16)[0] - 1) * _BLOCK
    if start < _BLOCK:
        raise ValueError("the header does not say where the frames begin")
    xyz = _points(data[start:], frames, markers, analog, scale, order, processor)
    unit = _text(point.get("POINT:UNITS")) or ["mm"]
    if unit[0].lower() not in METRES:
        raise ReconError(f"{file}: POINT:UNITS is {unit[0][:40]!r}; known are {', '.join(METRES)}")
    rate = _number(point.get("POINT:RATE"), float(_floats(data[20:24], order, processor)[0]))
    if not (math.isfinite(rate) and rate > 0):
        raise ReconError(f"{file}: POINT:RATE is {rate}; it must be positive")
    labels = [name for i in ("", *range(2, 100)) for name in _text(point.get(f"POINT:LABELS{i}"))][:markers]
    labels += [f"marker{i}" for i in range(len(labels), markers)]
    vertical = (_text(point.get("POINT:Y_SCREEN")) or ["+Z"])[0].lstrip("+-").lower()
    positions = torch.from_numpy(xyz * METRES[unit[0].lower()]).to(torch.get_default_dtype())
    return Markers(positions, tuple(labels), rate, vertical if vertical in ("x", "y", "z") else "z")


def _parameters(data: bytes, at: int, order: str, processor: int) -> dict[str, np.ndarray]:
    """Values by GROUP:NAME."""
    blocks = data[at + 2]
    section = data[at : at + (blocks or 255) * _BLOCK]
    groups: dict[int, str] = {}
    found: list[tuple[int, str, np.ndarray]] = []
    place = 4
    while place + 2 < len(section):
        length, group = struct.unpack_from("bb", section, place)
        length = abs(length)
        if length == 0 or group == 0:
            break
        name = section[place + 2 : place + 2 + length].decode("latin-1").strip().upper()
        after = place + 2 + length
        (step,) = struct.unpack_from(order + "h", section, after)
        if group < 0:
            groups[-group] = name
        else:
            found.append((group, name, _value(section, after + 2, order, processor)))
        if step <= 0:
            break
        place = after + step
    return {f"{groups.get(group, '')}:{name}": value for group, name, value in found}


def _value(section: bytes, at: int, order: str, processor: int) -> np.ndarray:
    kind, count = struct.unpack_from("bB", section, at)
    dims = section[at + 2 : at + 2 + count]
    size = math.prod(dims) * abs(kind)
    raw = section[at + 2 + count : at + 2 + count + size]
    if kind not in (-1, 1, 2, 4) or len(dims) < count or len(raw) < size:
        raise ValueError(f"a parameter of type {kind} and size {tuple(dims)} runs over the end")
    if kind == 4:
        return _floats(raw, order, processor)
    if kind == 2:
        return np.frombuffer(raw, order + "i2")
    if kind == 1:
        return np.frombuffer(raw, "u1")
    return np.frombuffer(raw, "S1").reshape(*dims, order="F").T if dims else np.frombuffer(raw, "S1")


def _floats(raw: bytes, order: str, processor: int) -> np.ndarray:
    if processor != _DEC:
        return np.frombuffer(raw, order + "f4")
    # VAX F: the two 16-bit words are swapped and the exponent is two larger than IEEE's.
    swapped = np.frombuffer(raw, "<u2").reshape(-1, 2)[:, ::-1]
    return np.ascontiguousarray(swapped).view("<f4").reshape(-1) / np.float32(4)


def _number(value: np.ndarray | None, other: float) -> float:
    return other if value is None or value.size == 0 or value.dtype.kind == "S" else float(value.reshape(-1)[0])


def _text(value: np.ndarray | None) -> list[str]:
    """Character parameters are stored with the characters on the first axis."""
    if value is None or value.dtype.kind != "S":
        return []
    rows = value.reshape(-1, value.shape[-1]) if value.size else value.reshape(0, 0)
    return [b"".join(c or b" " for c in row.tolist()).decode("latin-1").strip(" \0") for row in rows]


def _frames(point: dict[str, np.ndarray], first: int, last: int) -> int:
    """The header counts to 65,535 only; longer recordings say their ends in TRIAL, low word first."""
    ends = [point.get(f"TRIAL:ACTUAL_{which}_FIELD") for which in ("START", "END")]
    words = [
        end.reshape(-1)[:2].astype(int) % 65536
        for end in ends
        if end is not None and end.size >= 2 and end.dtype.kind == "i"
    ]
    if len(words) == 2:
        low, high = (int(word[0]) + 65536 * int(word[1]) for word in words)
        return high - low + 1
    declared = int(_number(point.get("POINT:FRAMES"), 0.0)) % 65536
    return max(last - first + 1, declared) if last == 65535 else last - first + 1


def _points(
    data: bytes, frames: int, markers: int, analog: int, scale: float, order: str, processor: int
) -> np.ndarray:
    """(frames, markers, 3) in the file's unit; a negative fourth word marks a marker that was not seen."""
    real = scale < 0
    width = 4 * markers + analog
    size = frames * width * (4 if real else 2)
    if size > len(data):
        raise ValueError(f"{frames} frames of {width} values are announced; the file is cut off")
    if not math.isfinite(scale):
        raise ValueError(f"POINT:SCALE is {scale}")
    raw = data[:size]
    words = _floats(raw, order, processor) if real else np.frombuffer(raw, order + "i2")
    point = words.reshape(frames, width)[:, : 4 * markers].reshape(frames, markers, 4).astype(np.float64)
    seen = point[..., 3:] >= 0
    return np.where(seen, point[..., :3] * (1.0 if real else scale), np.nan)
