"""The project's own tracks files: an npz whose arrays carry the names of the fields of ``Tracks``."""

from __future__ import annotations

from dataclasses import replace

from torchrecon.io.readers.base import Format, ReadOptions
from torchrecon.io.readers.people import alone
from torchrecon.io.readers.source import Source
from torchrecon.measurement import Tracks

__all__ = ["TRACKS", "read_tracks_npz"]


def _sniff(source: Source) -> bool:
    return source.kind == "npz" and "xy" in source.arrays


def read_tracks_npz(source: Source, options: ReadOptions | None = None) -> Tracks:
    """What :meth:`torchrecon.Tracks.save` writes; raises ReconError that names file and key."""
    options = options or ReadOptions()
    alone(source, options)
    tracks = Tracks.from_arrays(source.arrays, source.path)
    if options.fps is None:
        return tracks
    return replace(tracks, fps=options.fps, times=tracks.times * (tracks.fps / options.fps))


TRACKS = Format("torchrecon tracks", _sniff, read_tracks_npz)
