"""Atomic npz files without pickle, shared by the containers of this package."""

from __future__ import annotations

import io
import math
import os
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from torchrecon.errors import ReconError

_MAX_MEMBERS = 10_000


def write_atomic(path: str | os.PathLike[str], write: Callable[[IO[bytes]], object]) -> Path:
    """Let ``write`` fill a temporary file and move it to ``path``: the final name never holds half a file."""
    target = Path(path)
    if not target.parent.is_dir():
        raise ReconError(f"{target}: the folder {target.parent} does not exist; create it first")
    if target.is_dir():
        raise ReconError(f"{target}: is a folder; name a file")
    descriptor, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            write(stream)
            stream.flush()
            os.fsync(stream.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)  # mkstemp makes private files; results are ordinary ones
        os.replace(temporary, target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return target


def write_npz(path: str | os.PathLike[str], arrays: dict[str, Any]) -> Path:
    """Write the named arrays that are not None, atomically and without pickle."""
    plain = {
        name: value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
        for name, value in arrays.items()
        if value is not None
    }
    return write_atomic(path, lambda stream: np.savez_compressed(stream, allow_pickle=False, **plain))


def read_npz(path: str | os.PathLike[str], max_bytes: int = 1 << 32) -> dict[str, np.ndarray]:
    """Read every array of an npz file; pickled objects are refused, sizes are checked before memory is taken.

    Raises:
        ReconError: no such file, not an archive of arrays, an array whose header promises other than what is stored,
            or more than ``max_bytes`` in all.
    """
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file")
    with source.open("rb") as stream:
        if stream.read(6) == b"\x93NUMPY":
            raise ReconError(f"{source}: holds one bare array; an .npz archive with named arrays is needed")
        stream.seek(0)
        return read_archive(stream, source, max_bytes)


def read_archive(stream: IO[bytes] | io.BufferedIOBase, source: Path, max_bytes: int) -> dict[str, np.ndarray]:
    """The arrays of an npz archive that is open in ``stream``; member names are keys and never become paths."""
    arrays: dict[str, np.ndarray] = {}
    left = max_bytes
    try:
        with zipfile.ZipFile(stream) as archive:
            if len(archive.infolist()) > _MAX_MEMBERS:
                raise ValueError(f"{len(archive.infolist())} arrays are more than the {_MAX_MEMBERS} that are read")
            for info in archive.infolist():
                with archive.open(info) as member:
                    array = read_array(member, info.file_size, left)
                arrays[info.filename.removesuffix(".npy")] = array
                left -= array.nbytes
    except Exception as error:  # zip, codecs and numpy's header parser raise what they like on foreign bytes
        raise ReconError(f"{source}: is not a readable .npz archive ({error}); write it with numpy.savez") from error
    return arrays


def read_array(stream: IO[bytes] | io.BufferedIOBase, size: int, max_bytes: int) -> np.ndarray:
    """One array in npy form from ``size`` bytes.

    Raises:
        ValueError: objects, a header that promises other than what follows, more than ``max_bytes``.
    """
    start = stream.tell()
    version = np.lib.format.read_magic(stream)
    header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if header is None:
        raise ValueError(f"npy version {version} is not known")
    shape, _, dtype = header(stream)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are never loaded")
    if dtype.itemsize == 0 or dtype.fields is not None or min(shape, default=0) < 0:
        raise ValueError(f"shape {shape} of {dtype} is not an array of numbers or text")
    declared, stored = math.prod(shape) * dtype.itemsize, size - (stream.tell() - start)
    if declared != stored:
        raise ValueError(f"shape {shape} of {dtype} needs {declared} bytes, {stored} are stored")
    if declared > max_bytes:
        raise ValueError(f"{declared} bytes are more than the {max_bytes} that are read; cut the clip into pieces")
    stream.seek(start)
    return np.lib.format.read_array(stream, allow_pickle=False)
