"""2D joints of bodies that move: the synthetic world, real motion capture and real cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrecon._typing import Float, Tensor
from torchrecon.data.mocap import load_mocap
from torchrecon.data.synthetic import ACTIONS, sample_body, sample_motion
from torchrecon.errors import ReconError

__all__ = ["Joints2D", "humaneva_joints", "mocap_joints", "synthetic_joints"]

_HEIGHT = 190.0  # pixels: median height of a body in the image
_NEAR = 7.0  # metres from the camera at least, and twice as far as the body travels
_LENGTH = 90  # frames of a synthetic film


@dataclass(frozen=True, eq=False)
class Joints2D:
    """One sequence of joints without noise.

    Attributes:
        name, action: of the sequence.
        xy: (frames, joints, 2) pixels.
        fps: frames per second.
    """

    name: str
    action: str
    xy: Float[Tensor, "frames joints 2"]
    fps: float


def _seen(joints: Tensor, azimuth: float) -> Tensor:
    """Pinhole image from a fixed camera at chest height; the focal length makes the body ``_HEIGHT`` pixels tall."""
    c, s = math.cos(azimuth), math.sin(azimuth)
    turn = joints.new_tensor([[c, 0.0, s], [0.0, -1.0, 0.0], [-s, 0.0, c]])
    middle = joints.mean((0, 1))
    centred = (joints - middle) @ turn.T
    away = max(_NEAR, 2 * float(centred[..., 2].abs().max()))
    placed = centred + joints.new_tensor([0.0, 0.0, away])
    plane = placed[..., :2] / placed[..., 2:]
    height = plane[..., 1].amax(1) - plane[..., 1].amin(1)
    return 300 + plane * (_HEIGHT / height.median())


def synthetic_joints(count: int) -> list[Joints2D]:
    """Films of the synthetic world, all actions in turn.

    Example:
        >>> film = synthetic_joints(1)[0]
        >>> film.action, film.fps, film.xy.shape[0]
        ('shoot', 25.0, 90)
    """
    made = []
    for index in range(count):
        g = torch.Generator().manual_seed(5_000_000 + index)
        action = ACTIONS[index % len(ACTIONS)]
        motion = sample_motion(action, sample_body(g), frames=_LENGTH, fps=25.0, generator=g)
        azimuth = 2 * math.pi * float(torch.rand((), generator=g))
        made.append(Joints2D(f"{action}-{index}", action, _seen(motion.joints.double(), azimuth), motion.fps))
    return made


def mocap_joints(path: Path, count: int | None = None, least: int = 80) -> list[Joints2D]:
    """Optical clips of a motion capture collection (limbs of Kinect clips change their length), evenly taken."""
    clips = [clip for clip in load_mocap(path) if clip.quality.startswith("optical") and len(clip) >= least]
    kept = clips if count is None else [clips[i * len(clips) // count] for i in range(min(count, len(clips)))]
    g = torch.Generator().manual_seed(6_000_000)
    return [
        Joints2D(
            f"{clip.source} {clip.subject} {clip.trial}",
            clip.label,
            _seen(clip.joints.double(), 2 * math.pi * float(torch.rand((), generator=g))),
            clip.fps,
        )
        for clip in kept
    ]


def humaneva_joints(path: Path, count: int | None = None) -> list[Joints2D]:
    """Real cameras on real people: each sequence in each of its cameras, every second frame (30 Hz), evenly taken.

    Raises:
        ReconError: no such file.
    """
    if not path.is_file():
        raise ReconError(f"{path}: there is no such file; --data needs mocap/ and keypoints/ in it")
    with np.load(path, allow_pickle=False) as archive:
        made = [
            Joints2D(f"{name[:-4]} camera {c}", name, torch.from_numpy(archive[name][c, ::2]).double(), 30.0)
            for name in archive.files
            if name.endswith("__xy")
            for c in range(len(archive[name]))
        ]
    return made if count is None else [made[i * len(made) // count] for i in range(min(count, len(made)))]
