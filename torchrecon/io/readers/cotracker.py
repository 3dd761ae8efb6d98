"""CoTracker arrays: ``pred_tracks`` (batch, frames, points, 2) px and ``pred_visibility`` (batch, frames, points).

Source: Karaev et al. 2024; the visibility is a flag or a probability.
"""

from __future__ import annotations

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build
from torchrecon.io.readers.people import alone
from torchrecon.io.readers.source import Floats, Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["COTRACKER", "probability", "read_cotracker"]


def _sniff(source: Source) -> bool:
    return source.kind == "npz" and "pred_tracks" in source.arrays


def probability(source: Source, value: np.ndarray, name: str, shape: tuple[int, ...]) -> Floats:
    """Flags, probabilities, or logits (told by values outside 0..1), as probabilities of that shape."""
    array = numbers(source, value, name)
    if array.shape == (*shape, 1):
        array = array[..., 0]
    if array.shape != shape:
        raise source.error(f"{name}: shape {array.shape} does not fit the tracks; {shape} is needed")
    finite = array[np.isfinite(array)]
    if finite.size and (finite.min() < 0 or finite.max() > 1):
        return np.asarray(1 / (1 + np.exp(-np.clip(array, -50.0, 50.0))))
    return array


def read_cotracker(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Point tracks of CoTracker; a batch of one loses its batch axis.

    Raises:
        ReconError: shapes that are not as above.
    """
    options = options or ReadOptions()
    alone(source, options)
    xy = numbers(source, source.arrays["pred_tracks"], "pred_tracks", columns=2)
    if xy.ndim not in (3, 4) or 0 in xy.shape:
        raise source.error(f"pred_tracks: shape {xy.shape}; (batch, frames, points, 2) is needed")
    confidence = None
    if "pred_visibility" in source.arrays:
        confidence = probability(source, source.arrays["pred_visibility"], "pred_visibility", xy.shape[:-1])
    if xy.ndim == 4 and len(xy) == 1:
        xy, confidence = xy[0], None if confidence is None else confidence[0]
    return build(source, options, xy, confidence, body=False)


COTRACKER = Format("CoTracker", _sniff, read_cotracker)
