"""A clip to a folder with tracks, reconstruction and ``report.html``: ``python examples/own_video.py [CLIP] [FOLDER]``.

Without a clip one of the synthetic world is filmed, whose masks are known.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import torch

import torchrecon as tr
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.pipeline.video import reconstruct_video


def film(folder: Path, frames: int, size: tuple[int, int]) -> None:
    """Numbered images in ``frames/`` and masks of the player in ``masks/``."""
    g = torch.Generator().manual_seed(5)
    body = sample_body(g)
    motion = sample_motion("shoot", body, frames=frames, generator=g)
    clip = SyntheticClip(body, motion, turning_camera(motion, 60.0, distance=5.0, size=size, generator=g), seed=5)
    for name in ("frames", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for index in range(frames):
        frame = clip.render(index)
        image = (frame.rgb.permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype("uint8")
        cv2.imwrite(str(folder / "frames" / f"{index:03d}.png"), image)
        cv2.imwrite(str(folder / "masks" / f"{index:03d}.png"), frame.mask.numpy().astype("uint8") * 255)


def main(
    clip: str | Path | None = None,
    folder: str | Path = "out",
    frames: int = 40,
    size: tuple[int, int] = (360, 480),
    solver: str = "auto",
) -> tr.Reconstruction:
    """The same as ``torchrecon reconstruct CLIP -o FOLDER``, from Python."""
    masks = None
    if clip is None:
        made = Path(folder).with_name(Path(folder).name + "_film")
        film(made, frames, size)
        clip, masks = made / "frames", made / "masks"
    rec = reconstruct_video(clip, folder, masks=masks, solver=solver, progress=sys.stderr.isatty())
    tracks = tr.load_tracks(Path(folder) / "tracks.npz")
    seen = tracks.visible
    error = (rec.reproject() - tracks.xy)[seen].norm(dim=-1).median()
    print(rec.status)
    print(f"{tracks.points} tracks, K = {rec.rank}, median reprojection error {float(error):.2f} pixels")
    print(f"open {Path(folder) / 'report.html'} in a browser")
    return rec


if __name__ == "__main__":
    main(*sys.argv[1:3])
