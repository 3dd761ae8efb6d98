"""How far the points of the marginal solver may be off: the posterior at the optimum, its size checked by refits.

The posterior given the family of shapes is known in closed form. It leaves out that mean shape and modes were
estimated from the same tracks, that their errors and those of the poses go together, and that what smoothing leaves of
the noise lasts for several frames. Two kinds of refit have that in them, both from the answer on:
a parametric bootstrap (Efron 1979), in which noise is drawn again about the tracks that the answer predicts, and each
draw is smoothed and fitted; and fits to one half of the tracks (delete-half jackknife, Shao and Wu 1989), which show
what exact tracks leave open too: a likelihood as flat as that of bending bodies hardly tells the answer from its
neighbours, and deformation that the model lacks pulls the halves apart.
Both follow the likelihood alone, without the term for articulation: they show what the tracks leave open.
A few refits do not give a covariance per point, but they tell well by how much the closed form is too small: per axis
of the whitened errors, per frame and per point. No refit leaves the basin of the answer; the other basins that the
search has come upon say how far that may be off.
Deformation too weak to stand above the noise is in none of the refits. It is in the residual of the tracks: noise is
drawn anew in every frame, deformation is not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.linalg import interpolated, skew
from torchrecon.nrsfm.quasi_newton import DescentParams, descend
from torchrecon.nrsfm.shape_likelihood import Evaluation, ShapeModel, Views, evaluate

__all__ = ["SpreadParams", "between", "halved", "posterior_covariance", "refitted", "unmodelled", "widened"]


@dataclass(frozen=True)
class SpreadParams:
    """Parameters of the refits.

    Attributes:
        draws: of the noise; none leaves this kind of refit out (count).
        drawn: standard deviation of the noise over that of the residual below which none is drawn: it shows nothing
            that the closed form has not, and would dilute what halves show (no unit).
        steps: quasi-Newton steps of a refit to drawn noise (count).
        halves: fits to one half of the tracks; none leaves them out (count).
        half_steps: quasi-Newton steps of such a fit, whose way is longer: flat valleys (count).
        stretches: for which a sequence hides each point, or not, in turn (count).
        least: points of a frame below which it keeps all it has (count).
        window: half-width of the average over frames of a frame's factor (frames).
        temper: what another answer costs more where it counts by 1/e (nats a frame). Far more than one in all: by how
            much the likelihood of a family that is not quite true tells basins apart is not known from itself.
    """

    draws: int = 4
    drawn: float = 0.5
    steps: int = 15
    halves: int = 2
    half_steps: int = 40
    stretches: int = 6
    least: int = 8
    window: int = 4
    temper: float = 10.0


def posterior_covariance(
    views: Views, model: ShapeModel, answer: Evaluation, eps: float
) -> Float[Tensor, "frames points 3 3"]:
    """Of the points, camera axes: what weights, translation and poses leave, and the residual where it is not measured.

    The family of shapes is taken as known, and the weights do not follow the pose.

    Args:
        model, answer: batches of one, the answer with its ``spread``.
    """
    assert answer.spread is not None
    spread = answer.spread[0]
    variance = (eps * model.scale[0]).square()
    whitener = views.whitener(variance)
    gain = torch.nn.functional.pad(variance[:, None, None, None] * (whitener.mT @ whitener), (0, 1, 0, 1))
    eye = torch.eye(3, dtype=spread.dtype, device=spread.device)
    points, fisher = answer.points[0], answer.pose_fisher[0]
    size = fisher.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    ridge = 1e-6 * size + 1e-6 * size.amax()
    root = torch.linalg.cholesky(torch.linalg.inv(fisher + ridge * torch.eye(4, dtype=eye.dtype, device=eye.device)))
    moves = torch.cat([-skew(points), points[..., None]], -1) @ root[:, None]
    both = torch.cat([spread, (eye - gain) @ moves], -1)
    return both @ both.mT + variance[:, None, None, None] * (eye - gain)


def _errors(
    fitted: Views, shown: Views, model: ShapeModel, answer: Evaluation, eps: float, steps: int, descent: DescentParams
) -> Float[Tensor, "refits frames points 3"]:
    """How far fits to each of ``fitted``, begun at the model, move the points that they say of ``shown``; centred."""
    count = len(fitted.xy)
    parts = (getattr(model, part.name) for part in fields(ShapeModel))
    start = ShapeModel(*(part.expand(count, *[-1] * (part.ndim - 1)).clone() for part in parts))
    again, _, _ = descend(fitted, start, eps, steps, descent)
    away = evaluate(shown, again, eps).points - answer.points
    return away - away.mean(-2, keepdim=True)


@torch.no_grad()
def refitted(
    measured: Views,
    smooth: Callable[[Views, Tensor], Views],
    model: ShapeModel,
    answer: Evaluation,
    eps: float,
    generator: torch.Generator,
    params: SpreadParams,
    descent: DescentParams,
) -> Float[Tensor, "draws frames points 3"]:
    """Errors of refits to what the answer predicts with fresh noise; centred per frame, camera axes.

    Args:
        measured: views before they were smoothed.
        smooth: what was done to them before the fit; takes the views, and the tracks without gaps.
        model, answer: batches of one.
    """
    seen = measured.visible[..., None]
    predicted = answer.points[0][..., :2] + answer.translation[0][:, None]
    variance = measured.noise.diagonal(dim1=-2, dim2=-1)
    slope = measured.noise[..., 1, 0] / variance[..., 0].clamp_min(torch.finfo(variance.dtype).tiny)
    across = (variance[..., 1] - slope * measured.noise[..., 1, 0]).clamp_min(0).sqrt()
    drawn = []
    for _ in range(params.draws):
        white = torch.randn(predicted.shape, generator=generator, dtype=predicted.dtype).to(predicted.device)
        first = variance[..., 0].sqrt() * white[..., 0]
        noise = torch.stack([first, slope * first + across * white[..., 1]], -1)
        noisy = predicted + torch.where(seen, noise, noise.new_zeros(()))
        drawn.append(smooth(Views(noisy, measured.visible, measured.noise), noisy))
    views = Views(*(torch.stack([getattr(view, part.name) for view in drawn]) for part in fields(Views)))
    return _errors(views, views, model, answer, eps, params.steps, descent)


@torch.no_grad()
def halved(
    views: Views,
    model: ShapeModel,
    answer: Evaluation,
    eps: float,
    generator: torch.Generator,
    params: SpreadParams,
    descent: DescentParams,
) -> Float[Tensor, "halves frames points 3"]:
    """Errors of fits to one half of the tracks; centred per frame, camera axes.

    Every point is hidden in every other stretch of frames, from a random beginning; what the fit to the rest says of
    all tracks is compared with the answer. As much as an estimate moves with half of the data it is off with all.

    Args:
        views: as they were fitted.
        model, answer: batches of one.
    """
    frames, points = views.visible.shape
    length = max(1, frames // params.stretches)
    time = torch.arange(frames, device=views.xy.device)[:, None]
    begin = torch.randint(2 * length, (params.halves, 1, points), generator=generator).to(time.device)
    kept = views.visible & ((time + begin) // length % 2 == 0)
    kept = torch.where(kept.sum(-1, keepdim=True) < params.least, views.visible, kept)
    some = Views(views.xy.expand(params.halves, -1, -1, -1), kept, views.noise.expand(params.halves, -1, -1, -1, -1))
    return _errors(some, views, model, answer, eps, params.half_steps, descent)


def unmodelled(
    xy: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    predicted: Float[Tensor, "frames points 2"],
) -> Float[Tensor, ""]:
    """Variance per axis of the motion that the answer lacks: that of the part of the residual that lasts.

    The autocovariance of the residual at lag 0 without the noise, which has none at others, drawn out from lags 1 and 2
    on a straight line; zero where they leave nothing.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> noise = torch.randn(400, 30, 2, generator=g)
        >>> sway = 0.5 * torch.sin(torch.arange(400) / 9)[:, None, None].expand(400, 30, 2)
        >>> seen = torch.ones(400, 30, dtype=torch.bool)
        >>> still = torch.zeros_like(sway)
        >>> [round(float(unmodelled(noise + motion, seen, still)), 2) for motion in (still, sway)]
        [0.0, 0.13]
    """
    rest = torch.where(visible[..., None], xy - predicted, xy.new_zeros(()))

    def lagged(lag: int) -> Tensor:
        pairs = 2 * (visible[lag:] & visible[:-lag]).sum()
        return (rest[lag:] * rest[:-lag]).sum() / pairs.clamp_min(1)

    return (2 * lagged(1) - lagged(2)).clamp_min(0)


def between(
    points: Float[Tensor, "frames points 3"],
    rotations: Float[Tensor, "frames 3 3"],
    others: Sequence[tuple[Tensor, Tensor, float]],
    temper: float,
) -> Float[Tensor, "frames points 3 3"]:
    """Second moment about an answer of the others, each by what it costs more; in camera axes.

    Args:
        points, rotations: of the answer, camera axes.
        others: of each the points (chosen, points, 3), their frames (chosen,) and what it costs more (nats a frame).
        temper: as in the parameters.

    Example:
        >>> import torch
        >>> points = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(0))
        >>> away = torch.zeros(4, 5, 3)
        >>> away[:, 0, 2], away[:, 1, 2] = 1.0, -1.0
        >>> eye = torch.eye(3).expand(4, 3, 3)
        >>> moment = between(points, eye, [(points + away, torch.arange(4), 0.0)], 1.0)  # half the weight is its own
        >>> [round(value, 6) for value in moment[0, :, 2, 2].tolist()]
        [0.5, 0.5, 0.0, 0.0, 0.0]
    """
    moment = points.new_zeros(*points.shape, 3)
    total, flip = 1.0, points.new_tensor([1.0, 1.0, -1.0])
    for shown, frames, excess in others:
        weight = math.exp(-max(excess, 0.0) / temper)
        here, there = (part - part.mean(-2, keepdim=True) for part in (points[frames], shown))
        away = min(there - here, flip * there - here, key=torch.Tensor.norm)
        known = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        known[frames] = True
        # In the body's own axes, in which it changes more slowly than the view.
        body = torch.zeros_like(points).index_copy(0, frames, away @ rotations[frames])
        away = interpolated(body, known) @ rotations.mT
        moment = moment + weight * away[..., :, None] * away[..., None, :]
        total += weight
    return moment / total


def _average(values: Float[Tensor, "frames kinds"], half: int) -> Float[Tensor, "frames kinds"]:
    """Mean over up to ``2 half + 1`` neighbouring frames."""
    k = torch.arange(len(values), device=values.device)
    total = torch.cat([torch.zeros_like(values[:1]), values.cumsum(0)])
    low, high = (k - half).clamp_min(0), (k + half + 1).clamp_max(len(values))
    return (total[high] - total[low]) / (high - low)[:, None]


def widened(
    covariance: Float[Tensor, "frames points 3 3"], errors: Float[Tensor, "draws frames points 3"], window: int
) -> Float[Tensor, "frames points 3 3"]:
    """The covariance, made larger where the errors are larger than it says; never smaller.

    One 3 x 3 factor for the sequence, then one for the image plane and one for depth in every frame and at every
    point.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> level = torch.linspace(1, 3, 200, dtype=torch.float64)[:, None, None]
        >>> errors = 2 * level * torch.randn(6, 200, 30, 3, generator=g, dtype=torch.float64)
        >>> wide = widened(torch.eye(3, dtype=torch.float64).expand(200, 30, 3, 3), errors, 4)
        >>> round(float(wide[:20, :, 2, 2].mean())), round(float(wide[-20:, :, 2, 2].mean()))
        (5, 33)
    """
    # Exact tracks leave nothing open in the image; the ridge keeps the root of their covariance.
    ridge = 1e-9 * covariance.detach().diagonal(dim1=-2, dim2=-1).mean(-1) + torch.finfo(covariance.dtype).tiny ** 0.5
    root = torch.linalg.cholesky(covariance.detach() + torch.diag_embed(ridge[..., None].expand(*ridge.shape, 3)))
    white = torch.linalg.solve_triangular(root, errors[..., None], upper=False)[..., 0]
    common = torch.einsum("dfpi,dfpj->ij", white, white) / white[..., 0].numel()
    values, vectors = torch.linalg.eigh(common)
    common = vectors @ (values.clamp_min(1)[:, None] * vectors.mT)
    factor = root @ torch.linalg.cholesky(common)
    white = torch.linalg.solve_triangular(factor, errors[..., None], upper=False)[..., 0].square().mean(0)
    power = torch.stack([white[..., :2].mean(-1), white[..., 2]], -1)
    by_frame = _average(power.mean(1), window).clamp_min(torch.finfo(power.dtype).tiny)
    by_point = (power / by_frame[:, None]).mean(0)
    level = torch.stack([common.diagonal()[:2].mean(), common[2, 2]])
    scale = torch.maximum(by_frame[:, None] * by_point, 1 / level).sqrt()
    factor = scale[..., [0, 0, 1], None] * factor
    # The factors stay constants where the covariance is differentiated.
    change = factor @ torch.linalg.inv(root)
    return change @ covariance @ change.mT
