"""People with known 3D joints before one camera that stands: captured motion, HumanEva, the synthetic world."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import torchrecon as tr
from eval.recordings import FILE, recordings
from torchrecon.data.mocap import MocapClip, load_mocap
from torchrecon.data.synthetic import ACTIONS, sample_body, sample_motion, static_camera
from torchrecon.io.readers.layouts import HUMANEVA_15

__all__ = ["FOLDS", "NAMES", "SCORED", "Person", "captured", "few", "folds_of", "humaneva", "synthetic"]

FOLDS = 3
SCORED = ("head", *(f"{s}_{j}" for s in "lr" for j in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")))
"""The joints that both data sets have and that are scored."""
NAMES = ("pelvis", "neck", *SCORED)
"""The joints that are tracked: those of HumanEva."""
TRAINING = ("mocap/dev.npz", "mocap/general.npz")
PIXEL_NOISE = 1.0
HUMANEVA_FRAMES = 120
"""Frames at 30 Hz, 4 s; the recordings are of 2.5 to 10 s."""


@dataclass(frozen=True, eq=False)
class Person:
    """One sequence.

    Attributes:
        name: of the sequence; ``group`` is the figure it counts for, ``source`` says who captured it.
        fold: which prior is asked: that of this fold has not seen the subject.
        tracks: named joints, no intrinsics.
        truth: (frames, joints, 3) metres; ``in_camera`` tells whether in the axes of the camera.
    """

    name: str
    group: str
    source: str
    fold: int
    tracks: tr.Tracks
    truth: torch.Tensor
    in_camera: bool

    @property
    def scored(self) -> list[int]:
        """Columns of the joints that are scored."""
        assert self.tracks.names is not None
        return [self.tracks.names.index(name) for name in SCORED]


def _group(subject: str) -> str:
    """Subjects that may be one person count as one."""
    return subject.split("_unk_")[0] + "_unk" if "_unk_" in subject else subject


def _optical(folder: Path) -> list[MocapClip]:
    return [clip for clip in load_mocap(folder / TRAINING[0]) if clip.quality != "kinect-v1"]


def folds_of(folder: Path) -> list[list[str]]:
    """Subjects of each fold, those that are only trained on in none; folds are as even in frames as subjects allow."""
    frames = Counter[str]()
    for clip in _optical(folder):
        frames[_group(clip.subject)] += len(clip)
    fold_of: dict[str, int] = {}
    load = [0] * FOLDS
    for name in sorted(frames, key=lambda name: (-frames[name], name)):
        fold_of[name] = load.index(min(load))
        load[fold_of[name]] += frames[name]
    subjects = {clip.subject for file in TRAINING for clip in load_mocap(folder / file)}
    return [sorted(s for s in subjects if fold_of.get(_group(s)) == fold) for fold in range(FOLDS)]


def captured(folder: Path, seed: int) -> list[Person]:
    """Every optical dev clip before a pinhole camera of its own: 3 to 6 m away, 1 to 2.5 m high, aimed at the middle of
    the path, 1 px of noise."""
    folds = folds_of(folder)
    people = []
    for index, clip in enumerate(_optical(folder)):
        g = torch.Generator().manual_seed(1_000_000 * (seed + 1) + index)
        columns = [clip.names.index(name) for name in NAMES]
        world = clip.joints[:, columns].double()
        root = world[:, 0]
        middle = (root.amin(0) + root.amax(0)) / 2
        draw = torch.rand(3, generator=g, dtype=torch.float64).tolist()
        yaw, distance, height = 2 * math.pi * draw[0], 3 + 3 * draw[1], 1 + 1.5 * draw[2]
        floor = float(clip.joints[..., 1].amin())
        # Who travels is filmed from as much farther away as the path is long, so that nobody passes the camera.
        distance += float((root - middle)[:, [0, 2]].norm(dim=-1).max())
        place = middle + distance * torch.tensor([math.sin(yaw), 0.0, math.cos(yaw)], dtype=torch.float64)
        place[1] = floor + height
        ahead = torch.nn.functional.normalize(middle - place, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(ahead, ahead.new_tensor([0.0, 1.0, 0.0])), dim=0)
        truth = (world - place) @ torch.stack([right, torch.linalg.cross(ahead, right), ahead]).T
        xy = 1300 * truth[..., :2] / truth[..., 2:]
        xy = xy + PIXEL_NOISE * torch.randn(xy.shape, generator=g, dtype=torch.float64)
        fold = next(k for k, subjects in enumerate(folds) if clip.subject in subjects)
        tracks = tr.Tracks(xy, fps=clip.fps, names=NAMES)
        people.append(Person(f"dev{index:04d} {clip.label}", "dev", clip.source, fold, tracks, truth, True))
    return people


def humaneva(folder: Path) -> list[Person]:
    """Every recording by each of its three cameras, as filmed; at 30 Hz and at most 4 s."""
    rename = {"thorax": "neck"} | {f"{side}_{j.split('_')[1]}": j for side in ("left", "right") for j in SCORED[1:]
                                   if j[0] == side[0]}  # fmt: skip
    names = [rename.get(name, name) for name in HUMANEVA_15.names]
    people, keys = [], recordings(folder / "keypoints")
    with np.load(folder / "keypoints" / FILE, allow_pickle=False) as data:
        for key in keys:
            truth = torch.from_numpy(data[f"{key}__xyz"]).double()[::2][:HUMANEVA_FRAMES]
            for camera, xy in enumerate(data[f"{key}__xy"]):
                tracks = tr.Tracks(torch.from_numpy(xy).double()[::2][:HUMANEVA_FRAMES], fps=30.0, names=names)
                people.append(Person(f"{key} camera {camera}", "humaneva", "HumanEva", 0, tracks, truth, False))
    return people


def synthetic(seed: int, count: int) -> list[Person]:
    """``count`` sequences of every action before a static pinhole camera, 0.7 px of noise."""
    people = []
    for index in range(count):
        for number, action in enumerate(ACTIONS):
            g = torch.Generator().manual_seed(900_000_000 + 1000 * seed + 10 * index + number)
            motion = sample_motion(action, sample_body(g), frames=60, fps=25.0, generator=g)
            camera = static_camera(motion, generator=g)
            truth = camera.to_camera(motion.joints)
            xy = camera.project(truth) + 0.7 * torch.randn(truth[..., :2].shape, generator=g)
            tracks = tr.Tracks(xy.double(), fps=25.0, names=motion.names)
            name = f"{action} {index}"
            people.append(Person(name, "synthetic", "synthetic", 0, tracks, truth.double(), True))
    return people


def few(people: list[Person], every: int) -> list[Person]:
    """Every n-th of them, and of each HumanEva recording one camera, in turn."""
    chosen = [person for index, person in enumerate(p for p in people if p.group != "humaneva") if index % every == 0]
    eva = [person for person in people if person.group == "humaneva"]
    return chosen + [eva[3 * index + index % 3] for index in range(len(eva) // 3)]
