"""Reconstructions in the formats of other programs, chosen by the suffix."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from torchrecon.errors import ReconError
from torchrecon.io.files import write_bytes
from torchrecon.measurement import Reconstruction

__all__ = ["FORMATS", "export_reconstruction"]


def _csv(points: np.ndarray, fps: float) -> bytes:
    """Long form: one line per frame and point, camera axes, the unit of the reconstruction."""
    lines = ["frame,time,point,x,y,z"]
    for f, frame in enumerate(points):
        lines += [f"{f},{f / fps:.6f},{p},{x:.9g},{y:.9g},{z:.9g}" for p, (x, y, z) in enumerate(frame)]
    return ("\n".join(lines) + "\n").encode()


def _trc(points: np.ndarray, fps: float) -> bytes:
    """OpenSim marker file: Y up, so camera y and z change sign; the unit line says m."""
    frames, count, _ = points.shape
    up = points * np.array([1.0, -1.0, -1.0])
    names = [f"p{i}" for i in range(count)]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\treconstruction.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{fps:g}\t{fps:g}\t{frames}\t{count}\tm\t{fps:g}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, count + 1)),
        "",
    ]
    lines += [
        f"{f + 1}\t{f / fps:.6f}\t" + "\t".join(f"{value:.9g}" for value in up[f].reshape(-1)) for f in range(frames)
    ]
    return ("\n".join(lines) + "\n").encode()


def _ply(points: np.ndarray, fps: float) -> bytes:
    """ASCII point cloud of all frames; the property ``frame`` tells them apart."""
    frames, count, _ = points.shape
    header = ["ply", "format ascii 1.0", f"comment fps {fps:g}", f"element vertex {frames * count}"]
    header += [f"property float {axis}" for axis in "xyz"] + ["property int frame", "end_header"]
    rows = [f"{x:.9g} {y:.9g} {z:.9g} {f}" for f in range(frames) for x, y, z in points[f]]
    return ("\n".join(header + rows) + "\n").encode()


def _c3d(points: np.ndarray, fps: float) -> bytes:
    """Marker file (camera axes, metres) through ezc3d."""
    try:
        import ezc3d
    except ImportError as error:
        raise ReconError("export: .c3d needs ezc3d; install it with pip install 'torchrecon[io]'") from error
    import tempfile

    document = ezc3d.c3d()
    document["parameters"]["POINT"]["RATE"]["value"] = [fps]
    document["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    document["parameters"]["POINT"]["LABELS"]["value"] = [f"p{i}" for i in range(points.shape[1])]
    homogeneous = np.concatenate([points, np.ones_like(points[..., :1])], -1)
    document["data"]["points"] = homogeneous.transpose(2, 1, 0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "out.c3d"
        document.write(str(path))
        return path.read_bytes()


FORMATS: dict[str, Callable[[np.ndarray, float], bytes]] = {".csv": _csv, ".trc": _trc, ".ply": _ply, ".c3d": _c3d}


def export_reconstruction(reconstruction: Reconstruction, path: str | os.PathLike[str], fps: float = 25.0) -> Path:
    """Write ``points3d`` in the format that the suffix of ``path`` names.

    Args:
        reconstruction: batch ``()``; lengths keep the unit of the reconstruction.
        path: ``.csv``, ``.trc``, ``.ply`` or ``.c3d``, replaced atomically.
        fps: frames per second, for the time column.

    Raises:
        ReconError: unknown suffix, a batch, a rate that is not positive, or a missing optional library.

    Example:
        >>> import tempfile, torch
        >>> from torchrecon.measurement import Status
        >>> eye = torch.eye(3).expand(2, 3, 3)
        >>> rec = Reconstruction.from_points(torch.rand(2, 4, 3), eye, rank=1, status=Status("ok", "by hand"))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     len(export_reconstruction(rec, f"{folder}/a.csv").read_text().splitlines())
        9
    """
    target = Path(path)
    if target.suffix.lower() not in FORMATS:
        raise ReconError(f"{target}: cannot export to {target.suffix or 'no suffix'}; use one of {', '.join(FORMATS)}")
    if reconstruction.points3d.ndim != 3:
        raise ReconError("export: one reconstruction at a time; index the batch first")
    if not 0 < fps < float("inf"):
        raise ReconError(f"export: fps {fps} is not a positive rate")
    points = reconstruction.points3d.detach().cpu().double().numpy()
    return write_bytes(target, FORMATS[target.suffix.lower()](points, fps))
