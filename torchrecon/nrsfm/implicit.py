"""Gradients through the marginal likelihood: the optimum as a function of what was measured.

An optimum moves with the data so that the gradient of the objective stays zero (implicit function theorem); nothing of
the search is unrolled. Products with the Hessian come from automatic differentiation of the value. The turns of the
canonical frame and of the modes among themselves, in which it is singular, stay out because no point depends on them.
The loadings follow the tangents of the mean shape here, so the optimum depends on the data alone and not on the way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from torchrecon._typing import Tensor
from torchrecon.nrsfm.articulation import Articulation
from torchrecon.nrsfm.quasi_newton import Direction, added, inner, metric, scaled
from torchrecon.nrsfm.shape_likelihood import ShapeModel, Views, evaluate, moved, tangents

__all__ = ["ImplicitParams", "attached", "settled"]


@dataclass(frozen=True)
class ImplicitParams:
    """Parameters of Newton's method and of the linear systems.

    Attributes:
        steps: Newton steps at most (count).
        decrement: fall of the value per frame that a step still promises at which the optimum is reached (nats).
        largest: of the changes in a step (radians, rms sizes).
        dense: numbers of unknowns up to which the Hessian is formed and factorised (count).
        null: eigenvalues of it below this share of the largest count as zero (no unit).
        iterations: conjugate gradient iterations per system at most (count).
        residual: squared residual of a system, relative, at which it is solved (no unit).
        halvings: line search trials per step (count).
    """

    steps: int = 30
    decrement: float = 1e-18
    largest: float = 0.3
    dense: int = 1200
    null: float = 1e-9
    iterations: int = 400
    residual: float = 1e-20
    halvings: int = 20


def _stepped(model: ShapeModel, step: Direction) -> ShapeModel:
    """The model after a step, with the loadings off the tangents of the new mean shape."""
    there = moved(model, *step)
    mean = there.mean - there.mean.mean(-2, keepdim=True)
    basis, flat = tangents(mean), there.loadings.flatten(-3, -2)
    kept = flat - basis @ torch.linalg.solve(basis.mT @ basis, basis.mT @ flat)
    return replace(there, mean=mean, loadings=kept.view_as(there.loadings))


def _nothing(model: ShapeModel) -> Direction:
    pose = model.scale[..., None].expand(*model.scale.shape, 4)
    return torch.zeros_like(pose), torch.zeros_like(model.mean), torch.zeros_like(model.loadings)


def _objective(views: Views, model: ShapeModel, eps: float, articulation: Articulation | None) -> Tensor:
    """What the search minimises, per item."""
    found = evaluate(views, model, eps)
    return found.value if articulation is None else found.value + articulation.cost(found.points)


class _Local:
    """The objective about a model: value, gradient, and products with the Hessian."""

    def __init__(self, views: Views, model: ShapeModel, eps: float, articulation: Articulation | None) -> None:
        with torch.enable_grad():
            pose, mean, loadings = _nothing(model)
            self.at: Direction = pose.requires_grad_(), mean.requires_grad_(), loadings.requires_grad_()
            self.value = _objective(views, _stepped(model, self.at), eps, articulation)
            pose, mean, loadings = torch.autograd.grad(self.value.sum(), self.at, create_graph=True)
            self.gradient: Direction = pose, mean, loadings

    def product(self, step: Direction) -> Direction:
        """The Hessian times a step."""
        pose, mean, loadings = torch.autograd.grad(self.gradient, self.at, step, retain_graph=True)
        return pose, mean, loadings


def _split(flat: Tensor, like: Direction) -> Direction:
    """(..., n) as a direction (..., *shape of an item)."""
    shapes = [x.shape[1:] for x in like]
    pose, mean, loadings = (
        part.unflatten(-1, shape)
        for part, shape in zip(flat.split([shape.numel() for shape in shapes], -1), shapes, strict=True)
    )
    return pose, mean, loadings


def _joined(direction: Direction) -> Tensor:
    return torch.cat([x.flatten(1) for x in direction], 1)


def _factorised(local: _Local, null: float) -> Callable[[Direction], Direction]:
    """The inverse of the Hessian with its eigenvalues made positive, off its null space."""
    count = _joined(local.at).shape[1]
    eye = torch.eye(count, dtype=local.value.dtype, device=local.value.device)
    # Items do not meet in the value, so one sweep over the unknowns serves them all.
    seeds = _split(eye[:, None].expand(count, len(local.value), count), local.at)
    rows = torch.autograd.grad(local.gradient, local.at, seeds, retain_graph=True, is_grads_batched=True)
    hessian = torch.cat([x.flatten(2) for x in rows], 2).transpose(0, 1)
    values, vectors = torch.linalg.eigh((hessian + hessian.mT) / 2)
    size = values.abs()
    inverse = torch.where(size > null * size.amax(-1, keepdim=True), 1 / size, torch.zeros_like(size))

    def solve(target: Direction) -> Direction:
        image = vectors @ (inverse[..., None] * (vectors.mT @ _joined(target)[..., None]))
        return _split(image[..., 0], local.at)

    return solve


def _solve(
    local: _Local,
    target: Direction,
    precondition: Callable[[Direction], Direction],
    params: ImplicitParams,
) -> Direction:
    """Hessian^-1 target by conjugate gradients, per item; where a direction has no curvature an item stops."""
    solution, rest = scaled(torch.zeros_like(target[0][:, 0, 0]), target), target
    z = precondition(rest)
    direction, size = z, inner(rest, z)
    first, busy = size, size > 0
    for _ in range(params.iterations):
        image = local.product(direction)
        curvature = inner(direction, image)
        busy = busy & (curvature > 0)
        if not bool(busy.any()):
            break
        length = torch.where(busy, size / curvature.where(busy, torch.ones_like(size)), torch.zeros_like(size))
        solution, rest = added(solution, length, direction), added(rest, -length, image)
        z = precondition(rest)
        last, size = size, inner(rest, z)
        busy = busy & (size > params.residual * first)
        direction = added(z, size / last.where(busy, torch.ones_like(last)), direction)
    # Where the first direction already had no curvature, it is taken as it is.
    stuck = (inner(solution, solution) == 0) & (first > 0)
    return added(solution, stuck.to(first.dtype), precondition(target))


def _inverse(
    local: _Local, views: Views, model: ShapeModel, eps: float, params: ImplicitParams
) -> Callable[[Direction], Direction]:
    """The inverse of the Hessian as a function: factorised where it is small, else by iteration."""
    if _joined(local.at).shape[1] <= params.dense:
        return _factorised(local, params.null)
    precondition = _preconditioner(views, model, eps)
    return lambda target: _solve(local, target, precondition, params)


def _preconditioner(views: Views, model: ShapeModel, eps: float) -> Callable[[Direction], Direction]:
    residual = views.noise.diagonal(dim1=-2, dim2=-1).mean((-1, -2, -3)) + eps**2
    return metric(model, evaluate(views, model, eps).pose_fisher, residual.expand(len(model.scale)))


def settled(
    views: Views,
    model: ShapeModel,
    eps: float,
    params: ImplicitParams | None = None,
    articulation: Articulation | None = None,
) -> ShapeModel:
    """The optimum near a model by Newton's method; ``model`` and the result have one leading batch dimension.

    With more unknowns than ``params.dense`` the model is returned as it is, and what :func:`attached` gives is the
    gradient where the search ended.
    """
    params = params or ImplicitParams()
    if _joined(_nothing(model)).shape[1] > params.dense:
        return model
    frames = model.scale.shape[-1]
    with torch.no_grad():
        model = _stepped(model, _nothing(model))
        for _ in range(params.steps):
            local = _Local(views, model, eps, articulation)
            pose, mean, loadings = local.gradient
            gradient = pose.detach(), mean.detach(), loadings.detach()
            step = _factorised(local, params.null)(gradient)
            promise = inner(step, gradient)
            largest = _joined(step).abs().amax(1)
            length = (params.largest / largest.clamp_min(params.largest)).to(promise)
            for _ in range(params.halvings):
                trial = _stepped(model, scaled(-length, step))
                # Where the promise is below the rounding of the value, a full step is right.
                good = (_objective(views, trial, eps, articulation) <= local.value) | (promise < 1e-9 * frames)
                if bool(good.all()):
                    break
                length = torch.where(good, length, 0.5 * length)
            model = trial
            if bool((promise < params.decrement * frames).all()):
                break
    return model


class _Follow(torch.autograd.Function):
    """Zero, which moves by minus the solution of a symmetric system when its right-hand side moves."""

    @staticmethod
    def forward(ctx: Any, solve: Callable[[Direction], Direction], *gradient: Tensor) -> tuple[Tensor, ...]:
        ctx.solve = solve
        return tuple(torch.zeros_like(part) for part in gradient)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor | None, ...]:
        return None, *(-part for part in ctx.solve(grad))


def attached(
    views: Views,
    model: ShapeModel,
    eps: float,
    params: ImplicitParams | None = None,
    articulation: Articulation | None = None,
) -> ShapeModel:
    """The same optimum with a graph that leads to the tensors of ``views``.

    Args:
        views: with the graph to what was measured.
        model: from :func:`settled` on the same views.
    """
    params = params or ImplicitParams()
    fixed = Views(views.xy.detach(), views.visible, views.noise.detach())
    local = _Local(views, model, eps, articulation)
    with torch.no_grad():
        solve = _inverse(local, fixed, model, eps, params)
    pose, mean, loadings = _Follow.apply(solve, *local.gradient)
    return _stepped(model, (pose, mean, loadings))
