"""Low-rank shapes by marginal likelihood: poses, mean shape and loadings, everything else integrated out.

Starts come from metric upgrades with several numbers of bases. From each, the residual of the model falls from coarse
to fine; at every level one step of expectation-maximisation lets new modes in where the tracks ask for them, and a
preconditioned quasi-Newton descent follows the likelihood. The likeliest start is carried through. Where its parts do
not keep their distances, the residual falls once more from a coarser one, which ends elsewhere; the better of both is
kept, at once or, where they are close, after the search for articulated parts. No K is needed: the rank that is
reported decides only whether the first mode has to prove itself against the noise (K = 1). Complete and incomplete
tracks, with or without covariance, one objective.
The model is in ``shape_likelihood``; the search is derived here.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg.noise_edge import difference_noise, marchenko_pastur_tail
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.articulation import Articulation, ArticulationParams, broken, find_partners
from torchrecon.nrsfm.base import check_size, solve_items, turn_of_view
from torchrecon.nrsfm.bridging import bridging
from torchrecon.nrsfm.common import conclude, filled
from torchrecon.nrsfm.gram import gram_upgrade
from torchrecon.nrsfm.hopping import Basin, HoppingParams, better_basin, cost, part_of
from torchrecon.nrsfm.implicit import attached, settled
from torchrecon.nrsfm.observations import Observations, observe
from torchrecon.nrsfm.quasi_newton import DescentParams, Growth, descend, residual_levels
from torchrecon.nrsfm.relief import ReliefParams, other_depth
from torchrecon.nrsfm.shape_likelihood import (
    Evaluation,
    ShapeModel,
    Views,
    cost_of_modes,
    evaluate,
    grow_loadings,
    tangents,
)
from torchrecon.nrsfm.smoothing import SmoothingParams, smoothed
from torchrecon.nrsfm.spread import (
    SpreadParams,
    between,
    halved,
    posterior_covariance,
    refitted,
    unmodelled,
    widened,
)
from torchrecon.nrsfm.upgrade import UpgradeParams, upgraded_rotations

__all__ = ["MarginalParams", "marginal", "solve_marginal"]


@dataclass(frozen=True)
class MarginalParams:
    """Parameters of the solver; lengths are in units of the rms size of the tracks.

    Attributes:
        upgrade: of the metric upgrade, which supplies the starts.
        descent: of the quasi-Newton descent.
        smoothing: of noisy tracks over time, before anything else.
        spread: of the refits that tell how far the points may be off.
        articulation: of the pairs of points that keep their distance.
        hopping: of the search for a basin in which more of them do.
        relief: of the search for a shape of other depth that explains the tracks as well.
        coarse: first standard deviation of the residual; of the next search where the answer of the last one breaks
            its pairs.
        apart: what one answer has to cost more than another not to be followed (nats a frame).
        trial: residual at which the likeliest start is kept.
        fine: last residual.
        finest: how far below ``fine`` the residual of exact tracks goes on falling while no new mode appears.
        fall: of the residual from level to level, about (no unit).
        starts: starts from the metric upgrade, lowest residual first (count).
        gram_bases: numbers of bases for which the upgrade of least trace supplies one more start (count).
        steps: quasi-Newton steps of a round (count).
        rigid_steps: quasi-Newton steps of the fits of a rigid body (count).
        growths: steps of expectation-maximisation before them (count).
        last_rounds: rounds of growth and descent on the fine level; the others have one (count).
        settled: fall of the value per frame over a round at which the fine level has converged (nats).
        modes: deformation modes at most (count).
        fill_rank: rank of the completion from which incomplete tracks take their starts.
        noise_share: share of the spectrum from whose small end the noise is read where no covariance is given.
        noise_agrees: factor on that variance up to which what third differences say is believed instead (no unit).
    """

    upgrade: UpgradeParams = field(default_factory=UpgradeParams)
    descent: DescentParams = field(default_factory=DescentParams)
    smoothing: SmoothingParams = field(default_factory=SmoothingParams)
    spread: SpreadParams = field(default_factory=SpreadParams)
    articulation: ArticulationParams = field(default_factory=ArticulationParams)
    hopping: HoppingParams = field(default_factory=HoppingParams)
    relief: ReliefParams = field(default_factory=ReliefParams)
    coarse: tuple[float, ...] = (0.1, 0.3)
    apart: float = 3.0
    trial: float = 0.07
    fine: float = 0.003
    finest: float = 0.0001
    fall: float = 0.6
    starts: int = 1
    gram_bases: tuple[int, ...] = (2, 3)
    steps: int = 15
    rigid_steps: int = 60
    growths: int = 2
    last_rounds: int = 8
    settled: float = 0.05
    modes: int = 40
    fill_rank: int = 9
    noise_share: float = 0.25
    noise_agrees: float = 2.25


_Answer = tuple[ShapeModel, float, bool]
"""A model, a batch of one; deviation of its residual; whether the last descent to it converged."""


def _noise_variance(data: Observations, complete: Float[Tensor, "frames points 2"], params: MarginalParams) -> float:
    """Noise variance of the entries, read off the smallest eigenvalues by the Marchenko-Pastur law, or off time.

    Small deformations of a noise-free body fill the middle of the spectrum, so its end is read and no rank is needed.
    That end is off where entries are missing: completed ones bring the error of their model or no noise at all. Third
    differences are exact at any share of gaps, but only for smooth tracks: they are taken where they agree.
    """
    stack = (complete - complete.mean(1, keepdim=True)).mT.flatten(0, 1)
    n, d = max(stack.shape), min(stack.shape[0], stack.shape[1] - 1)
    eigenvalues = torch.linalg.svdvals(stack)[:d].square() / n
    count = max(1, int(params.noise_share * d))
    spectral = float(eigenvalues[-count:].mean()) / marchenko_pastur_tail(d / n, params.noise_share)
    temporal = float(difference_noise(data.xy.detach(), data.visible))
    return temporal if temporal < params.noise_agrees * spectral else spectral


def _views(data: Observations, complete: Tensor, params: MarginalParams) -> Views:
    """Observations with their covariance, or one common variance read off the tracks."""
    eye = torch.eye(2, dtype=data.xy.dtype, device=data.xy.device)
    if data.noise_known:
        information = data.weight.mT @ data.weight
        noise = torch.linalg.inv(torch.where(data.visible[..., None, None], information, eye))
    else:
        noise = _noise_variance(data, complete.detach(), params) * eye.expand(*data.xy.shape, 2)
    return Views(data.xy, data.visible, noise)


def _rigid_model(xy: Tensor, rotations: Tensor) -> ShapeModel:
    """The rigid shape that fits filled views best, one per candidate (candidates, frames, 3, 3)."""
    rows = rotations[:, :, :2].flatten(1, 2)
    stack = (xy - xy.mean(1, keepdim=True)).mT.flatten(0, 1)
    mean = (torch.linalg.pinv(rows.mT @ rows) @ (rows.mT @ stack)).mT
    return ShapeModel(
        rotations,
        torch.ones_like(rotations[..., 0, 0]),
        mean,
        mean.new_zeros(*mean.shape, 0),
        torch.linalg.qr(tangents(mean))[0],
    )


def solve_marginal(
    item: Tracks, rank: int, generator: torch.Generator, params: MarginalParams | None = None
) -> Reconstruction:
    """Solve one sequence; computed in float64, returned in the type of the tracks.

    Where the tracks ask for gradients, the descent goes on to the optimum by Newton's method and the answer is
    differentiated there (see ``implicit``); completion of gaps and a noise level that was not given are held.
    """
    params = params or MarginalParams()
    dtype = item.xy.dtype
    data = observe(item.to(dtype=torch.float64))
    with torch.no_grad():
        small = check_size(item, 1) or _shapeless(data)
        if small is not None:
            return _flat(data, rank, small).to(dtype=dtype)
    complete, centre = filled(data, params.fill_rank)
    measured = _views(data, complete, params)
    views = smoothed(measured, complete, params.smoothing)
    asked = torch.is_grad_enabled() and (views.xy.requires_grad or views.noise.requires_grad)
    with torch.no_grad():
        fixed = Views(views.xy.detach(), views.visible, views.noise.detach())
        # Tracks that show more than one basis have modes: only a body that may be rigid has to prove them.
        draws = 1.0 if views is measured or rank > 1 else float(fixed.noise.mean() / measured.noise.mean())
        answers, starts = _found(fixed, draws, (complete - centre[:, None]).detach(), generator, params)
        growth = Growth(params.modes, _told_noise(fixed, params), draws, params.growths, params.steps)
        tried = [_articulated(fixed, answer, growth, generator, params) for answer in answers]
        best = min(range(len(tried)), key=lambda i: _cost(fixed, tried[i][0][0], params)) if len(tried) > 1 else 0
        model, eps, rigid = tried[best][0]
        first, _, converged = answers[best]
        every = torch.arange(len(fixed.xy), device=fixed.xy.device)
        basins = [basin for _, hopped in tried for basin in hopped]
        basins += [Basin(other[0], every) for i, (other, _) in enumerate(tried) if i != best]
        if asked:
            model = settled(fixed, model, eps, articulation=rigid)
    if asked:
        model = attached(views, model, eps, articulation=rigid)
    answer = evaluate(views, model, eps, with_spread=True)
    assert answer.spread is not None
    covariance = _covariance(measured, views, model, answer, eps, basins, generator, params)
    doubt = None
    turn = float(turn_of_view(model.rotations[0].detach()))
    if turn < params.relief.turn:
        value = min(float(answer.value), float(evaluate(fixed, first, eps).value))
        other = other_depth(fixed, model, answer, value, eps, growth, params.relief, params.descent)
        if other is not None:
            away = (other - answer.points[0]).detach()
            covariance = covariance + away[..., :, None] * away[..., None, :]
            doubt = (
                f"shapes of other depth explain views that turn by {turn:.0f} degrees as well; depth is not determined"
            )
    complaint = None if converged else "the likelihood still rose when the rounds of growth and descent were over"
    # What makes the body larger in one frame, the camera or the shape, is not told apart: ``points3d`` is in
    # pixels of the tracks in every frame.
    answered = conclude(
        data,
        answer.points[0],
        model.rotations[0],
        torch.ones_like(model.scale[0]),
        answer.translation[0],
        rank=rank,
        doubt=doubt,
        complaint=complaint,
        summary=f"likeliest of {starts} starts, {model.loadings.shape[-1]} modes",
        covariance3d=covariance,
    )
    return answered.to(dtype=dtype)


def _articulated(
    views: Views, answer: _Answer, growth: Growth, generator: torch.Generator, params: MarginalParams
) -> tuple[tuple[ShapeModel, float, Articulation | None], list[Basin]]:
    """The answer, its residual and the pairs that keep their distance; as it was where there are none.

    An exact family, whose residual went on falling, is left where it is unless it breaks its pairs, and even then where
    its modes are few: that tracks agree with few modes so closely is no accident. What is found instead has to explain
    the tracks as closely.

    Second, the other answers that the search has come upon, the first one among them where it was left.
    """
    model, eps, _ = answer
    if not model.loadings.shape[-1]:
        return (model, eps, None), []
    articulation = params.articulation

    def share(model: ShapeModel, eps: float) -> float:
        return broken(evaluate(views, model, eps).points[0], views.variance, articulation)

    before = share(model, eps)
    believed = max(articulation.believed, articulation.fallen * before)
    found, basins = model, list[Basin]()
    if eps >= params.fine or before > articulation.believed:
        if _simple(model, eps, params):
            return (model, eps, None), []
        level, pairs = max(eps, params.fine), replace(articulation, believed=believed)
        found, basins = better_basin(views, model, level, growth, generator, params.hopping, pairs, params.descent)
    rigid = find_partners(evaluate(views, found, eps).points[0], views.variance, articulation)
    if rigid is None:
        return (model, eps, None), []
    found, _, _ = descend(views, found, eps, articulation.steps, params.descent, rigid)
    kept = share(found, eps) <= believed and cost(views, found, eps, rigid.width, articulation) < cost(
        views, model, eps, rigid.width, articulation
    )
    if not kept:
        return (model, eps, None), basins
    every = torch.arange(model.scale.shape[-1], device=model.scale.device)
    return (found, eps, rigid), [*basins, Basin(model, every)]


def _covariance(
    measured: Views,
    views: Views,
    model: ShapeModel,
    answer: Evaluation,
    eps: float,
    basins: list[Basin],
    generator: torch.Generator,
    params: MarginalParams,
) -> Float[Tensor, "frames points 3 3"]:
    """Of the points: the posterior, its size by refits, deformation that hides in the noise, and other answers.

    Args:
        measured, views: the observations, and what was fitted: smoothed.
        answer: of the model, with its ``spread``.
        basins: other answers.
    """
    spread, fixed = params.spread, Views(views.xy.detach(), views.visible, views.noise.detach())
    covariance = posterior_covariance(views, model, answer, eps)
    errors = []
    if spread.draws and float(measured.noise.detach().mean()) > (spread.drawn * eps) ** 2:
        smooth = partial(smoothed, params=params.smoothing)
        errors += [refitted(measured, smooth, model, answer, eps, generator, spread, params.descent)]
    if spread.halves:
        errors += [halved(fixed, model, answer, eps, generator, spread, params.descent)]
    if errors:
        covariance = widened(covariance, torch.cat(errors), spread.window)
    points, rotations = answer.points[0].detach(), model.rotations[0].detach()
    predicted = points[..., :2] + answer.translation[0].detach()[:, None]
    lacking = unmodelled(measured.xy.detach(), measured.visible, predicted)
    others = []
    with torch.no_grad():
        for other, frames in basins:
            some, part = part_of(fixed, model, frames)
            excess = _cost(some, other, params) - _cost(some, part, params)
            others.append((evaluate(some, other, max(eps, params.fine)).points[0], frames, excess))
    eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    return covariance + lacking * eye + between(points, rotations, others, spread.temper)


def _cost(views: Views, model: ShapeModel, params: MarginalParams) -> float:
    """What answers are compared by: likelihood and term for articulation at the fine residual, nats a frame."""
    return cost(views, model, params.fine, params.articulation.judged, params.articulation)


def _simple(model: ShapeModel, eps: float, params: MarginalParams) -> bool:
    """A body that does not bend, or an exact family of few modes: that tracks agree with either is no accident."""
    modes = model.loadings.shape[-1]
    return not modes or (eps < params.fine and 3 * modes <= model.mean.shape[-2])


def _told_noise(views: Views, params: MarginalParams) -> float:
    """Variance of the observations that a mode has to be told from; below the last residual it is a part of that."""
    noise = views.variance
    return noise if noise > params.fine**2 else 0.0


def _found(
    views: Views, draws: float, complete: Tensor, generator: torch.Generator, params: MarginalParams
) -> tuple[list[_Answer], int]:
    """The answers of all searches between which low rank cannot choose, best first, and the number of starts.

    One search is enough where its body is simple, keeps its distances or has none to keep.

    Args:
        draws: share of the observations that are independent of one another.
        complete: (frames, points, 2) centred tracks without gaps, for the starts.
    """
    stack = complete.mT.flatten(0, 1)
    found = sorted(upgraded_rotations(stack, params.upgrade, generator), key=lambda start: start[0])
    starts = [start[2] for start in found[: params.starts]]
    starts += [gram_upgrade(stack, 3 * bases, scaled=False).rotations for bases in params.gram_bases]
    starts += [gram_upgrade(stack, 3, scaled=True).rotations]
    rotations, pairs = torch.stack(starts), params.articulation
    answers: list[_Answer] = []
    for coarse in params.coarse:
        model, eps, converged = _search(views, draws, _rigid_model(complete, rotations), coarse, params)
        points = evaluate(views, model, eps).points[0]
        if _simple(model, eps, params) or find_partners(points, views.variance, pairs) is None:
            return [(model, eps, converged)], len(rotations) * (len(answers) + 1)
        answers.append((model, eps, converged))
        if broken(points, views.variance, pairs) <= pairs.believed:
            break
    costs = [_cost(views, model, params) for model, _, _ in answers]
    order = sorted(range(len(answers)), key=costs.__getitem__)
    close = [answers[i] for i in order if costs[i] <= costs[order[0]] + params.apart]
    return close, len(rotations) * len(answers)


def _search(views: Views, draws: float, rigid: ShapeModel, coarse: float, params: MarginalParams) -> _Answer:
    """The likeliest model: from the coarse residual to the fine one, from several starts until one is the likeliest.

    Args:
        draws: as for :func:`_found`.
        rigid: the starts, one a batch item.
        coarse: first residual.
    """
    noise, frames = _told_noise(views, params), rigid.scale.shape[-1]
    finer = residual_levels(params.fine, params.finest, params.fall)[1:]
    model, eps, grown = rigid, coarse, True
    value = torch.full_like(model.scale[:, 0], torch.inf)
    for residual in residual_levels(coarse, params.fine, params.fall) + finer:
        # Beyond the fine level only a family that has found all its modes is followed: it is exact, or nearly. Noise
        # that hides further modes is no such sign.
        if residual < params.fine and (noise > 0 or grown):
            break
        eps, modes = residual, model.loadings.shape[-1]
        # What the loadings avoid follows the mean shape only in a growth, so the fine level grows again and again.
        for turn in range(params.last_rounds if eps == params.fine else 1):
            for _ in range(params.growths):
                model = grow_loadings(views, model, eps, params.modes, noise, draws)
            last = value
            model, value, converged = descend(views, model, eps, params.steps, params.descent)
            if turn and float((last - value).amax()) < params.settled * frames:
                converged = True
                break
        grown = model.loadings.shape[-1] > modes
        if len(value) > 1 and eps <= params.trial:
            model = model.pick(int(value.argmin()))
    # Modes that come in before the views are right can stand for a turn: a body that does not bend is tried as well.
    stiff, worth = rigid, cost_of_modes(views, model)
    for residual in (coarse, eps):
        stiff, stiff_value, ended = descend(views, stiff, residual, params.rigid_steps, params.descent)
        if float(stiff_value.min()) >= float(evaluate(views, model, residual).value) + worth:
            return model, eps, converged
    return stiff.pick(int(stiff_value.argmin())), eps, ended


def _shapeless(data: Observations) -> Status | None:
    """A status where all seen points of every frame lie in one place."""
    count = data.visible.sum(1).clamp_min(1)[:, None]
    rest = torch.where(data.visible[..., None], data.xy - (data.xy.sum(1) / count)[:, None], data.xy.new_zeros(()))
    if float(rest.abs().max()) > 1e-9:
        return None
    return Status("degenerate", "in every frame all points that are seen lie in one place; there is no shape to find")


def _flat(data: Observations, rank: int, status: Status) -> Reconstruction:
    """What can be said where a solve cannot begin: the points as they are seen, without depth."""
    xy = data.held()
    translation = xy.mean(1)
    points3d = torch.cat([xy - translation[:, None], torch.zeros_like(xy[..., :1])], -1)
    eye = torch.eye(3, dtype=xy.dtype, device=xy.device).expand(len(xy), 3, 3)
    return data.reconstruction(points3d, eye, torch.ones_like(xy[:, 0, 0]), translation, rank=rank, status=status)


def marginal(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Marginal likelihood of low-rank shapes under scaled orthographic views; any leading batch.

    Args:
        tracks: seen entries only are read; a covariance is used where there is one.
        rank: what the result reports; with one basis the first mode has to stand above what noise does to a rigid body.
        generator: starts of the metric upgrade.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(12, 3, generator=g)
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.1]))
        >>> marginal(Tracks((shape @ turn.mT)[..., :2]), 1).points3d.shape
        torch.Size([15, 12, 3])
    """
    return solve_items(tracks, rank, bridging(solve_marginal), generator)
