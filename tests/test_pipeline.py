"""The whole road on a small synthetic film: frames in a folder to a reconstruction in a folder."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest
import torch

import torchrecon as tr
from torchrecon.cli import main
from torchrecon.data.synthetic import (
    SensorNoise,
    SyntheticClip,
    sample_body,
    sample_motion,
    static_camera,
    turning_camera,
)
from torchrecon.errors import ReconError
from torchrecon.measurement import backproject_points, project_points
from torchrecon.pipeline.depth import body_depth, with_depth

FRAMES = 20


def film(folder, depth: bool):
    """Frames, masks, depth and camera file of a shot at goal; returns the clip."""
    cv2 = pytest.importorskip("cv2")
    g = torch.Generator().manual_seed(5)
    body = sample_body(g)
    motion = sample_motion("shoot", body, frames=FRAMES, fps=25.0, generator=g)
    if depth:
        camera = static_camera(motion, size=(288, 384), generator=g)
    else:
        camera = turning_camera(motion, total_turn_deg=60.0, distance=5.0, size=(288, 384), generator=g)
    clip = SyntheticClip(body, motion, camera, seed=5, sensor_noise=SensorNoise() if depth else None)
    for name in ("frames", "masks", "depth"):
        (folder / name).mkdir()
    for i in range(FRAMES):
        frame = clip.render(i)
        image = (frame.rgb.permute(1, 2, 0).numpy()[..., ::-1] * 255).round().astype(np.uint8)
        cv2.imwrite(str(folder / "frames" / f"{i:03d}.png"), image)
        cv2.imwrite(str(folder / "masks" / f"{i:03d}.png"), frame.mask.numpy().astype(np.uint8) * 255)
        millimetres = torch.nan_to_num(frame.depth * 1000).clamp(0, 65535).round().numpy().astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{i:03d}.png"), millimetres)
    (folder / "camera.json").write_text(json.dumps({"K": camera.intrinsics.tolist()}))
    return clip


def test_a_film_becomes_a_reconstruction_and_is_not_overwritten(tmp_path, capsys):
    film(tmp_path, depth=False)
    out = tmp_path / "out"
    command = ["reconstruct", str(tmp_path / "frames"), "-o", str(out), "--masks", str(tmp_path / "masks")]
    command += ["--camera", str(tmp_path / "camera.json")]
    assert main([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    tracks = tr.load_tracks(out / "tracks.npz")
    rec = tr.Reconstruction.load(out / "reconstruction.npz")
    assert printed["points"] == tracks.points == rec.points3d.shape[1]
    assert printed["rank"] == rec.rank == tr.estimate_rank(tracks).rank
    assert (out / "views.png").read_bytes()[:4] == b"\x89PNG"
    page = (out / "report.html").read_text()
    assert f"torchrecon reconstruct {tmp_path / 'frames'} -o {out} --masks" in page
    assert '"film":{"every":1' in page
    seen = tracks.visible
    error = (rec.reproject() - tracks.xy)[seen].norm(dim=-1).median()
    assert error < 1.5  # pixels
    before = (out / "reconstruction.npz").read_bytes()
    assert main([*command, "--rank", "2"]) == 2
    assert "--force" in capsys.readouterr().err
    assert (out / "reconstruction.npz").read_bytes() == before
    assert main([*command, "--rank", "2", "--force"]) == 0
    assert tr.Reconstruction.load(out / "reconstruction.npz").rank == 2


def test_measured_depth_gives_metres(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # as after a plain install, which ends with the page too
    clip = film(tmp_path, depth=True)
    out = tmp_path / "out"
    # The folder holds frames/, masks/, depth/ and camera.json, and brings them all.
    assert main(["reconstruct", str(tmp_path), "-o", str(out)]) == 0
    assert {path.name for path in out.glob("*.[ph]*")} == {"report.html"}
    tracks = tr.load_tracks(out / "tracks.npz")
    rec = tr.Reconstruction.load(out / "reconstruction.npz")
    measured = tracks.visible & torch.isfinite(tracks.depth)
    assert measured.sum() > 0.5 * tracks.visible.sum()
    placed = rec.points3d + rec.translation[:, None]
    surface = backproject_points(tracks.filled_xy(), torch.nan_to_num(tracks.depth), tracks.intrinsics)
    assert (placed - surface)[measured].norm(dim=-1).median() < 0.02
    # The first observation of a track names a true point of the body; the answer has to lie near it in metres.
    first = int(tracks.visible.sum(1).argmax())
    points = clip.surface_at(first, tracks.xy[first][tracks.visible[first]])
    truth, _ = clip.trajectory(points)
    distance = (placed[first][tracks.visible[first]] - truth[first].to(placed)).norm(dim=-1)
    assert distance[points.part >= 0].median() < 0.05
    pixels = project_points(truth[first].to(placed), tracks.intrinsics)
    assert (pixels - tracks.xy[first][tracks.visible[first]])[points.part >= 0].norm(dim=-1).median() < 0.1


def test_a_frame_out_of_the_sensors_range_has_no_body_and_no_depth_at_all_is_an_error():
    k = torch.tensor([[50.0, 0, 16], [0, 50, 16], [0, 0, 1]])
    mask = torch.zeros(32, 32, dtype=torch.bool)
    mask[8:24, 8:24] = True
    near, far = torch.full((32, 32), 2.0), torch.full((32, 32), math.nan)
    assert body_depth(near, mask, k).body.sum() > 100
    assert not body_depth(far, mask, k).body.any()
    assert not body_depth(far, None, k).body.any()
    tracks = tr.Tracks(torch.full((2, 4, 2), 16.0))
    depth = with_depth(tracks, [near, far], k).depth
    assert torch.isfinite(depth[0]).all()
    assert not torch.isfinite(depth[1]).any()
    with pytest.raises(ReconError, match="depth: no tracked point"):
        with_depth(tracks, [far, far], k)


def test_counts_that_do_not_fit_are_named(tmp_path, capsys):
    film(tmp_path, depth=True)
    (tmp_path / "masks" / "007.png").unlink()
    command = ["track", str(tmp_path / "frames"), "-o", str(tmp_path / "t.npz"), "--masks", str(tmp_path / "masks")]
    assert main(command) == 2
    assert "19 images for the 20 frames" in capsys.readouterr().err
    assert main(["track", str(tmp_path / "frames"), "-o", "t.npz", "--depth", str(tmp_path / "depth")]) == 2
    assert "--camera" in capsys.readouterr().err
