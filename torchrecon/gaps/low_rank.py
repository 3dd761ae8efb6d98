"""Fillers that use the other points: windowed low-rank completion, and a low-rank model of the whole sequence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.gaps.base import Gaps, Guess
from torchrecon.gaps.rts import fill_rts
from torchrecon.linalg.missing_factors import FactorModel, fit_factors, grow_factors, start_factors

__all__ = ["LowRankParams", "factor_model", "fill_low_rank"]


@dataclass(frozen=True)
class LowRankParams:
    """Parameters of :func:`fill_low_rank`.

    Attributes:
        delay: frames that stand side by side in one row of the delay-embedded matrix.
        rank: of the delay-embedded matrix.
        window: frames that are completed together; gaps of more than a third of it go to the sequence model.
        iterations: of the completion, at most.
        tolerance: stop when no filled value moves further than this, pixels.
        missing: largest share of unseen entries in a window.
        disagree: distance between the answers from two starts that makes a value doubtful, pixels.
        bases: K of the sequence model, at most.
    """

    delay: int = 9
    rank: int = 14
    window: int = 120
    iterations: int = 60
    tolerance: float = 0.05
    missing: float = 0.35
    disagree: float = 5.0
    bases: int = 4


def fill_low_rank(gaps: Gaps, params: LowRankParams | None = None) -> Guess:
    """Values on which all points and frames agree that share a low-rank motion.

    Gaps that end: each row of the completed matrix holds ``delay`` successive frames of all points, so the filler
    knows about motion as well as about shape. The completion is started from monotone cubics, from the smoother and
    from the sequence model; the answer with the smallest residual beside the gap is kept, and values on which the
    starts disagree are doubtful. Everything else (before the first and after the last observation of a point, very
    long gaps, windows that are mostly empty, hundreds of points) comes from one probabilistic model of rank 3K for
    the whole sequence, and is always doubtful where a point has no observation on one side.
    """
    params = params or LowRankParams()
    smooth = fill_rts(gaps)
    model = factor_model(gaps, params.bases)
    if model is None:
        return smooth
    xy = torch.where(gaps.visible[..., None], gaps.xy, model.predict())
    spread = model.variance().diagonal(dim1=-2, dim2=-1).mean(-1)
    growth = spread + max(model.noise - float(gaps.variance.median()), 0.0)
    doubtful = ~gaps.inside | (spread > params.disagree**2)
    frames, points = gaps.visible.shape
    wanted = gaps.inside & (gaps.length <= params.window // 3)
    if frames < 2 * params.delay or points * min(frames, params.window) ** 2 > 1.5e6 or not wanted.any():
        return Guess(xy, growth, doubtful)
    starts = [torch.where(gaps.inside[..., None], other, xy) for other in (_cubic(gaps), smooth.xy)] + [xy]
    half = params.window // 2
    for first in range(0, max(frames - half, 1), half):
        window = slice(first, min(first + params.window, frames))
        visible = gaps.visible[window]
        # the ends of a window are served by its neighbours, except at the ends of the sequence
        core = torch.zeros_like(visible)
        low = 0 if first == 0 else half // 2
        high = len(visible) if window.stop == frames else half + half // 2
        core[low:high] = True
        target = wanted[window] & core
        if not target.any() or float((~visible).to(xy.dtype).mean()) > params.missing:
            continue
        answers = [_complete(gaps.xy[window], visible, start[window], params) for start in starts]
        best, residual2, apart2 = _agree(answers, gaps.xy[window], visible, target)
        xy[window] = torch.where(target[..., None], best, xy[window])
        depth = _depth(visible).to(xy.dtype)
        growth[window] = torch.where(target, residual2 * (1 + depth) + apart2 / 2, growth[window])
        doubtful[window] = torch.where(target, apart2 > params.disagree**2, doubtful[window])
    return Guess(xy, growth, doubtful)


def factor_model(gaps: Gaps, bases: int) -> FactorModel | None:
    """Probabilistic model of rank 3K of the whole sequence; None where there are too few points or frames."""
    frames, points = gaps.visible.shape
    numbers = 2 * int(gaps.visible.sum(0).to(torch.float64).median())
    most = min(bases, points // 5, (numbers - 1) // 3)
    if most < 1 or frames < 3:
        return None
    # a few hundred points say all there is to say about the motion; the others are then placed by it
    chosen = torch.linspace(0, points - 1, min(points, 400)).round().long().to(gaps.xy.device)
    xy, visible = gaps.xy[:, chosen], gaps.visible[:, chosen]
    model = start_factors(xy, visible)
    for _ in range(most):
        model = fit_factors(grow_factors(model, xy, visible, 3), xy, visible, 30, 1e-3)
    if len(chosen) < points:
        empty = gaps.xy.new_zeros(points, 3 * most)
        wide = FactorModel(model.rows, model.shift, empty, empty.new_zeros(points, 3 * most, 3 * most), model.noise)
        model = fit_factors(wide, gaps.xy, gaps.visible, 2)
    return model


def _cubic(gaps: Gaps) -> Float[Tensor, "frames points 2"]:
    """Monotone cubic interpolation of the gaps that end."""
    out = gaps.xy.clone()
    clock = np.concatenate([[0.0], np.cumsum(gaps.steps)])
    for point in gaps.inside.any(0).nonzero()[:, 0].tolist():
        seen, hole = gaps.visible[:, point].cpu().numpy(), gaps.inside[:, point]
        curve = PchipInterpolator(clock[seen], gaps.xy[gaps.visible[:, point], point].cpu().numpy(), axis=0)
        out[hole, point] = torch.as_tensor(curve(clock[hole.cpu().numpy()])).to(out)
    return out


def _complete(
    xy: Tensor, visible: Bool[Tensor, "frames points"], start: Tensor, params: LowRankParams
) -> Float[Tensor, "frames points 2"]:
    """Hard-impute: alternate the best rank-r approximation of the delay-embedded matrix with the measurements."""
    frames, points = visible.shape
    delay = min(params.delay, frames // 2)
    middle = start.mean((0, 1))
    known, filled = (xy - middle).flatten(1), (start - middle).flatten(1)
    seen = visible[..., None].expand(frames, points, 2).flatten(1)
    filled = torch.where(seen, known, filled)
    rows = frames - delay + 1
    count = _overlap(filled.new_ones(rows, delay), delay, frames)
    smooth = filled
    for _ in range(params.iterations):
        embedded = torch.cat([filled[k : k + rows] for k in range(delay)], 1)
        _, vectors = torch.linalg.eigh(embedded @ embedded.T)
        leading = vectors[:, -params.rank :]
        smooth = _overlap(leading @ (leading.T @ embedded), delay, frames) / count
        updated = torch.where(seen, known, smooth)
        moved = float((updated - filled).abs().max())
        filled = updated
        if moved < params.tolerance:
            break
    return smooth.view(frames, points, 2) + middle


def _overlap(embedded: Float[Tensor, "rows wide"], delay: int, frames: int) -> Float[Tensor, "frames cols"]:
    """Sum of the copies of each frame that the rows of a delay-embedded matrix hold."""
    total = embedded.new_zeros(frames, embedded.shape[1] // delay)
    for k, part in enumerate(embedded.chunk(delay, 1)):
        total[k : k + len(part)] += part
    return total


def _agree(
    answers: list[Tensor], xy: Tensor, visible: Tensor, target: Tensor
) -> tuple[Tensor, Float[Tensor, "frames points"], Float[Tensor, "frames points"]]:
    """For each point the answer with the smallest residual; that residual, and the squared distance of the others."""
    # the residual of a wrong fill shows in the whole frames of the gap, not only at the point that is missing
    stacked = torch.stack(answers)
    residual2 = torch.where(visible, ((stacked - xy) ** 2).sum(-1) / 2, 0.0)
    per_frame = residual2.sum(2) / visible.sum(1).clamp(min=1)
    frames_of = target.to(xy.dtype)
    score = per_frame @ frames_of / frames_of.sum(0).clamp(min=1)
    winner = score.argmin(0)
    column = torch.arange(xy.shape[1], device=xy.device)
    best = stacked[winner, :, column].transpose(0, 1)
    apart2 = ((stacked - best) ** 2).sum(-1).amax(0)
    return best, score[winner, column].expand(visible.shape), apart2


def _depth(visible: Bool[Tensor, "frames points"]) -> Tensor:
    """Frames to the nearest end of the gap; 0 where visible."""
    order = torch.arange(len(visible), device=visible.device)[:, None]
    before = torch.where(visible, order, -len(visible)).cummax(0).values
    after = torch.where(visible, order, 2 * len(visible)).flip(0).cummin(0).values.flip(0)
    return torch.minimum(order - before, after - order)
