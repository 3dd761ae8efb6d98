"""Point-tracker arrays in either axis order: TAPIR and BootsTAPIR (points, frames, 2), TAPNext (frames, points, 2).

Sources: TAPIR (Doersch et al. 2023) gives ``tracks`` xy with ``occluded`` flags or ``occlusion`` and ``expected_dist``
logits, query points (t, y, x); TAPNext (Zholus et al. 2025) gives ``visible_logits`` and takes (t, x, y). TAP-Vid
names the tracks ``points``. A bare .npy holds the positions alone.

Which axis is time is told from the content: at its query frame a track stands on its query point, in one of the two
coordinate orders; without query points, positions change less from frame to frame than from point to point.
"""

from __future__ import annotations

import numpy as np

from torchrecon.io.readers.base import FARTHEST, Format, ReadOptions, build, pixels, warn
from torchrecon.io.readers.cotracker import probability
from torchrecon.io.readers.people import alone
from torchrecon.io.readers.source import Floats, Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["TAPIR", "read_tapir"]

_TRACKS = ("tracks", "points", "trajectories", "")
_HIDDEN = ("occluded", "occlusion", "occlusion_logits", "occlusions")
_SEEN = ("visibles", "visible", "visibility", "visible_logits", "vis")
_QUERIES = ("query_points", "queries", "query")
_DECISIVE = 1.5  # ratio of steps along the two axes from which the smaller one is believed to be time


def _sniff(source: Source) -> bool:
    if source.kind == "npy":
        return True
    if source.kind != "npz":
        return False
    array = next((source.arrays[key] for key in _TRACKS if key in source.arrays), np.zeros(0))
    return array.ndim in (3, 4) and array.shape[-1] == 2


def _query_time_axis(xy: Floats, query: Floats) -> int | None:
    """0 or 1, the axis of (a, b, 2) along which the frames run, from (points, 3) query points; None if unclear."""
    errors = []
    for axis in (0, 1):
        tracks = xy if axis == 1 else xy.swapaxes(0, 1)
        points, frames = tracks.shape[:2]
        if len(query) != points or not (np.abs(query) <= FARTHEST).all():
            errors.append(np.inf)
            continue
        at = tracks[np.arange(points), np.clip(np.round(query[:, 0]), 0, frames - 1).astype(int)]
        both = [np.abs(at - query[:, order]).max(-1) for order in ([2, 1], [1, 2])]
        distance = [d[np.isfinite(d)] for d in both]
        errors.append(min((float(np.median(d)) for d in distance if d.size), default=np.inf))
    if errors[0] == errors[1]:
        return None
    return int(errors[1] < errors[0])


def _smooth_time_axis(xy: Floats) -> tuple[int, float]:
    """Axis with the smaller median step, and how much smaller it is."""
    steps = []
    for axis in (0, 1):
        step = np.abs(np.diff(xy, axis=axis)).sum(-1)
        step = step[np.isfinite(step)]
        steps.append(float(np.median(step)) if step.size else np.inf)
    low, high = min(steps), max(steps)
    return int(steps[1] < steps[0]), np.inf if low == 0 < high else high / low if 0 < low < np.inf else 1.0


def _confidence(source: Source, shape: tuple[int, ...]) -> Floats | None:
    arrays = source.arrays
    seen = next((key for key in _SEEN if key in arrays), None)
    if seen is not None:
        return probability(source, arrays[seen], seen, shape)
    hidden = next((key for key in _HIDDEN if key in arrays), None)
    if hidden is None:
        return None
    confidence = 1 - probability(source, arrays[hidden], hidden, shape)
    if "expected_dist" in arrays:  # TAPIR calls a point visible where it is neither hidden nor likely to be far off
        confidence = confidence * (1 - probability(source, arrays["expected_dist"], "expected_dist", shape))
    return confidence


def read_tapir(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Point tracks with the frames on either axis.

    Positions that are all within 0..1 are shares of the image: give ``image_size``. Tracks at the tracker's own
    resolution (256 x 256) should be brought to that of the video first, or the shape is stretched.

    Raises:
        ReconError: shapes that do not fit one another.
    """
    options = options or ReadOptions()
    alone(source, options)
    name = next(key for key in _TRACKS if key in source.arrays)
    xy = numbers(source, source.arrays[name], name or "array", columns=2)
    if xy.ndim not in (3, 4) or 0 in xy.shape:
        raise source.error(f"{name or 'array'}: shape {xy.shape}; (points, frames, 2) or (frames, points, 2) is needed")
    confidence = _confidence(source, xy.shape[:-1])
    if xy.ndim == 4 and len(xy) == 1:
        xy, confidence = xy[0], None if confidence is None else confidence[0]
    # No position at all rather than infinity or an absurd one: differences of these say nothing.
    one = xy if xy.ndim == 3 else xy[0]
    one = np.where(np.abs(np.nan_to_num(one, nan=np.inf)) <= FARTHEST, one, np.nan)
    axis = None
    asked = next((key for key in _QUERIES if key in source.arrays), None)
    if asked is not None:
        axis = _query_time_axis(one, numbers(source, source.arrays[asked], asked, columns=3).reshape(-1, 3))
    if axis is None:
        axis, ratio = _smooth_time_axis(one)
        if ratio < _DECISIVE:
            axis = 1 if name in ("tracks", "points") else 0
            order = "(points, frames, 2)" if axis else "(frames, points, 2)"
            warn(source, f"which axis is time is not clear from the positions; {order} is taken; save query_points too")
    if axis == 1:
        xy, confidence = xy.swapaxes(-3, -2), None if confidence is None else confidence.swapaxes(-2, -1)
    finite = xy[np.isfinite(xy)]
    if finite.size and finite.min() >= 0 and finite.max() <= 1:
        xy = pixels(source, options, xy)
    return build(source, options, xy, confidence, body=False)


TAPIR = Format("TAPIR or TAPNext", _sniff, read_tapir)
