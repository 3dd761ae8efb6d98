"""One input, opened once: what container it is, and its content within bounds of memory.

Nothing is unpickled, no member of an archive becomes a path, and a size that a header promises is checked against
what is stored before memory is taken for it.
"""

from __future__ import annotations

import functools
import gzip
import io
import json
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrecon.errors import ReconError
from torchrecon.io.readers.matfile import read_mat
from torchrecon.measurement._store import read_archive, read_array

__all__ = ["MAX_BYTES", "MAX_NUMBERS", "MAX_TEXT", "Floats", "Source", "numbers"]

MAX_BYTES = 1 << 28  # 256 MiB of file, or of arrays once decompressed
MAX_NUMBERS = 1 << 23  # in one table, in double precision and with the copies that checking makes
MAX_TEXT = 1 << 26  # 64 MiB of text: Python objects take several times the room of the text that makes them
_MAX_NODES = 4_000_000  # containers and keys of a JSON text, some 100 bytes each
_MAX_FILES = 200_000  # of a folder

Floats = NDArray[np.float64]


class Source:
    """A file or folder that some format's reader may understand.

    Attributes:
        path: where it is.
        kind: container, told from the first bytes: ``folder npz npy hdf5 mat c3d json text``.

    Raises:
        ReconError: no such file, empty, too large, a pickle, or bytes that are none of these.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "points.txt"
        ...     _ = path.write_text('[{"x": NaN}]')
        ...     Source(path).kind, Source(path).json
        ('json', [{'x': nan}])
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._zipped = False
        try:
            if self.path.is_dir():
                self.kind = "folder"
                return
            if not self.path.is_file():
                raise self.error("no such file or folder")
            size = self.path.stat().st_size
            with self.path.open("rb") as stream:
                head = stream.read(1024)
                self._zipped = head[:2] == b"\x1f\x8b"
                if self._zipped:
                    self._data = self._unzip(stream)
                    head, size = self._data[:1024], len(self._data)
        except (OSError, ValueError) as error:
            if isinstance(error, ReconError):
                raise
            raise self.error(f"cannot be read ({error})") from error
        if size == 0:
            raise self.error("is empty")
        if size > MAX_BYTES:
            raise self.error(f"{size} bytes are more than the {MAX_BYTES} that are read; cut the clip into pieces")
        self.kind = self._container(head)
        if not self._zipped and self.kind not in ("hdf5", "npz"):
            self._data = self.path.read_bytes()

    @property
    def plain_path(self) -> Path:
        """The path, for readers that open the file themselves and do not unzip."""
        if self._zipped:
            raise self.error("unzip it first; files of this format are read as they stand")
        return self.path

    @property
    def is_json(self) -> bool:
        """Whether there is something to ask ``json`` for."""
        return self.kind == "json" or bool(self.files)

    def error(self, message: str) -> ReconError:
        """An error that names this input."""
        return ReconError(f"{self.path}: {message}")

    def _unzip(self, stream: io.BufferedReader) -> bytes:
        stream.seek(0)
        try:
            with gzip.GzipFile(fileobj=stream) as unzipped:
                data = unzipped.read(MAX_BYTES + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise self.error(f"is a damaged gzip file ({error})") from error
        return data

    def _container(self, head: bytes) -> str:
        if head[:4] == b"PK\x03\x04":
            return "npz"
        if head[:6] == b"\x93NUMPY":
            return "npy"
        if b"\x89HDF\r\n\x1a\n" in (head[:8], head[512:520]):
            return "hdf5"
        if head[:10] == b"MATLAB 5.0":
            return "mat"
        if head[1:2] == b"\x50" and head[:1] < b"\x20" and b"\x00" in head[:64]:
            return "c3d"
        if head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05":
            raise self.error("is a pickle, which can run code and is never loaded; save the arrays with numpy.savez")
        if b"\x00" in head:
            raise self.error("is binary and of no format that is read here")
        return "json" if head.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] in (b"{", b"[") else "text"

    @functools.cached_property
    def data(self) -> bytes:
        """The bytes, unzipped."""
        return self._data if hasattr(self, "_data") else self.path.read_bytes()

    @functools.cached_property
    def text(self) -> str:
        """The content as text; bytes that are no UTF-8 are replaced."""
        if len(self.data) > MAX_TEXT:
            raise self.error(f"more than {MAX_TEXT} bytes of text; cut the clip into pieces or use an .npz")
        return self.data.decode("utf-8-sig", errors="replace")

    @functools.cached_property
    def json(self) -> Any:
        """The parsed JSON, of a folder the list of that of its files; NaN and Infinity are taken as numbers."""
        if self.kind == "folder":
            return self._folder_json()
        text = self.text
        if text.count("[") + text.count("{") + text.count(":") > _MAX_NODES:
            raise self.error(f"more than {_MAX_NODES} JSON containers and keys; cut the clip into pieces")
        try:
            return json.loads(text)
        except RecursionError as error:
            raise self.error("JSON is nested too deeply to be read") from error
        except ValueError as error:
            raise self.error(f"is not JSON ({error})") from error

    @functools.cached_property
    def arrays(self) -> Mapping[str, np.ndarray]:
        """Arrays by name of an npz or .mat file; that of an npy file has the name ``''``."""
        if self.kind == "mat":
            return read_mat(self.data, self.path, MAX_BYTES)
        if self.kind == "npy":
            try:
                return {"": read_array(io.BytesIO(self.data), len(self.data), MAX_BYTES)}
            except Exception as error:  # numpy's header parser raises what it likes on foreign bytes
                raise self.error(f"is not a readable .npy file ({error}); write it with numpy.save") from error
        if self._zipped:
            return read_archive(io.BytesIO(self._data), self.path, MAX_BYTES)
        with self.path.open("rb") as stream:
            return read_archive(stream, self.path, MAX_BYTES)

    @contextmanager
    def hdf5(self) -> Iterator[Any]:
        """The open HDF5 file; errors of the library become ReconError."""
        try:
            import h5py
        except ImportError as error:
            raise self.error("HDF5 needs h5py; install it with: pip install 'torchrecon[io]'") from error
        try:
            with h5py.File(io.BytesIO(self._data) if self._zipped else self.path, "r") as file:
                yield file
        except ReconError:
            raise
        except Exception as error:  # h5py raises what it likes on foreign bytes
            raise self.error(f"HDF5 cannot be read ({error}); export the file again, or as CSV") from error

    def dataset(self, group: Any, name: str) -> np.ndarray:
        """One dataset of an open HDF5 group, after its declared size is checked."""
        found = group[name]
        size = int(found.size or 0) * int(found.dtype.itemsize)
        if size > MAX_BYTES:
            raise self.error(f"{name}: {size} bytes are more than the {MAX_BYTES} that are read; cut the clip")
        return np.asarray(found[()])

    @functools.cached_property
    def files(self) -> tuple[Path, ...]:
        """JSON files of a folder, frame2 before frame10; none for a file."""
        if self.kind != "folder":
            return ()
        try:
            found = [p for p in self.path.iterdir() if p.suffix.lower() == ".json" and p.is_file()]
        except OSError as error:
            raise self.error(f"the folder cannot be read ({error})") from error
        if len(found) > _MAX_FILES:
            raise self.error(f"{len(found)} files are more than the {_MAX_FILES} that are read")
        split = {p: re.split(r"([0-9]+)", p.name) for p in found}
        return tuple(sorted(found, key=lambda p: [int(x) if x.isdecimal() else x for x in split[p]]))

    def _folder_json(self) -> list[Any]:
        contents, left = [], MAX_TEXT
        for path in self.files:
            each = Source(path)
            if each.kind != "json":
                raise each.error("is not JSON; a folder of keypoints holds one JSON file a frame")
            left -= len(each.data)
            if left < 0:
                raise self.error(f"its files are larger than {MAX_TEXT} bytes; cut the clip into pieces")
            contents.append(each.json)
        return contents

    def numbering(self, count: int) -> list[int]:
        """Frame numbers of the entries of a JSON list: of a folder those in the names of its files, if they differ.

        The last number counts: ``clip_000000000012_keypoints.json`` is frame 12.
        """
        found = [re.findall(r"[0-9]+", path.stem) for path in self.files]
        named = [int(digits[-1][:15]) for digits in found if digits]
        return named if len(set(named)) == len(found) == count else list(range(count))


def numbers(source: Source, value: Any, what: str, columns: int | None = None) -> Floats:
    """Nested lists, or an array, as float64; ``null`` becomes NaN.

    Args:
        source: stands in the error.
        value: as it was parsed.
        what: stands in the error.
        columns: length that the last axis must have.

    Raises:
        ReconError: ragged lists, text, objects, complex numbers, another last axis.
    """
    try:
        array = np.asarray(value)
        if array.size > 2 * MAX_NUMBERS:
            raise source.error(f"{what}: {array.size} numbers are more than are read at once; cut the clip into pieces")
        if array.dtype.kind not in "biufO" and array.size:
            raise ValueError(f"it holds {array.dtype}")
        array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, ReconError):
            raise
        raise source.error(f"{what}: is not a table of numbers ({error})") from error
    if columns is not None and array.shape[-1:] != (columns,):
        raise source.error(f"{what}: shape {array.shape}; {columns} numbers per entry are needed")
    return array
