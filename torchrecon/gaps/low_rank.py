"""Fillers that use the other points: windowed low-rank completion, and a low-rank model of the whole sequence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.gaps.base import Gaps, Guess, whole_gaps
from torchrecon.gaps.rts import fill_rts
from torchrecon.linalg.missing_factors import FactorModel, fit_factors, grow_factors, start_factors

__all__ = ["LowRankParams", "factor_model", "fill_low_rank"]


@dataclass(frozen=True)
class LowRankParams:
    """Parameters of :func:`fill_low_rank`.

    Attributes:
        delay: frames that stand side by side in one row of the delay-embedded matrix.
        ranks: of the delay-embedded matrix, one after the other; see :func:`fill_low_rank`.
        window: frames that are completed together.
        iterations: of the completion at each rank, at most.
        tolerance: stop when no filled value moves further than this, pixels.
        missing: largest share of unseen entries in a window.
        disagree: distance between two fillers, or error on the gaps cut for a test, from which on a gap is doubtful,
            pixels.
        bases: K of the sequence model, at most.
        decoys: gaps that are cut beside each real one to choose a filler (count).
        tested: share of a point's observations that such gaps may take.
    """

    delay: int = 9
    ranks: tuple[int, ...] = (3, 5, 7, 9, 11, 14)
    window: int = 120
    iterations: int = 15
    tolerance: float = 0.02
    missing: float = 0.35
    disagree: float = 2.5
    bases: int = 4
    decoys: int = 12
    tested: float = 0.1


# gaps are judged together with gaps of similar length, frames
_CLASSES = ((1, 4), (5, 15), (16, 10**9))


def fill_low_rank(gaps: Gaps, params: LowRankParams | None = None, choose: bool = True) -> Guess:
    """Values on which all points and frames agree that share a low-rank motion.

    Gaps that end have three candidates: completion of a delay-embedded matrix, whose rows hold ``delay`` successive
    frames of all points so that it knows about motion as well as about shape; one probabilistic model of rank 3K for
    the whole sequence; and the smoother. How far to trust them is measured on the sequence itself: gaps of the same
    length are cut into the same points beside the real ones. For each class of lengths the candidate, or the mean of
    two, that predicts those best is taken, with its mean squared error as the variance; without ``choose`` it is the
    completion (where the size allows it). A gap is doubtful as a whole where another candidate disagrees anywhere in
    it: where the fillers cross they agree by chance. The completion raises the rank step by step, because a high rank
    from the start can reproduce any first guess.

    Everything before the first and after the last observation of a point comes from the sequence model and is always
    doubtful.
    """
    params = params or LowRankParams()
    model = factor_model(gaps, params.bases)
    if model is None:
        return fill_rts(gaps)
    spread = model.variance().diagonal(dim1=-2, dim2=-1).mean(-1)
    xy = torch.where(gaps.visible[..., None], gaps.xy, model.predict())
    growth = spread + max(model.noise - float(gaps.variance.median()), 0.0)
    doubtful = ~gaps.visible.clone()
    if not gaps.inside.any():
        return Guess(xy, growth, doubtful)
    candidates = _candidates(gaps, model, params)
    single = len(candidates)
    candidates = _with_means(candidates)
    decoys, length = _decoys(gaps, params)
    errors2 = None
    if decoys.any():
        trial = replace(gaps, visible=gaps.visible & ~decoys, inside=gaps.inside | decoys)
        again = factor_model(trial, params.bases)
        if again is not None:
            errors2 = ((_with_means(_candidates(trial, again, params)) - gaps.xy) ** 2).sum(-1) / 2
    depth = 1 + _depth(gaps.visible).to(xy.dtype)
    for low, high in _CLASSES:
        target = gaps.inside & (gaps.length >= low) & (gaps.length <= high)
        tested = decoys & (length >= low) & (length <= high)
        # without a test the last candidate (completion, where it was possible) is taken and flagged
        winner, error2 = single - 1, float(spread[target].mean()) if target.any() else 0.0
        if errors2 is not None and tested.any():
            winner = int(errors2[:, tested].mean(1).argmin()) if choose else winner
            error2 = float(errors2[winner, tested].mean())
        apart2 = ((candidates[:single] - candidates[winner]) ** 2).sum(-1).sort(0).values[int(winner < single)]
        unsure = whole_gaps(apart2 > params.disagree**2, gaps.visible)
        unsure |= (error2 > params.disagree**2) | (not tested.any())
        xy = torch.where(target[..., None], candidates[winner], xy)
        profile = depth / depth[target].mean() if target.any() else depth
        growth = torch.where(target, error2 * profile, growth)
        doubtful = torch.where(target, unsure, doubtful)
    return Guess(xy, growth, doubtful)


def _candidates(gaps: Gaps, model: FactorModel, params: LowRankParams) -> Float[Tensor, "n frames points 2"]:
    """What smoother, sequence model and (where the size allows it) completion say about every entry."""
    smooth, predicted = fill_rts(gaps).xy, model.predict()
    frames, points = gaps.visible.shape
    if frames < 2 * params.delay or points * min(frames, params.window) ** 2 > 1.5e6:
        return torch.stack([smooth, predicted])
    start = torch.where(gaps.inside[..., None], smooth, predicted)
    completed, half = predicted.clone(), params.window // 2
    for first in range(0, max(frames - half, 1), half):
        window = slice(first, min(first + params.window, frames))
        visible = gaps.visible[window]
        if float((~visible).to(start.dtype).mean()) > params.missing:
            continue
        # the ends of a window are served by its neighbours, except at the ends of the sequence
        low = 0 if first == 0 else half // 2
        high = len(visible) if window.stop == frames else half + half // 2
        answer = _complete(gaps.xy[window], visible, start[window], params)
        completed[first + low : first + high] = answer[low:high]
    return torch.stack([smooth, predicted, completed])


def _with_means(candidates: Float[Tensor, "n frames points 2"]) -> Float[Tensor, "m frames points 2"]:
    """The candidates, and the mean of each two: their errors have little to do with each other."""
    pairs = [(candidates[a] + candidates[b]) / 2 for a in range(len(candidates)) for b in range(a)]
    return torch.cat([candidates, torch.stack(pairs)])


def _decoys(gaps: Gaps, params: LowRankParams) -> tuple[Bool[Tensor, "frames points"], Int[Tensor, "frames points"]]:
    """Gaps of the same lengths in the same points, as near to the real ones as there are observations for them."""
    frames = len(gaps.visible)
    seen, length = gaps.visible.cpu().numpy(), gaps.length.cpu().numpy()
    decoys, sizes = np.zeros_like(seen), np.zeros_like(length)
    first = gaps.inside & ~torch.nn.functional.pad(gaps.inside, (0, 0, 1, 0))[:-1]
    for start, point in first.nonzero().tolist():
        size, made = int(length[start, point]), 0
        room = params.tested * int(seen[:, point].sum())
        for shift in [s for k in range(size + 3, frames) for s in (-k, k)]:
            low, high = start + shift, start + shift + size
            if low < 2 or high > frames - 2 or not seen[low - 2 : high + 2, point].all():
                continue
            # one is always made; a point keeps most of what was seen of it
            if made and (made == params.decoys or int(decoys[:, point].sum()) + size > room):
                break
            if not decoys[low - 2 : high + 2, point].any():
                decoys[low:high, point], sizes[low:high, point] = True, size
                made += 1
    return torch.from_numpy(decoys).to(gaps.visible.device), torch.from_numpy(sizes).to(gaps.visible.device)


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
        model = fit_factors(grow_factors(model, xy, visible, 3), xy, visible, 100, 1e-4)
    if len(chosen) < points:
        empty = gaps.xy.new_zeros(points, 3 * most)
        wide = FactorModel(model.rows, model.shift, empty, empty.new_zeros(points, 3 * most, 3 * most), model.noise)
        model = fit_factors(wide, gaps.xy, gaps.visible, 2)
    return model


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
    for rank in params.ranks:
        for _ in range(params.iterations):
            embedded = torch.cat([filled[k : k + rows] for k in range(delay)], 1)
            _, vectors = torch.linalg.eigh(embedded @ embedded.T)
            leading = vectors[:, -rank:]
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


def _depth(visible: Bool[Tensor, "frames points"]) -> Tensor:
    """Frames to the nearest end of the gap; 0 where visible."""
    order = torch.arange(len(visible), device=visible.device)[:, None]
    before = torch.where(visible, order, -len(visible)).cummax(0).values
    after = torch.where(visible, order, 2 * len(visible)).flip(0).cummin(0).values.flip(0)
    return torch.minimum(order - before, after - order)
