"""Atomic npz files without pickle, shared by the containers of this package."""

from __future__ import annotations

import os
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from torchrecon.errors import ReconError


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


def read_npz(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """Read every array of an npz file; pickled objects are refused."""
    source = Path(path)
    if not source.is_file():
        raise ReconError(f"{source}: no such file")
    try:
        # Opened here: numpy leaves the file open when it turns out to be no archive.
        with source.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ReconError(f"{source}: holds one bare array; an .npz archive with named arrays is needed")
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, NotImplementedError) as error:
        if isinstance(error, ReconError):
            raise
        raise ReconError(f"{source}: is not a readable .npz archive ({error}); write it with numpy.savez") from error
