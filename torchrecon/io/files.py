"""Files that are whole or absent."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

from torchrecon.measurement._store import write_atomic

__all__ = ["write_bytes", "write_json"]


def write_bytes(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write ``content`` under a temporary name and move it into place.

    Raises:
        ReconError: the folder does not exist.
    """
    return write_atomic(path, lambda stream: stream.write(content))


def write_json(path: str | os.PathLike[str], content: Any) -> Path:
    """Write JSON, unrounded, atomically; NaN becomes null."""
    text = json.dumps(plain(content), indent=1, allow_nan=False)
    return write_bytes(path, (text + "\n").encode())


def plain(value: Any) -> Any:
    """Tensors, arrays, tuples and dataclass-free nests as JSON values; non-finite numbers as None."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
