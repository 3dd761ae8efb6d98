"""Ref. 5-style: optimal affine transforms in hierarchical temporal groups, after Kim et al.: piecewise rigid.

The original aligns the sections of an image stack by the optimal affine map between neighbours, group by group. Taken
over to tracks: the rigid shape of the whole sequence is the root; the frames are halved again and again down to
groups of about ``smallest`` frames; the shape of a group is the ridge least-squares shape of its own frames, held to
the shape of its parent; each frame is the optimal affine map of its group's shape, made a rotation to give depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from eval.rows.base import Context, RowOutput, Views, in_camera, with_perspective
from torchrecon._typing import Float, Tensor
from torchrecon.linalg import rotation_from_rows
from torchrecon.measurement import Tracks

__all__ = ["GroupParams", "piecewise_rigid", "solve"]


@dataclass(frozen=True)
class GroupParams:
    """Parameters of the hierarchy."""

    smallest: int = 12  # frames; a group is not halved below this length
    overlap: float = 0.25  # of a group's length, added on both sides so that short tracks have neighbours
    hold: float = 3.0  # weight of the parent's shape, in observed frames
    rounds: int = 3  # alternations of shape and pose in each group
    pose_hold: float = 10.0  # weight of the given rotation against the frame's own affine map


def _group_shape(views: Views, rotations: Tensor, frames: Tensor, parent: Tensor, hold: float) -> Tensor:
    """argmin over G of sum of |w - Rbar G_p|^2 over the group's observations + hold |G_p - parent_p|^2."""
    camera, weight = rotations[frames, :2], views.weight[frames]
    gram = torch.einsum("fp,fai,faj->pij", weight, camera, camera)
    right = torch.einsum("fp,fai,fpa->pi", weight, camera, views.seen[frames])
    eye = torch.eye(3, dtype=gram.dtype)
    return torch.linalg.solve(gram + hold * eye, (right + hold * parent)[..., None])[..., 0]


def _frame_poses(views: Views, rotations: Tensor, frames: Tensor, shape: Tensor, hold: float) -> Tensor:
    """Each frame's optimal affine map of the group's shape, drawn to the given camera, made a rotation.

    Only part of the body is seen in a frame, and a flat part leaves the affine map open in one direction: the
    pull to the given camera, ``hold`` times the spread of the seen points, decides there and hardly elsewhere.
    """
    weight = views.weight[frames]
    gram = torch.einsum("fp,pi,pj->fij", weight, shape, shape)
    cross = torch.einsum("fp,fpa,pi->fai", weight, views.seen[frames], shape)
    pull = hold * gram.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] * torch.eye(3, dtype=gram.dtype)
    pull = pull + torch.finfo(gram.dtype).tiny * torch.eye(3, dtype=gram.dtype)
    right = cross + rotations[frames, :2] @ pull
    affine = torch.linalg.solve((gram + pull).mT, right.mT).mT
    return rotation_from_rows(affine)


def piecewise_rigid(views: Views, params: GroupParams | None = None) -> Float[Tensor, "frames points 3"]:
    """Camera-axes points of the hierarchy's leaves; neighbouring groups overlap and are blended linearly."""
    p = params or GroupParams()
    count = views.xy.shape[0]
    total = views.xy.new_zeros(*views.xy.shape[:2], 3)
    mass = views.xy.new_zeros(count)

    def descend(start: int, stop: int, parent: Tensor, rotations: Tensor) -> None:
        margin = int(p.overlap * (stop - start)) if stop - start < count else 0
        frames = torch.arange(max(0, start - margin), min(count, stop + margin))
        shape, rotations = parent, rotations.clone()
        for _ in range(p.rounds):
            shape = _group_shape(views, rotations, frames, parent, p.hold)
            rotations[frames] = _frame_poses(views, rotations, frames, shape, p.pose_hold)
        if stop - start >= 2 * p.smallest:
            middle = (start + stop) // 2
            descend(start, middle, shape, rotations)
            descend(middle, stop, shape, rotations)
            return
        centre, half = (start + stop - 1) / 2, (stop - start) / 2 + margin
        ramp = (1 - (frames - centre).abs() / (half + 1)).clamp_min(1e-3).to(total.dtype)
        total[frames] += ramp[:, None, None] * (shape @ rotations[frames].mT)
        mass[frames] += ramp

    descend(0, count, views.shape, views.rotations)
    return in_camera(views, total / mass[:, None, None])


def solve(tracks: Tracks, context: Context) -> RowOutput:
    """The row: piecewise-rigid groups on the shared rotations."""
    return RowOutput(with_perspective(tracks, context.rigid, piecewise_rigid), tracks.visible)
