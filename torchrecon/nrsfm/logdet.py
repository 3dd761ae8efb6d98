"""Depths and rotations that make the shapes of a sequence as low-dimensional as the views allow.

Unknown are the rotation of every frame and the depth of every point in it. The cost is
``log det(cov(R_f^T [W_f; z_f]) + eps I) + smoothness * mean_f ||S_f - S_{f-1}||^2`` over the frames: a soft rank that
needs no K. It is concave in the covariance, so ``sum_f y_f^T A y_f / F`` with ``A = (cov + eps I)^-1`` lies above
it and touches it: a quadratic in each frame's 3 + P unknowns, solved for all frames at once. eps falls from coarse
to fine, so that the mean shape settles before its deformations. Derived here from that cost; not a published method.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg import rotation_from_vector, skew

__all__ = ["LogDetParams", "camera_points", "lift_depths", "logdet_cost", "rigid_depths"]


@dataclass(frozen=True)
class LogDetParams:
    """Parameters of the lifting; lengths are in units of the rms size of the tracks.

    Attributes:
        eps_coarse: first variance added to the covariance (squared rms size).
        eps_fine: last variance added to the covariance (squared rms size).
        smoothness: weight of the squared change from frame to frame (per squared rms size).
        relaxation: factor on the step of the majoriser, between 1 and 2 (no unit).
        tolerance: fall of the cost per step, per frame unknown, at which the descent has converged (nats).
    """

    eps_coarse: float = 1e-1
    eps_fine: float = 1e-5
    smoothness: float = 1e-2
    relaxation: float = 1.8
    tolerance: float = 1e-4


def camera_points(
    xy: Float[Tensor, "frames points 2"], depth: Float[Tensor, "frames points"]
) -> Float[Tensor, "frames points 3"]:
    """Image coordinates and depths side by side."""
    return torch.cat([xy, depth[..., None]], -1)


def rigid_depths(
    xy: Float[Tensor, "frames points 2"], rotations: Float[Tensor, "frames 3 3"]
) -> Float[Tensor, "frames points"]:
    """Depths of the one rigid shape that fits the views best, seen through the rotations."""
    rows = rotations[:, :2].flatten(0, 1)
    shape = torch.linalg.pinv(rows.mT @ rows) @ (rows.mT @ xy.mT.flatten(0, 1))
    return rotations[:, 2] @ shape


def logdet_cost(shapes: Float[Tensor, "frames points 3"], eps: float, smoothness: float) -> Float[Tensor, ""]:
    """The cost above for canonical shapes, through the smaller Gram matrix of the two."""
    flat = (shapes - shapes.mean(0)).flatten(1)
    frames, size = flat.shape
    gram = (flat.mT @ flat if frames > size else flat @ flat.mT) / frames
    factor = torch.linalg.cholesky(gram + eps * torch.eye(len(gram), dtype=gram.dtype, device=gram.device))
    rest = (size - len(gram)) * torch.log(gram.new_tensor(eps))
    change = shapes.diff(dim=0).square().sum() / frames
    return 2 * factor.diagonal().log().sum() + rest + smoothness * change


def _step(xy: Tensor, rotations: Tensor, depth: Tensor, eps: float, smoothness: float) -> tuple[Tensor, Tensor]:
    """Minimiser of the quadratic majoriser: change of the depths (F, P) and rotation vectors (F, 3) to subtract."""
    frames, points = depth.shape
    placed = camera_points(xy, depth)
    shapes = placed @ rotations
    flat = (shapes - shapes.mean(0)).flatten(1)
    eye = torch.eye(3 * points, dtype=xy.dtype, device=xy.device)
    precision = torch.linalg.inv(flat.mT @ flat / frames + eps * eye)
    padded = torch.cat([shapes[:1], shapes, shapes[-1:]])
    pulled = (padded[:-2] + 2 * shapes + padded[2:]) / 4
    pull = 4 * smoothness
    slope = ((flat @ precision).unflatten(1, (points, 3)) + pull * (shapes - pulled)) @ rotations.mT
    axis = rotations[:, 2]
    blocks = precision.view(points, 3, points, 3).permute(1, 3, 0, 2).reshape(9, points * points)
    depth_block = ((axis[:, :, None] * axis[:, None, :]).flatten(1) @ blocks).view(frames, points, points)
    depth_block.diagonal(dim1=-2, dim2=-1).add_(pull)
    cross = skew(placed)
    turn = (rotations.mT[:, None] @ cross).flatten(1, 2)
    weighted = (precision + pull * eye) @ turn
    mixed = torch.einsum("fi,fpij->fpj", axis, weighted.unflatten(1, (points, 3)))
    # A roll of everything changes nothing when the shape is a line; the small ridge keeps the block invertible.
    turn_block = turn.mT @ weighted + 1e-9 * torch.eye(3, dtype=xy.dtype, device=xy.device)
    normal = torch.cat([torch.cat([depth_block, mixed], 2), torch.cat([mixed.mT, turn_block], 2)], 1)
    gradient = torch.cat([slope[..., 2], torch.einsum("fpi,fpij->fj", slope, cross)], -1)
    solution = torch.cholesky_solve(gradient[..., None], torch.linalg.cholesky(normal))[..., 0]
    return solution[:, :points], solution[:, points:]


def lift_depths(
    xy: Float[Tensor, "frames points 2"],
    rotations: Float[Tensor, "frames 3 3"],
    depth: Float[Tensor, "frames points"],
    iterations: int,
    params: LogDetParams,
    *,
    anneal: bool = True,
) -> tuple[Float[Tensor, "frames 3 3"], Float[Tensor, "frames points"], float, bool]:
    """Descend from the given rotations and depths.

    Args:
        xy: centred per frame, in units of their rms size.
        iterations: number of steps; with ``anneal`` eps falls geometrically over the first 60 % of them.
        anneal: False keeps eps at its fine value.

    Returns:
        rotations, depths, the cost at ``eps_fine``, and whether the descent converged before the limit.
    """
    ratio = params.eps_fine / params.eps_coarse
    falling = int(0.6 * iterations) if anneal else 0
    previous = float("inf")
    converged = False
    cost = float("inf")
    for index in range(iterations):
        eps = params.eps_coarse * ratio ** (index / falling) if index < falling else params.eps_fine
        d_depth, d_turn = _step(xy, rotations, depth, eps, params.smoothness)
        depth = depth - params.relaxation * d_depth
        rotations = rotation_from_vector(-params.relaxation * d_turn) @ rotations
        if index >= falling and index % 10 == 9:
            cost = float(logdet_cost(camera_points(xy, depth) @ rotations, params.eps_fine, params.smoothness))
            if previous - cost < 10 * params.tolerance * depth.shape[1]:
                converged = True
                break
            previous = cost
    cost = float(logdet_cost(camera_points(xy, depth) @ rotations, params.eps_fine, params.smoothness))
    return rotations, depth, cost, converged
