"""Ref. 6-style: a nonlinear observer with unknown input, one per point (after Mejri, Sidhom and Abdelkrim 2020).

State s = (x, y, z) of a point in camera axes; the camera's known turn carries it on, the body's own motion is the
unknown input d: ``s+ = dR s + D d``, ``y = (x, y)``. The gain is of Kalman type. The unknown input is taken to act
along the innovation: where the innovation is larger than noise explains, the covariance is inflated in that
direction until it is not, so that what a limb does by itself is not taken for depth (in the limit of infinite
inflation that direction is decoupled exactly). The observer is causal: it runs forward only, from the rigid depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from eval.rows.base import Context, RowOutput, Views, in_camera, with_perspective
from torchrecon._typing import Float, Tensor
from torchrecon.measurement import Tracks

__all__ = ["ObserverParams", "observe", "solve"]


@dataclass(frozen=True)
class ObserverParams:
    """Standard deviations, each as a fraction of the rms size of the rigid shape."""

    first_depth: float = 0.3  # of the depth at a point's first observation
    image_walk: float = 0.01  # of the body's own motion in the image plane, per frame
    depth_walk: float = 0.01  # of the body's own motion in depth, per frame
    least_noise: float = 2e-3  # of a measurement; never below this, the tracks' covariance may raise it
    unknown_input: bool = True  # inflate along innovations that noise does not explain


def observe(
    views: Views, params: ObserverParams | None = None
) -> tuple[Float[Tensor, "frames points 3"], Float[Tensor, "frames points"]]:
    """Forward observer of all points at once.

    Returns:
        points: (frames, points, 3) camera axes; before a point's first observation the rigid position.
        depth_variance: (frames, points) in squared units of the views.
    """
    p = params or ObserverParams()
    size = float(views.shape.square().sum(-1).mean().sqrt())
    noise = max(views.noise, p.least_noise * size) ** 2
    eye2 = torch.eye(2, dtype=views.xy.dtype)
    walk = torch.diag(views.xy.new_tensor([p.image_walk, p.image_walk, p.depth_walk]) * size).square()
    start = torch.diag(views.xy.new_tensor([noise, noise, (p.first_depth * size) ** 2]))
    rigid = views.shape @ views.rotations.mT
    points, variances = [], []
    state, covariance = rigid[0], start.expand(views.xy.shape[1], 3, 3)
    born = torch.zeros_like(views.visible[0])
    for f in range(views.xy.shape[0]):
        if f:
            turn = views.rotations[f] @ views.rotations[f - 1].T
            state = torch.where(born[:, None], state @ turn.T, rigid[f])
            covariance = torch.where(born[:, None, None], turn @ covariance @ turn.T + walk, start)
        seen = views.visible[f]
        new = seen & ~born
        state = torch.where(new[:, None], torch.cat([views.seen[f], rigid[f, :, 2:]], -1), state)
        innovation = torch.where(seen[:, None], views.seen[f] - state[:, :2], torch.zeros_like(views.seen[f]))
        spread = covariance[:, :2, :2] + noise * eye2
        if p.unknown_input:
            # Along e = innovation / |innovation| a variance a makes innovation^T (S + a e e^T)^-1 innovation = 2,
            # its expected value: by the Sherman-Morrison formula a = |innovation|^2 (m - 2) / (2 m).
            m = torch.einsum("pi,pij,pj->p", innovation, torch.linalg.inv(spread), innovation)
            extra = 0.5 * (1 - 2 / m.clamp_min(2.0))[:, None, None] * innovation[:, :, None] * innovation[:, None, :]
            covariance = covariance + torch.nn.functional.pad(extra, (0, 1, 0, 1))
            spread = spread + extra
        gain = torch.linalg.solve(spread, covariance[:, :2, :]).mT
        updated = covariance - gain @ covariance[:, :2, :]
        state = state + (gain @ innovation[..., None])[..., 0]
        covariance = torch.where((seen & ~new)[:, None, None], 0.5 * (updated + updated.mT), covariance)
        born = born | seen
        points.append(state)
        variances.append(covariance[:, 2, 2])
    return torch.stack(points), torch.stack(variances)


def solve(tracks: Tracks, context: Context) -> RowOutput:
    """The row: one observer per point on the shared rotations."""
    points = with_perspective(tracks, context.rigid, lambda views: in_camera(views, observe(views)[0]))
    return RowOutput(points, tracks.visible)
