"""The rows that are torchrecon itself or no method at all: rigid, paper's rules, default, flat, sensor depth."""

from __future__ import annotations

import torch

import torchrecon as tr
from eval.rows.base import Context, RowOutput, registered_views
from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks
from torchrecon.measurement.camera import backproject_points

__all__ = ["solve_default", "solve_flat", "solve_rigid", "solve_sensor"]


def _generator(context: Context) -> torch.Generator:
    return torch.Generator().manual_seed(context.seed)


def solve_rigid(tracks: Tracks, context: Context) -> RowOutput:
    """The shared rigid factorisation: one shape for all frames."""
    return RowOutput(context.rigid.points3d, tracks.visible, str(context.rigid.status))


def solve_default(tracks: Tracks, context: Context) -> RowOutput:
    """``torchrecon.reconstruct`` with everything automatic."""
    answer = tr.reconstruct(tracks, generator=_generator(context))
    return RowOutput(answer.points3d, tracks.visible, f"K = {answer.rank}; {answer.status}")


def solve_flat(tracks: Tracks, context: Context) -> RowOutput:
    """The floor: the tracked points with zero depth, in the registered image plane."""
    xy = registered_views(tracks, context.rigid).xy
    return RowOutput(torch.cat([xy, torch.zeros_like(xy[..., :1])], -1), tracks.visible)


def solve_sensor(tracks: Tracks, context: Context) -> RowOutput:
    """What the depth sensor says of each tracked point, without any method; unmeasured entries are left out."""
    if tracks.depth is None or tracks.intrinsics is None:
        raise ReconError("sensor depth: the tracks carry no measured depth")
    points = backproject_points(tracks.xy, tracks.depth, tracks.intrinsics)
    return RowOutput(points, tracks.visible & torch.isfinite(points).all(-1))
