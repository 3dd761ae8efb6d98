"""How likely tracks are when every frame shows a draw from one low-dimensional family of shapes.

Frame f shows ``s_f R_f (m + sum_k L_k a_fk + residual) + t_f`` through its first two rows, with weights
``a_f ~ N(0, I)``, an isotropic 3D residual of variance ``eps^2`` and the noise covariance of each observation. Weights,
residual and translation (flat prior) are integrated out in closed form, so depths are never estimated on the way and
unseen entries are never filled: what is left are the poses (s_f, R_f), the mean shape m and the loadings L. The
loadings are kept orthogonal to what a turn or a change of size would do to the mean shape: the Procrustean condition of
Lee et al. (CVPR 2013), without which turns and deformations are confounded.
Derived here from that model; its one published relative, estimated by expectation-maximisation with a residual in the
image, is Torresani et al. (PAMI 2008).
Cost: linear in frames and in points. All leading dimensions are batch dimensions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.linalg import rotation_from_vector, skew

__all__ = ["Evaluation", "ShapeModel", "Views", "cost_of_modes", "evaluate", "grow_loadings", "moved", "tangents"]


@dataclass(frozen=True, eq=False)
class Views:
    """Observations in units in which the body has rms size about one.

    Attributes:
        xy: (*b, frames, points, 2), any finite value where nothing is seen.
        visible: (*b, frames, points).
        noise: (*b, frames, points, 2, 2) covariance of the observations, squared units; zero for exact ones.
    """

    xy: Float[Tensor, "*b frames points 2"]
    visible: Bool[Tensor, "*b frames points"]
    noise: Float[Tensor, "*b frames points 2 2"]

    @property
    def variance(self) -> float:
        """Mean noise variance of a coordinate."""
        return float(self.noise.diagonal(dim1=-2, dim2=-1).mean())

    def whitener(self, residual: Float[Tensor, "*b frames"]) -> Float[Tensor, "*b frames points 2 2"]:
        """K with ``K^T K`` the inverse of noise plus residual; zero where nothing is seen.

        Args:
            residual: variance of the residual in the image.
        """
        xx = self.noise[..., 0, 0] + residual[..., None]
        yx, yy = self.noise[..., 1, 0], self.noise[..., 1, 1] + residual[..., None]
        first = xx.rsqrt()
        second = (yy - yx.square() / xx).rsqrt()
        rows = torch.stack([first, torch.zeros_like(first), -yx / xx * second, second], -1).unflatten(-1, (2, 2))
        return rows * self.visible[..., None, None]


@dataclass(frozen=True, eq=False)
class ShapeModel:
    """Poses and family of shapes; gradients and steps keep the loadings orthogonal to ``avoided``.

    Attributes:
        rotations: (*b, frames, 3, 3) canonical -> camera.
        scale: (*b, frames), geometric mean one.
        mean: (*b, points, 3) centred.
        loadings: (*b, points, 3, modes).
        avoided: (*b, 3 * points, 4) orthonormal; spans what turn and growth do to the mean shape at its last growth.
    """

    rotations: Float[Tensor, "*b frames 3 3"]
    scale: Float[Tensor, "*b frames"]
    mean: Float[Tensor, "*b points 3"]
    loadings: Float[Tensor, "*b points 3 modes"]
    avoided: Float[Tensor, "*b size 4"]

    def pick(self, index: int) -> ShapeModel:
        """Item ``index`` of the first dimension, as a batch of one."""
        return ShapeModel(*(getattr(self, part.name)[index : index + 1] for part in fields(self)))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Value, gradient and curvature at a model, and the posterior of the shapes.

    Attributes:
        value: (*b) minus the log-likelihood, summed over frames; infinite (and nothing else of use) where it cannot
            be computed.
        pose: (*b, frames, 4) gradient: rotation vector on the camera side, logarithm of the scale.
        mean, loadings: gradients.
        pose_fisher: (*b, frames, 4, 4) expected information of the poses.
        points: (*b, frames, points, 3) posterior mean in camera axes, the scale included, translation removed.
        spread: (*b, frames, points, 3, columns) ``points`` moves by ``spread @ d`` with d ~ N(0, I): uncertainty of the
            weights; the residual comes on top. None unless asked for.
        translation: (*b, frames, 2).
    """

    value: Float[Tensor, "*b"]
    pose: Float[Tensor, "*b frames 4"]
    mean: Float[Tensor, "*b points 3"]
    loadings: Float[Tensor, "*b points 3 modes"]
    pose_fisher: Float[Tensor, "*b frames 4 4"]
    points: Float[Tensor, "*b frames points 3"]
    spread: Float[Tensor, "*b frames points 3 columns"] | None
    translation: Float[Tensor, "*b frames 2"]


def tangents(mean: Float[Tensor, "*b points 3"]) -> Float[Tensor, "*b size 4"]:
    """What three turns and a growth do to the mean shape, as columns of 3 * points numbers."""
    eye = torch.eye(3, dtype=mean.dtype, device=mean.device)
    turned = torch.linalg.cross(eye.expand(*mean.shape[:-1], 3, 3), mean[..., None, :].expand(*mean.shape[:-1], 3, 3))
    return torch.cat([turned.mT, mean[..., None]], -1).flatten(-3, -2)


def cost_of_modes(views: Views, model: ShapeModel) -> float:
    """What the loadings of an item must gain to be believed, nats (Schwarz 1978): so much they explain of noise."""
    return 0.5 * model.loadings[0].numel() * math.log(2 * max(1, int(views.visible.sum())))


def moved(model: ShapeModel, pose: Tensor, mean: Tensor, loadings: Tensor) -> ShapeModel:
    """The model after a step: poses on their manifold, loadings back on theirs."""
    growth = pose[..., 3] - pose[..., 3].mean(-1, keepdim=True)
    return replace(
        model,
        rotations=rotation_from_vector(pose[..., :3]) @ model.rotations,
        scale=model.scale * torch.exp(growth),
        mean=model.mean + mean,
        loadings=model.loadings + loadings,
    )


def _placed(model: ShapeModel) -> Tensor:
    """Mean and loadings of every frame in camera axes: (*b, frames, 3, points, 1 + modes)."""
    basis = torch.cat([model.mean[..., None], model.loadings], -1)
    flat = basis.transpose(-3, -2).flatten(-2)
    poses = (model.scale[..., None, None] * model.rotations).flatten(-3, -2)
    return (poses @ flat).unflatten(-2, (model.scale.shape[-1], 3)).unflatten(-1, (basis.shape[-3], basis.shape[-1]))


def _spread(placed: Tensor, factor: Tensor, gain: Tensor) -> Tensor:
    """Root of the posterior covariance of the points through that of the weights, columns last."""
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    root = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False).mT
    loadings = placed[..., 1:].transpose(-3, -2)  # (*b, frames, points, 3, modes)
    # What is measured exactly does not move with the weights.
    kept = torch.cat([loadings[..., :2, :] - gain @ loadings[..., :2, :], loadings[..., 2:, :]], -2)
    return (kept.flatten(-3, -2) @ root[..., : kept.shape[-1], :]).unflatten(-2, kept.shape[-3:-1])


def _whitened(whitener: Tensor, rows: Float[Tensor, "*b points 2 columns"]) -> Float[Tensor, "*b points 2 columns"]:
    """``whitener @ rows`` for lower triangles, without a matrix product for every point."""
    first, second = rows.unbind(-2)
    k = whitener[..., None]
    return torch.stack([k[..., 0, 0, :] * first, k[..., 1, 0, :] * first + k[..., 1, 1, :] * second], -2)


def _back(whitener: Tensor, rows: Float[Tensor, "*b points 2 columns"]) -> Float[Tensor, "*b points 2 columns"]:
    """``whitener.mT @ rows`` likewise."""
    first, second = rows.unbind(-2)
    k = whitener[..., None]
    return torch.stack([k[..., 0, 0, :] * first + k[..., 1, 0, :] * second, k[..., 1, 1, :] * second], -2)


def evaluate(views: Views, model: ShapeModel, eps: float, *, with_spread: bool = False) -> Evaluation:
    """Minus the log-likelihood with its gradient, see the module's text; ``eps`` is the deviation of the residual."""
    modes = model.loadings.shape[-1]
    residual = (eps * model.scale).square()
    whitener = views.whitener(residual)
    placed = _placed(model)
    plane = placed[..., :2, :, :].transpose(-3, -2)  # (*b, frames, points, 2, 1 + modes)
    seen = views.visible[..., None]
    error = torch.where(seen, views.xy - plane[..., 0], plane.new_zeros(()))
    # Columns: the modes, then the two of the translation, whose prior is flat.
    design = torch.cat([_whitened(whitener, plane[..., 1:]), whitener], -1).flatten(-3, -2)
    target = _whitened(whitener, error[..., None]).flatten(-3, -2)
    precision = torch.cat([plane.new_ones(modes), plane.new_full((2,), 1e-9)])
    factor, failed = torch.linalg.cholesky_ex(design.mT @ design + torch.diag(precision))
    # Loadings so large that rounding hides the prior are no family of shapes: a line search turns back there.
    factor = torch.where(failed[..., None, None] > 0, torch.eye(len(precision)).to(factor), factor)
    weights = torch.cholesky_solve(design.mT @ target, factor)
    rest = target - design @ weights
    half = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    scatter = torch.where(seen, whitener.diagonal(dim1=-2, dim2=-1), plane.new_ones(())).log().sum((-1, -2))
    value = (0.5 * (target * rest).sum((-1, -2)) + half - scatter).sum(-1)
    value = torch.where((failed > 0).any(-1), torch.full_like(value, torch.inf), value)

    # Gradient with respect to everything placed in the image.
    inverse = torch.cholesky_inverse(factor)
    solved = design @ inverse
    inner = torch.cat([-rest, solved[..., :modes] - rest @ weights[..., :modes, :].mT], -1)
    slope = _back(whitener, inner.unflatten(-2, (plane.shape[-3], 2)))
    stacked = slope.transpose(-3, -2).flatten(-2)  # (*b, frames, 2, points * (1 + modes))
    poses = model.scale[..., None, None] * model.rotations[..., :2, :]
    basis = (poses.flatten(-3, -2).mT @ stacked.flatten(-3, -2)).unflatten(-1, (plane.shape[-3], 1 + modes))
    basis = basis.transpose(-3, -2)
    gx, gy = (stacked @ placed.flatten(-2).mT).unbind(-2)
    pose = torch.stack([-gy[..., 2], gx[..., 2], gy[..., 0] - gx[..., 1], gx[..., 0] + gy[..., 1]], -1)
    # The residual grows with the scale: s^2 eps^2 (tr C^-1 - |C^-1 e|^2), with C^-1 = K^T (I - design G^-1 design^T) K.
    within = _back(whitener, design.unflatten(-2, (plane.shape[-3], 2))).flatten(-3, -2)
    known = (_back(whitener, solved.unflatten(-2, (plane.shape[-3], 2))).flatten(-3, -2) * within).sum((-1, -2))
    pull = slope[..., 0].square().sum((-1, -2))
    pose[..., 3] += residual * (whitener.square().sum((-1, -2, -3)) - known - pull)
    pose[..., 3] -= pose[..., 3].mean(-1, keepdim=True)
    mean, loadings = basis[..., 0], basis[..., 1:]
    flat = loadings.flatten(-3, -2)
    loadings = (flat - model.avoided @ (model.avoided.mT @ flat)).view_as(loadings)

    # Posterior of the shapes, and the information of the poses at its mean.
    shapes = (weights[..., :modes, 0] @ model.loadings.flatten(-3, -2).mT).unflatten(-1, model.mean.shape[-2:])
    fitted = (model.mean[..., None, :, :] + shapes) @ (model.scale[..., None, None] * model.rotations).mT
    translation = weights[..., modes:, 0]
    gain = residual[..., None, None, None] * _back(whitener, whitener)
    loose = error - (fitted[..., :2] - plane[..., 0]) - translation[..., None, :]
    inplane = fitted[..., :2] + (gain @ torch.where(seen, loose, loose.new_zeros(()))[..., None])[..., 0]
    points = torch.cat([inplane, fitted[..., 2:]], -1)
    spread = _spread(placed, factor, gain) if with_spread else None
    jacobian = torch.cat([-skew(points)[..., :2, :], points[..., :2, None]], -1)
    seen_jacobian = _whitened(whitener, jacobian).flatten(-3, -2)
    explained = torch.linalg.solve_triangular(factor, design.mT @ seen_jacobian, upper=False)
    fisher = seen_jacobian.mT @ seen_jacobian - explained.mT @ explained
    return Evaluation(value, pose, mean - mean.mean(-2, keepdim=True), loadings, fisher, points, spread, translation)


def grow_loadings(
    views: Views, model: ShapeModel, eps: float, most: int, noise: float = 0.0, draws: float = 1.0
) -> ShapeModel:
    """One step of expectation-maximisation for mean and loadings: principal directions of the expected covariance.

    Directions whose variance exceeds that of the residual become modes, at most ``most``: the number of modes finds
    itself. Loadings of fewer modes are padded with zeros to the largest of the batch.

    Args:
        noise: variance of the observations that a mode has to be told from, zero for exact ones.
        draws: independent observations among as many: what smoothing over time has left.
    """
    now = evaluate(views, model, eps, with_spread=True)
    assert now.spread is not None
    back = model.rotations / model.scale[..., None, None]
    shapes = now.points @ back
    mean = shapes.mean(-3)
    mean = mean - mean.mean(-2, keepdim=True)
    frames = shapes.shape[-3]
    data = (shapes - shapes.mean(-3, keepdim=True)).flatten(-2)
    doubt = back[..., None, :, :].mT @ now.spread  # canonical axes
    doubt = doubt.flatten(-3, -2).mT.flatten(-3, -2)  # (*b, frames * columns, 3 * points)
    rows = torch.cat([data, doubt], -2) / frames**0.5
    avoided, _ = torch.linalg.qr(tangents(mean))
    rows = rows - (rows @ avoided) @ avoided.mT
    variance = (eps * model.scale).square()
    measured = views.whitener(variance).square().sum((-1, -2)) * variance[..., None]
    gain = measured.mean((-1, -2))  # 2 for exact, 0 for unseen entries
    residual = eps**2 * (1 - gain / 3)
    if rows.shape[-2] <= rows.shape[-1]:
        values, left = torch.linalg.eigh(rows @ rows.mT)
        vectors = rows.mT @ (left / values.clamp_min(torch.finfo(values.dtype).tiny).sqrt()[..., None, :])
    else:
        values, vectors = torch.linalg.eigh(rows.mT @ rows)
    values = values.flip(-1)[..., :most]
    vectors = vectors.flip(-1)[..., :most]
    strength = (values + residual[..., None] - eps**2).clamp_min(0)
    # What noise does in so few frames (Baik, Ben Arous and Peche 2005): signal over noise must exceed the root of
    # dimensions over samples, and a frame measures two of three coordinates.
    ratio = 1.5 * mean.shape[-2] * 3 / frames
    strength = torch.where(strength > noise * ratio**0.5, strength, torch.zeros_like(strength))
    # A body bends at all only if its strongest mode stands above all that correlated noise does to a rigid one
    # (edge of Marchenko and Pastur).
    ratio /= draws
    bends = strength[..., :1] > noise * (ratio + 2 * ratio**0.5) if draws < 1 else strength[..., :1] > 0
    strength = torch.where(bends, strength, torch.zeros_like(strength))
    modes = int((strength > 0).sum(-1).max())
    loadings = vectors[..., :modes] * strength[..., None, :modes].sqrt()
    return ShapeModel(model.rotations, model.scale, mean, loadings.unflatten(-2, (mean.shape[-2], 3)), avoided)
