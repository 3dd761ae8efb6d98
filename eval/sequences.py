"""The test films of Table 1: who moves how before which camera, and what the tracker and the truth say of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import tee
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from eval.job import Profile, read_arrays, write_arrays
from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.synthetic import (
    SensorNoise,
    SurfacePoints,
    SyntheticClip,
    retarget_joints,
    sample_body,
    sample_motion,
    static_camera,
    turning_camera,
)
from torchrecon.errors import ReconError
from torchrecon.features import track_points
from torchrecon.measurement import Tracks
from torchrecon.noise import hessian_covariance
from torchrecon.pipeline.depth import body_depth, with_depth

__all__ = ["ACTIONS", "Filmed", "Filming", "Sequence", "mocap_sequences", "synthetic_sequences"]

ACTIONS = ("shoot", "run", "jump", "pass")
TEST_SEED = 960_000_000  # seeds of test films start here; training takes its own, lower ones


@dataclass(frozen=True)
class Filming:
    """How every sequence is filmed.

    Attributes:
        regime: ``turning`` camera without depth, or ``depth``: static camera with a depth sensor.
        turn: of the camera about the player over the whole film, degrees; in the depth regime none.
        nearest, farthest: distance of the camera, metres.
        size: height and width, pixels.
    """

    regime: Literal["turning", "depth"] = "turning"
    turn: float = 300.0
    nearest: float = 6.0
    farthest: float = 8.0
    size: tuple[int, int] = (576, 768)


@dataclass(frozen=True)
class Sequence:
    """One test sequence: everything else follows from these fields and the :class:`Filming`.

    Attributes:
        name: file name of its predictions.
        action: true action.
        seed: of body, motion, camera and texture.
        frames: length; of a real motion its own length.
        fps: frames per second.
        data: mocap file of a real motion, else None.
        clip: index in that file.
        fold: of the cross-validation: the recogniser that reads this sequence never saw its subject.
        subject, source: of a real motion.
    """

    name: str
    action: str
    seed: int
    frames: int = 60
    fps: float = 25.0
    data: str | None = None
    clip: int = -1
    fold: int = 0
    subject: str = "synthetic"
    source: str = "synthetic"


def synthetic_sequences(per_action: int, frames: int, seed: int = 0) -> list[Sequence]:
    """``per_action`` films of each action; no two share a body.

    Example:
        >>> [item.name for item in synthetic_sequences(1, 60)]
        ['shoot-00', 'run-00', 'jump-00', 'pass-00']
    """
    return [
        Sequence(f"{action}-{i:02d}", action, TEST_SEED + 1000 * seed + 100 * a + i, frames)
        for i in range(per_action)
        for a, action in enumerate(ACTIONS)
    ]


def subject_folds(subjects: list[str], folds: int) -> dict[str, int]:
    """A fold for each subject, so that the clips are spread evenly: the largest subjects first, to the emptiest fold.

    Example:
        >>> subject_folds(["a", "a", "b", "c"], 2)
        {'a': 0, 'b': 1, 'c': 1}
    """
    count = {name: subjects.count(name) for name in sorted(set(subjects))}
    load = [0] * folds
    fold = {}
    for name in sorted(count, key=lambda item: (-count[item], item)):
        fold[name] = load.index(min(load))
        load[fold[name]] += count[name]
    return fold


def mocap_sequences(path: str, folds: int = 5, least_seconds: float = 1.0, seed: int = 0) -> list[Sequence]:
    """Every clip of the four actions that lasts long enough, at its own length.

    Raises:
        ReconError: the file is missing, lacks a key, or holds no such clip.
    """
    file = Path(path)
    if not file.is_file():
        raise ReconError(f"{file}: no such file; give the path of a mocap .npz")
    with np.load(file, allow_pickle=False) as archive:
        missing = {"label", "subject", "source", "fps", "n_frames"} - set(archive.files)
        if missing:
            raise ReconError(f"{file}: has no key {sorted(missing)[0]!r}; it is not a mocap file of this layout")
        label, subject, source = (archive[key].tolist() for key in ("label", "subject", "source"))
        fps, frames = archive["fps"].tolist(), archive["n_frames"].tolist()
    kept = [i for i in range(len(label)) if label[i] in ACTIONS and frames[i] >= least_seconds * fps[i]]
    if not kept:
        raise ReconError(f"{file}: holds no clip of {', '.join(ACTIONS)} of at least {least_seconds} s")
    fold = subject_folds([subject[i] for i in kept], folds)
    return [
        Sequence(
            f"{label[i]}-clip{i:04d}",
            label[i],
            TEST_SEED + 1_000_000 * (1 + seed) + i,
            int(frames[i]),
            float(fps[i]),
            str(file),
            i,
            fold[subject[i]],
            subject[i],
            source[i],
        )
        for i in kept
    ]


def make_clip(sequence: Sequence, filming: Filming) -> SyntheticClip:
    """The film, not yet rendered."""
    generator = torch.Generator().manual_seed(sequence.seed)
    body = sample_body(generator)
    if sequence.data is None:
        motion = sample_motion(sequence.action, body, frames=sequence.frames, fps=sequence.fps, generator=generator)
    else:
        with np.load(sequence.data, allow_pickle=False) as archive:
            joints = torch.from_numpy(archive[f"clip_{sequence.clip:04d}"]).to(torch.float32)
            parents, names = tuple(archive["parents"].tolist()), tuple(archive["joints"].tolist())
        motion = retarget_joints(joints, parents, names, body, sequence.fps)
    distance = filming.nearest + (filming.farthest - filming.nearest) * float(torch.rand((), generator=generator))
    if filming.regime == "depth":
        camera = static_camera(motion, distance=distance, size=filming.size, generator=generator)
    else:
        camera = turning_camera(
            motion, total_turn_deg=filming.turn, distance=distance, size=filming.size, generator=generator
        )
    return SyntheticClip(body, motion, camera, seed=sequence.seed, sensor_noise=SensorNoise())


@dataclass(frozen=True, eq=False)
class Filmed:
    """What one sequence gives: the tracks for the methods, the truth for the scores only.

    Attributes:
        tracks: from the pixels, with intrinsics (and depth in the depth regime).
        hessian: (frames, points, 2, 2) px^2 the paper's covariance (eq. 22) of each observation.
        truth: (frames, points, 3) camera axes, metres: the body point under each track's first observation.
        known: (points,) tracks that start on the body; the others have no truth and are scored in no row.
        rotations: (frames, 3, 3) world -> camera, of the film: for the read-out of every row alike.
    """

    tracks: Tracks
    hessian: Float[Tensor, "frames points 2 2"]
    truth: Float[Tensor, "frames points 3"]
    known: Bool[Tensor, " points"]
    rotations: Float[Tensor, "frames 3 3"]

    def save(self, path: Path) -> None:
        """Write everything into one file, atomically."""
        t = self.tracks
        arrays = {
            "xy": t.xy,
            "covariance": t.covariance,
            "depth": t.depth,
            "depth_variance": t.depth_variance,
            "intrinsics": t.intrinsics,
            "fps": torch.tensor(t.fps),
            "hessian": self.hessian,
            "truth": self.truth,
            "known": self.known,
            "rotations": self.rotations,
        }
        write_arrays(path, arrays)

    @classmethod
    def load(cls, path: Path) -> Filmed:
        """Read what :meth:`save` wrote."""
        a: dict[str, Any] = {name: torch.from_numpy(value) for name, value in read_arrays(path).items()}
        fields = ("covariance", "depth", "depth_variance", "intrinsics")
        tracks = Tracks(a["xy"], fps=float(a["fps"]), **{name: a.get(name) for name in fields})
        return cls(tracks, a["hessian"], a["truth"], a["known"], a["rotations"])


def film(sequence: Sequence, filming: Filming, profile: Profile) -> Filmed:
    """Render, track, and look up the truth under every track; frames are streamed.

    Grey frames (8 bit) and depth frames are kept until the tracks are known, for the paper's covariance and for the
    depth at each observation.
    """
    clip = make_clip(sequence, filming)
    grey: list[Tensor] = []
    depth: list[Tensor] = []

    render, whole = Profile(), Profile()

    def rendered() -> Iterator[tuple[Tensor, Tensor]]:
        for index in range(sequence.frames):
            with render("render"):
                frame = clip.render(index)
            luma = (frame.rgb * frame.rgb.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0)
            grey.append((255 * luma).round().to(torch.uint8))
            if filming.regime == "depth":
                sensed = body_depth(frame.depth, frame.mask, clip.camera.intrinsics)
                depth.append(torch.where(sensed.body, sensed.depth, torch.nan))
            yield frame.rgb, frame.mask

    first, second = tee(rendered())
    with whole("tracking"):
        tracks = track_points((rgb for rgb, _ in first), (mask for _, mask in second), fps=sequence.fps)
    profile.merge(render)
    spent, rest = render.stages["render"], whole.stages["tracking"]
    # The frames are rendered inside the tracker's loop over them: their share is taken out of its time.
    profile.add("tracking", rest["cpu_s"] - spent["cpu_s"], rest["wall_s"] - spent["wall_s"])
    tracks = replace(tracks, intrinsics=clip.camera.intrinsics, extras=None)
    with profile("covariance and truth"):
        if filming.regime == "depth":
            tracks = with_depth(tracks, depth, clip.camera.intrinsics)
        return Filmed(tracks, _hessian(tracks, grey), *_truth(tracks, clip), clip.camera.rotations)


def _hessian(tracks: Tracks, grey: list[Tensor]) -> Tensor:
    result = torch.full((*tracks.visible.shape, 2, 2), torch.nan, dtype=tracks.xy.dtype)
    for f, image in enumerate(grey):
        seen = tracks.visible[f]
        if seen.any():
            result[f, seen] = hessian_covariance(image[None].to(tracks.xy.dtype) / 255, tracks.xy[f, seen])[0]
    return result


def _truth(tracks: Tracks, clip: SyntheticClip) -> tuple[Tensor, Tensor]:
    """Trajectory of the body point under each track's first observation."""
    frames, points = tracks.visible.shape
    birth = tracks.visible.to(torch.int8).argmax(0)
    part = torch.full((points,), -1)
    local = torch.full((points, 3), torch.nan)
    for f in birth.unique().tolist():
        born = (birth == f).nonzero()[:, 0]
        surface = clip.surface_at(f, tracks.xy[f, born])
        part[born], local[born] = surface.part, surface.local.to(local.dtype)
    known = part >= 0
    truth = torch.full((frames, points, 3), torch.nan, dtype=tracks.xy.dtype)
    if known.any():
        truth[:, known] = clip.trajectory(SurfacePoints(part[known], local[known]))[0].to(truth.dtype)
    return truth, known
