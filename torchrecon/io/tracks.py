"""Tracks from files of any known format."""

from __future__ import annotations

import os

from torchrecon.errors import ReconError
from torchrecon.io.readers import FORMATS, ConfidenceParams, ReadOptions, Source, detect
from torchrecon.measurement import Tracks

__all__ = ["load_tracks"]


def load_tracks(
    path: str | os.PathLike[str],
    *,
    person: int | None = None,
    view: str | None = None,
    image_size: tuple[int, int] | None = None,
    fps: float | None = None,
    confidence: ConfidenceParams | None = None,
) -> Tracks:
    """Read tracks; the format is told from the content, not from the name.

    Known are: the project's own .npz (arrays named as the fields of :class:`torchrecon.Tracks`), CoTracker, TAPIR and
    TAPNext arrays (.npz, .npy), OpenPose, MediaPipe, MMPose and rtmlib JSON (a file, or a folder with one a frame),
    rtmlib .npz, COCO keypoint JSON, Penn Action .mat, DeepLabCut and SLEAP CSV and H5, HumanEva collections, long and
    wide CSV, each also gzipped. C3D, TRC, BVH and free-throw JSON hold 3D positions: they become tracks only with
    ``view``. Confidence becomes visibility and covariance by the one rule of
    :class:`torchrecon.io.readers.ConfidenceParams`.

    Args:
        path: file or folder.
        person: which person, where there are several, 0 = the longest and surest; default: that one, with a warning
            that says how many there are.
        view: for 3D files: ``front``, ``side`` or ``top``, an orthographic view in which a pixel is a millimetre.
        image_size: (height, width) in pixels, for positions that are shares of the image.
        fps: frames per second; default: what the file states, else 25.
        confidence: parameters of the rule.

    Returns:
        Tracks in float64 (own files keep their type): a file of keypoints is small, and normal equations of nearly
        noise-free points are not positive definite in float32. Frames without an entry have no visible point.

    Raises:
        ReconError: no such file, an unknown or damaged format, no such person, 3D positions without a view; names
            the file and what to do.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Tracks(torch.rand(4, 3, 2)).save(f"{folder}/tracks.npz")
        ...     load_tracks(path).xy.shape
        torch.Size([4, 3, 2])
    """
    if fps is not None and not 0 < fps < float("inf"):
        raise ReconError(f"fps: {fps} is not a positive number of frames per second")
    source = Source(path)
    found = detect(source)
    if found is None:
        raise source.error(f"{_content(source)}; known formats: {', '.join(known.name for known in FORMATS)}")
    return found.read(source, ReadOptions(person, view, image_size, fps, confidence or ConfidenceParams()))


def _content(source: Source) -> str:
    """What is there instead of a known format."""
    if source.path.suffix.lower() == ".npz" and source.kind != "npz":
        return f"is not a readable .npz archive (it holds {source.kind}); write it with numpy.savez"
    if source.kind in ("npz", "mat"):
        return f"has no key 'xy' nor those of another format; keys found: {', '.join(sorted(source.arrays)) or 'none'}"
    if source.kind == "json" and isinstance(source.json, dict):
        return f"is JSON of no known format; keys found: {', '.join(list(source.json)[:10]) or 'none'}"
    if source.kind == "folder":
        return "is a folder without .json files, of which OpenPose writes one a frame"
    return f"is {source.kind} of no known format"
