"""A rigid body before a camera that turns about it: where the search for a camera path begins.

Tracks on a turning body live for a fraction of the turn, so no frame shares points with one far away and an affine
factorisation has too little to hold on to. Two things are used instead: the turn is smooth, and near points look
larger than far ones. Rates of turn are tried in both senses, each with the rigid shape and the translations that fit
best in the pinhole sense; the best are kept, and rotations of single frames are freed under a prior on the angular
acceleration. Far residuals count less, so that the trunk decides and not the limbs.
Derived here; not a published method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector, skew
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.measurement.camera import normalised_coordinates

__all__ = ["RigidTurn", "TurnParams", "longest", "rigid_turns", "rigid_under", "turning_rigid"]


@dataclass(frozen=True)
class TurnParams:
    """Parameters of the search.

    Attributes:
        rates: of turn that are tried, in both senses (degrees per second).
        rounds: alternations of shape and translation for each rate (count).
        kept: best rates of each sense that are refined (count).
        refinements: alternations with the rotations free (count).
        acceleration: standard deviation of the angular acceleration (degrees per second^2).
        tilt: standard deviation of the angular velocity across the axis that is tried (degrees per second).
        together: observations of one track err together while a limb moves; so many count as one.
        outlier: residual at which an observation counts half (rms sizes of the body in the image).
        ridge: pull of the shape to its centre where a point is hardly seen (observations).
        search_points: longest tracks that the search for the turn uses (count).
    """

    rates: tuple[float, ...] = (25.0, 50.0, 75.0, 100.0, 125.0, 150.0, 175.0, 200.0)
    rounds: int = 8
    kept: int = 2
    refinements: int = 25
    acceleration: float = 6.0
    tilt: float = 10.0
    together: float = 10.0
    outlier: float = 0.16
    ridge: float = 1e-2
    search_points: int = 300


@dataclass(frozen=True, eq=False)
class RigidTurn:
    """A rigid body under a turn; a point lies at ``R S + t`` in the camera, whose mean distance is 1.

    Attributes:
        plane: (frames, points, 2) normalised image coordinates, zero where unseen.
        weight: (frames, points) of each observation, zero where unseen.
        rotations: (frames, 3, 3) canonical -> camera.
        shape: (points, 3) canonical axes.
        translation: (frames, 3).
        cost: mean robust squared residual (tangents of the viewing angle).
    """

    plane: Float[Tensor, "frames points 2"]
    weight: Float[Tensor, "frames points"]
    rotations: Float[Tensor, "frames 3 3"]
    shape: Float[Tensor, "points 3"]
    translation: Float[Tensor, "frames 3"]
    cost: float = math.inf

    def rows(self, vectors: Float[Tensor, "frames _ 3 n"]) -> Float[Tensor, "frames points 2 n"]:
        """``v_xy - n v_z`` of camera-axes vectors: zero for a point on its ray."""
        return vectors[..., :2, :] - self.plane[..., None] * vectors[..., 2:, :]

    def residual(self) -> Float[Tensor, "frames points 2"]:
        """Distance from the ray, as a tangent of the viewing angle."""
        points = self.shape @ self.rotations.mT + self.translation[:, None]
        return self.rows(points[..., None])[..., 0] / points[..., 2:].clamp_min(1e-3)


def _fit_shape(s: RigidTurn, ridge: float) -> RigidTurn:
    design = s.rows(s.rotations[:, None])
    right = s.rows(s.translation[:, None, :, None])[..., 0]
    eye = torch.eye(3, dtype=design.dtype, device=design.device)
    gram = torch.einsum("fp,fpai,fpaj->pij", s.weight, design, design) + ridge * eye
    shape = -torch.linalg.solve(gram, torch.einsum("fp,fpai,fpa->pi", s.weight, design, right)[..., None])[..., 0]
    seen = s.weight.sum(0)[:, None] > 0
    centre = torch.where(seen, shape, torch.zeros_like(shape)).sum(0) / seen.sum()
    return replace(s, shape=torch.where(seen, shape - centre, torch.zeros_like(shape)))


def _fit_translation(s: RigidTurn) -> RigidTurn:
    points = s.shape @ s.rotations.mT
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    design = s.rows(eye.expand(*points.shape[:2], 3, 3))
    right = s.rows(points[..., None])[..., 0]
    # A slight pull to where it was: a frame may see a single point, or none.
    gram = torch.einsum("fp,fpai,fpaj->fij", s.weight, design, design) + 1e-4 * eye
    goal = 1e-4 * s.translation - torch.einsum("fp,fpai,fpa->fi", s.weight, design, right)
    shift = torch.linalg.solve(gram, goal[..., None])[..., 0]
    # The unit of length is free: the mean distance is held, or shape and distance would shrink to nothing together.
    scale = s.translation[:, 2].mean() / shift[:, 2].mean()
    return replace(s, translation=shift * scale, shape=s.shape * scale)


def _robust(s: RigidTurn, outlier: float) -> RigidTurn:
    """Weights that let far residuals count less, and the mean cost they stand for."""
    seen = s.weight > 0
    square = s.residual().square().sum(-1)
    share = 1 / (1 + square / outlier**2)
    zero = torch.zeros_like(square)
    cost = torch.where(seen, square * share, zero).sum() / seen.sum()
    return replace(s, weight=torch.where(seen, share.square(), zero), cost=float(cost))


def _fit_rotations(s: RigidTurn, axis: Tensor, fps: float, params: TurnParams) -> RigidTurn:
    """One Gauss-Newton step of all rotations and translations under the priors on angular acceleration and axis."""
    frames = len(s.rotations)
    points = s.shape @ s.rotations.mT
    away = (points + s.translation[:, None])[..., 2:, None].clamp_min(1e-3)
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    # A small turn d moves a point by d x X = -[X]_x d.
    design = torch.cat([s.rows(-skew(points)), s.rows(eye.expand(*points.shape[:2], 3, 3))], -1) / away
    weight = s.weight / (max(s.cost, 1e-12) * params.together)
    gram = torch.einsum("fp,fpai,fpaj->fij", weight, design, design)
    ridge = torch.eye(6, dtype=points.dtype, device=points.device)
    gram = gram + (1e-6 * gram.diagonal(dim1=-2, dim2=-1).amax()) * ridge
    right = -torch.einsum("fp,fpai,fpa->fi", weight, design, s.residual())
    # Translations drop out frame by frame (Schur complement); what is left is one smooth system of the rotations.
    ahead = torch.linalg.solve(gram[:, 3:, 3:], gram[:, 3:, :3])
    reduced = gram[:, :3, :3] - gram[:, :3, 3:] @ ahead
    value = right[:, :3] - (ahead.mT @ right[:, 3:, None])[..., 0]
    second = points.new_zeros(frames - 2, frames)
    index = torch.arange(frames - 2, device=points.device)
    second[index, index], second[index, index + 1], second[index, index + 2] = 1.0, -2.0, 1.0
    first = second.new_zeros(frames - 1, frames)
    index = torch.arange(frames - 1, device=points.device)
    first[index, index], first[index, index + 1] = -1.0, 1.0
    step = _steps(s.rotations)
    steady = (fps**2 / math.radians(params.acceleration)) ** 2
    upright = (fps / math.radians(params.tilt)) ** 2 * (eye - axis[:, None] * axis)
    system = torch.block_diag(*reduced).reshape(frames, 3, frames, 3)
    system = system + torch.einsum("fg,ij->figj", steady * second.T @ second, eye)
    system = system + torch.einsum("fg,ij->figj", first.T @ first, upright)
    goal = value - steady * second.T @ (step[1:] - step[:-1]) - first.T @ step @ upright
    turn = torch.linalg.solve(system.reshape(3 * frames, 3 * frames), goal.reshape(-1)).reshape(frames, 3)
    turn = turn * (0.2 / turn.norm(dim=-1).max().clamp_min(0.2))  # radians; a longer step leaves the linear range
    return replace(s, rotations=rotation_from_vector(turn) @ s.rotations)


def _steps(rotations: Float[Tensor, "frames 3 3"]) -> Float[Tensor, "steps 3"]:
    """Rotation vector from each frame to the next, radians; exact for small steps to third order."""
    step = rotations[1:] @ rotations[:-1].mT
    return 0.5 * torch.stack(
        [step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], -1
    )


def _outlier(plane: Tensor, visible: Tensor, params: TurnParams) -> float:
    """The residual at which an observation counts half, tangents of the viewing angle."""
    weight = visible.to(plane.dtype)[..., None]
    seen = torch.where(visible[..., None], plane, torch.zeros_like(plane))
    middle = seen.sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1)
    return params.outlier * float((((seen - middle) * weight).square().sum() / (2 * weight.sum())).sqrt())


def longest(visible: Bool[Tensor, "frames points"], count: int) -> Int[Tensor, " kept"]:
    """Indices of the longest tracks, which say most about a turn.

    Example:
        >>> import torch
        >>> longest(torch.tensor([[True, True, False], [False, True, False]]), 2).tolist()
        [1, 0]
    """
    return torch.argsort(visible.sum(0), descending=True, stable=True)[:count]


def rigid_under(
    plane: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    rotations: Float[Tensor, "frames 3 3"],
    params: TurnParams | None = None,
) -> RigidTurn:
    """Rigid shape and translations that fit best under given rotations.

    Args:
        plane, visible, params: as for :func:`rigid_turns`.
        rotations: canonical -> camera.

    Example:
        >>> import torch
        >>> plane = 0.1 * torch.rand(8, 6, 2, generator=torch.Generator().manual_seed(0))
        >>> rigid_under(plane, torch.ones(8, 6, dtype=torch.bool), torch.eye(3).expand(8, 3, 3)).shape.shape
        torch.Size([6, 3])
    """
    p = params or TurnParams()
    weight = visible.to(plane.dtype)
    plane = torch.where(visible[..., None], plane, torch.zeros_like(plane))
    middle = plane.sum(1) / weight.sum(1, keepdim=True).clamp_min(1)
    translation = torch.cat([middle, torch.ones_like(middle[:, :1])], -1)
    turn = RigidTurn(plane, weight, rotations, plane.new_zeros(plane.shape[1], 3), translation)
    for _ in range(p.rounds):
        turn = _fit_translation(_fit_shape(turn, p.ridge))
    return _robust(turn, _outlier(plane, visible, p))


def rigid_turns(
    plane: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    fps: float,
    axes: tuple[float, ...] = (0.0,),
    parallel: bool = False,
    params: TurnParams | None = None,
) -> list[RigidTurn]:
    """The best turns of each sense about each axis, refined; best first.

    Args:
        plane: normalised image coordinates (tangents of the viewing angle); unseen entries are not read.
        visible: what is seen.
        fps: frames per second.
        axes: directions of the turning axis in the image (degrees from the vertical).
        parallel: rays are (nearly) parallel and cannot tell the sense of a turn: one sense only.
        params: of the search.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> shape = torch.randn(20, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 0.8, 0.2])
        >>> turn = rotation_from_vector(torch.arange(30)[:, None] * torch.tensor([0.0, 0.07, 0.0]))
        >>> points = shape @ turn.mT + torch.tensor([0.0, 0.0, 7.0])
        >>> plane = points[..., :2] / points[..., 2:]
        >>> best = rigid_turns(plane, torch.ones(30, 20, dtype=torch.bool), 25.0)[0]
        >>> step = best.rotations[1:] @ best.rotations[:-1].mT
        >>> round(float(step[:, 0, 2].mean()), 3)
        0.07
    """
    p = params or TurnParams()
    seconds = (torch.arange(len(plane), dtype=plane.dtype, device=plane.device) - len(plane) // 2) / fps
    found = []
    for sense in (1.0,) if parallel else (1.0, -1.0):
        tried = []
        for direction in axes:
            angle = math.radians(direction)
            axis = plane.new_tensor([math.sin(angle), math.cos(angle), 0.0])
            for rate in p.rates:
                rotations = rotation_from_vector(seconds[:, None] * (sense * math.radians(rate)) * axis)
                tried.append((rigid_under(plane, visible, rotations, p), axis))
        found += sorted(tried, key=lambda turn: turn[0].cost)[: p.kept]
    refined = [_refined(turn, axis, fps, p) for turn, axis in found]
    return sorted(refined, key=lambda turn: turn.cost)


def _refined(turn: RigidTurn, axis: Tensor, fps: float, params: TurnParams) -> RigidTurn:
    """Shape, translations and rotations in turn, far residuals counting less."""
    outlier = _outlier(turn.plane, turn.weight > 0, params)
    for _ in range(params.refinements):
        turn = _robust(turn, outlier)
        turn = _fit_rotations(_fit_translation(_fit_shape(turn, params.ridge)), axis, fps, params)
    return _robust(_fit_translation(_fit_shape(turn, params.ridge)), outlier)


def turning_rigid(tracks: Tracks, params: TurnParams | None = None) -> Reconstruction:
    """Rigid shape, rotations and translations of pinhole tracks of a body that the camera goes round.

    The sense of the turn, and with it the mirror image, is decided by perspective.

    Args:
        tracks: one sequence with intrinsics.
        params: of the search.

    Returns:
        Reconstruction: ``points3d`` in units in which the mean distance of the camera is 1.

    Raises:
        ReconError: the tracks have no intrinsics.

    Example:
        >>> import torch
        >>> xy = 50 + 10 * torch.rand(12, 9, 2, generator=torch.Generator().manual_seed(0))
        >>> k = torch.tensor([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
        >>> turning_rigid(Tracks(xy, intrinsics=k), TurnParams(refinements=2)).points3d.shape
        torch.Size([12, 9, 3])
    """
    if tracks.intrinsics is None:
        raise ReconError("turning_rigid: the tracks have no intrinsics, and perspective is what tells the sense")
    plane = normalised_coordinates(torch.nan_to_num(tracks.xy), tracks.intrinsics)
    p = params or TurnParams()
    search = longest(tracks.visible, p.search_points)
    found = rigid_turns(plane[:, search], tracks.visible[:, search], tracks.fps, params=p)[0]
    # The longest tracks find the turn; all of them then have their say.
    whole = rigid_under(plane, tracks.visible, found.rotations, p)
    best = _refined(whole, plane.new_tensor([0.0, 1.0, 0.0]), tracks.fps, replace(p, refinements=p.rounds))
    pixels = best.cost**0.5 * float(tracks.intrinsics[0, 0])
    turned = float(torch.rad2deg(_steps(best.rotations).norm(dim=-1).sum()))
    return Reconstruction.from_points(
        best.shape @ best.rotations.mT,
        best.rotations,
        rank=1,
        status=Status("ok", f"rigid body, view turning by {turned:.0f} degrees, {pixels:.1f} px from the tracks"),
        translation=best.translation,
        intrinsics=tracks.intrinsics,
        observed=tracks.visible,
    )
