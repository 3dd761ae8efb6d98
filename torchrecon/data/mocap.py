"""Readers of motion capture with a skeleton: the project's npz collections and BVH.

Both deliver metres; the npz collections and most BVH files have y up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["MocapClip", "load_mocap", "read_bvh"]

_VECTORS = ("label", "subject", "trial", "source", "quality", "license")
_MAX_BYTES = 1 << 26
_MAX_POSITIONS = 1 << 21  # each comes with a rotation matrix


@dataclass(frozen=True, eq=False)
class MocapClip:
    """One captured motion.

    Attributes:
        joints: metres.
        parents: parent of each joint, -1 for the root.
        names: of the joints.
        fps: frames per second.
        label: action; ``subject``, ``trial``, ``source``, ``quality`` and ``license`` say where it comes from.
    """

    joints: Float[Tensor, "frames joints 3"]
    parents: tuple[int, ...]
    names: tuple[str, ...]
    fps: float
    label: str = ""
    subject: str = ""
    trial: str = ""
    source: str = ""
    quality: str = ""
    license: str = ""

    def __len__(self) -> int:
        return self.joints.shape[0]


def load_mocap(path: str | Path, labels: Sequence[str] | None = None) -> list[MocapClip]:
    """Clips of an npz collection: ``joints``, ``parents``, ``n_clips``, ``clip_0000`` ... and one vector per field.

    Args:
        path: file; numbers only, nothing in it is unpickled.
        labels: keep only clips with one of these labels.

    Raises:
        ReconError: no such file, or a key is missing.
    """
    file = Path(path)
    if not file.is_file():
        raise ReconError(f"{file}: there is no such file; give the path of a mocap collection (.npz)")
    with np.load(file, allow_pickle=False) as data:
        missing = [k for k in ("joints", "parents", "n_clips", "fps", *_VECTORS) if k not in data.files]
        if missing:
            raise ReconError(f"{file}: key {missing[0]!r} is missing; a mocap collection has it per clip or once")
        names = tuple(str(n) for n in data["joints"])
        parents = tuple(int(p) for p in data["parents"])
        fields = {key: data[key] for key in (*_VECTORS, "fps")}
        clips = []
        for index in range(int(data["n_clips"])):
            if labels is not None and str(fields["label"][index]) not in labels:
                continue
            joints = torch.from_numpy(data[f"clip_{index:04d}"]).to(torch.get_default_dtype())
            if joints.shape[1:] != (len(names), 3):
                raise ReconError(
                    f"{file}: clip_{index:04d} has shape {tuple(joints.shape)}, not (frames, {len(names)}, 3)"
                )
            text = {key: str(fields[key][index]) for key in _VECTORS}
            clips.append(MocapClip(joints, parents, names, float(fields["fps"][index]), **text))
    return clips


def read_bvh(path: str | Path, metres_per_unit: float = 0.01) -> MocapClip:
    """Joint positions of a BVH file by forward kinematics.

    Rotations are applied in the order of the channels, as intrinsic turns in degrees. End sites become joints named
    after their parent with ``_end``.

    Args:
        path: text file with HIERARCHY and MOTION.
        metres_per_unit: the format states no unit; centimetres are the most common.

    Raises:
        ReconError: the text is not BVH, or a frame has the wrong number of values; the line is named.
    """
    file = Path(path)
    if not file.is_file():
        raise ReconError(f"{file}: there is no such file; give the path of a BVH file")
    if file.stat().st_size > _MAX_BYTES:
        raise ReconError(f"{file}: larger than {_MAX_BYTES} bytes; cut the recording into pieces")
    lines = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    skeleton, at = _bvh_hierarchy(file, lines)
    frames, fps = _bvh_frames(file, lines, at, sum(len(c) for c in skeleton.channels))
    if len(frames) * len(skeleton.names) > _MAX_POSITIONS:
        raise ReconError(f"{file}: {len(frames)} frames of {len(skeleton.names)} joints; cut the recording into pieces")
    values = torch.from_numpy(frames)
    positions: list[Tensor] = []
    rotations: list[Tensor] = []
    column = 0
    for joint, (parent, channels) in enumerate(zip(skeleton.parents, skeleton.channels, strict=True)):
        local = torch.eye(3, dtype=torch.float64).expand(len(values), 3, 3)
        step = torch.tensor(skeleton.offsets[joint], dtype=torch.float64).expand(len(values), 3).clone()
        moved = False
        for channel in channels:
            axis, kind = "XYZ".index(channel[0]), channel[1:]
            if kind == "position":
                # Positions replace the offset: that is what writers of the format do for the root.
                step = step if moved else torch.zeros_like(step)
                moved = True
                step[:, axis] = values[:, column]
            else:
                local = local @ _axis_rotation(torch.deg2rad(values[:, column]), axis)
            column += 1
        if parent < 0:
            positions.append(step)
            rotations.append(local)
        else:
            positions.append(positions[parent] + torch.einsum("fij,fj->fi", rotations[parent], step))
            rotations.append(rotations[parent] @ local)
    joints = (metres_per_unit * torch.stack(positions, 1)).to(torch.get_default_dtype())
    return MocapClip(joints, tuple(skeleton.parents), tuple(skeleton.names), fps, trial=file.stem, source="BVH")


@dataclass
class _BvhSkeleton:
    names: list[str]
    parents: list[int]
    offsets: list[list[float]]
    channels: list[list[str]]


def _bvh_hierarchy(file: Path, lines: list[str]) -> tuple[_BvhSkeleton, int]:
    """The skeleton, and the index of the line MOTION."""
    skeleton = _BvhSkeleton([], [], [], [])
    stack: list[int] = []
    opened = -1
    for number, line in enumerate(lines):
        words = line.split()
        if not words or words[0] == "HIERARCHY":
            continue
        key = words[0]
        try:
            if key in ("ROOT", "JOINT", "End"):
                parent = stack[-1] if stack else -1
                name = f"{skeleton.names[parent]}_end" if key == "End" else " ".join(words[1:])
                skeleton.names.append(name)
                skeleton.parents.append(parent)
                skeleton.offsets.append([0.0, 0.0, 0.0])
                skeleton.channels.append([])
                opened = len(skeleton.names) - 1
            elif key == "{":
                stack.append(opened)
            elif key == "}":
                stack.pop()
            elif key == "OFFSET":
                skeleton.offsets[stack[-1]] = [float(words[i]) for i in (1, 2, 3)]
            elif key == "CHANNELS":
                channels = words[2 : 2 + int(words[1])]
                if len(channels) != int(words[1]) or any(
                    c[0] not in "XYZ" or c[1:] not in ("position", "rotation") for c in channels
                ):
                    raise ValueError("channels")
                skeleton.channels[stack[-1]] = channels
            elif key == "MOTION":
                if not skeleton.names:
                    raise ValueError("no joint before MOTION")
                return skeleton, number
            else:
                raise ValueError(key)
        except (IndexError, ValueError) as error:
            raise ReconError(
                f"{file}: line {number + 1} is not BVH ({' '.join(words)[:60]!r}); repair the file"
            ) from error
    raise ReconError(f"{file}: there is no line MOTION; this is not a BVH file, or it is cut off")


def _bvh_frames(file: Path, lines: list[str], at: int, width: int) -> tuple[np.ndarray, float]:
    rows = [(number, line) for number, line in enumerate(lines[at + 1 :], at + 2) if line.strip()]
    head = {line.split()[0]: line.split() for _, line in rows[:2]}
    if "Frames:" not in head or "Frame" not in head:
        raise ReconError(f"{file}: line {at + 2}: MOTION must go on with 'Frames: n' and 'Frame Time: seconds'")
    try:
        count, seconds = int(head["Frames:"][1]), float(head["Frame"][2])
    except (IndexError, ValueError) as error:
        raise ReconError(f"{file}: line {at + 2}: 'Frames: n' and 'Frame Time: seconds' need a number each") from error
    body = rows[2:]
    if not 0 < count <= len(body) or not 0 < seconds < math.inf:
        raise ReconError(
            f"{file}: {count} frames of {seconds} s are announced, {len(body)} are there; the file is cut off"
        )
    values = np.empty((count, width))
    for index, (number, line) in enumerate(body[:count]):
        words = line.split()
        if len(words) != width:
            raise ReconError(f"{file}: line {number} has {len(words)} values; the channels of the skeleton are {width}")
        try:
            values[index] = [float(w) for w in words]
        except ValueError as error:
            raise ReconError(f"{file}: line {number} holds something that is no number; repair the file") from error
    return values, 1.0 / seconds


def _axis_rotation(angle: Tensor, axis: int) -> Tensor:
    """Right-handed rotation about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = torch.eye(3, dtype=angle.dtype).repeat(*angle.shape, 1, 1)
    matrix[..., i, i] = matrix[..., j, j] = angle.cos()
    matrix[..., j, i] = angle.sin()
    matrix[..., i, j] = -angle.sin()
    return matrix
