"""Tracks from files."""

from __future__ import annotations

import os
from pathlib import Path

from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks

__all__ = ["load_tracks"]


def load_tracks(path: str | os.PathLike[str]) -> Tracks:
    """Read a tracks file.

    Args:
        path: an ``.npz`` whose arrays carry the names of the fields of :class:`torchrecon.Tracks`
            (``xy`` is needed, the rest is optional), as :meth:`torchrecon.Tracks.save` writes it.

    Raises:
        ReconError: no such file, another format, a key or shape that does not fit; names file and key.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Tracks(torch.rand(4, 3, 2)).save(f"{folder}/tracks.npz")
        ...     load_tracks(path).xy.shape
        torch.Size([4, 3, 2])
    """
    source = Path(path)
    if source.suffix.lower() != ".npz" and source.is_file():
        raise ReconError(
            f"{source}: {source.suffix or 'no suffix'} is not a tracks format; an .npz with 'xy' is needed"
        )
    return Tracks.load(source)
