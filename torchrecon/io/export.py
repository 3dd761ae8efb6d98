"""Reconstructions in the formats of other programs, chosen by the suffix."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from torchrecon.errors import ReconError
from torchrecon.io.files import write_bytes
from torchrecon.io.frames import open_frames
from torchrecon.io.writers import Motion, bvh, c3d, csv, glb, mp4, npz, ply, rrd, trc
from torchrecon.measurement import Reconstruction, Tracks

__all__ = ["FORMATS", "export_reconstruction", "to_motion"]

FORMATS: dict[str, Callable[[Motion], bytes]] = {
    ".bvh": bvh.encode,
    ".c3d": c3d.encode,
    ".csv": csv.encode,
    ".glb": glb.encode,
    ".npz": npz.encode,
    ".ply": ply.encode,
    ".rrd": rrd.encode,
    ".trc": trc.encode,
}


def export_reconstruction(
    reconstruction: Reconstruction,
    path: str | os.PathLike[str],
    fps: float | None = None,
    *,
    tracks: Tracks | None = None,
    names: Sequence[str] | None = None,
    edges: Sequence[tuple[int, int]] | None = None,
    unit_scale: float | None = None,
    height_m: float | None = None,
    place: bool = False,
    video: str | os.PathLike[str] | None = None,
    force: bool = False,
) -> Path:
    """Write ``points3d`` in the format that the suffix of ``path`` names.

    Args:
        reconstruction: batch ``()``.
        path: ``.bvh``, ``.c3d``, ``.csv``, ``.glb``, ``.npz``, ``.ply``, ``.rrd``, ``.trc`` or ``.mp4``, replaced
            atomically. A folder (``frames/``) or a name with a number (``walk_%04d.ply``) takes one PLY file a frame.
        fps: frames per second; default: the rate of the tracks, else 25.
        tracks: what was reconstructed; brings rate, names, edges, and whether depth was measured.
        names: one per point, instead of those of the tracks.
        edges: bones as pairs of point indices, instead of those of the tracks.
        unit_scale: metres per unit of the reconstruction.
        height_m: stature of the person in metres, instead of ``unit_scale``: what the median over the frames of the
            vertical extent of the points is scaled to. Right for a person who mostly stands upright in the picture.
        place: keep where the camera saw the shape, the camera at the origin, instead of centring every frame; needs
            intrinsics.
        video: the clip, for ``.mp4``, which shows the tracks and the reprojection on it.
        force: replace the files of an earlier sequence of PLY files.

    Raises:
        ReconError: unknown suffix, a batch, a rate or scale that is not positive, names, edges or tracks that do not
            fit, or a missing optional library.

    Example:
        >>> import tempfile, torch
        >>> from torchrecon.measurement import Status
        >>> eye = torch.eye(3).expand(2, 3, 3)
        >>> rec = Reconstruction.from_points(torch.rand(2, 4, 3), eye, rank=1, status=Status("ok", "by hand"))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     len(export_reconstruction(rec, f"{folder}/a.csv").read_text().splitlines())
        9
    """
    target, suffix = Path(path), Path(path).suffix.lower()
    _check_tracks(reconstruction, tracks)
    if suffix == ".mp4":
        if video is None:
            raise ReconError(f"{target}: .mp4 shows the reconstruction on its clip; give --video VIDEO")
        if edges is None:
            edges = None if tracks is None else tracks.edges
        return write_bytes(target, mp4.encode(open_frames(video, fps), reconstruction, tracks, edges or ()))
    sequence = os.fspath(path).endswith(("/", os.sep)) or "%" in target.name
    if not sequence and suffix not in FORMATS:
        known = ", ".join([*FORMATS, ".mp4"])
        raise ReconError(f"{target}: cannot export to {target.suffix or 'no suffix'}; use one of {known}")
    motion = to_motion(reconstruction, fps, tracks, names, edges, unit_scale, height_m, place)
    if sequence:
        return _write_sequence(motion, target, "%" in target.name, force)
    return write_bytes(target, FORMATS[suffix](motion))


def to_motion(
    reconstruction: Reconstruction,
    fps: float | None = None,
    tracks: Tracks | None = None,
    names: Sequence[str] | None = None,
    edges: Sequence[tuple[int, int]] | None = None,
    unit_scale: float | None = None,
    height_m: float | None = None,
    place: bool = False,
) -> Motion:
    """What :func:`export_reconstruction` writes, arguments as there; its ``unit`` says what the numbers are.

    ``m`` with ``unit_scale``, ``height_m`` or tracks with measured depth; ``px`` without intrinsics; else ``unit``:
    with intrinsics alone the scale is arbitrary.

    Example:
        >>> import torch
        >>> from torchrecon.measurement import Status
        >>> points = torch.tensor([[[0.0, -100, 0], [0, 100, 0]]])
        >>> rec = Reconstruction.from_points(points, torch.eye(3)[None], rank=1, status=Status("ok", "by hand"))
        >>> to_motion(rec).unit, to_motion(rec, height_m=1.8).points[0, :, 1].round(6).tolist()
        ('px', [-0.9, 0.9])
    """
    _check_tracks(reconstruction, tracks)
    shape = reconstruction.points3d
    if place:
        if reconstruction.intrinsics is None:
            raise ReconError("export: --place needs intrinsics; without them the distance to the camera is not known")
        shape = shape * reconstruction.scale[:, None, None] + reconstruction.translation[:, None]
    points = shape.detach().cpu().double().numpy()
    unit = "px" if reconstruction.intrinsics is None else "unit"
    if tracks is not None and tracks.depth is not None:
        unit = "m"
    if unit_scale is not None and height_m is not None:
        raise ReconError("export: --unit-scale and --height exclude each other; give one of them")
    if height_m is not None:
        unit_scale = _positive("--height", height_m) / _stature(points)
    if unit_scale is not None:
        points, unit = points * _positive("--unit-scale", unit_scale), "m"
    if tracks is not None:
        fps = tracks.fps if fps is None else fps
        names = tracks.names if names is None else names
        edges = tracks.edges if edges is None else edges
    return Motion(
        points,
        25.0 if fps is None else float(fps),
        tuple(names or ()),
        tuple((int(a), int(b)) for a, b in edges or ()),
        unit,
    )


def _check_tracks(reconstruction: Reconstruction, tracks: Tracks | None) -> None:
    if reconstruction.points3d.ndim != 3:
        raise ReconError("export: one reconstruction at a time; index the batch first")
    shape = tuple(reconstruction.points3d.shape[:-1])
    if tracks is not None and tuple(tracks.visible.shape) != shape:
        raise ReconError(
            f"export: the tracks hold {tuple(tracks.visible.shape)} frames and points, the reconstruction {shape}; "
            "give the tracks it was made from"
        )


def _positive(name: str, value: float) -> float:
    if not 0 < value < float("inf"):
        raise ReconError(f"export: {name} {value} is not a positive number")
    return float(value)


def _stature(points: np.ndarray) -> float:
    extent = float(np.median(np.ptp(points[..., 1], axis=1)))
    if not extent > 0:
        raise ReconError("export: the points have no vertical extent that --height could scale; give --unit-scale")
    return extent


def _write_sequence(motion: Motion, target: Path, pattern: bool, force: bool) -> Path:
    """One PLY file a frame; a longer sequence that stood there before leaves nothing behind."""
    folder, name = (target.parent, target.name) if pattern else (target, "%04d.ply")
    if Path(name).suffix.lower() != ".ply":
        raise ReconError(f"{target}: a sequence is written as .ply files; end the name with .ply")
    fresh = [ply.frame_name(name, frame) for frame in range(len(motion.points))]
    try:
        folder.mkdir(parents=not pattern, exist_ok=True)
    except OSError as error:
        raise ReconError(f"{folder}: cannot be made a folder ({error.strerror})") from error
    earlier = ply.sequence_files(folder, name)
    if earlier and not force:
        raise ReconError(f"{target}: {earlier[0]} stands there; choose another name or give --force")
    for frame, file in enumerate(fresh):
        write_bytes(folder / file, ply.encode_frame(motion, frame))
    for stale in earlier:
        if stale.name not in fresh:
            stale.unlink()
    return target
