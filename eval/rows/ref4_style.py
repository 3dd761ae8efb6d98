"""Ref. 4-style: a deformable template with action-wise shape prior (after Coenen and Rottensteiner 2021). Supervised.

The original fits a deformable wireframe, whose prior depends on the predicted subcategory, to keypoints of named
parts. Tracks have no names, so the wireframe here is a template of points spread over the body's surface, and which
template point a track belongs to is found with the fit:

- prior: for each action the mean and the principal components of the template over poses of training bodies,
  brought to one heading and scale;
- start: the shared camera rotations times an unknown heading; headings and actions are tried, the best few are kept;
- then alternate (1) assignment: a track takes, for its whole life, the template point that lies nearest in the image,
  and loosely in the depth of the shared rigid shape, over all its frames, points that are not hidden preferred;
  (2) pose: rotation of each frame by Procrustes with the depth that the template gives, one scale, a translation
  each; (3) shape: the coefficients of each frame as the maximum a posteriori under the prior, with a pull to the
  neighbouring frames;
- the action with the lowest total energy wins.

The prior is trained on 3D shapes of training bodies, which no other row gets: the row is marked supervised.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch

from eval.rows.base import Context, RowOutput, Views, in_camera, registered_views
from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_rotation, rotation_from_vector
from torchrecon.measurement import Tracks

__all__ = ["ShapePrior", "TemplateParams", "fit_prior", "fit_template", "solve"]


@dataclass(frozen=True)
class TemplateParams:
    """Parameters of prior and fit; lengths are fractions of the rms size of the template."""

    modes: int = 12  # principal components of each action
    headings: int = 12  # headings tried
    kept: int = 1  # best starts of each action that are refined
    rounds: int = 6  # alternations of each of them
    final: int = 4  # further alternations of the best one, on views corrected for perspective
    every: int = 2  # every how many frames are looked at in the assignment; starts look at twice as few
    misfit: float = 0.07  # standard deviation of an observation from the template
    depth_misfit: float = 0.12  # standard deviation of a track's rigid depth from the template
    shade: float = 0.2  # a template point hides others within this distance in the image
    thickness: float = 0.25  # and behind it by at least this
    hidden: float = 3.0  # cost of an observation of a hidden template point, in standard deviations
    smooth: float = 2.0  # pull of the two neighbouring frames' coefficients, in units of the prior's


@dataclass(frozen=True)
class ActionShapes:
    """One action: mean (M, 3), modes (K, M, 3) orthonormal, deviations (K,)."""

    mean: Float[Tensor, "points 3"]
    modes: Float[Tensor, "modes points 3"]
    deviations: Float[Tensor, " modes"]


ShapePrior = Mapping[str, ActionShapes]


def fit_prior(shapes: Mapping[str, Float[Tensor, "samples points 3"]], modes: int = 12) -> dict[str, ActionShapes]:
    """Principal components of each action's shapes, which are already of one heading, centred and of rms size 1."""
    prior = {}
    for action, sample in shapes.items():
        mean = sample.mean(0)
        _, s, vh = torch.linalg.svd((sample - mean).flatten(1), full_matrices=False)
        kept = vh[:modes].unflatten(-1, mean.shape)
        prior[action] = ActionShapes(mean, kept, s[:modes] / math.sqrt(len(sample)))
    return prior


@dataclass(frozen=True)
class _Fit:
    """State of one start: template in camera axes (F, M, 3) = scale R (mean + modes g) + (translation, 0)."""

    shapes: ActionShapes
    rotations: Tensor
    scale: Tensor
    translation: Tensor
    coefficients: Tensor
    match: Tensor
    energy: float

    def template(self) -> Tensor:
        """(F, M, 3) canonical shapes."""
        return self.shapes.mean + torch.einsum("fk,kmi->fmi", self.coefficients, self.shapes.modes)

    def placed(self) -> Tensor:
        """(F, M, 3) camera axes."""
        body = self.scale * self.template() @ self.rotations.mT
        return body + torch.nn.functional.pad(self.translation, (0, 1))[:, None]


def _assign(views: Views, fit: _Fit, p: TemplateParams) -> tuple[Int[Tensor, " points"], float]:
    """Template point of each track, and the mean cost of an observation under that choice."""
    placed, size = fit.placed().float(), float(fit.scale)  # single precision is enough to choose by, and faster
    image, depth = placed[..., :2], placed[..., 2]
    over = torch.cdist(image, image) < p.shade * size  # a template point hides those behind it
    nearest = torch.where(over, depth[:, None, :], depth.amax()).amin(-1)
    hidden = p.hidden**2 * (depth > nearest + p.thickness * size).to(depth.dtype)
    f, track = views.visible.nonzero(as_tuple=True)
    misfit = (views.xy[f, track, None].float() - image[f]).square().sum(-1) / (size * p.misfit) ** 2
    rigid = (views.shape @ views.rotations.mT)[f, track, 2].float()
    away = (rigid[:, None] - depth[f]).square() / (size * p.depth_misfit) ** 2
    # A robust cost: where the template lacks a limb's pose, a far track says nothing but that.
    misfit = misfit + away
    cost = misfit / (1 + misfit / 25) + hidden[f]
    total = depth.new_zeros(views.xy.shape[1], placed.shape[1]).index_add_(0, track, cost)
    best, match = total.min(1)
    return match, float(best.sum() / len(f))


def _pose(views: Views, fit: _Fit) -> _Fit:
    """Scale, translation and rotation of each frame, the unseen depth taken from the template."""
    weight = views.weight[..., None]
    count = weight.sum(1).clamp_min(1)
    body = fit.template()[:, fit.match]
    for _ in range(2):
        turned = body @ fit.rotations.mT
        centre = (weight * turned).sum(1) / count
        image = (weight * views.seen).sum(1) / count
        flat, target = weight * (turned - centre[:, None])[..., :2], weight * (views.seen - image[:, None])
        scale = (flat * target).sum() / flat.square().sum()
        if not float(scale) > 0:  # also catches NaN
            scale = fit.scale
        lifted = torch.cat([target / scale, weight * (turned - centre[:, None])[..., 2:]], -1)
        middle = (weight * body).sum(1, keepdim=True) / count[:, None]
        rotations = nearest_rotation(lifted.mT @ (weight * (body - middle)))
        few = views.visible.sum(1) < 6  # too few points to turn a frame by themselves
        fit = replace(fit, rotations=torch.where(few[:, None, None], fit.rotations, rotations), scale=scale)
    centre = (weight * (body @ fit.rotations.mT)).sum(1)[..., :2] / count
    return replace(fit, translation=(weight * views.seen).sum(1) / count - fit.scale * centre)


def _shape(views: Views, fit: _Fit, p: TemplateParams) -> _Fit:
    """Coefficients of all frames: MAP under the prior, with a pull to the neighbours, one banded linear system."""
    camera = fit.scale * fit.rotations[:, :2]
    modes = fit.shapes.modes[:, fit.match]
    design = torch.einsum("fai,kpi->fpak", camera, modes) * views.weight[..., None, None]
    base = torch.einsum("fai,pi->fpa", camera, fit.shapes.mean[fit.match]) + fit.translation[:, None]
    residual = (views.seen - base) * views.weight[..., None]
    precision = 1 / (fit.scale * p.misfit) ** 2
    frames = len(fit.coefficients)
    gram = precision * torch.einsum("fpak,fpal->fkl", design, design)
    right = precision * torch.einsum("fpak,fpa->fk", design, residual)
    prior = torch.diag(1 / fit.shapes.deviations.clamp_min(1e-6).square())
    neighbours = torch.full((frames,), 2.0, dtype=gram.dtype)
    neighbours[0] = neighbours[-1] = 1.0 if frames > 1 else 0.0
    blocks = gram + (1 + p.smooth * neighbours)[:, None, None] * prior
    return replace(fit, coefficients=_solve_chain(blocks, -p.smooth * prior, right))


def _solve_chain(blocks: Tensor, link: Tensor, right: Tensor) -> Tensor:
    """Block-tridiagonal system with diagonal ``blocks`` (F, k, k) and the one off-diagonal ``link``, by elimination."""
    pivots, reduced = [blocks[0]], [right[0]]
    for block, value in zip(blocks[1:], right[1:], strict=True):
        carried = torch.linalg.solve(pivots[-1].mT, link).mT
        pivots.append(block - carried @ link)
        reduced.append(value - carried @ reduced[-1])
    answer = [torch.linalg.solve(pivots[-1], reduced[-1])]
    for pivot, value in zip(reversed(pivots[:-1]), reversed(reduced[:-1]), strict=True):
        answer.append(torch.linalg.solve(pivot, value - link @ answer[-1]))
    return torch.stack(answer[::-1])


def _start(views: Views, shapes: ActionShapes, heading: float) -> _Fit:
    axis = torch.tensor([0.0, heading, 0.0], dtype=views.xy.dtype)
    rotations = views.rotations @ rotation_from_vector(axis)
    count, k = len(rotations), len(shapes.deviations)
    size = (views.seen - _mean(views)).square().mul(views.weight[..., None]).sum() / views.weight.sum()
    flat = (shapes.mean @ rotations.mT)[..., :2].square().sum(-1).mean()
    return _Fit(
        shapes,
        rotations,
        (size / flat).sqrt(),
        _mean(views)[:, 0],
        views.xy.new_zeros(count, k),
        torch.zeros(views.xy.shape[1], dtype=torch.long),
        math.inf,
    )


def _mean(views: Views) -> Tensor:
    return views.seen.sum(1, keepdim=True) / views.weight.sum(1).clamp_min(1)[:, None, None]


def _round(views: Views, fit: _Fit, p: TemplateParams, shape: bool) -> _Fit:
    frames = torch.arange(0, len(fit.rotations), p.every)
    match, cost = _assign(_some(views, frames), _some_frames(fit, frames), p)
    unseen = ~views.visible[frames].any(0)
    fit = _pose(views, replace(fit, match=torch.where(unseen, fit.match, match)))
    if shape:
        fit = _shape(views, fit, p)
    pull = (fit.coefficients / fit.shapes.deviations.clamp_min(1e-6)).square().sum(-1).mean()
    return replace(fit, energy=cost * float(views.weight.sum()) / len(fit.rotations) + float(pull))


def _some(views: Views, frames: Tensor) -> Views:
    return replace(views, xy=views.xy[frames], visible=views.visible[frames], rotations=views.rotations[frames])


def _some_frames(fit: _Fit, frames: Tensor) -> _Fit:
    return replace(
        fit,
        rotations=fit.rotations[frames],
        translation=fit.translation[frames],
        coefficients=fit.coefficients[frames],
    )


def fit_template(
    views: Views,
    prior: ShapePrior,
    params: TemplateParams | None = None,
    corrected: Callable[[Tensor], Views] | None = None,
) -> tuple[Float[Tensor, "frames points 3"], str]:
    """Fit the template of every action and keep the best.

    Args:
        views: the sequence.
        prior: one set of shapes per action.
        params: of the fit.
        corrected: from the depths (frames, points) found so far to views freed of perspective.

    Returns:
        points: (frames, points, 3) camera axes: image position as measured, depth of the template.
        action: whose template has the lowest energy.
    """
    p = params or TemplateParams()
    coarse = _some(views, torch.arange(0, len(views.rotations), 2))
    fits = []
    for action, shapes in prior.items():
        starts = []
        for step in range(p.headings):
            heading = 2 * math.pi * step / p.headings
            starts.append((_round(coarse, _start(coarse, shapes, heading), p, shape=False).energy, heading))
        for _, heading in sorted(starts)[: p.kept]:
            fit = _start(views, shapes, heading)
            for step in range(p.rounds):
                fit = _round(views, fit, p, shape=step > 0)
            fits.append((action, fit))
    action, best = min(fits, key=lambda item: item[1].energy)
    for _ in range(p.final):
        if corrected is not None:
            views = corrected(best.placed()[:, best.match, 2])
        best = _round(views, best, p, shape=True)
    return in_camera(views, best.placed()[:, best.match]), action


def solve(tracks: Tracks, context: Context) -> RowOutput:
    """The row: template fit on the shared rotations; needs ``context.prior``."""
    if context.prior is None:
        raise ReconError("Ref. 4-style: needs a trained shape prior; pass it as context.prior")
    points, action = fit_template(
        registered_views(tracks, context.rigid),
        context.prior,
        corrected=lambda depth: registered_views(tracks, context.rigid, depth),
    )
    return RowOutput(points, tracks.visible, f"template of action {action}")
