"""Ref. 7-style: structure from two non-orthogonal views (after Han et al.; blood cells from two phase images).

The original's four steps taken over to tracks: register (centroid and scale of the shared factorisation), detect and
segment (the mask of visible points), reconstruct: an observation is paired with the observation of the same point
that is nearest in time among those whose line of sight differs by at least ``least_angle``; the pair is taken for two
views of a rigid body and triangulated by least squares, ``[R_t; R_j] X = [W_t; W_j]``. A point that is never seen
under such an angle takes its rigid position.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from eval.rows.base import Context, RowOutput, Views, in_camera, registered_views, with_perspective
from torchrecon._typing import Float, Int, Tensor
from torchrecon.measurement import Tracks

__all__ = ["PairParams", "partners", "solve", "triangulate"]


@dataclass(frozen=True)
class PairParams:
    """Parameters of the pairing."""

    least_angle: float = 35.0  # degrees between the two lines of sight


def partners(views: Views, params: PairParams | None = None) -> Int[Tensor, "frames points"]:
    """Frame of each observation's partner, -1 where there is none."""
    p = params or PairParams()
    sight = views.rotations[:, 2]  # canonical direction of the optical axis
    # Parallel rays from in front and from behind are the same view of an orthographic camera: the angle of lines.
    angle = torch.rad2deg(torch.arccos((sight @ sight.T).abs().clamp(max=1.0)))
    frames = torch.arange(len(sight))
    apart = (frames[:, None] - frames).abs().to(sight.dtype)
    never = float(2 * len(sight))
    cost = torch.where(angle >= p.least_angle, apart, torch.full_like(apart, never))
    # (frames, frames, points): cost of partner j for an observation in frame t, where j sees the point at all.
    table = torch.where(views.visible[None], cost[:, :, None], torch.full((), never, dtype=cost.dtype))
    best, partner = table.min(1)
    return torch.where((best < never) & views.visible, partner, torch.full_like(partner, -1))


def triangulate(views: Views, params: PairParams | None = None) -> Float[Tensor, "frames points 3"]:
    """Camera-axes points from two views each; unpaired entries are those of the rigid shape."""
    partner = partners(views, params)
    f, p = (partner >= 0).nonzero(as_tuple=True)
    j = partner[f, p]
    camera = torch.cat([views.rotations[f, :2], views.rotations[j, :2]], -2)
    image = torch.cat([views.xy[f, p], views.xy[j, p]], -1)
    point = torch.linalg.solve(camera.mT @ camera, camera.mT @ image[..., None])[..., 0]
    points = views.shape @ views.rotations.mT
    points[f, p] = (views.rotations[f] @ point[..., None])[..., 0]
    return in_camera(views, points)


def solve(tracks: Tracks, context: Context) -> RowOutput:
    """The row: two-view triangulation on the shared rotations."""
    views = registered_views(tracks, context.rigid)
    paired = float((partners(views) >= 0).sum() / views.visible.sum())
    note = f"{100 * paired:.0f} % of the observations have a partner"
    return RowOutput(with_perspective(tracks, context.rigid, triangulate), tracks.visible, note)
