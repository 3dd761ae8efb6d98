"""HumanEva collection: ``NAME__xy`` (cameras, frames, 15, 2) px, real projections at 60 Hz (Sigal et al. 2010)."""

from __future__ import annotations

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build
from torchrecon.io.readers.layouts import HUMANEVA_15
from torchrecon.io.readers.people import Detection, Person, choose
from torchrecon.io.readers.source import Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["HUMANEVA", "read_humaneva"]

_FPS = 60.0


def _keys(source: Source) -> list[str]:
    return sorted(key for key, array in source.arrays.items() if key.endswith("__xy") and array.ndim == 4)


def _sniff(source: Source) -> bool:
    return source.kind == "npz" and bool(_keys(source))


def read_humaneva(source: Source, options: ReadOptions | None = None) -> Tracks:
    """One recording of one camera; ``person`` counts through recordings and cameras, the longest first.

    Raises:
        ReconError: shapes that are not as above, no such recording.
    """
    options = options or ReadOptions()
    recordings = []
    for key in _keys(source):
        cameras = numbers(source, source.arrays[key], key, columns=2)
        for camera, xy in enumerate(cameras):
            seen = {frame: Detection(body, np.ones(len(body))) for frame, body in enumerate(xy)}
            recordings.append(Person(seen, f"{key.removesuffix('__xy')} camera {camera}"))
    if not any(recording.seen for recording in recordings):
        raise source.error("its recordings hold no frames")
    recordings.sort(key=lambda recording: -len(recording.seen))
    chosen = choose(source, options, recordings, "recordings")
    if not chosen.seen:
        raise source.error(f"{chosen.name} holds no frames")
    xy, _ = chosen.arrays(source, len(chosen.seen))
    return build(source, options, xy, layout=HUMANEVA_15, fps=_FPS)


HUMANEVA = Format("HumanEva collection", _sniff, read_humaneva)
