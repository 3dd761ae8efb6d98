"""Files that are whole or absent."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from torchrecon.measurement._store import read_npz, write_atomic, write_npz

__all__ = ["plain", "read_npz", "remove_leftovers", "write_bytes", "write_json", "write_npz"]


def write_bytes(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write ``content`` under a temporary name and move it into place.

    Raises:
        ReconError: the folder does not exist, or ``path`` is one.
    """
    return write_atomic(path, lambda stream: stream.write(content))


def remove_leftovers(folder: Path, names: Iterable[str]) -> None:
    """Remove what a killed run left of these files under temporary names.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as name:
        ...     _ = [(Path(name) / file).touch() for file in (".a.json.x1.part", "a.json", ".b.json.x2.part")]
        ...     remove_leftovers(Path(name), ["a.json"])
        ...     sorted(file.name for file in Path(name).iterdir())
        ['.b.json.x2.part', 'a.json']
    """
    for name in names:
        for pattern in (f".{name}.*.part", f".{name}.part*"):
            for file in folder.glob(pattern):
                file.unlink(missing_ok=True)


def write_json(path: str | os.PathLike[str], content: Any) -> Path:
    """Write the plain form of ``content`` as JSON, unrounded, atomically."""
    text = json.dumps(plain(content), indent=1, allow_nan=False)
    return write_bytes(path, (text + "\n").encode())


def plain(value: Any) -> Any:
    """The value as JSON can hold it: numbers unrounded, non-finite numbers as None, paths and tuples plain.

    Example:
        >>> plain({"a": (1, float("nan")), "b": Path("c")})
        {'a': [1, None], 'b': 'c'}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # tensors, arrays and their scalars
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{type(value).__name__} has no plain form: {value!r}")
