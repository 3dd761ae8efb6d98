"""What a reader is, what it is asked for, and the last step that all of them share."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import torch

from torchrecon.errors import ReconError
from torchrecon.io.readers.confidence import ConfidenceParams, visible_and_covariance
from torchrecon.io.readers.layouts import Layout
from torchrecon.io.readers.source import MAX_NUMBERS, Floats, Source
from torchrecon.measurement import Tracks

__all__ = ["FARTHEST", "Format", "Read", "ReadOptions", "build", "frame_numbers", "pixels", "warn"]

FARTHEST = 1e7  # pixels; beyond it a number is no image position
_SPARSEST = 10  # frames per frame that holds something, at most


@dataclass(frozen=True)
class ReadOptions:
    """What a caller may ask of a reader; the fields are the keywords of :func:`torchrecon.load_tracks`."""

    person: int | None = None
    view: str | None = None
    image_size: tuple[int, int] | None = None
    fps: float | None = None
    confidence: ConfidenceParams = field(default_factory=ConfidenceParams)


Read: TypeAlias = Callable[[Source, ReadOptions], Tracks]
"""A reader: a source that its ``sniff`` accepted, to tracks."""


@dataclass(frozen=True)
class Format:
    """One format, or family of formats.

    Attributes:
        name: as people call it.
        sniff: whether a source is of this format, told from its content.
        read: the reader.
    """

    name: str
    sniff: Callable[[Source], bool]
    read: Read


def warn(source: Source, message: str) -> None:
    """Tell the user about a choice that was made for them."""
    warnings.warn(f"{source.path}: {message}", stacklevel=2)


def build(
    source: Source,
    options: ReadOptions,
    xy: Floats,
    confidence: Floats | None = None,
    *,
    layout: Layout | None = None,
    body: bool = True,
    fps: float | None = None,
) -> Tracks:
    """Tracks from positions and confidence, by the one rule of :class:`ConfidenceParams`.

    Args:
        source: stands in the errors.
        options: what the caller asked for; its ``fps`` goes before that of the file.
        xy: (*batch, frames, points, 2) pixels, not finite where there is nothing.
        confidence: (*batch, frames, points), not finite where there is nothing; None: all equally good.
        layout: names and edges of the points; left out where the number of points is another.
        body: whether the points are keypoints of one body, or those of a point tracker.
        fps: frames per second, where the file states it.

    Raises:
        ReconError: positions that no image has, nothing visible.
    """
    if xy.ndim < 3 or 0 in xy.shape:
        raise source.error(f"holds no points (shape {xy.shape})")
    if xy.size > MAX_NUMBERS:
        raise source.error(f"{xy.shape} positions are more than are read at once; cut the clip into pieces")
    xy = np.where(np.isfinite(xy).all(-1, keepdims=True), xy, np.nan)
    c = np.ones(xy.shape[:-1]) if confidence is None else np.nan_to_num(confidence, nan=0.0, posinf=0.0, neginf=0.0)
    far = (np.abs(np.nan_to_num(xy)).max(-1) > FARTHEST) & (c > 0)
    if far.any():
        where = tuple(int(i) for i in np.argwhere(far)[0])
        raise source.error(f"frame {where[-2]}, point {where[-1]}: a position beyond {FARTHEST:g} pixels; repair it")
    visible, covariance = visible_and_covariance(xy, c, options.confidence, body)
    if not visible.any():
        raise source.error("no point is visible in any frame; every confidence is at or below the floor")
    known = layout is not None and len(layout.names) == xy.shape[-2]
    try:
        return Tracks(
            torch.from_numpy(xy),
            torch.from_numpy(visible),
            None if covariance is None else torch.from_numpy(covariance),
            fps=options.fps or fps or 25.0,
            names=layout.names if layout is not None and known else None,
            edges=(layout.edges or None) if layout is not None and known else None,
        )
    except ReconError as error:
        raise source.error(str(error)) from error


def pixels(source: Source, options: ReadOptions, unit: Floats, stated: tuple[float, float] | None = None) -> Floats:
    """Positions that are shares of the image's width and height, in pixels.

    The image size comes from ``options``, else from the file; where neither knows it the image is taken as a square of
    1000 pixels, with a warning, since that changes the shape.

    Args:
        source: stands in the warning.
        options: ``image_size`` is (height, width) in pixels.
        unit: (..., 2), 0 to 1.
        stated: (height, width) that the file states.
    """
    size = options.image_size or stated
    if size is None:
        warn(
            source,
            "positions are shares of an image whose size is not known; a square of 1000 pixels is assumed, which "
            "stretches the shape if the video is not square; give image_size=(height, width)",
        )
        size = (1000.0, 1000.0)
    if not all(math.isfinite(x) and 0 < x < FARTHEST for x in size):
        raise source.error(f"image size {size}: two positive numbers (height, width) are needed")
    return unit * np.array([size[1], size[0]], dtype=np.float64)


def frame_numbers(source: Source, numbers: Sequence[int]) -> tuple[list[int], int]:
    """Frame index of each number, counted from the smallest, and how many frames there are; gaps stay gaps.

    Raises:
        ReconError: the numbers are so scattered that they are no frames of one video.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile(suffix=".csv") as file:
        ...     _ = file.write(b"a"), file.flush()
        ...     frame_numbers(Source(file.name), [12, 10, 13])
        ([2, 0, 3], 4)
    """
    if not numbers:
        raise source.error("holds no frames")
    first, distinct = min(numbers), len(set(numbers))
    count = max(numbers) - first + 1
    if count > _SPARSEST * max(distinct, 10):
        raise source.error(
            f"{distinct} frames are numbered from {first} to {max(numbers)}; that looks like single images of a data "
            "set, not like a video: keep the entries of one video, numbered by frame"
        )
    return [n - first for n in numbers], count
