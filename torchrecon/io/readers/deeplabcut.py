"""DeepLabCut CSV and H5: x, y, likelihood per body part, of one or several animals (Mathis et al. 2018).

The column header has the rows scorer, [individuals,] bodyparts, coords. In H5 pandas keeps it as text in the pickle
language; only its literal part (text, numbers, tuples, lists) is interpreted here, by :mod:`pickletools`, which runs
nothing. Where anything else stands there, the error asks for the CSV.
"""

from __future__ import annotations

import pickletools
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build, frame_numbers
from torchrecon.io.readers.layouts import Layout
from torchrecon.io.readers.markers import project
from torchrecon.io.readers.people import Detection, Person, choose
from torchrecon.io.readers.source import Floats, Source
from torchrecon.io.readers.table import row_numbers, table_rows
from torchrecon.measurement import Tracks

__all__ = ["DEEPLABCUT_CSV", "DEEPLABCUT_H5", "literal_pickle", "read_deeplabcut_csv", "read_deeplabcut_h5"]

Column = tuple[str, str, str]  # individual, body part, coordinate
_HEADER = 1 << 20  # bytes in which the header rows are looked for


def _sniff_csv(source: Source) -> bool:
    head = source.data[:_HEADER] if source.kind == "text" else b""
    return head.removeprefix(b"\xef\xbb\xbf").startswith(b"scorer") and b"\nbodyparts" in head


def read_deeplabcut_csv(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Body parts of one animal; ``person`` chooses where the file has several.

    Raises:
        ReconError: header rows missing, cells that are no numbers, coordinates missing.
    """
    head: dict[str, list[str]] = {}
    labels, values = [], []
    index = 1
    for number, row in enumerate(table_rows(source), 1):
        if "coords" not in head:
            head[row[0]] = row
            # Labelled images have three index columns, of which the header leaves two empty.
            index = next((i for i, cell in enumerate(row[1:], 1) if cell), 1)
            if number > 4:
                raise source.error("its first four rows are not scorer, [individuals,] bodyparts and coords")
            continue
        labels.append(row[index - 1] if len(row) >= index else "")
        values.append(np.array(row_numbers(source, row, range(index, len(head["coords"])), number)))
    if not {"bodyparts", "coords"} <= head.keys() or not values:
        raise source.error("has no header rows bodyparts and coords, or no row after them")
    parts, coords = head["bodyparts"], head["coords"]
    who = head.get("individuals", [""] * len(coords))
    if not len(parts) == len(coords) == len(who):
        raise source.error("its header rows differ in length")
    columns = list(zip(who[index:], parts[index:], coords[index:], strict=True))
    return _tracks(
        source, options or ReadOptions(), columns, np.array(values), [_frame(x, i) for i, x in enumerate(labels)]
    )


def _frame(label: str, row: int) -> int:
    """Frame number of an index cell: a number, or an image's name with one in it."""
    digits = re.findall(r"[0-9]+", re.sub(r"\.0*$", "", label))
    return int(digits[-1][:15]) if digits else row


def _tracks(
    source: Source, options: ReadOptions, columns: Sequence[Column], values: Floats, numbered: Sequence[int]
) -> Tracks:
    """Tracks from a table whose columns are known."""
    if len(set(numbered)) < len(numbered):
        raise source.error("two rows have one frame number")
    if len(set(columns)) < len(columns):
        raise source.error("two columns have one name")
    place = {column: i for i, column in enumerate(columns)}
    parts = list(dict.fromkeys(part for _, part, _ in columns))
    rows, count = frame_numbers(source, numbered)

    def get(who: str, coord: str) -> Floats:
        found = [place.get((who, part, coord)) for part in parts]
        return np.stack([values[:, i] if i is not None else np.full(len(values), np.nan) for i in found], 1)

    people, solid = [], []
    for who in dict.fromkeys(who for who, _, _ in columns):
        xyz = np.stack([get(who, axis) for axis in "xyz"], -1)
        there = np.asarray(np.isfinite(xyz[..., :2]).all(-1).any(-1))
        if not there.any():
            continue
        scored = any((who, part, "likelihood") in place for part in parts)
        confidence = get(who, "likelihood") if scored else np.ones(xyz.shape[:-1])
        seen = {row: Detection(xyz[i, :, :2], confidence[i]) for i, row in enumerate(rows) if there[i]}
        people.append(Person(seen, who))
        solid.append(np.isfinite(xyz[..., 2]).any())
        if solid[-1]:
            full = np.full((count, len(parts), 3), np.nan)
            full[rows] = xyz
            return project(source, options, full, "z", names=parts)
    if not people:
        raise source.error("no body part has x and y in any frame")
    people.sort(key=lambda person: -person.evidence)
    chosen = choose(source, options, people, "individuals")
    xy, confidence = chosen.arrays(source, count)
    return build(source, options, xy, confidence, layout=Layout(tuple(parts)))


def _group(file: Any) -> Any:
    """The first group that pandas wrote."""
    for name in list(file)[:100]:
        kind = file[name].attrs.get("pandas_type", b"")
        if bytes(kind if isinstance(kind, bytes) else str(kind).encode()) in (b"frame_table", b"frame"):
            return file[name]
    return None


def _sniff_h5(source: Source) -> bool:
    if source.kind != "hdf5":
        return False
    with source.hdf5() as file:
        return _group(file) is not None


def read_deeplabcut_h5(source: Source, options: ReadOptions | None = None) -> Tracks:
    """As :func:`read_deeplabcut_csv`, from the table or the fixed layout that pandas writes.

    Raises:
        ReconError: header or values in a form that cannot be read safely: export the CSV instead.
    """
    with source.hdf5() as file:
        group = _group(file)
        if "table" in group:
            names, values, frames = _table(source, group)
        else:
            names, values, frames = _fixed(source, group)
    if not names or values.ndim != 2 or values.shape[1] != len(names) or len(frames) != len(values):
        raise source.error(f"{len(names)} column names for values of shape {values.shape}; export the CSV instead")
    if any(len(name) not in (3, 4) for name in names):
        raise source.error("its columns are not scorer, [individual,] bodypart, coord; export the CSV instead")
    columns = [(name[1] if len(name) == 4 else "", name[-2], name[-1]) for name in names]
    return _tracks(source, options or ReadOptions(), columns, values, frames)


def _table(source: Source, group: Any) -> tuple[list[tuple[str, ...]], Floats, list[int]]:
    table = source.dataset(group, "table")
    fields = table.dtype.names or ()
    if "values_block_0" not in fields or "values_block_1" in fields or "index" not in fields:
        raise source.error("its table is not one block of numbers with an index; export the CSV instead")
    header = literal_pickle(source, group["table"].attrs.get("values_block_0_kind", b""))
    if not isinstance(header, list):
        raise source.error("its column names are no list; export the CSV instead")
    names = [name for name in header if isinstance(name, tuple) and all(isinstance(part, str) for part in name)]
    values = np.asarray(table["values_block_0"], dtype=np.float64)
    index = table["index"]
    frames = index.tolist() if index.dtype.kind in "iu" else list(range(len(index)))
    return names, values.reshape(len(values), -1), frames


def _fixed(source: Source, group: Any) -> tuple[list[tuple[str, ...]], Floats, list[int]]:
    levels = []
    for i in range(4):
        if f"block0_items_level{i}" in group:
            level = [_plain(x) for x in source.dataset(group, f"block0_items_level{i}").reshape(-1)]
            label = source.dataset(group, f"block0_items_label{i}").reshape(-1).astype(int)
            if label.size and not 0 <= label.min() <= label.max() < len(level):
                raise source.error("its column labels do not fit its levels; export the CSV instead")
            levels.append([level[k] for k in label])
    values = np.asarray(source.dataset(group, "block0_values"), dtype=np.float64)
    return list(zip(*levels, strict=True)), values, list(range(len(values)))


def _plain(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def literal_pickle(source: Source, pickled: Any) -> Any:
    """The value of a pickle made of text, integers, None, tuples and lists only; nothing is imported or called.

    Raises:
        ReconError: any other instruction, or a damaged pickle.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    try:
        for code, argument, _ in pickletools.genops(bytes(pickled)):
            name = code.name
            if name in ("PROTO", "FRAME", "STOP"):
                continue
            if name in ("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "INT", "BININT", "BININT1", "BININT2", "LONG1"):
                stack.append(argument)
            elif name == "NONE":
                stack.append(None)
            elif name == "MARK":
                marks.append(len(stack))
            elif name in ("EMPTY_LIST", "EMPTY_TUPLE"):
                stack.append([] if name == "EMPTY_LIST" else ())
            elif name in ("LIST", "TUPLE"):
                start = marks.pop()
                items = stack[start:]
                stack[start:] = [items if name == "LIST" else tuple(items)]
            elif name in ("TUPLE1", "TUPLE2", "TUPLE3"):
                size = int(name[-1])
                if len(stack) < size:
                    raise ValueError("it takes more than is there")
                stack[-size:] = [tuple(stack[-size:])]
            elif name == "APPEND":
                item = stack.pop()
                stack[-1].append(item)
            elif name == "APPENDS":
                start = marks.pop()
                items = stack[start:]
                del stack[start:]
                stack[-1].extend(items)
            elif name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
                memo[len(memo) if name == "MEMOIZE" else int(argument or 0)] = stack[-1]
            elif name in ("GET", "BINGET", "LONG_BINGET"):
                stack.append(memo[int(argument or 0)])
            else:
                raise ValueError(f"it holds the instruction {name}")
        (value,) = stack
    except (ValueError, IndexError, KeyError, AttributeError, TypeError) as error:
        raise source.error(f"its column names cannot be read safely ({error}); export the CSV instead") from error
    return value


DEEPLABCUT_CSV = Format("DeepLabCut CSV", _sniff_csv, read_deeplabcut_csv)
DEEPLABCUT_H5 = Format("DeepLabCut H5", _sniff_h5, read_deeplabcut_h5)
