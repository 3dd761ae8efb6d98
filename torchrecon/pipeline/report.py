"""The page of a run: rank evidence, film and origin are gathered here, drawn by ``viz.report``."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from pathlib import Path

import torch

import torchrecon
from torchrecon.errors import ReconError
from torchrecon.io.files import write_bytes
from torchrecon.io.frames import FrameSource, encode_stills, open_frames
from torchrecon.measurement import RankEstimate, Reconstruction, Tracks
from torchrecon.rank import estimate_rank
from torchrecon.viz.report import build_report

__all__ = ["write_report"]

_PACKAGES = ("torch", "kornia", "numpy", "scipy", "opencv-python-headless")


def write_report(
    reconstruction: Reconstruction,
    path: str | os.PathLike[str],
    *,
    tracks: Tracks | None = None,
    video: str | os.PathLike[str] | None = None,
    rank: RankEstimate | None = None,
    title: str | None = None,
    command: str | None = None,
    settings: Mapping[str, object] | None = None,
    seed: int = 0,
    max_bytes: int = 8_000_000,
) -> Path:
    """Write ``report.html``, atomically.

    Args:
        reconstruction: batch ``()``.
        path: the page.
        tracks: the tracks it was made from.
        video: the clip they were found in.
        rank: the estimate of K; default: made from ``tracks`` with ``seed``.
        title: default: the name of the clip.
        command: the command that made it, for the page to show.
        settings: what the run was asked for, for the page to show.
        seed: of the rank estimate.
        max_bytes: largest page; size and quality of the film follow from it.

    Raises:
        ReconError: unreadable video, or tracks or video that do not have the frames of the reconstruction.
    """
    frames = None if video is None else open_frames(video)
    _check(reconstruction, frames)
    if rank is None and tracks is not None:
        rank = estimate_rank(tracks, generator=torch.Generator().manual_seed(seed))
    page = build_report(
        reconstruction,
        tracks,
        rank,
        None if frames is None else lambda budget: encode_stills(frames, budget),
        title=title or ("Reconstruction" if video is None else _name(Path(video).resolve())),
        fps=25.0 if frames is None else frames.fps,
        command=command,
        versions=_versions(),
        settings=settings,
        max_bytes=max_bytes,
    )
    return write_bytes(path, page)


def _check(reconstruction: Reconstruction, frames: FrameSource | None) -> None:
    wanted = reconstruction.points3d.shape[-3]
    if frames is not None and len(frames) != wanted:
        raise ReconError(
            f"{frames.path}: has {len(frames)} frames, the reconstruction {wanted}; give the clip it was made from"
        )


def _name(video: Path) -> str:
    """A folder of images is often called "frames", so that the folder around it says more."""
    return video.name if video.is_file() else "/".join(video.parts[-2:])


def _versions() -> dict[str, str]:
    found = {"torchrecon": torchrecon.__version__, "python": platform.python_version()}
    for name in _PACKAGES:
        found[name] = importlib.metadata.version(name)
    return found | {"system": f"{platform.system()} {platform.machine()}"}
