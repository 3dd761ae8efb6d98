"""The commands: read, call, write, print."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from torchrecon.errors import ReconError
from torchrecon.io.files import plain, write_json
from torchrecon.measurement import RankEstimate, Reconstruction, Tracks

__all__ = ["run"]


def run(options: argparse.Namespace) -> None:
    """Run the command that ``options.command`` names."""
    try:
        torch.empty(0, device=options.device)
    except (RuntimeError, AssertionError) as error:  # a build without that backend fails an assertion inside torch
        raise ReconError(f"--device {options.device}: is not available here ({error})") from error
    by_name = {f.__name__: f for f in (solve, rank, track, reconstruct, report, batch, export)}
    by_name[options.command](options)


def solve(options: argparse.Namespace) -> None:
    """``torchrecon solve``."""
    from torchrecon.pipeline.reconstructor import reconstruct as reconstruct_tracks

    tracks = _load(options)
    if options.camera is not None:
        tracks = _with_camera(tracks, options.camera)
    prior = _prior(options)
    answer = reconstruct_tracks(tracks, _rank(options.rank), options.solver, prior, _generator(options))
    path = answer.save(options.out)
    _say(options, _summary(answer) | {"out": str(path)})


def rank(options: argparse.Namespace) -> None:
    """``torchrecon rank``."""
    from torchrecon.rank import estimate_rank

    tracks = _load(options)
    estimate = estimate_rank(tracks, options.rule, options.layout, generator=_generator(options))
    fields = {name: plain(getattr(estimate, name)) for name in RankEstimate.__dataclass_fields__}
    if options.out is not None:
        write_json(options.out, fields)
    if options.figure is not None:
        from torchrecon.viz.scree import draw_scree

        draw_scree(estimate, options.figure)
    if options.json:
        _say(options, fields)
        return
    print(f"K = {fields['rank']} (interval {fields['interval']}), rule {estimate.rule}, layout {estimate.layout}")
    for warning in estimate.warnings:
        print(f"warning: {warning}", file=sys.stderr)


def track(options: argparse.Namespace) -> None:
    """``torchrecon track``."""
    if options.pose is not None:
        tracks = _joints(options)
    elif options.person is not None:
        raise ReconError("--person: tells people apart whose joints are found; it needs --pose")
    else:
        from torchrecon.pipeline.video import track_video

        config = _config(options)
        tracks = track_video(options.video, options.masks, options.depth, options.camera, config, progress=True)
    path = tracks.save(options.out)
    _say(options, {"tracks": tracks.points, "frames": tracks.frames, "out": str(path)})


def _joints(options: argparse.Namespace) -> Tracks:
    from torchrecon.io.readers import ReadOptions
    from torchrecon.pipeline.pose import track_pose

    for name in ("masks", "depth", "config"):
        if getattr(options, name) is not None:
            raise ReconError(f"--{name}: is of no use with --pose, which finds people by itself; leave one of them out")
    asked = ReadOptions(person=options.person)
    with _said_on_stderr():
        return track_pose(options.video, options.pose, options.camera, asked, options.device, progress=True)


def reconstruct(options: argparse.Namespace) -> None:
    """``torchrecon reconstruct``."""
    from torchrecon.pipeline.video import reconstruct_video

    answer = reconstruct_video(
        options.video,
        options.out,
        masks=options.masks,
        depth=options.depth,
        camera=options.camera,
        config=_config(options),
        rank=_rank(options.rank),
        solver=options.solver,
        device=options.device,
        seed=options.seed,
        force=options.force,
        progress=True,
    )
    _say(options, _summary(answer) | {"out": options.out, "report": str(Path(options.out) / "report.html")})


def report(options: argparse.Namespace) -> None:
    """``torchrecon report``."""
    from torchrecon.io.tracks import load_tracks
    from torchrecon.pipeline.report import write_report

    words = ["torchrecon", "report", options.reconstruction, "-o", options.out]
    for name in ("tracks", "video"):
        words += [] if getattr(options, name) is None else [f"--{name}", getattr(options, name)]
    path = write_report(
        Reconstruction.load(options.reconstruction),
        options.out,
        tracks=None if options.tracks is None else load_tracks(options.tracks),
        video=options.video,
        title=None if options.video is not None else Path(options.reconstruction).name,
        command=shlex.join(words),
        seed=options.seed,
    )
    _say(options, {"bytes": path.stat().st_size, "out": str(path)})


def batch(options: argparse.Namespace) -> None:
    """``torchrecon batch``."""
    from torchrecon.pipeline.batch import BatchSettings, run_batch
    from torchrecon.pipeline.workers import available_cores

    if options.threads < 1 or (options.workers is not None and options.workers < 0):
        raise ReconError("--workers and --threads: positive numbers are needed (--workers 0: in this process)")
    camera = None if options.camera is None else Path(options.camera)
    settings = BatchSettings(
        _rank(options.rank), options.solver, camera, _config(options), options.device, options.seed
    )
    workers = max(1, available_cores() // options.threads) if options.workers is None else options.workers
    manifest = run_batch(
        Path(options.folder),
        Path(options.out),
        settings,
        workers=workers,
        threads=options.threads,
        force=options.force,
        progress=True,
    )
    _say(options, manifest["counts"] | {"out": options.out})
    failed = [item["name"] for item in manifest["items"] if item["status"] == "failed"]
    if failed:
        raise ReconError(f"{', '.join(failed)}: failed; {options.out}/manifest.json says why, the rest is done")


def export(options: argparse.Namespace) -> None:
    """``torchrecon export``."""
    from torchrecon.io.export import export_reconstruction, to_motion
    from torchrecon.io.tracks import load_tracks

    source, out = Path(options.reconstruction), Path(options.out)
    reconstruction, tracks_file = Reconstruction.load(source), _tracks_of(options, source)
    tracks = None if tracks_file is None else load_tracks(tracks_file)
    if out.exists() and out.samefile(source):
        raise ReconError(f"{out}: is the reconstruction itself; choose another name")
    how = {"unit_scale": options.unit_scale, "height_m": options.height, "place": options.place}
    unit = to_motion(reconstruction, options.fps, tracks, **how).unit
    path = export_reconstruction(
        reconstruction, options.out, options.fps, tracks=tracks, **how, video=options.video, force=options.force
    )
    _say(options, {"out": str(path), "unit": unit, "tracks": None if tracks_file is None else str(tracks_file)})


def _tracks_of(options: argparse.Namespace, reconstruction: Path) -> Path | None:
    """The tracks that were named, else those of the run whose folder holds the reconstruction."""
    if options.tracks is not None:
        return Path(options.tracks)
    beside = reconstruction.with_name("tracks.npz")
    of_a_run = any(reconstruction.with_name(name).is_file() for name in ("run.json", "item.json"))
    return beside if of_a_run and beside.is_file() else None


def _load(options: argparse.Namespace) -> Tracks:
    """The tracks file, with what its reader has to say on stderr."""
    from torchrecon.io.tracks import load_tracks

    size = None if options.image_size is None else tuple(options.image_size)
    with _said_on_stderr():
        tracks = load_tracks(options.tracks, person=options.person, view=options.view, image_size=size, fps=options.fps)
    return tracks.to(options.device)


@contextmanager
def _said_on_stderr() -> Iterator[None]:
    """Warnings as sentences, once the work is done."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        yield
    for warning in said:
        print(f"warning: {warning.message}", file=sys.stderr)


def _config(options: argparse.Namespace) -> Any:
    from torchrecon.config import load_config

    return load_config(options.config)


def _with_camera(tracks: Tracks, path: str) -> Tracks:
    from dataclasses import replace

    from torchrecon.io.frames import load_camera

    return replace(tracks, intrinsics=load_camera(path).intrinsics)


def _prior(options: argparse.Namespace) -> Any:
    from torchrecon.models.prior import load_prior

    return None if options.prior is None else load_prior(options.prior).to(options.device)


def _rank(text: str) -> Any:
    if text == "auto":
        return "auto"
    if not text.isascii() or not text.isdigit() or int(text) < 1:
        raise ReconError(f"--rank {text}: is neither 'auto' nor a positive integer")
    return int(text)


def _generator(options: argparse.Namespace) -> torch.Generator:
    return torch.Generator().manual_seed(options.seed)


def _summary(answer: Reconstruction) -> dict[str, Any]:
    frames, points = answer.points3d.shape[-3:-1]
    return {
        "status": [str(status) for status in answer.statuses],
        "rank": plain(answer.rank),
        "deformation_degree": plain(answer.deformation_degree),
        "frames": frames,
        "points": points,
    }


def _say(options: argparse.Namespace, result: dict[str, Any]) -> None:
    if options.json:
        print(json.dumps(plain(result), allow_nan=False))
        return
    for name, value in result.items():
        print(f"{name}: {'; '.join(value) if name == 'status' else value}")
