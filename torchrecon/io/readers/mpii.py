"""MPII Human Pose annotations: single images, which are recognised in order to say what they are good for."""

from __future__ import annotations

from torchrecon.io.readers.base import Format, ReadOptions
from torchrecon.io.readers.source import Source
from torchrecon.measurement import Tracks

__all__ = ["MPII", "read_mpii"]


def _is_entry(value: object) -> bool:
    return isinstance(value, dict) and {"joints", "joints_vis", "image"} <= value.keys()


def _sniff(source: Source) -> bool:
    if source.kind == "json":
        return isinstance(source.json, list) and any(_is_entry(entry) for entry in source.json[:100])
    if source.kind == "mat":
        return {"pos_gt_src", "jnt_missing"} <= source.arrays.keys()
    head = source.data[:2000].partition(b"\n")[0] if source.kind == "text" else b""
    return b"NAME" in head and b"r ankle_X" in head


def read_mpii(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Always refuses.

    Raises:
        ReconError: with what the annotations can serve for.
    """
    raise source.error(
        "is MPII Human Pose: single images of different people, while a moving 3D shape needs one person through "
        "many frames. It can serve to score 2D detections (PCKh) or as a training set of poses; run a pose detector on "
        "a video and give its output instead"
    )


MPII = Format("MPII Human Pose", _sniff, read_mpii)
