"""Joints of captured everyday motion before a turning camera: far more sequences than the solver was made on."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path

import torch

from torchrecon.data.benchmarks import Benchmark
from torchrecon.data.mocap import load_mocap
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector

__all__ = ["FILE", "sample", "trial", "trials"]

FILE = "general.npz"
SHORTEST, LONGEST = 90, 240  # frames; longer trials are cut
EVERY = 16  # trial of the sample
STEP, ABOVE = math.radians(5), math.radians(10)  # of the camera: yaw per frame, as in the public sequences; pitch


@lru_cache(maxsize=1)
def _clips(file: Path) -> dict[str, torch.Tensor]:
    clips = enumerate(load_mocap(file))
    return {f"{i:04d}-{clip.label}": clip.joints[:LONGEST].double() for i, clip in clips if len(clip) >= SHORTEST}


def trials(folder: Path) -> list[str]:
    """Names of the trials that are long enough.

    Raises:
        ReconError: the file is not there.
    """
    return list(_clips(folder / FILE))


def sample(folder: Path) -> list[str]:
    """Every so many of them, a fixed sample of a few minutes."""
    return trials(folder)[::EVERY]


def trial(name: str, folder: Path) -> Benchmark:
    """Joints in metres, world axes with y up, and in the axes of a camera that turns about them by 5 degrees a frame.

    Raises:
        ReconError: there is no such trial.
    """
    clips = _clips(folder / FILE)
    if name not in clips:
        raise ReconError(f"{folder / FILE}: has no trial {name!r} of {SHORTEST} frames or more")
    world = clips[name]
    turns = torch.zeros(len(world), 3, dtype=world.dtype)
    turns[:, 1] = STEP * torch.arange(len(world), dtype=world.dtype)
    tilt = rotation_from_vector(world.new_tensor([ABOVE, 0.0, 0.0]))
    centred = world - world.mean(1, keepdim=True)
    return Benchmark(name, centred @ (tilt @ rotation_from_vector(turns)).mT, centred)
