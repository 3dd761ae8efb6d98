"""TRC, the marker file of OpenSim."""

from __future__ import annotations

from torchrecon.io.writers.motion import Motion

__all__ = ["encode"]


def encode(motion: Motion) -> bytes:
    """Tab-separated markers, y up and z towards the camera; the unit line names the unit of the motion.

    OpenSim reads lengths in ``m``; ``px`` and ``unit`` say that the numbers are no lengths yet.
    """
    frames, count, _ = motion.points.shape
    fps = motion.fps
    lines = [
        "PathFileType\t4\t(X/Y/Z)\treconstruction.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{fps:.9g}\t{fps:.9g}\t{frames}\t{count}\t{motion.unit}\t{fps:.9g}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(motion.names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, count + 1)),
        "",
    ]
    lines += [
        f"{f + 1}\t{f / fps:.6f}\t" + "\t".join(f"{value:.9g}" for value in frame.reshape(-1))
        for f, frame in enumerate(motion.upright)
    ]
    return ("\n".join(lines) + "\n").encode()
