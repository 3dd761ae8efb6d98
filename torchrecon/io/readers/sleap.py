"""SLEAP analysis exports: H5 with ``tracks`` (individuals, 2, nodes, frames), and CSV (Pereira et al. 2022)."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build, frame_numbers
from torchrecon.io.readers.layouts import Layout
from torchrecon.io.readers.people import Detection, Person, choose, follow
from torchrecon.io.readers.source import Source, numbers
from torchrecon.io.readers.table import cell_number, table_rows
from torchrecon.measurement import Tracks

__all__ = ["SLEAP_CSV", "SLEAP_H5", "read_sleap_csv", "read_sleap_h5"]


def _sniff_h5(source: Source) -> bool:
    if source.kind != "hdf5":
        return False
    with source.hdf5() as file:
        return "tracks" in file and "node_names" in file


def _texts(source: Source, file: Any, name: str) -> list[str]:
    if name not in file:
        return []
    values = source.dataset(file, name).reshape(-1).tolist()
    return [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values]


def read_sleap_h5(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Nodes of one individual; ``person`` chooses where the file has several.

    Raises:
        ReconError: ``tracks`` of another shape.
    """
    options = options or ReadOptions()
    with source.hdf5() as file:
        tracks = numbers(source, source.dataset(file, "tracks"), "tracks")
        nodes, individuals = _texts(source, file, "node_names"), _texts(source, file, "track_names")
        edges = numbers(source, source.dataset(file, "edge_inds"), "edge_inds") if "edge_inds" in file else np.zeros(0)
        scores = (
            numbers(source, source.dataset(file, "point_scores"), "point_scores") if "point_scores" in file else None
        )
    if tracks.ndim == 4 and tracks.shape[1] != 2 == tracks.shape[2]:  # some versions write the axes the other way
        tracks, scores = tracks.T, None if scores is None else scores.T
    if tracks.ndim != 4 or tracks.shape[1] != 2:
        raise source.error(f"tracks: shape {tracks.shape}; (individuals, 2, nodes, frames) is needed")
    xy = tracks.transpose(0, 3, 2, 1)
    if scores is not None and scores.shape != (xy.shape[0], xy.shape[2], xy.shape[1]):
        raise source.error(f"point_scores: shape {scores.shape} does not fit tracks {tracks.shape}")
    confidence = np.asarray(np.isfinite(xy).all(-1), np.float64) if scores is None else scores.swapaxes(1, 2)
    people = []
    for i, body in enumerate(xy):
        there = np.isfinite(body).all(-1).any(-1)
        seen = {frame: Detection(body[frame], confidence[i, frame]) for frame in np.flatnonzero(there).tolist()}
        if seen:
            people.append(Person(seen, individuals[i] if i < len(individuals) else ""))
    if not people:
        raise source.error("tracks: no node has a position in any frame")
    people.sort(key=lambda person: -person.evidence)
    place, c = choose(source, options, people, "individuals").arrays(source, xy.shape[1])
    bones = edges.reshape(-1, 2) if edges.ndim == 2 and edges.shape[1] == 2 else np.zeros((0, 2))
    pairs = [(int(a), int(b)) for a, b in bones if 0 <= a < len(nodes) and 0 <= b < len(nodes)]
    return build(source, options, place, c, layout=Layout(tuple(nodes), tuple(pairs)))


def _sniff_csv(source: Source) -> bool:
    if source.kind != "text":
        return False
    head = source.data[:65536].removeprefix(b"\xef\xbb\xbf").partition(b"\n")[0]
    return b"frame_idx" in head and b"instance.score" in head


def read_sleap_csv(source: Source, options: ReadOptions | None = None) -> Tracks:
    """One row per frame and individual; rows without track are followed through the frames.

    Raises:
        ReconError: columns missing, cells that are no numbers.
    """
    options = options or ReadOptions()
    rows = table_rows(source)
    head = next(rows, [])
    nodes = [name[:-2] for name in head if name.endswith(".x")]
    try:
        columns = [[head.index(f"{node}.{c}") for c in ("x", "y")] for node in nodes]
        at = head.index("frame_idx")
    except ValueError as error:
        raise source.error(f"a column is missing ({error}); frame_idx and NODE.x, NODE.y are needed") from error
    if not nodes:
        raise source.error("has no column NODE.x")
    scores = [head.index(f"{node}.score") if f"{node}.score" in head else None for node in nodes]
    track = head.index("track") if "track" in head else None
    numbered, found = [], []
    for number, row in enumerate(rows, 2):
        frame = cell_number(source, row, at, number)
        if not abs(frame) < 1e15:
            raise source.error(f"row {number}: has no frame_idx")
        xy = np.array([[cell_number(source, row, c, number) for c in pair] for pair in columns])
        c = np.array([1.0 if s is None else cell_number(source, row, s, number) for s in scores])
        who = row[track] if track is not None and track < len(row) else ""
        numbered.append(int(frame))
        found.append(Detection(xy, c, who or None))
    places, count = frame_numbers(source, numbered)
    frames: dict[int, list[Detection]] = {}
    for frame_index, detection in zip(places, found, strict=True):
        frames.setdefault(frame_index, []).append(detection)
    xy, c = choose(source, options, follow(source, frames), "individuals").arrays(source, count)
    return build(source, options, xy, c, layout=Layout(tuple(nodes)))


SLEAP_H5 = Format("SLEAP analysis H5", _sniff_h5, read_sleap_h5)
SLEAP_CSV = Format("SLEAP CSV", _sniff_csv, read_sleap_csv)
