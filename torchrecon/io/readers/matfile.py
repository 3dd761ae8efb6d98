"""Numeric arrays of a MATLAB 5 file.

Own and small on purpose: of such a file only plain top-level arrays are needed here, and a general reader in compiled
code can be made to crash the process by a damaged file. Format: MAT-File Format, MathWorks, version 5.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchrecon.errors import ReconError

__all__ = ["read_mat"]

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_NUMERIC = range(6, 16)  # array classes double ... uint64; char, cell, struct, object and sparse are passed over
_COMPLEX = 0x0800


def read_mat(data: bytes, path: Path, max_bytes: int) -> dict[str, np.ndarray]:
    """Real numeric arrays by name; anything else in the file is passed over.

    Raises:
        ReconError: the file is cut off or damaged, or its arrays are larger than ``max_bytes``.
    """
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise ReconError(f"{path}: is not a MATLAB 5 file; save it again with save -v7")
    arrays: dict[str, np.ndarray] = {}
    try:
        for kind, body in _elements(data[128:], order):
            if kind == _COMPRESSED:
                inflate = zlib.decompressobj()
                body = inflate.decompress(body, max_bytes)
                if inflate.unconsumed_tail:
                    raise ValueError(f"a variable is larger than {max_bytes} bytes")
                kind, body = next(_elements(body, order), (0, b""))
            if kind == _MATRIX and (named := _matrix(body, order)) is not None:
                arrays[named[0]] = named[1]
                max_bytes -= named[1].nbytes
    except (ValueError, struct.error, zlib.error) as error:
        raise ReconError(f"{path}: is a damaged MATLAB file ({error}); save it again") from error
    return arrays


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and content of the data elements that follow one another, each padded to eight bytes."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(order + "II", data, at)
        if kind >> 16:  # small element: size, type and up to four bytes of content in one word pair
            kind, size, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
            if size > 4:
                raise ValueError(f"small element of {size} bytes at {at}")
        else:
            start = at + 8
            step = 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if start + size > len(data):
            raise ValueError(f"element of {size} bytes at {at} runs over the end")
        yield kind, data[start : start + size]
        at += step


def _matrix(body: bytes, order: str) -> tuple[str, np.ndarray] | None:
    parts = _elements(body, order)
    try:
        (_, flags), (_, dims), (_, name) = next(parts), next(parts), next(parts)
    except StopIteration:
        return None
    word = struct.unpack_from(order + "I", flags)[0] if len(flags) >= 4 else 0
    if word & 0xFF not in _NUMERIC or word & _COMPLEX:
        return None
    shape = struct.unpack(f"{order}{len(dims) // 4}i", dims[: len(dims) // 4 * 4])
    kind, values = next(parts, (0, b""))
    if kind not in _TYPES:
        raise ValueError(f"values of the unknown type {kind}")
    dtype = np.dtype(order + _TYPES[kind])
    if min(shape, default=-1) < 0 or math.prod(shape) * dtype.itemsize != len(values):
        raise ValueError(f"{len(values)} bytes for shape {shape} of {dtype}")
    array = np.frombuffer(values, dtype).reshape(shape, order="F")
    return name.decode("latin-1"), array.astype(array.dtype.newbyteorder("="))
