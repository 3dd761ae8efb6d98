"""Numbers packed for the page: quantised, differences in time, byte planes, zlib, base64."""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Block", "pack_bits", "pack_series", "unpack_bits", "unpack_series"]

Array = NDArray[Any]
_MOST = 32767


@dataclass(frozen=True)
class Block:
    """A packed array as the page reads it.

    Attributes:
        text: base64 of the zlib stream.
        step: size of one integer in the unit of the data; 1 for bits.
        clipped: how many values lay outside what 16 bits hold and stand at the limit.
    """

    text: str
    step: float = 1.0
    clipped: int = 0


def pack_series(values: Array, step: float) -> Block:
    """Pack a series in time at the given resolution.

    Neighbouring frames are alike, so differences in time are small; with their low and high bytes apart, zlib finds
    what repeats. The differences wrap around at 16 bits and so lose nothing.

    Args:
        values: (frames, n); NaN repeats the frame before it (zero at the start), to cost nothing.
        step: resolution in the unit of ``values``, > 0.

    Example:
        >>> block = pack_series(np.array([[0.0, 1.0], [0.5, np.nan]]), 0.25)
        >>> unpack_series(block, 2).tolist()
        [[0.0, 1.0], [0.5, 1.0]]
    """
    held = hold(values)
    scaled = np.rint(held / step)
    clipped = int((np.abs(scaled) > _MOST).sum())
    whole = np.clip(scaled, -_MOST, _MOST).astype(np.int16)
    change = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1])).view(np.uint16)
    # Zigzag: small negative differences become small numbers, their high byte zero.
    zigzag = (change << 1) ^ np.where(change >> 15, 0xFFFF, 0).astype(np.uint16)
    planes = np.concatenate([(zigzag & 255).astype(np.uint8).ravel(), (zigzag >> 8).astype(np.uint8).ravel()])
    return Block(_text(planes.tobytes()), step, clipped)


def unpack_series(block: Block, width: int) -> Array:
    """What the page makes of :func:`pack_series`: (frames, width), in the unit of the data."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(block.text)), np.uint8).astype(np.uint16)
    low, high = planes.reshape(2, -1, width)
    zigzag = low | (high << 8)
    change = (zigzag >> 1) ^ np.where(zigzag & 1, 0xFFFF, 0).astype(np.uint16)
    return np.cumsum(change, axis=0, dtype=np.uint16).view(np.int16) * block.step


def pack_bits(bits: Array) -> Block:
    """Pack booleans, eight to a byte, first one in the highest bit.

    Example:
        >>> unpack_bits(pack_bits(np.array([[True, False, True]])), (1, 3)).tolist()
        [[True, False, True]]
    """
    return Block(_text(np.packbits(bits.astype(bool).ravel()).tobytes()))


def unpack_bits(block: Block, shape: tuple[int, ...]) -> Array:
    """What the page makes of :func:`pack_bits`."""
    packed = np.frombuffer(zlib.decompress(base64.b64decode(block.text)), np.uint8)
    return np.unpackbits(packed, count=int(np.prod(shape))).astype(bool).reshape(shape)


def hold(values: Array) -> Array:
    """Values with every non-finite one replaced by the last finite one before it in time, or by zero."""
    good = np.isfinite(values)
    last = np.maximum.accumulate(np.where(good, np.arange(len(values))[:, None], -1), axis=0)
    held = np.take_along_axis(np.where(good, values, 0.0), np.maximum(last, 0), axis=0)
    return np.where(last >= 0, held, 0.0)


def _text(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 7)).decode("ascii")
