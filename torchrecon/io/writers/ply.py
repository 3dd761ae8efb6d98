"""PLY point clouds: all frames in one file, or one file a frame."""

from __future__ import annotations

import re
from pathlib import Path

from torchrecon.errors import ReconError
from torchrecon.io.writers.motion import Motion

__all__ = ["encode", "encode_frame", "frame_name", "sequence_files"]


def encode(motion: Motion) -> bytes:
    """ASCII point cloud of all frames in camera axes; the property ``frame`` tells them apart."""
    frames, count, _ = motion.points.shape
    header = ["ply", "format ascii 1.0", f"comment fps {motion.fps:g}", f"comment unit {motion.unit}"]
    header += [f"element vertex {frames * count}"]
    header += [f"property float {axis}" for axis in "xyz"] + ["property int frame", "end_header"]
    rows = [f"{x:.9g} {y:.9g} {z:.9g} {f}" for f in range(frames) for x, y, z in motion.points[f]]
    return ("\n".join(header + rows) + "\n").encode()


def encode_frame(motion: Motion, frame: int) -> bytes:
    """ASCII point cloud of one frame in camera axes, with the bones as edges where they are known."""
    header = ["ply", "format ascii 1.0", f"comment unit {motion.unit}", f"element vertex {motion.points.shape[1]}"]
    header += [f"property float {axis}" for axis in "xyz"]
    rows = [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in motion.points[frame]]
    if motion.edges:
        header += [f"element edge {len(motion.edges)}", "property int vertex1", "property int vertex2"]
        rows += [f"{a} {b}" for a, b in motion.edges]
    return ("\n".join([*header, "end_header", *rows]) + "\n").encode()


def frame_name(pattern: str, frame: int) -> str:
    """The file name of a frame: ``%d`` or ``%04d`` in the pattern is the number.

    Raises:
        ReconError: no or more than one number in the pattern, or another per cent sign.

    Example:
        >>> frame_name("walk_%04d.ply", 7)
        'walk_0007.ply'
    """
    before, width, after = _split(pattern)
    return f"{before}{frame:0{width}d}{after}"


def sequence_files(folder: Path, pattern: str) -> list[Path]:
    """The files in a folder that a sequence of this pattern would write, in the order of their names."""
    before, _, after = _split(pattern)
    rule = re.compile(re.escape(before) + r"\d+" + re.escape(after))
    return sorted(file for file in folder.iterdir() if rule.fullmatch(file.name))


def _split(pattern: str) -> tuple[str, int, str]:
    parts = re.fullmatch(r"([^%]*)%(?:0(\d))?d([^%]*)", pattern)
    if parts is None:
        raise ReconError(f"{pattern}: needs one place for the frame number, like %04d")
    return parts[1], int(parts[2] or 1), parts[3]
