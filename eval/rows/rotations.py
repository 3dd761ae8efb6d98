"""The one source of rotations of all comparison rows: a rigid body before a camera that turns smoothly about it.

Tracks on a turning body live for a fraction of the turn, so no frame shares points with one far away and an affine
factorisation has too little to hold on to. Two things that every film of a walking-round camera has are used instead,
for every row alike: the turn is smooth, about the vertical; and near points look larger than far ones. Rates of turn
are tried from one side to the other, each with the rigid shape and the translations that fit best in the pinhole
sense; the rate with the smallest robust residual is kept, its sign with it, so the mirror is decided by perspective;
then rotations of single frames are freed under a prior on the angular acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.linalg import rotation_from_vector, skew
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.measurement.camera import normalised_coordinates

__all__ = ["TurnParams", "turning_rigid"]


@dataclass(frozen=True)
class TurnParams:
    """Parameters of the search.

    Attributes:
        fastest: largest rate of turn tried, degrees per frame.
        steps: rates tried on each side of a standing camera.
        rounds: alternations of shape and translation for each rate.
        kept: best rates that are refined.
        refinements: alternations with the rotations free.
        acceleration: standard deviation of the angular acceleration, degrees per frame^2.
        together: observations of one track err together while a limb moves; so many count as one.
        outlier: residual at which an observation counts half, pixels.
        ridge: pull of the shape to its centre where a point is hardly seen, in squared metres at 1 m distance.
    """

    fastest: float = 8.0
    steps: int = 8
    rounds: int = 8
    kept: int = 2
    refinements: int = 25
    acceleration: float = 0.03
    together: float = 10.0
    outlier: float = 10.0
    ridge: float = 1e-2


@dataclass(frozen=True)
class _State:
    """Plane: normalised image coordinates, zero where unseen. A point lies at R S + t in the camera."""

    plane: Float[Tensor, "frames points 2"]
    weight: Float[Tensor, "frames points"]
    rotations: Float[Tensor, "frames 3 3"]
    shape: Float[Tensor, "points 3"]
    translation: Float[Tensor, "frames 3"]

    def rows(self, vectors: Float[Tensor, "frames _ 3 n"]) -> Float[Tensor, "frames points 2 n"]:
        """``v_xy - n v_z`` of camera-axes vectors: zero for a point on its ray."""
        return vectors[..., :2, :] - self.plane[..., None] * vectors[..., 2:, :]

    def residual(self) -> Float[Tensor, "frames points 2"]:
        """Distance from the ray, as a tangent of the viewing angle."""
        points = self.shape @ self.rotations.mT + self.translation[:, None]
        return self.rows(points[..., None])[..., 0] / points[..., 2:].clamp_min(1e-3)


def _fit_shape(s: _State, ridge: float) -> _State:
    design = s.rows(s.rotations[:, None])
    right = s.rows(s.translation[:, None, :, None])[..., 0]
    eye = torch.eye(3, dtype=design.dtype)
    gram = torch.einsum("fp,fpai,fpaj->pij", s.weight, design, design) + ridge * eye
    shape = -torch.linalg.solve(gram, torch.einsum("fp,fpai,fpa->pi", s.weight, design, right)[..., None])[..., 0]
    seen = s.weight.sum(0)[:, None] > 0
    centre = torch.where(seen, shape, torch.zeros_like(shape)).sum(0) / seen.sum()
    return replace(s, shape=torch.where(seen, shape - centre, torch.zeros_like(shape)))


def _fit_translation(s: _State) -> _State:
    points = s.shape @ s.rotations.mT
    eye = torch.eye(3, dtype=points.dtype)
    design = s.rows(eye.expand(*points.shape[:2], 3, 3))
    right = s.rows(points[..., None])[..., 0]
    # A slight pull to where it was: a frame may see a single point, or none.
    gram = torch.einsum("fp,fpai,fpaj->fij", s.weight, design, design) + 1e-4 * eye
    goal = 1e-4 * s.translation - torch.einsum("fp,fpai,fpa->fi", s.weight, design, right)
    shift = torch.linalg.solve(gram, goal[..., None])[..., 0]
    # The unit of length is free: the mean distance is held, or shape and distance would shrink to nothing together.
    scale = s.translation[:, 2].mean() / shift[:, 2].mean()
    return replace(s, translation=shift * scale, shape=s.shape * scale)


def _robust(s: _State, visible: Bool[Tensor, "frames points"], outlier: float) -> tuple[_State, float]:
    """Weights that let far residuals count less, and the mean cost they stand for."""
    square = s.residual().square().sum(-1)
    weight = torch.where(visible, 1 / (1 + square / outlier**2).square(), torch.zeros_like(square))
    cost = torch.where(visible, square / (1 + square / outlier**2), torch.zeros_like(square)).sum() / visible.sum()
    return replace(s, weight=weight), float(cost)


def _fit_rotations(s: _State, cost: float, p: TurnParams) -> _State:
    """One Gauss-Newton step of all rotations and translations under the prior on the angular acceleration."""
    frames = len(s.rotations)
    points = s.shape @ s.rotations.mT
    away = (points + s.translation[:, None])[..., 2:, None].clamp_min(1e-3)
    eye = torch.eye(3, dtype=points.dtype)
    # A small turn d moves a point by d x X = -[X]_x d.
    design = torch.cat([s.rows(-skew(points)), s.rows(eye.expand(*points.shape[:2], 3, 3))], -1) / away
    weight = s.weight / (max(cost, 1e-12) * p.together)
    gram = torch.einsum("fp,fpai,fpaj->fij", weight, design, design)
    gram = gram + (1e-6 * gram.diagonal(dim1=-2, dim2=-1).amax()) * torch.eye(6, dtype=points.dtype)
    right = -torch.einsum("fp,fpai,fpa->fi", weight, design, s.residual())
    # Translations drop out frame by frame (Schur complement); what is left is one smooth system of the rotations.
    ahead = torch.linalg.solve(gram[:, 3:, 3:], gram[:, 3:, :3])
    reduced = gram[:, :3, :3] - gram[:, :3, 3:] @ ahead
    value = right[:, :3] - (ahead.mT @ right[:, 3:, None])[..., 0]
    second = torch.zeros(frames - 2, frames, dtype=points.dtype)
    index = torch.arange(frames - 2)
    second[index, index], second[index, index + 1], second[index, index + 2] = 1.0, -2.0, 1.0
    strength = 1 / torch.deg2rad(points.new_tensor(p.acceleration)) ** 2
    speed = _speeds(s.rotations)
    bend = speed[1:] - speed[:-1]
    smooth = strength * torch.einsum("af,ag->fg", second, second)
    system = torch.block_diag(*reduced).reshape(frames, 3, frames, 3)
    system = system + torch.einsum("fg,ij->figj", smooth, eye)
    goal = value - strength * second.T @ bend
    turn = torch.linalg.solve(system.reshape(3 * frames, 3 * frames), goal.reshape(-1)).reshape(frames, 3)
    turn = turn * (0.2 / turn.norm(dim=-1).max().clamp_min(0.2))  # radians; a longer step leaves the linear range
    return replace(s, rotations=rotation_from_vector(turn) @ s.rotations)


def _speeds(rotations: Float[Tensor, "frames 3 3"]) -> Float[Tensor, "steps 3"]:
    """Rotation vector from each frame to the next; exact for small steps to third order."""
    step = rotations[1:] @ rotations[:-1].mT
    return 0.5 * torch.stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], -1
    )


def turning_rigid(tracks: Tracks, params: TurnParams | None = None) -> Reconstruction:
    """Rigid shape, rotations and translations of pinhole tracks of a body that the camera goes round.

    Args:
        tracks: one sequence with intrinsics.
        params: of the search.

    Returns:
        Reconstruction: ``points3d`` in units in which the mean distance of the camera is 1.
    """
    p = params or TurnParams()
    visible = tracks.visible
    plane = normalised_coordinates(torch.nan_to_num(tracks.xy), tracks.intrinsics)
    plane = torch.where(visible[..., None], plane, torch.zeros_like(plane))
    weight = visible.to(plane.dtype)
    outlier = p.outlier / float(tracks.intrinsics[0, 0])
    middle = plane.sum(1) / weight.sum(1).clamp_min(1)[:, None]
    translation = torch.cat([middle, torch.ones_like(middle[:, :1])], -1)
    frames = len(plane)
    found: list[tuple[float, float, _State]] = []
    for step in range(-p.steps, p.steps + 1):
        rate = p.fastest * step / p.steps
        angle = torch.deg2rad(rate * torch.arange(frames, dtype=plane.dtype))
        rotations = rotation_from_vector(torch.stack([0 * angle, angle, 0 * angle], -1))
        state = _State(plane, weight, rotations, plane.new_zeros(plane.shape[1], 3), translation)
        for _ in range(p.rounds):
            state = _fit_translation(_fit_shape(state, p.ridge))
        found.append((_robust(state, visible, outlier)[1], rate, state))
    found.sort(key=lambda item: item[0])
    refined = []
    for _, rate, state in found[: p.kept]:
        for _ in range(p.refinements):
            state, cost = _robust(state, visible, outlier)
            state = _fit_rotations(_fit_translation(_fit_shape(state, p.ridge)), cost, p)
        state = _fit_translation(_fit_shape(state, p.ridge))
        refined.append((_robust(state, visible, outlier)[1], rate, state))
    cost, rate, best = min(refined, key=lambda item: item[0])
    pixels = cost**0.5 * float(tracks.intrinsics[0, 0])
    turned = float(torch.rad2deg(_speeds(best.rotations).norm(dim=-1).sum()))
    return Reconstruction.from_points(
        best.shape @ best.rotations.mT,
        best.rotations,
        rank=1,
        status=Status("ok", f"rigid body, view turning by {turned:.0f} degrees, {pixels:.1f} px from the tracks"),
        translation=best.translation,
        intrinsics=tracks.intrinsics,
        observed=visible,
    )
