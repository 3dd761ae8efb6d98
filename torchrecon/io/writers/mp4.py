"""The clip with tracks and reprojection drawn on it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrecon.errors import ReconError
from torchrecon.io.frames import FrameSource
from torchrecon.measurement import Reconstruction, Tracks

__all__ = ["encode"]

# Blue, green and red of colours that the colour-blind tell apart; sizes in pixels.
_RING, _DOT, _BONE, _INFERRED = (233, 180, 86), (0, 94, 213), (255, 255, 255), (120, 120, 120)
_SHIFT = 4  # OpenCV draws at 1/16 of a pixel


def encode(
    frames: FrameSource,
    reconstruction: Reconstruction,
    tracks: Tracks | None = None,
    edges: Sequence[tuple[int, int]] = (),
) -> bytes:
    """MPEG-4 video of the size and rate of the clip.

    Blue rings stand where the reconstruction is seen, orange dots where the tracks were measured, a line joins the
    two. With tracks, rings of points that were not seen in a frame are grey.

    Args:
        frames: the clip that was reconstructed.
        reconstruction: batch ``()``, one frame for each of the clip.
        tracks: the measurements, or None.
        edges: bones as pairs of point indices.

    Raises:
        ReconError: another number of frames, or OpenCV has no MPEG-4 writer.
    """
    import cv2

    pixels = reconstruction.reproject().detach().cpu().double().numpy()
    if len(pixels) != len(frames):
        raise ReconError(f"{frames.path}: has {len(frames)} frames, not {len(pixels)} like the reconstruction")
    height, width = frames.size
    radius = max(2, round(min(height, width) / 160))
    with tempfile.TemporaryDirectory() as folder:  # OpenCV writes to a path only
        path = os.path.join(folder, "out.mp4")
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), frames.fps, (width, height))
        if not writer.isOpened():
            raise ReconError("export: this build of OpenCV cannot write MPEG-4; install opencv-python-headless")
        try:
            for f, frame in enumerate(frames):
                image = (frame.permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
                image = np.ascontiguousarray(image)
                _draw(cv2, image, pixels[f], None if tracks is None else _seen(tracks, f), radius)
                for a, b in edges:
                    _line(cv2, image, pixels[f, a], pixels[f, b], _BONE)
                writer.write(image)
        finally:
            writer.release()
        return Path(path).read_bytes()


def _seen(tracks: Tracks, frame: int) -> NDArray[np.float64]:
    return tracks.xy[frame].detach().cpu().double().numpy()


def _draw(
    cv2: Any, image: NDArray[np.uint8], rings: NDArray[np.float64], dots: NDArray[np.float64] | None, radius: int
) -> None:
    seen = np.isfinite(rings if dots is None else dots).all(axis=-1).reshape(-1)
    for index in np.argsort(seen, kind="stable"):  # what was measured lies on top
        if dots is not None and seen[index]:
            _line(cv2, image, dots[index], rings[index], _DOT)
            if (at := _fixed(dots[index])) is not None:
                cv2.circle(image, at, radius << (_SHIFT - 1), _DOT, -1, cv2.LINE_AA, _SHIFT)
        if (at := _fixed(rings[index])) is not None:
            cv2.circle(image, at, radius << _SHIFT, _RING if seen[index] else _INFERRED, 1, cv2.LINE_AA, _SHIFT)


def _line(cv2: Any, image: NDArray[np.uint8], a: NDArray[np.float64], b: NDArray[np.float64], colour: Any) -> None:
    start, end = _fixed(a), _fixed(b)
    if start is not None and end is not None:
        cv2.line(image, start, end, colour, 1, cv2.LINE_AA, _SHIFT)


def _fixed(point: NDArray[np.float64]) -> tuple[int, int] | None:
    """The point in sixteenths of a pixel; None where it is so far away that OpenCV's integers would overflow."""
    if not (np.abs(point) < 1e6).all():
        return None
    return round(float(point[0]) * (1 << _SHIFT)), round(float(point[1]) * (1 << _SHIFT))
