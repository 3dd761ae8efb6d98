"""What the page draws over time: lanes of the timeline and the lengths of bones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrecon.measurement import Reconstruction, Tracks

__all__ = ["Lane", "as_array", "bone_lengths", "deformation", "finite", "lanes"]

Array = NDArray[Any]


@dataclass(frozen=True)
class Lane:
    """One line of the timeline.

    Attributes:
        key: short name, unique on the page.
        label: what it is, for people.
        unit: of the values; empty for counts.
        hint: how to read it, one sentence.
        values: (frames,); NaN where a frame has none.
        total: what a count is out of.
        sigma: the values are standard deviations.
    """

    key: str
    label: str
    unit: str
    hint: str
    values: Array
    total: int | None = None
    sigma: bool = False


def deformation(points: Array, rotations: Array, seen: Array) -> Array:
    """How far the shape of each frame is from the mean shape: RMS distance over RMS size, per cent.

    Args:
        points: (frames, points, 3) camera axes; NaN where a point is not known.
        rotations: (frames, 3, 3) canonical -> camera.
        seen: (frames, points) points that count; a frame without any gets NaN.

    Example:
        >>> still = np.tile(np.array([[1.0, 0, 0], [-1, 0, 0]]), (4, 1, 1))
        >>> deformation(still, np.tile(np.eye(3), (4, 1, 1)), np.ones((4, 2), bool)).tolist()
        [0.0, 0.0, 0.0, 0.0]
    """
    canonical = points @ rotations
    counts = seen & finite(canonical)
    shapes = np.where(counts[..., None], canonical, 0.0)
    often = counts.sum(0)
    mean = shapes.sum(0) / np.maximum(often, 1)[:, None]
    used = mean[often > 0]
    size = np.sqrt(np.square(used - used.mean(0)).sum(-1).mean()) if len(used) else 0.0
    away = (np.square(shapes - mean).sum(-1) * counts).sum(1) / np.maximum(counts.sum(1), 1)
    return np.where(counts.any(1) & (size > 0), 100.0 * np.sqrt(away) / (size or 1.0), np.nan)


def lanes(reconstruction: Reconstruction, tracks: Tracks | None, seen: Array, unit: str) -> list[Lane]:
    """The lines of the timeline, top to bottom; those whose data are absent are left out."""
    points = as_array(reconstruction.points3d)
    found = [
        Lane("seen", "Points seen", "", "Tracks with a measurement in this frame.", seen.sum(1) * 1.0, seen.shape[1])
    ]
    if tracks is not None and tracks.covariance is not None:
        spread = np.sqrt(np.trace(as_array(tracks.covariance), axis1=-2, axis2=-1) / 2)
        text = "Standard deviation of a track, median over the points seen; low is sure."
        found.append(Lane("noise", "Confidence", "px", text, _median(spread, seen), sigma=True))
    if tracks is not None:
        miss = np.linalg.norm(as_array(reconstruction.reproject()) - as_array(tracks.xy), axis=-1)
        text = "Distance from a track to the reconstruction put back into the picture, median over the points seen."
        found.append(Lane("fit", "Misfit", "px", text, _median(miss, seen)))
    if reconstruction.covariance3d is not None:
        spread = np.sqrt(np.trace(as_array(reconstruction.covariance3d), axis1=-2, axis2=-1) / 3)
        text = "Standard deviation of a 3D point, median over all points; low is sure."
        found.append(Lane("spread", "3D uncertainty", unit, text, _median(spread, finite(points)), sigma=True))
    text = "Distance of this frame's shape from the mean shape, in per cent of its size."
    found.append(Lane("bend", "Deformation", "%", text, deformation(points, as_array(reconstruction.rotations), seen)))
    return found


def bone_lengths(points: Array, edges: tuple[tuple[int, int], ...]) -> Array:
    """Length of every bone in every frame, (frames, edges)."""
    ends = np.asarray(edges, dtype=int).reshape(-1, 2)
    return np.linalg.norm(points[:, ends[:, 0]] - points[:, ends[:, 1]], axis=-1)


def _median(values: Array, counts: Array) -> Array:
    """Median of the finite values that count, frame by frame; NaN where a frame has none."""
    rows = [row[keep & np.isfinite(row)] for row, keep in zip(values, counts, strict=True)]
    return np.array([np.median(row) if len(row) else np.nan for row in rows])


def finite(vectors: Array) -> Array:
    """Whether every component of a vector is finite."""
    return np.asarray(np.isfinite(vectors).all(-1))


def as_array(tensor: Any) -> Array:
    """A tensor as a float64 array, wherever it lives."""
    return tensor.detach().cpu().double().numpy()
