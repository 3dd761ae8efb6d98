"""The commands: read, call, write, print."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
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
    {"solve": solve, "rank": rank, "track": track, "reconstruct": reconstruct, "export": export}[options.command](
        options
    )


def solve(options: argparse.Namespace) -> None:
    """``torchrecon solve``."""
    from torchrecon.pipeline.reconstructor import reconstruct as reconstruct_tracks

    tracks = _load(options)
    if options.camera is not None:
        tracks = _with_camera(tracks, options.camera)
    answer = reconstruct_tracks(tracks, _rank(options.rank), options.solver, generator=_generator(options))
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
    if options.json:
        _say(options, fields)
        return
    print(f"K = {fields['rank']} (interval {fields['interval']}), rule {estimate.rule}, layout {estimate.layout}")
    for warning in estimate.warnings:
        print(f"warning: {warning}", file=sys.stderr)


def track(options: argparse.Namespace) -> None:
    """``torchrecon track``."""
    from torchrecon.pipeline.video import track_video

    tracks = track_video(options.video, options.masks, options.depth, options.camera, _config(options), progress=True)
    path = tracks.save(options.out)
    _say(options, {"tracks": tracks.points, "frames": tracks.frames, "out": str(path)})


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
    _say(options, _summary(answer) | {"out": options.out})


def export(options: argparse.Namespace) -> None:
    """``torchrecon export``."""
    from torchrecon.io.export import export_reconstruction

    path = export_reconstruction(Reconstruction.load(options.reconstruction), options.out, options.fps)
    _say(options, {"out": str(path)})


def _load(options: argparse.Namespace) -> Tracks:
    """The tracks file, with what its reader has to say on stderr."""
    from torchrecon.io.tracks import load_tracks

    size = None if options.image_size is None else tuple(options.image_size)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        tracks = load_tracks(options.tracks, person=options.person, view=options.view, image_size=size, fps=options.fps)
    for warning in said:
        print(f"warning: {warning.message}", file=sys.stderr)
    return tracks.to(options.device)


def _config(options: argparse.Namespace) -> Any:
    from torchrecon.config import load_config

    return load_config(options.config)


def _with_camera(tracks: Tracks, path: str) -> Tracks:
    from dataclasses import replace

    from torchrecon.io.frames import load_camera

    return replace(tracks, intrinsics=load_camera(path).intrinsics)


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
