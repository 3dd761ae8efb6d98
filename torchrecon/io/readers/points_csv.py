"""Plain CSV of points: long (one row per frame and point) or wide (one row per frame, columns NAME_x, NAME_y).

Long: ``frame``, ``point`` (or track, keypoint, joint, marker, bodypart, name), ``x``, ``y`` and optionally
``confidence`` (or likelihood, score, visibility) and ``person``. Wide: ``NAME_x``, ``NAME_y`` and optionally
``NAME_confidence`` and ``frame``; separators ``_ . - :`` and space, or none before a bare number (``x0, y0``).
A column z makes it 3D (see markers): its numbers are taken as millimetres with y up.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build, frame_numbers
from torchrecon.io.readers.layouts import Layout
from torchrecon.io.readers.markers import project
from torchrecon.io.readers.people import Detection, Person, alone, choose
from torchrecon.io.readers.source import MAX_NUMBERS, Floats, Source
from torchrecon.io.readers.table import cell_number, row_numbers, table_rows
from torchrecon.measurement import Tracks

__all__ = ["POINTS_CSV", "read_points_csv"]

_FRAME = ("frame", "frame_idx", "frame_id", "frame_number", "frame_index", "image_id", "t")
_POINT = ("point", "point_id", "track", "track_id", "keypoint", "joint", "marker", "bodypart", "node", "name", "id")
_PERSON = ("person", "person_id", "individual", "animal")
_CONFIDENCE = ("confidence", "likelihood", "score", "visibility", "visible", "conf", "c", "p")
_WIDE = re.compile(rf"^(.+?)(?:[ _.:\-]+)(x|y|z|{'|'.join(_CONFIDENCE)})$|^(x|y|z|c|p|conf)[ _.]?([0-9]+)$")
_MOST = 1_000_000_000  # a larger frame number is no frame number


def _head(source: Source) -> list[str]:
    return [cell.lower() for cell in next(table_rows(source), [])]


def _find(head: Sequence[str], names: Sequence[str]) -> int | None:
    return next((head.index(name) for name in names if name in head), None)


def _wide(head: Sequence[str]) -> dict[str, dict[str, int]]:
    """Columns by point and coordinate."""
    points: dict[str, dict[str, int]] = {}
    for column, name in enumerate(head):
        match = _WIDE.match(name)
        if match:
            point, kind = match[1] or match[4], match[2] or match[3]
            points.setdefault(point, {}).setdefault(kind if kind in "xyz" else "c", column)
    return {point: columns for point, columns in points.items() if {"x", "y"} <= columns.keys()}


def _is_long(head: Sequence[str]) -> bool:
    return {"x", "y"} <= set(head) and _find(head, _FRAME) is not None and _find(head, _POINT) is not None


def _sniff(source: Source) -> bool:
    if source.kind != "text":
        return False
    head = _head(source)
    return _is_long(head) or bool(_wide(head))


def read_points_csv(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Points by frame; the order of the points is that in which they first appear.

    Raises:
        ReconError: cells that are no numbers, a point twice in a frame, 3D positions without a view.
    """
    options = options or ReadOptions()
    head = _head(source)
    return _read_long(source, options, head) if _is_long(head) else _read_wide(source, options, head)


def _frame(source: Source, row: list[str], column: int, number: int) -> int:
    value = cell_number(source, row, column, number)
    if not abs(value) < _MOST:
        raise source.error(f"row {number}: {row[column][:40] if column < len(row) else ''!r} is no frame number")
    return round(value)


def _read_long(source: Source, options: ReadOptions, head: Sequence[str]) -> Tracks:
    frame_at, point_at, who_at = (_find(head, names) for names in (_FRAME, _POINT, _PERSON))
    axes = [head.index(axis) for axis in "xyz" if axis in head]
    sure_at = _find(head, _CONFIDENCE)
    points: dict[str, int] = {}
    people: dict[str, int] = {}
    # Typed arrays: a long file has millions of rows, and Python objects take ten times the room.
    keys, values = array("q"), array("d")
    for number, row in enumerate(table_rows(source), 1):
        if number == 1:
            continue
        name, who = (row[at][:100] if at is not None and at < len(row) else "" for at in (point_at, who_at))
        keys.append(people.setdefault(who, len(people)))
        keys.append(_frame(source, row, frame_at or 0, number))
        keys.append(points.setdefault(name, len(points)))
        values.extend(row_numbers(source, row, [*axes, sure_at], number))
    person, frame, point = np.array(keys, dtype=np.int64).reshape(-1, 3).T
    _, count = frame_numbers(source, frame.tolist())
    if len(people) * count * len(points) * 2 > MAX_NUMBERS:
        raise source.error(f"{count} frames of {len(points)} points are more than are read at once; cut the clip")
    place = (person, frame - frame.min(), point)
    found = np.array(values).reshape(-1, len(axes) + 1)
    _check_single(source, np.ravel_multi_index(place, (len(people), count, len(points))))
    table = np.full((len(people), count, len(points), len(axes)), np.nan)
    table[place] = found[:, :-1]
    sure = np.zeros(table.shape[:-1])
    sure[place] = found[:, -1] if sure_at is not None else 1.0
    layout = Layout(tuple(points))
    if len(axes) == 3:
        if len(people) > 1:
            raise source.error(f"holds 3D positions of {len(people)} people; keep the rows of one")
        return project(source, options, table[0], "y", names=layout.names)
    if who_at is None:
        alone(source, options)
        return build(source, options, table[0], sure[0], layout=layout)
    bodies = [_person(who, table[i], sure[i]) for who, i in people.items()]
    bodies = sorted((b for b in bodies if b.seen), key=lambda body: -body.evidence)
    if not bodies:
        raise source.error("no point has x and y in any frame")
    xy, confidence = choose(source, options, bodies).arrays(source, count)
    return build(source, options, xy, confidence, layout=layout)


def _check_single(source: Source, index: np.ndarray) -> None:
    order = np.sort(index, kind="stable")
    if (order[1:] == order[:-1]).any():
        twice = order[:-1][order[1:] == order[:-1]][0]
        row = int(np.flatnonzero(index == twice)[1]) + 2
        raise source.error(f"row {row}: this point stands twice in its frame")


def _person(name: str, xy: Floats, sure: Floats) -> Person:
    there = np.asarray(np.isfinite(xy).all(-1).any(-1))
    return Person({f: Detection(xy[f], sure[f]) for f in np.flatnonzero(there).tolist()}, name)


def _read_wide(source: Source, options: ReadOptions, head: Sequence[str]) -> Tracks:
    alone(source, options)
    points = _wide(head)
    frame_at = _find(head, _FRAME)
    solid = all("z" in columns for columns in points.values())
    sure = any("c" in columns for columns in points.values())
    rows, numbered = [], []
    wanted = [columns.get(kind) for columns in points.values() for kind in "xyzc"]
    for number, row in enumerate(table_rows(source), 1):
        if number > 1:
            numbered.append(number - 2 if frame_at is None else _frame(source, row, frame_at, number))
            rows.append(np.array(row_numbers(source, row, wanted, number)))
    if len(set(numbered)) < len(numbered):
        raise source.error("two rows have one frame number")
    places, count = frame_numbers(source, numbered)
    if count * len(wanted) > 2 * MAX_NUMBERS:
        raise source.error(f"{count} frames of {len(points)} points are more than are read at once")
    table = np.full((count, len(points), 4), np.nan)
    table[places] = np.array(rows).reshape(len(rows), len(points), 4)
    if solid:
        return project(source, options, table[..., :3], "y", names=tuple(points))
    return build(source, options, table[..., :2], table[..., 3] if sure else None, layout=Layout(tuple(points)))


POINTS_CSV = Format("CSV of points", _sniff, read_points_csv)
