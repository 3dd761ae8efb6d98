"""An array of tracked points to a moving 3D shape, and to files for other programs."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

import torchrecon as tr
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.io.export import export_reconstruction
from torchrecon.metrics import error3d_camera


def main(folder: str | Path = "out", frames: int = 60, points: int = 40, solver: str = "auto") -> tr.Reconstruction:
    """Write ``tracks.npz``, ``shape.npz``, ``shape.glb`` and ``shape.csv`` into the folder."""
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)

    # Your own array goes here: (frames, points, 2) pixels, x right and y down, NaN where a point is not seen.
    g = torch.Generator().manual_seed(2)
    body = sample_body(g)
    motion = sample_motion("shoot", body, frames=frames, generator=g)
    clip = SyntheticClip(body, motion, turning_camera(motion, 200.0, generator=g, projection="orthographic"))
    truth, _ = clip.trajectory(clip.sample_surface(points, g))
    xy = clip.camera.project(truth).double() + 0.5 * torch.randn(frames, points, 2, generator=g, dtype=torch.float64)
    xy[10:15, 0] = torch.nan

    tracks = tr.Tracks(xy, fps=25.0)
    rec = tr.reconstruct(tracks, solver=solver)
    print(rec.status)
    print(f"K = {rec.rank}, {rec.points3d.shape[0]} frames, {rec.points3d.shape[1]} points")
    error = error3d_camera(rec.points3d, truth.to(rec.points3d), align_scale="sequence")  # pixels against metres
    print(f"error against the truth: {float(error):.3f}")

    tracks.save(out / "tracks.npz")
    rec.save(out / "shape.npz")
    for suffix in (".glb", ".csv"):
        print(export_reconstruction(rec, out / f"shape{suffix}", tracks=tracks))
    return rec


if __name__ == "__main__":
    main(*sys.argv[1:2])
