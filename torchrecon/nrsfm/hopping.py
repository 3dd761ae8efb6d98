"""Search for a likelier basin, once parts that keep their distances can tell basins apart.

Low rank alone ends in one of many answers that explain the tracks about as well. With the term for articulation they
differ, but a descent at the last residual does not leave its basin: the residual and the width of the term have to
start wide and fall together. So the search is repeated from the best answer so far, as it is, made shallower or deeper
along the view, and with turns that are off by a little, and the likeliest is kept: basin hopping (Wales and Doye 1997),
with moves derived here. It goes over a part of the frames; the winner is then brought to all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import interpolated, nearest_rotation, rotation_angle, rotation_from_vector
from torchrecon.nrsfm.articulation import ArticulationParams, broken, find_partners
from torchrecon.nrsfm.base import turn_of_view
from torchrecon.nrsfm.quasi_newton import DescentParams, Growth, descend
from torchrecon.nrsfm.relief import made_deeper
from torchrecon.nrsfm.shape_likelihood import ShapeModel, Views, evaluate, grow_loadings

__all__ = ["Basin", "HoppingParams", "better_basin", "cost", "part_of"]


@dataclass(frozen=True)
class HoppingParams:
    """Parameters of the search; lengths are in units of the rms size of the tracks.

    Attributes:
        hops: moves that are tried at most (count).
        patience: moves in a row that bring nothing after which it ends (count).
        same: change of the points, relative to their extent, below which the first hop is back where it started: the
            basin of low rank is that of the term too, and nothing else is tried.
        view: turn of the view below which what was found is no answer: such a view tells no depth, and the deeper a
            body the less its distances change (degrees).
        frames: that it goes over at least, evenly spaced (count).
        turn: between two of these at most, but for every tenth (degrees).
        coarse: first standard deviation of the residual.
        resumed: the same where the winner is brought to all frames.
        levels: of the residual, geometric down to that of the answer (count).
        width: deviation of a rigid pair over that of the residual, as long as this is above its last value (no unit).
        last_rounds: of growth and descent on the last level; the others have one (count).
        factor: by which a move makes the body shallower or deeper (no unit).
        wobble: standard deviation of the turns that a move adds (radians).
        knots: frames between two of these turns, straight lines in between (count).
        deepest: depth over image size, both rms over points and frames, beyond which an answer is none: distances of
            an infinitely deep body are constant whatever is seen (no unit).
    """

    hops: int = 12
    patience: int = 4
    same: float = 0.05
    view: float = 45.0
    frames: int = 60
    turn: float = 30.0
    coarse: float = 0.1
    resumed: float = 0.03
    levels: int = 8
    width: float = 1.0
    last_rounds: int = 3
    factor: float = 1.4
    wobble: float = 0.15
    knots: int = 12
    deepest: float = 2.0


class Basin(NamedTuple):
    """An answer that a search has ended at.

    Attributes:
        model: a batch of one, of these frames alone.
        frames: (chosen,) indices in the sequence.
    """

    model: ShapeModel
    frames: Int[Tensor, " chosen"]


def _annealed(
    views: Views,
    model: ShapeModel,
    eps: float,
    coarse: float,
    growth: Growth,
    params: HoppingParams,
    articulation: ArticulationParams,
    descent: DescentParams,
) -> ShapeModel | None:
    """The model where residual and width of the term have fallen together; None where it became deeper than bodies."""
    fall = (eps / coarse) ** (1 / (params.levels - 1))
    for level in range(params.levels):
        residual = coarse * fall**level
        wide = replace(articulation, deviation=max(articulation.deviation, params.width * residual))
        for _ in range(params.last_rounds if level == params.levels - 1 else 1):
            if not _plausible(evaluate(views, model, residual).points[0], params):
                return None
            for _ in range(growth.growths):
                model = grow_loadings(views, model, residual, growth.modes, growth.noise, growth.draws)
            rigid = find_partners(evaluate(views, model, residual).points[0], views.variance, wide)
            model, _, _ = descend(views, model, residual, growth.steps, descent, rigid)
    return model


def _plausible(points: Float[Tensor, "frames points 3"], params: HoppingParams) -> bool:
    """Whether a body is no deeper than bodies are; false for numbers that are none."""
    return float(points[..., 2].norm()) <= params.deepest * float(points[..., :2].norm())


def cost(views: Views, model: ShapeModel, eps: float, width: float, articulation: ArticulationParams) -> float:
    """Likelihood and term at the last residual, nats a frame, the width being the same for all that are compared."""
    answer = evaluate(views, model, eps)
    rigid = find_partners(answer.points[0], views.variance, replace(articulation, deviation=width, loosest=width))
    assert rigid is not None
    return (float(answer.value) + float(rigid.cost(answer.points))) / model.scale.shape[-1]


def _shown(
    views: Views, model: ShapeModel | None, eps: float, params: HoppingParams, articulation: ArticulationParams
) -> float | None:
    """The width that the pairs of an answer show; None where it is none: too deep, or not articulated."""
    if model is None:
        return None
    points = evaluate(views, model, eps).points[0]
    if not _plausible(points, params) or broken(points, views.variance, articulation) > articulation.believed:
        return None
    rigid = find_partners(points, views.variance, articulation)
    return None if rigid is None else rigid.width


def _survey_frames(model: ShapeModel, params: HoppingParams) -> Int[Tensor, " chosen"]:
    """Evenly spaced frames, close enough for the turns of the model."""
    frames = model.scale.shape[-1]
    step = max(1, frames // params.frames)
    while step > 1:
        chosen = model.rotations[0, ::step]
        if float(rotation_angle(chosen[1:] @ chosen[:-1].mT).quantile(0.9)) <= torch.pi / 180 * params.turn:
            break
        step -= 1
    return torch.arange(0, frames, step, device=model.scale.device)


def part_of(views: Views, model: ShapeModel, index: Int[Tensor, " chosen"]) -> tuple[Views, ShapeModel]:
    """Some frames of observations and model."""
    scale = model.scale[:, index]
    scale = scale / scale.log().mean().exp()
    some = Views(views.xy[index], views.visible[index], views.noise[index])
    return some, replace(model, rotations=model.rotations[:, index], scale=scale)


def _whole(part: ShapeModel, index: Tensor, frames: int) -> ShapeModel:
    """A model of all frames from one of some: poses in between are interpolated."""
    there = torch.zeros(frames, dtype=torch.bool, device=index.device)
    there[index] = True

    def spread(values: Tensor) -> Tensor:
        return interpolated(values.new_zeros(frames, *values.shape[1:]).index_copy(0, index, values), there)[None]

    scale = spread(part.scale[0].log())
    return replace(part, rotations=nearest_rotation(spread(part.rotations[0])), scale=(scale - scale.mean()).exp())


def _change(views: Views, before: ShapeModel, after: ShapeModel, eps: float) -> float:
    """How far the points of a model are from those of another, relative to their extent."""
    first, second = evaluate(views, before, eps).points, evaluate(views, after, eps).points
    return float((second - first).norm() / first.norm())


def _wobbled(model: ShapeModel, params: HoppingParams, generator: torch.Generator) -> ShapeModel:
    """The model with smooth random turns added."""
    frames = model.scale.shape[-1]
    knots = torch.randn(1, 3, max(2, frames // params.knots), generator=generator, dtype=torch.float64)
    turns = torch.nn.functional.interpolate(knots, size=frames, mode="linear", align_corners=True)[0].mT
    return replace(model, rotations=rotation_from_vector(params.wobble * turns.to(model.scale)) @ model.rotations)


@torch.no_grad()
def better_basin(
    views: Views,
    model: ShapeModel,
    eps: float,
    growth: Growth,
    generator: torch.Generator,
    params: HoppingParams,
    articulation: ArticulationParams,
    descent: DescentParams,
) -> tuple[ShapeModel, list[Basin]]:
    """The likeliest of the model and what hops from it lead to; likelihood and term for articulation together.

    The first hop, from the model as it is, ends the search where it comes back to it, and where it shows no parts that
    keep their distances. The model itself where the view of what was found hardly turns. Second, all articulated
    answers that hops have ended at.

    Args:
        model: a batch of one, with modes.
        eps: standard deviation of its residual.
    """
    index = _survey_frames(model, params)
    some, best = part_of(views, model, index)
    moves = (
        lambda start: start,
        lambda start: made_deeper(start, 1 / params.factor),
        lambda start: made_deeper(start, params.factor),
        lambda start: _wobbled(start, params, generator),
    )
    basins: list[Basin] = []
    width, vain = articulation.loosest, 0
    for hop in range(params.hops):
        found = _annealed(
            some, moves[hop % len(moves)](best), eps, params.coarse, growth, params, articulation, descent
        )
        shown = _shown(some, found, eps, params, articulation)
        if found is None or shown is None:
            if hop == 0:
                return model, basins
            vain += 1
        else:
            basins.append(Basin(found, index))
            # Costs compare at one width only: the tightest that an answer has shown.
            width = min(width, shown)
            gain = cost(some, best, eps, width, articulation) - cost(some, found, eps, width, articulation)
            if hop == 0 and _change(some, best, found, eps) < params.same:
                best = found
                break
            if hop == 0 or gain > 0:
                best = found
            vain = 0 if gain > 0 else vain + 1
        if vain == params.patience:
            break
    if float(turn_of_view(best.rotations[0])) < params.view:
        return model, basins
    whole = _annealed(
        views,
        _whole(best, index, model.scale.shape[-1]),
        eps,
        params.resumed,
        growth,
        params,
        articulation,
        descent,
    )
    if whole is None or _shown(views, whole, eps, params, articulation) is None:
        return model, basins
    before = cost(views, model, eps, width, articulation)
    return whole if cost(views, whole, eps, width, articulation) < before else model, basins
