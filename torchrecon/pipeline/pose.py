"""Joints of a person in a video, found by a pose estimator that is installed beside this package.

Source: rtmlib runs RTMPose (Jiang et al. 2023) from ONNX files that it keeps in its own cache; nothing is fetched here.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.io.frames import load_camera, open_frames
from torchrecon.io.readers import ReadOptions, Source
from torchrecon.io.readers.base import build
from torchrecon.io.readers.mmpose import bodies, layout_of
from torchrecon.io.readers.people import choose, follow
from torchrecon.io.readers.source import numbers
from torchrecon.measurement import Tracks

__all__ = ["MODE", "POSES", "track_pose"]

MODE = "balanced"  # rtmlib's name of the models of middle size
Detector: TypeAlias = Callable[[NDArray[np.uint8]], tuple[Any, Any]]


class _Clip(Source):
    """A clip in the place of a file of keypoints: it names itself in errors, its content comes from a detector."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.kind = "video"


def track_pose(
    video: str | os.PathLike[str],
    pose: str = "rtmlib",
    camera: str | os.PathLike[str] | None = None,
    options: ReadOptions | None = None,
    device: str = "cpu",
    progress: bool = False,
) -> Tracks:
    """Joints of one person through a clip, the others told apart as in files of keypoints.

    Args:
        video: video file or folder of numbered images.
        pose: one of ``POSES``.
        camera: JSON file with the intrinsics.
        options: which person, and what confidence means.
        device: of the pose estimator.
        progress: show a progress bar on stderr.

    Returns:
        Tracks of 17 joints in COCO's order with names, bones, visibility and covariance.

    Raises:
        ReconError: the estimator or its weights are not there, an unreadable clip, nobody found.
    """
    if pose not in POSES:
        raise ReconError(f"--pose {pose}: is not known; use {', '.join(POSES)}")
    options = options or ReadOptions()
    frames = open_frames(video)
    clip = _Clip(Path(video))
    detect = POSES[pose](device)
    found = {}
    for index, frame in enumerate(_bar(frames, f"{pose} {clip.path.name}") if progress else frames):
        xy, scores = (numbers(clip, np.asarray(part), f"frame {index}") for part in detect(_bgr(frame)))
        found[index] = bodies(clip, xy, scores, f"frame {index}") if xy.size else []
    xy, confidence = choose(clip, options, follow(clip, found)).arrays(clip, len(frames))
    tracks = build(clip, options, xy, confidence, layout=layout_of(xy.shape[1]), fps=frames.fps)
    return tracks if camera is None else replace(tracks, intrinsics=load_camera(camera).intrinsics.to(tracks.xy))


def _rtmlib(device: str) -> Detector:
    try:
        import rtmlib
    except ImportError as error:
        raise ReconError("--pose rtmlib: needs rtmlib; install it with pip install 'torchrecon[pose]'") from error
    folder = _weights_folder()
    models = rtmlib.Body.MODE[MODE]
    missing = [
        name
        for name in (f"{PurePosixPath(models[part]).stem}.onnx" for part in ("det", "pose"))
        if not (folder / name).is_file()
    ]
    if missing:
        raise ReconError(
            f"--pose rtmlib: its weights {' and '.join(missing)} are not in {folder}; copy them there, or let rtmlib "
            f"fetch them once: python -c \"import rtmlib; rtmlib.Body(mode='{MODE}')\""
        )
    with contextlib.redirect_stdout(sys.stderr):  # it says there what it loads, where --json promises JSON alone
        detector: Detector = rtmlib.Body(mode=MODE, backend="onnxruntime", device=device)
    return detector


def _weights_folder() -> Path:
    """Where rtmlib keeps its weights."""
    cache = os.environ.get("TORCH_HOME") or os.path.join(os.environ.get("XDG_CACHE_HOME") or "~/.cache", "rtmlib")
    return Path(cache).expanduser() / "hub" / "checkpoints"


POSES: dict[str, Callable[[str], Detector]] = {"rtmlib": _rtmlib}
"""Pose estimators by name: from a device to a function of one BGR image, which gives the keypoints (people, points, 2)
in pixels and their scores (people, points)."""


def _bgr(frame: Float[Tensor, "3 height width"]) -> NDArray[np.uint8]:
    image: NDArray[np.uint8] = (frame.flip(0).permute(1, 2, 0) * 255).round().byte().contiguous().numpy()
    return image


def _bar(frames: Any, title: str) -> Any:
    from tqdm import tqdm

    return tqdm(frames, desc=title, unit="frame")
