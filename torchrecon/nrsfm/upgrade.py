"""Rotations from the column space of the measurement matrix: the metric upgrade."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg import rotation_from_rows

__all__ = ["UpgradeParams", "metric_upgrade", "motion_basis", "upgraded_rotations"]


@dataclass(frozen=True)
class UpgradeParams:
    """Parameters of the metric upgrade.

    Attributes:
        ranks: numbers of bases K that are tried for the motion (no unit); what is tried here is not the
            reported rank.
        starts: random starts per K (count).
        iterations: Levenberg-Marquardt steps (count).
        spread: size of the random part of a start relative to a unit row of the motion (no unit).
    """

    ranks: tuple[int, ...] = (1, 2, 3)
    starts: int = 8
    iterations: int = 60
    spread: float = 0.3


def motion_basis(stack: Float[Tensor, "rows points"], columns: int) -> Float[Tensor, "rows columns"]:
    """Leading left singular vectors, scaled to rows of size about one, with a sign that ignores the point order."""
    u, _, vh = torch.linalg.svd(stack, full_matrices=False)
    sign = torch.where(vh.pow(3).sum(-1) < 0, -1.0, 1.0).to(stack.dtype)
    return (u * sign)[:, :columns] * (stack.shape[0] / 2) ** 0.5


def metric_upgrade(
    motion: Float[Tensor, "frames 2 m"], start: Float[Tensor, "starts m 3"], iterations: int
) -> tuple[Float[Tensor, "starts m 3"], Float[Tensor, " starts"]]:
    """Find m x 3 matrices Q with orthonormal ``motion_f Q`` in every frame, by Levenberg-Marquardt from each start.

    Returns:
        q: one matrix per start.
        residual: mean over frames of ``||motion_f Q Q^T motion_f^T - I||_F^2``.
    """
    u, v = motion[:, 0], motion[:, 1]
    root = 2.0**0.5

    def residuals(q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        a, b = u @ q, v @ q
        r = torch.cat([a.square().sum(-1) - 1, b.square().sum(-1) - 1, root * (a * b).sum(-1)], -1)
        return a, b, r

    q = start
    a, b, r = residuals(q)
    cost = r.square().sum(-1)
    damping = torch.full_like(cost, 1e-2)
    for _ in range(iterations):
        jacobian = torch.cat(
            [
                2 * u[:, :, None] * a[:, :, None, :],
                2 * v[:, :, None] * b[:, :, None, :],
                root * (u[:, :, None] * b[:, :, None, :] + v[:, :, None] * a[:, :, None, :]),
            ],
            1,
        ).flatten(-2)
        normal = jacobian.mT @ jacobian
        diagonal = torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1) + 1e-9)
        step = torch.linalg.solve(normal + damping[:, None, None] * diagonal, jacobian.mT @ r[..., None])
        trial = q - step[..., 0].unflatten(-1, q.shape[-2:])
        a_new, b_new, r_new = residuals(trial)
        cost_new = r_new.square().sum(-1)
        better = cost_new < cost
        damping = torch.where(better, damping * 0.3, damping * 4).clamp(1e-9, 1e6)
        wide = better[:, None, None]
        q, a, b = torch.where(wide, trial, q), torch.where(wide, a_new, a), torch.where(wide, b_new, b)
        r, cost = torch.where(better[:, None], r_new, r), torch.where(better, cost_new, cost)
    return q, cost / motion.shape[0]


def upgraded_rotations(
    stack: Float[Tensor, "rows points"], params: UpgradeParams, generator: torch.Generator
) -> list[tuple[float, int, Float[Tensor, "frames 3 3"]]]:
    """Candidate rotations from several K and starts, as (residual, K, rotations), the best of each K first.

    The rank-3 solution seeds the larger K; a start whose residual is within 20 % of another of the same K is taken
    for the same solution and dropped.
    """
    frames, points = stack.shape[0] // 2, stack.shape[1]
    values = torch.linalg.svdvals(stack)
    # Columns of rounding noise fit the conditions as well as anything; a rigid body is tried all the same.
    available = max(min(3, len(values)), int((values > 1e-6 * values[0]).sum()))
    found: list[tuple[float, int, Tensor]] = []
    seed: Tensor | None = None
    for rank in params.ranks:
        columns = 3 * rank
        if columns > available or (rank > 1 and columns > min(2 * frames, points - 1)):
            break
        motion = motion_basis(stack, columns).unflatten(0, (frames, 2))
        noise = torch.randn(params.starts, columns, 3, generator=generator, dtype=torch.float64).to(stack)
        if seed is None:
            start = torch.eye(3, dtype=stack.dtype, device=stack.device) + noise
            start[0] = torch.eye(3, dtype=stack.dtype, device=stack.device)
        else:
            start = params.spread * noise
            start[:, :3] += seed
            start[0, 3:] *= 0.1
        q, residual = metric_upgrade(motion, start, params.iterations)
        order = residual.argsort()
        if seed is None:
            seed = q[order[0]]
        last = -1.0
        for index in order.tolist():
            value = float(residual[index])
            if last < 0 or value > 1.2 * last + 1e-12:
                found.append((value, rank, rotation_from_rows(motion @ q[index])))
                last = value
    return found
