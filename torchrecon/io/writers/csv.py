"""CSV in long form: one line per frame and point."""

from __future__ import annotations

from torchrecon.io.writers.motion import Motion

__all__ = ["encode"]


def encode(motion: Motion) -> bytes:
    """Columns frame, time (s), point, x, y, z (camera axes, the unit of the motion) and name.

    Example:
        >>> import numpy as np
        >>> print(encode(Motion(np.zeros((1, 1, 3)), names=("hip",))).decode().splitlines()[1])
        0,0.000000,0,0,0,0,hip
    """
    lines = ["frame,time,point,x,y,z,name"]
    for f, frame in enumerate(motion.points):
        time = f"{f},{f / motion.fps:.6f}"
        lines += [
            f"{time},{p},{x:.9g},{y:.9g},{z:.9g},{name}"
            for p, ((x, y, z), name) in enumerate(zip(frame, motion.names, strict=True))
        ]
    return ("\n".join(lines) + "\n").encode()
