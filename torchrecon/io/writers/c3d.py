"""C3D marker files through ezc3d."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from torchrecon.errors import ReconError
from torchrecon.io.writers.motion import Motion

__all__ = ["encode"]


def encode(motion: Motion) -> bytes:
    """Markers in camera axes, single precision; ``POINT:UNITS`` names the unit of the motion.

    Raises:
        ReconError: ezc3d is not installed.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise ReconError("export: .c3d needs ezc3d; install it with pip install 'torchrecon[io]'") from error
    document = ezc3d.c3d()
    document["parameters"]["POINT"]["RATE"]["value"] = [motion.fps]
    document["parameters"]["POINT"]["UNITS"]["value"] = [motion.unit]
    document["parameters"]["POINT"]["LABELS"]["value"] = list(motion.names)
    homogeneous = np.concatenate([motion.points, np.ones_like(motion.points[..., :1])], -1)
    document["data"]["points"] = homogeneous.transpose(2, 1, 0)
    with tempfile.TemporaryDirectory() as folder:  # ezc3d writes to a path only
        path = Path(folder) / "out.c3d"
        document.write(str(path))
        return path.read_bytes()
