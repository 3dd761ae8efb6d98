"""Damaged copies of files: truncated, wrong shapes and types, NaN, huge numbers, lying headers, path tricks.

``mutate(path, target, rng)`` damages in the way of the format where it knows one (JSON nodes, arrays of an archive,
datasets, cells of a table), and then or instead bytes.
"""

from __future__ import annotations

import copy
import gzip
import io
import json
import os
import random
import shutil
import zipfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np

_DEEP = "@@deep@@"
POISON: tuple[Any, ...] = (
    float("nan"), float("inf"), -float("inf"), 1e308, -1e30, 1e-320, 0, -1, 2**63, 10**400, True, None, "", "nan",
    "text", "x" * 5000, "../../etc/passwd", "\x00", [], {}, [[]], [None], [1, [2, [3]]], {"x": {}}, _DEEP,
)  # fmt: skip
_WORDS = (b"\xff\xff\xff\x7f", b"\xff" * 4, b"\x00" * 4, b"\x00\x00\x00\x80", b"\xff\xff\xff\xff\xff\xff\xff\x7f")
_CELLS = ("", "nan", "inf", "1e400", "-1", "9" * 400, "text", '"', "x" * 3000, "\x00", "0x10", "1_000", "⅓", ",,,,")


def mutate(path: Path, target: Path, rng: random.Random) -> Path:
    """Write a damaged copy of a file or folder and give its path."""
    if path.is_dir():
        return _folder(path, target, rng)
    data = path.read_bytes()
    zipped = data[:2] == b"\x1f\x8b"
    plain = gzip.decompress(data) if zipped else data
    if rng.random() < 0.65:
        try:
            plain = _structure(plain, rng)
        except ValueError:  # damaged before, as a file of a folder may be
            plain = _bytes(plain, rng)
    if zipped and rng.random() < 0.7:
        plain, zipped = gzip.compress(plain, 1), False
    if rng.random() < 0.5:
        plain = _bytes(plain, rng)
    target.write_bytes(gzip.compress(plain, 1) if zipped else plain)
    return target


def _structure(data: bytes, rng: random.Random) -> bytes:
    head = data[:8]
    if head[:2] == b"PK":
        return _archive(data, rng)
    if head[:6] == b"\x93NUMPY":
        return _npy(_array(np.load(io.BytesIO(data)), rng), rng)
    if head == b"\x89HDF\r\n\x1a\n":
        return _hdf5(data, rng)
    if head.lstrip()[:1] in (b"{", b"["):
        return _json(json.loads(data), rng)
    if b"\x00" in data[:600]:
        return _bytes(data, rng)
    return _text(data.decode(), rng)


def _bytes(data: bytes, rng: random.Random) -> bytes:
    d = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(max(1, min(len(d), 1024) if rng.random() < 0.6 else len(d)))
        kind = rng.randrange(7)
        if kind == 0:
            d[at : at + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            word = rng.choice(_WORDS)
            d[at : at + len(word)] = word
        elif kind == 2:
            del d[at : at + rng.randrange(1, 64)]
        elif kind == 3:
            d[at:at] = rng.randbytes(rng.randrange(1, 64))
        elif kind == 4:
            del d[at:]
        elif kind == 5:
            d[at:at] = d[at : at + rng.randrange(1, 200)] * rng.choice((1, 2, 30))
        else:
            d[at : at + 2] = bytes(rng.choice((0, 255)) for _ in range(2))
        if not d:
            break
    return bytes(d)


def _json(content: Any, rng: random.Random) -> bytes:
    holder = [content]
    for _ in range(rng.choice((1, 1, 2, 5))):
        parent, key = holder, 0
        depth = rng.choice((1, 2, 3, 4, 6, 9))
        for _ in range(depth):
            child = parent[key]
            if isinstance(child, dict) and child:
                parent, key = child, rng.choice(list(child))
            elif isinstance(child, list) and child:
                parent, key = child, rng.choice((0, rng.randrange(len(child))))
            else:
                break
        kind = rng.randrange(5)
        if kind == 0 and parent is not holder:
            del parent[key]
        elif kind == 1 and isinstance(parent, list):
            parent[key:key] = copy.deepcopy([parent[key]] * rng.choice((1, 3, 300)))
        elif kind == 2 and isinstance(parent, dict):
            parent[rng.choice(("x", "people", "keypoints", "frame", "image_id", "scores"))] = parent.pop(key)
        else:
            parent[key] = copy.deepcopy(rng.choice(POISON))
    text = json.dumps(holder[0])
    return text.replace(f'"{_DEEP}"', "[" * 60000 + "]" * rng.choice((60000, 3))).encode()


def _array(array: np.ndarray, rng: random.Random) -> np.ndarray:
    kind = rng.randrange(11) if array.ndim else 6
    if kind == 0:
        return array.T
    if kind == 1:
        return array.reshape(-1)
    if kind == 2:
        return array[..., None]
    if kind == 3:
        return array[:0]
    if kind == 4:
        return array[..., :1] if array.ndim else array
    if kind == 5:
        dtype = rng.choice(("U8", "S3", "complex128", "float16", "int8", "bool", ">f8", "uint64", "float32", "M8[s]"))
        with np.errstate(all="ignore"):
            try:
                return np.nan_to_num(array).astype(dtype) if array.dtype.kind == "f" else array.astype(dtype)
            except (ValueError, TypeError):
                return array.reshape(-1)
    if kind == 6:
        return np.array([{"a": 1}, print], dtype=object)
    if array.dtype.kind != "f" or not array.size:
        return np.concatenate([array.reshape(-1)] * 3)
    bad = array.copy().reshape(-1)
    where = slice(None) if kind == 7 else rng.randrange(bad.size)
    bad[where] = rng.choice((np.nan, np.inf, 1e300, -1e20, 1e8, 0.0))
    return bad.reshape(array.shape)


def _npy(array: np.ndarray, rng: random.Random) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    data = stream.getvalue()
    if rng.random() < 0.25:  # a header that promises what is not there
        head = io.BytesIO()
        shape = rng.choice(((10**9, 10**6, 2), (10**12,), (-1, 2), (2**62, 4), (3, 5, 2), ()))
        np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": shape})
        data = head.getvalue() + data[128:]
    return data


def _archive(data: bytes, rng: random.Random) -> bytes:
    with np.load(io.BytesIO(data)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    chosen = rng.choice(list(arrays))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, array in arrays.items():
            if name != chosen:
                archive.writestr(f"{name}.npy", _npy(array, random.Random(7)))
                continue
            kind = rng.randrange(8)
            if kind == 0:
                continue
            trick = rng.choice(
                ("../../../tmp/torchrecon_escaped.npy", "/tmp/torchrecon_escaped.npy", "C:\\a.npy", "xy")
            )
            archive.writestr(trick if kind == 1 else f"{name}.npy", _npy(_array(array, rng), rng))
            if kind == 2:
                archive.writestr(f"{trick}", rng.randbytes(50))
    return out.getvalue()


def _hdf5(data: bytes, rng: random.Random) -> bytes:
    stream = io.BytesIO(data)
    with h5py.File(stream, "r+") as file:
        sets: list[str] = []
        file.visititems(lambda name, item: sets.append(name) if isinstance(item, h5py.Dataset) else None)
        name = rng.choice(sets)
        attributes = dict(file[name].attrs)
        kind = rng.randrange(6)
        old = file[name][()]
        if kind == 5 and attributes:
            key = rng.choice(list(attributes))
            file[name].attrs[key] = rng.choice((b"", b"cos\nsystem\n(S'true'\ntR.", 7, np.zeros(3), "text"))
            return _closed(stream, file)
        del file[name]
        if kind == 1:
            file.create_dataset(name, shape=(10**6, 10**6, 3), dtype="f8", chunks=(100, 100, 3))
        elif kind == 2:
            file.create_group(name)
        elif kind == 3:
            file[name] = h5py.SoftLink("/" + rng.choice(sets))
        elif kind == 4 and old.dtype.kind == "f":
            bad = _array(old, rng)
            file[name] = bad if bad.dtype.kind in "fiubc" else old.reshape(-1)
        elif kind == 4:
            file[name] = old.reshape(-1)[: rng.randrange(old.size + 1)]
        if kind in (1, 4):
            for key, value in attributes.items():
                file[name].attrs[key] = value
        return _closed(stream, file)


def _closed(stream: io.BytesIO, file: h5py.File) -> bytes:
    file.flush()
    return stream.getvalue()


def _text(text: str, rng: random.Random) -> bytes:
    lines = text.split("\n")
    for _ in range(rng.choice((1, 1, 3, 8))):
        at = rng.randrange(min(len(lines), 8) if rng.random() < 0.5 else len(lines))
        kind = rng.randrange(6)
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines[at:at] = [lines[at]] * rng.choice((1, 2, 500))
        elif kind == 2:
            rng.shuffle(lines)
        else:
            mark = max("\t;, ", key=lines[at].count)
            cells = lines[at].split(mark)
            cells[rng.randrange(len(cells))] = rng.choice(_CELLS)
            lines[at] = mark.join(cells if kind < 5 else cells[: rng.randrange(len(cells) + 1)])
        if not lines:
            break
    return "\n".join(lines).encode()


def _folder(path: Path, target: Path, rng: random.Random) -> Path:
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(path, target)
    files = sorted(target.iterdir())
    for _ in range(rng.choice((1, 1, 3))):
        one = rng.choice(files)
        kind = rng.randrange(7)
        if not one.is_file() or one.is_symlink():
            continue
        if kind == 0:
            one.unlink()
        elif kind == 1:
            one.write_bytes(rng.randbytes(100))
        elif kind == 2:
            one.unlink()
            os.symlink(one.name, one)
        elif kind == 3:
            (target / f"{rng.choice(('9' * 30, 'no number', '-1'))}.json").write_bytes(one.read_bytes())
        elif kind == 4:
            (target / "a.json").mkdir(exist_ok=True)
        else:
            mutate(one, one, rng)
    return target
