"""Preconditioned limited-memory quasi-Newton descent of the marginal likelihood, all batch items at once.

The initial metric is the information of the model: a 4 x 4 block per pose, the covariance of the shapes for mean and
loadings. It is fresh in every step, which is what lets few steps walk the valley that couples tilt with depth. Steps,
curvature pairs and the line search are per item; an item never waits for the line search of another to say no.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchrecon._typing import Tensor
from torchrecon.nrsfm.articulation import Articulation, evaluate_with
from torchrecon.nrsfm.shape_likelihood import Evaluation, ShapeModel, Views, evaluate, moved

__all__ = ["DescentParams", "Direction", "Growth", "added", "descend", "inner", "metric", "residual_levels", "scaled"]


@dataclass(frozen=True)
class DescentParams:
    """Parameters of the descent.

    Attributes:
        memory: curvature pairs that are kept (count).
        tolerance: fall of the value per frame and step at which an item has converged (nats).
        turn: largest turn of a frame in one step (radians).
        halvings: line search trials per step (count).
        shorter: factor between them, and between the steps that two iterations try first (no unit).
        least: share of a full step that is tried first at least (no unit).
        sufficient: share of the predicted fall that a step has to bring (no unit).
    """

    memory: int = 20
    tolerance: float = 5e-4
    turn: float = 0.4
    halvings: int = 8
    shorter: float = 0.4
    least: float = 1e-3
    sufficient: float = 1e-4


@dataclass(frozen=True)
class Growth:
    """How modes come in, see ``grow_loadings``, and how the descent goes on in between.

    Attributes:
        modes, noise, draws: as for ``grow_loadings``.
        growths: steps of expectation-maximisation before a descent (count).
        steps: quasi-Newton steps of a descent (count).
    """

    modes: int
    noise: float
    draws: float
    growths: int
    steps: int


Direction = tuple[Tensor, Tensor, Tensor]


def residual_levels(coarse: float, fine: float, fall: float) -> list[float]:
    """Standard deviations of the residual from coarse to fine, both included, each about ``fall`` times the last.

    Example:
        >>> [round(level, 3) for level in residual_levels(0.1, 0.0125, 0.45)]
        [0.1, 0.05, 0.025, 0.013]
    """
    steps = max(1, round(math.log(fine / coarse) / math.log(fall)))
    return [*(coarse * (fine / coarse) ** (step / steps) for step in range(steps)), fine]


def inner(a: Direction, b: Direction) -> Tensor:
    """Inner product per item (b,)."""
    return sum(((x * y).flatten(1).sum(1) for x, y in zip(a, b, strict=True)), torch.zeros_like(a[0][:, 0, 0]))


def added(a: Direction, factor: Tensor, b: Direction) -> Direction:
    """``a + factor * b`` with one factor per item."""
    pose, mean, loadings = (x + factor.view(-1, *[1] * (x.ndim - 1)) * y for x, y in zip(a, b, strict=True))
    return pose, mean, loadings


def scaled(factor: Tensor, a: Direction) -> Direction:
    """``a`` with one factor per item."""
    pose, mean, loadings = (factor.view(-1, *[1] * (x.ndim - 1)) * x for x in a)
    return pose, mean, loadings


def _gradient(at: Evaluation) -> Direction:
    return at.pose, at.mean, at.loadings


def metric(model: ShapeModel, fisher: Tensor, residual: Tensor) -> Callable[[Direction], Direction]:
    """The inverse information of poses, mean and loadings, as a function on gradients."""
    frames, modes = model.scale.shape[-1], model.loadings.shape[-1]
    eye = torch.eye(4, dtype=fisher.dtype, device=fisher.device)
    size = fisher.diagonal(dim1=-2, dim2=-1).mean(-1)
    # A frame that shows nothing has no information of its own; only the common scale moves its pose, and little.
    most = size.amax(-1, keepdim=True)
    ridge = 1e-6 * size + torch.where(size < 1e-6 * most, most, torch.zeros_like(size))
    factor = torch.linalg.cholesky(fisher + ridge[..., None, None] * eye)
    flat = model.loadings.flatten(-3, -2)

    def spread(gradient: Tensor) -> Tensor:
        return flat @ (flat.mT @ gradient) + residual[:, None, None] * gradient

    def apply(gradient: Direction) -> Direction:
        pose, mean, loadings = gradient
        return (
            torch.cholesky_solve(pose[..., None], factor)[..., 0],
            spread(mean.flatten(-2)[..., None]).view_as(mean) / frames,
            (spread(loadings.flatten(-3, -2)) / (2 * frames)).view_as(loadings) if modes else loadings,
        )

    return apply


def descend(
    views: Views,
    model: ShapeModel,
    eps: float,
    steps: int,
    params: DescentParams,
    articulation: Articulation | None = None,
) -> tuple[ShapeModel, Tensor, bool]:
    """At most ``steps`` steps from a model with one leading batch dimension.

    Args:
        articulation: what rigid pairs add to the value, if anything.

    Returns:
        model; the value per item (b,); whether every item converged before the steps were spent.
    """

    def judged(model: ShapeModel) -> Evaluation:
        if articulation is None:
            return evaluate(views, model, eps)
        return evaluate_with(articulation, views, model, eps)

    frames = model.scale.shape[-1]
    residual = (views.noise.diagonal(dim1=-2, dim2=-1).mean((-1, -2, -3)) + eps**2).expand(len(model.scale))
    now = judged(model)
    pairs: list[tuple[Direction, Direction, Tensor]] = []
    done = torch.zeros_like(now.value, dtype=torch.bool)
    reach = torch.ones_like(now.value)
    for _ in range(steps):
        precondition = metric(model, now.pose_fisher, residual)
        q, kept = _gradient(now), []
        for step, change, weight in reversed(pairs):
            share = weight * inner(step, q)
            q = added(q, -share, change)
            kept.append(share)
        q = precondition(q)
        for (step, change, weight), share in zip(pairs, reversed(kept), strict=True):
            q = added(q, share - weight * inner(change, q), step)
        slope = -inner(q, _gradient(now))
        # A direction that does not descend starts the memory of its item anew.
        lost = slope >= 0
        if bool(lost.any()):
            share = lost.to(slope.dtype)
            q = added(scaled(1 - share, q), share, precondition(_gradient(now)))
            slope = -inner(q, _gradient(now))
            pairs = [(s, c, torch.where(lost, torch.zeros_like(w), w)) for s, c, w in pairs]
        turn = q[0][..., :3].norm(dim=-1).amax(-1)
        length = torch.where(done, torch.zeros_like(turn), torch.minimum(params.turn / turn.clamp_min(1e-300), reach))
        tried = length
        for _ in range(params.halvings):
            step = scaled(-length, q)
            trial = moved(model, *step)
            then = judged(trial)
            good = (then.value <= now.value + params.sufficient * length * slope) | (length == 0)
            if bool(good.all()):
                break
            length = torch.where(good, length, params.shorter * length)
        length = torch.where(good, length, torch.zeros_like(length))
        if not bool(good.all()):
            step = scaled(-length, q)
            trial = moved(model, *step)
            then = judged(trial)
        # A step as long as the last one that was accepted, longer where that was so at once.
        reach = torch.where(length == tried, length / params.shorter, length).clamp(params.least, 1.0)
        change = added(_gradient(then), -torch.ones_like(length), _gradient(now))
        curvature = inner(step, change)
        usable = curvature > 1e-10 * (length * slope).abs()
        weight = torch.where(usable, 1 / curvature.where(usable, torch.ones_like(curvature)), torch.zeros_like(turn))
        pairs = [*pairs, (step, change, weight)][-params.memory :]
        fell = now.value - then.value
        model, now = trial, then
        # Where the line search failed, the memory is to blame unless there was none.
        fresh = sum((w for _, _, w in pairs[:-1]), torch.zeros_like(turn)) == 0
        failed = (length == 0) & ~done
        pairs = [(s, c, torch.where(failed, torch.zeros_like(w), w)) for s, c, w in pairs]
        done = done | ((fell < params.tolerance * frames) & (~failed | fresh))
        if bool(done.all()):
            break
    return model, now.value, bool(done.all())
