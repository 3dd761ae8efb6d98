"""Rigid factorisation (Tomasi and Kanade 1992), with missing entries and a covariance per observation.

Affine motion, translation and shape are fitted to the seen entries by alternating least squares; the translation is
part of the fit, so a changing visible subset injects no motion. A metric upgrade then makes the motion orthonormal.
Tracks with gaps take their camera path from the trajectory likelihood instead.
The answer is one rigid shape seen from every frame: what a non-rigid solver has to beat. With intrinsics the views
are taken as weak perspective (one distance per frame). Orthographic views leave a mirror ambiguity, resolved by the
documented rule; perspective inside the body is not used.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import rotation_from_rows
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.base import check_size, mirror_sign, solve_items, turn_of_view
from torchrecon.nrsfm.likelihood import MotionPrior, pack, posterior_points
from torchrecon.nrsfm.observations import Observations, observe
from torchrecon.nrsfm.trajectory import TrajectoryParams, find_path, place_points
from torchrecon.nrsfm.upgrade import UpgradeParams, metric_upgrade

__all__ = ["RigidParams", "affine_factors", "rigid"]

STATIC_TURN = 3.0  # degrees of change of view below which depth is called undetermined


@dataclass(frozen=True)
class RigidParams:
    """Parameters of rigid factorisation.

    Attributes:
        iterations: alternations of motion and shape (count).
        tolerance: relative fall of the residual at which the alternation has converged (no unit).
        ridge: weight that keeps motion and shape bounded where few entries are seen (squared rms size).
        upgrade: of the metric upgrade.
    """

    iterations: int = 300
    tolerance: float = 1e-6
    ridge: float = 1e-9
    upgrade: UpgradeParams = field(default_factory=lambda: UpgradeParams(ranks=(1,)))


def affine_factors(
    data: Observations, params: RigidParams
) -> tuple[Float[Tensor, "frames 2 4"], Float[Tensor, "points 3"], bool]:
    """Affine cameras (last column: translation) and shape that fit the seen entries (whitened least squares).

    Returns:
        motion, shape and whether the alternation converged before the limit.
    """
    frames, points = data.visible.shape
    start = data.held()
    translation = start.mean(1, keepdim=True)
    stack = (start - translation).mT.flatten(0, 1)
    _, s, vh = torch.linalg.svd(stack, full_matrices=False)
    shape = torch.zeros(points, 4, dtype=stack.dtype, device=stack.device)
    count = min(3, len(s))
    shape[:, :count] = (vh[:count].T) * points**0.5
    shape[:, 3] = 1
    weight = data.weight
    target = (weight @ data.xy[..., None])[..., 0]
    eye4, eye8 = (torch.eye(n, dtype=stack.dtype, device=stack.device) for n in (4, 8))
    previous, converged = float("inf"), False
    motion = torch.zeros(frames, 2, 4, dtype=stack.dtype, device=stack.device)
    information = weight.mT @ weight
    moment = (weight.mT @ target[..., None])[..., 0]
    for index in range(params.iterations):
        outer = shape[:, :, None] * shape[:, None, :]
        normal = torch.einsum("fpab,pij->faibj", information, outer).reshape(frames, 8, 8)
        right = torch.einsum("fpa,pi->fai", moment, shape).reshape(frames, 8)
        motion = torch.linalg.solve(normal + params.ridge * eye8, right).view(frames, 2, 4)
        rows, offset = motion[:, :, :3], motion[:, :, 3]
        turned = torch.einsum("fai,fpab->fpib", rows, information)
        normal3 = torch.einsum("fpib,fbj->pij", turned, rows)
        right3 = torch.einsum("fai,fpa->pi", rows, moment) - torch.einsum("fpib,fb->pi", turned, offset)
        shape = torch.cat(
            [torch.linalg.solve(normal3 + params.ridge * eye4[:3, :3], right3), torch.ones_like(shape[:, :1])], 1
        )
        fitted = (shape[:, :3] @ rows.mT) + offset[:, None]
        residual = float((weight @ (data.xy - fitted)[..., None]).square().sum())
        if index > 10 and previous - residual <= params.tolerance * max(previous, 1e-20):
            converged = True
            break
        previous = residual
    seen = data.visible.any(0)
    centre = shape[seen, :3].mean(0)
    shape = torch.where(seen[:, None], shape[:, :3] - centre, shape.new_zeros(()))
    motion = torch.cat([motion[:, :, :3], (motion[:, :, 3] + motion[:, :, :3] @ centre)[..., None]], -1)
    return motion, shape, converged


def _euclidean(
    motion: Tensor, shape: Tensor, scaled: bool, params: UpgradeParams, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotations, per-frame scale (mean 1 unless ``scaled``) and shape from affine factors."""
    u, s, vh = torch.linalg.svd(shape, full_matrices=False)
    sign = torch.where(u.pow(3).sum(0) < 0, -1.0, 1.0).to(shape.dtype)
    rows = motion @ (vh.mT * s * sign)
    size = rows.square().sum((-1, -2)).mean().sqrt()
    rows, points = rows / size, u * sign * size
    scale = torch.ones_like(rows[:, 0, 0])
    eye = torch.eye(3, dtype=rows.dtype, device=rows.device)
    noise = torch.randn(params.starts, 3, 3, generator=generator, dtype=torch.float64).to(rows)
    noise[0] = 0
    start = eye + noise
    q = eye
    for _ in range(5 if scaled else 1):
        found, residual = metric_upgrade(rows / scale[:, None, None], start, params.iterations)
        q = found[residual.argmin()]
        if scaled:
            scale = (rows @ q).square().sum((-1, -2)).div(2).sqrt()
            scale = scale / scale.mean()
            start = q[None]
    rotations = rotation_from_rows(rows @ q)
    return rotations, scale, points @ torch.linalg.pinv(q).mT


def _rigid_with_gaps(data: Observations, rank: int) -> Reconstruction:
    """One rigid shape from tracks that are born and die.

    Alternation from filled gaps ends far from the views (20 px on bands of 20 frames), so the camera path comes from
    the likelihood of ``trajectory``; the points are then held rigid under it.
    """
    params = TrajectoryParams()
    found = find_path(data, params)
    prior = found.prior
    stiff = MotionPrior(prior.rest, torch.zeros_like(prior.kernels[:1]), torch.zeros_like(prior.log_share[:1]))
    with torch.no_grad():
        canonical, _, _ = posterior_points(pack(data), found.path, stiff, found.noise)
    return place_points(data, found, canonical, None, rank, params)


def rigid(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """One rigid shape and its rotation in every frame; any leading batch.

    Args:
        tracks: seen entries only are read.
        rank: reported as it is given; the fit itself is rigid.
        generator: starts of the metric upgrade.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(12, 3, generator=g)
        >>> turn = rotation_from_vector(torch.linspace(0, 2, 15)[:, None] * torch.tensor([0.1, 1.0, 0.0]))
        >>> truth = shape @ turn.mT
        >>> rec = rigid(Tracks(truth[..., :2]), 1)
        >>> bool((rec.reproject() - truth[..., :2]).abs().max() < 1e-3), rec.status.code
        (True, 'ok')
    """
    params = RigidParams()

    def solve_one(item: Tracks, k: int, source: torch.Generator) -> Reconstruction:
        data = observe(item)
        if not bool(data.visible.all()):
            return _rigid_with_gaps(data, k)
        motion, shape, converged = affine_factors(data, params)
        rotations, scale, shape = _euclidean(
            motion[..., :3], shape, item.intrinsics is not None, params.upgrade, source
        )
        points3d = shape @ rotations.mT
        flip = mirror_sign(points3d) * torch.ones(3, dtype=shape.dtype, device=shape.device)
        flip[:2] = 1
        points3d, rotations = points3d * flip, rotations * (flip[:, None] * flip)
        status = check_size(item, 1)
        turn = float(turn_of_view(rotations))
        if turn < STATIC_TURN:  # what the views do not tell would be divided by how little they turn
            points3d = points3d * points3d.new_tensor([1.0, 1.0, 0.0])
        if status is None and turn < STATIC_TURN:
            status = Status("undetermined", f"the view turns by only {turn:.1f} degrees; depth is not determined")
        if status is None and not converged:
            status = Status("not_converged", f"the factorisation still improved after {params.iterations} alternations")
        if status is None:
            status = Status("ok", f"one rigid shape, view turning by {turn:.0f} degrees")
        return data.reconstruction(points3d, rotations, scale, motion[..., 3], rank=k, status=status)

    return solve_items(tracks, rank, solve_one, generator)
