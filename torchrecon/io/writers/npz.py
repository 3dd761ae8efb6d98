"""NumPy archive of the points with what other programs need to draw them."""

from __future__ import annotations

import io

import numpy as np

from torchrecon.io.writers.motion import Motion

__all__ = ["encode"]


def encode(motion: Motion) -> bytes:
    """Arrays ``points3d`` (frames, points, 3) in camera axes, ``fps``, ``names``, ``edges`` (edges, 2), ``unit``.

    Example:
        >>> with np.load(io.BytesIO(encode(Motion(np.ones((2, 3, 3)), unit="m")))) as archive:
        ...     print(archive["points3d"].shape, archive["unit"])
        (2, 3, 3) m
    """
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        points3d=motion.points,
        fps=np.float64(motion.fps),
        names=np.asarray(motion.names, dtype=np.str_),
        edges=np.asarray(motion.edges, dtype=np.int64).reshape(-1, 2),
        unit=np.asarray(motion.unit, dtype=np.str_),
    )
    return stream.getvalue()
