"""How good tracks, silhouettes and contours are, on real clips and against the truth of synthetic ones.

    python -m eval.frontend [--clip NAME ...] [--synthetic] [--only tracks|silhouette|contour|depth] [-o DIR]

Without ``--clip``, ``--synthetic`` and ``--only`` everything is run: tracks, silhouettes, the repair of silhouettes by
the kernel dynamical model, and depth (Fig. 3). Figures go to ``frontend.json`` (unrounded) and to the screen,
pictures of the tracks on frames beside them. When a track counts is said in ``eval/counting.py``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from eval.contours import run_repair
from eval.counting import LONG, MOVES, best_window
from eval.silhouettes import run_clip_silhouette, run_depth_figure, run_depth_silhouette, run_synthetic_silhouette
from torchrecon._typing import Float, Tensor
from torchrecon.contour.global_motion import background_paths, own_motion, to_gray8
from torchrecon.contour.mover import find_mover
from torchrecon.errors import ReconError
from torchrecon.features import track_points
from torchrecon.io.frames import CameraFile, load_camera, open_depths, open_frames, open_masks
from torchrecon.measurement import Tracks, backproject_points

VIDEO = Path(__file__).resolve().parents[2] / "shared" / "data" / "video"
WITHIN = 0.015  # metres
# Tracks that are to count on each clip (see eval.counting); of kinect_turn the tracks of 20 frames or more.
TARGETS = {
    "kinect_turn": 150,
    "PS7A1P1T1": 200,
    "bb_senatopal": 120,
    "sam2_juggle": 80,
    "davis_dance_twirl": 40,
    "bb_qinwyh_002": 40,
    "stgcn_ta_chi": 60,
}
ACTIONS = ("shoot", "run", "jump", "pass", "dribble")


def lengths(tracks: Tracks) -> Tensor:
    """Frames in which each track is seen."""
    return tracks.visible.sum(-2)


def world_positions(tracks: Tracks, folder: Path, camera: CameraFile) -> Float[Tensor, "frames points 3"]:
    """Sensor depth at each observation, carried to world axes: X_world = R X_camera + t; NaN = none."""
    if camera.rotations is None or camera.translations is None:
        raise ReconError(f"{folder}: the camera file has no R and t; they are needed to compare frames in the world")
    world = torch.full((*tracks.xy.shape[:2], 3), torch.nan, dtype=torch.float64)
    for index, depth in enumerate(open_depths(folder / "depth")):
        nearest = torch.nan_to_num(tracks.xy[index]).round().long()
        z = depth[nearest[:, 1], nearest[:, 0]].double()
        points = backproject_points(tracks.xy[index].double(), z, camera.intrinsics)
        world[index] = points @ camera.rotations[index].T + camera.translations[index]
    return torch.where(tracks.visible[..., None], world, torch.nan)


def depth_figures(tracks: Tracks, world: Float[Tensor, "frames points 3"]) -> dict[str, float]:
    """Distance of each long track's observations to its median position, the body being nearly rigid."""
    chosen = world[:, lengths(tracks) >= LONG]
    distance = (chosen - chosen.nanmedian(0).values).norm(dim=-1)
    known = torch.isfinite(distance)
    inside = (distance < WITHIN) & known
    share = inside.sum(0) / known.sum(0).clamp_min(1)
    return {
        "tracks_20": chosen.shape[1],
        "observations_within_15mm": float(inside.sum() / known.sum().clamp_min(1)),
        "tracks_90_percent_within_15mm": float((share >= 0.9).double().mean()),
        "tracks_all_within_15mm": float((share >= 1.0).double().mean()),
        "tracks_median_within_15mm": float((distance.nanmedian(0).values < WITHIN).double().mean()),
        "median_distance_mm": float(1000 * distance[known].median()),
    }


def draw(frame: Tensor, tracks: Tracks, index: int, path: Path) -> None:
    """Living tracks of one frame with their last ten positions; colour is age."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    height, width = frame.shape[-2:]
    figure = plt.figure(figsize=(width / 100, height / 100), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.imshow(frame.permute(1, 2, 0).numpy())
    seen = tracks.visible[index]
    tails = tracks.xy[max(0, index - 10) : index + 1, seen]
    axes.plot(tails[..., 0].numpy(), tails[..., 1].numpy(), color="yellow", linewidth=0.6)
    age = (tracks.extras or {})["age"][index, seen]
    axes.scatter(tails[-1, :, 0], tails[-1, :, 1], s=6, c=age, cmap="cool", vmin=0, vmax=LONG)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.axis("off")
    figure.savefig(path)
    plt.close(figure)


def run_clip(name: str, out: Path) -> dict[str, Any]:
    """Figures and pictures of one real clip."""
    path = VIDEO / name
    folder = path if path.is_dir() else None
    if folder is None and not path.is_file():
        matches = sorted(VIDEO.glob(f"{name}.*"))
        if not matches:
            raise ReconError(f"--clip {name}: neither a file nor a folder of that name in {VIDEO}")
        path = matches[0]
    frames = open_frames(path if folder is None else folder / "frames")
    began = time.process_time()
    given = folder is not None and (folder / "masks").is_dir()
    masks = list(open_masks(folder / "masks") if folder is not None and given else find_mover(frames))
    found = time.process_time()
    with_depth = folder is not None and (folder / "depth").is_dir()
    depths = open_depths(folder / "depth") if folder is not None and with_depth else None
    tracks = track_points(frames, masks, fps=frames.fps, depths=depths)
    done = time.process_time()
    paths = background_paths(frames, masks)
    counted = best_window(tracks, [to_gray8(f) for f in frames], paths, torch.stack(masks) if given else None)
    figures: dict[str, Any] = {
        "frames": len(frames),
        "size": list(frames.size),
        "masks": "given" if given else "found",
        "mask_seconds_per_frame": (found - began) / len(frames),
        "track_seconds_per_frame": (done - found) / len(frames),
        "tracks": tracks.points,
        "tracks_20": int((lengths(tracks) >= LONG).sum()),
        "alive_per_frame": float(tracks.visible.sum(1).double().mean()),
        "tracks_20_moving": int(
            ((lengths(tracks) >= LONG) & (own_motion(tracks.xy, tracks.visible, paths) >= MOVES)).sum()
        ),
        "counted": counted.count,
        "target": TARGETS.get(path.stem),
        "counting": asdict(counted),
    }
    if folder is not None and with_depth and (folder / "cameras.json").is_file():
        figures |= depth_figures(tracks, world_positions(tracks, folder, load_camera(folder / "cameras.json")))
    for index in sorted({len(frames) // 4, len(frames) // 2, 3 * len(frames) // 4}):
        frame = next(f for i, f in enumerate(frames) if i == index)
        dimmed = torch.where(masks[index], frame, 0.45 * frame)
        draw(dimmed, tracks, index, out / f"{path.stem}_{index:04d}.png")
    return figures


def synthetic_errors(tracks: Tracks, clip: Any) -> tuple[Tensor, Tensor]:
    """Track minus the true path of the body point under its first pixel; and which tracks began on the body."""
    first = tracks.visible.int().argmax(0)
    error = torch.full_like(tracks.xy, torch.nan)
    on_body = torch.zeros(tracks.points, dtype=torch.bool)
    for frame in first.unique().tolist():
        columns = (first == frame).nonzero()[:, 0]
        points = clip.surface_at(frame, tracks.xy[frame, columns])
        xyz, _ = clip.trajectory(points)
        error[:, columns] = tracks.xy[:, columns] - clip.camera.project(xyz).to(tracks.xy)
        on_body[columns] = points.part >= 0
    return error, on_body


def run_synthetic(action: str, view: str, seed: int, out: Path) -> dict[str, Any]:
    """Figures of one synthetic clip of 60 frames, 768 x 576 at 25 per second."""
    from torchrecon.data.synthetic import (
        SensorNoise,
        SyntheticClip,
        sample_body,
        sample_motion,
        static_camera,
        turning_camera,
    )

    generator = torch.Generator().manual_seed(seed)
    body = sample_body(generator)
    motion = sample_motion(action, body, frames=60, fps=25.0, generator=generator)
    make = turning_camera if view == "turning" else static_camera
    clip = SyntheticClip(body, motion, make(motion, generator=generator), seed=seed, sensor_noise=SensorNoise())
    rendered = [clip.render(index) for index in range(len(clip))]
    began = time.process_time()
    tracks = track_points([f.rgb for f in rendered], [f.mask for f in rendered], fps=clip.fps)
    seconds = time.process_time() - began
    error, on_body = synthetic_errors(tracks, clip)
    judged = tracks.visible & on_body & ((tracks.extras or {})["age"] > 0)
    distance = error[judged].norm(dim=-1)
    covariance = torch.as_tensor(tracks.covariance)[judged]
    squared = (error[judged][:, None] @ torch.linalg.inv(covariance) @ error[judged][..., None])[:, 0, 0] / 2
    draw(rendered[30].rgb, tracks, 30, out / f"synthetic_{action}_{view}.png")
    return {
        "seconds_per_frame": seconds / len(clip),
        "tracks": tracks.points,
        "tracks_20": int((lengths(tracks) >= LONG).sum()),
        "alive_per_frame": float(tracks.visible.sum(1).double().mean()),
        "within_1.5px": float((distance < 1.5).double().mean()),
        "median_px": float(distance.median()),
        "normalised_squared_error_mean": float(squared.mean()),
        "normalised_squared_error_median": float(squared.median()),
        "not_on_body": int((~on_body).sum()),
    }


def silhouettes(seed: int, out: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Silhouettes followed from a first-frame mask, and one found by depth."""
    for action in ACTIONS:
        yield f"silhouette {action} static", run_synthetic_silhouette(action, seed, out)
    if (VIDEO / "davis_dance_twirl").is_dir():
        yield "silhouette davis_dance_twirl", run_clip_silhouette(VIDEO / "davis_dance_twirl", out)
    if (VIDEO / "kinect_turn").is_dir():
        yield "silhouette kinect_turn by depth", run_depth_silhouette(VIDEO / "kinect_turn", out)


def contours(seed: int, out: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Corrupted silhouettes of the synthetic world repaired; the last line is the mean over the clips."""
    errors = []
    for view in ("turning", "static"):
        for action in ACTIONS:
            figures = run_repair(action, view, seed, out)
            errors.append((figures["corrupted_px"], figures["repaired_px"]))
            yield f"repair {action} {view}", figures
    before, after = (sum(column) / len(errors) for column in zip(*errors, strict=True))
    yield "repair mean", {"corrupted_px": before, "repaired_px": after, "lowered_by": 1 - after / before}


def depths(seed: int, out: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Fig. 3."""
    yield "depth squat", run_depth_figure(seed, out)


PARTS: dict[str, Callable[[int, Path], Iterator[tuple[str, dict[str, Any]]]]] = {
    "silhouette": silhouettes,
    "contour": contours,
    "depth": depths,
}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m eval.frontend", description="Figures and pictures of the tracker.")
    parser.add_argument("--clip", nargs="+", default=None, help="names in the video folder")
    parser.add_argument("--synthetic", action="store_true", help="the synthetic clips")
    parser.add_argument("--only", choices=["tracks", *PARTS], default=None, help="one part of the front end")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, default=Path("out/frontend"))
    chosen = parser.parse_args(argv)
    clips = chosen.clip
    tracks_named = clips is not None or chosen.synthetic
    if tracks_named and chosen.only not in (None, "tracks"):
        parser.error("--clip and --synthetic choose among the tracks; they do not go with --only " + chosen.only)
    everything = not tracks_named and chosen.only in (None, "tracks")
    parts = [chosen.only] if chosen.only in PARTS else [] if tracks_named or chosen.only else list(PARTS)
    if everything:
        clips = list(TARGETS) if VIDEO.is_dir() else []
    chosen.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {}
    try:
        for name in clips or []:
            results[name] = run_clip(name, chosen.out)
            print(_line(name, results[name]), flush=True)
        if chosen.synthetic or everything:
            for view in ("turning", "static"):
                for action in ACTIONS:
                    key = f"synthetic {action} {view}"
                    results[key] = run_synthetic(action, view, chosen.seed, chosen.out)
                    print(_line(key, results[key]), flush=True)
        for part in parts:
            for key, figures in PARTS[part](chosen.seed, chosen.out):
                results[key] = figures
                print(_line(key, figures), flush=True)
    except ReconError as error:
        print(f"eval.frontend: {error}", file=sys.stderr)
        return 2
    (chosen.out / "frontend.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
    return 0


def _line(name: str, figures: dict[str, Any]) -> str:
    values = (f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in figures.items())
    return f"{name}: " + ", ".join(values)


if __name__ == "__main__":
    raise SystemExit(main())
