"""Kritchman-Nadler: sequential Tracy-Widom with the noise scale estimated, per frame and per point where it varies."""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg.noise_edge import Complement, count_signals
from torchrecon.rank.base import Spectrum, whitened_stack

__all__ = ["UNEQUAL", "kritchman_nadler", "kritchman_nadler_count", "shrunk"]

# how many standard deviations the spread of the residuals has to exceed that of equal noise before it is believed
UNEQUAL = 3.0
_STEP = 3
_ROUNDS = 5
# residual variances further than this from the common one are taken for accidents of a small matrix (log scale)
_LOG_RANGE = 4.0


def kritchman_nadler_count(spectrum: Spectrum, *, noise: float | None = None) -> tuple[int, Float[Tensor, " d"]]:
    """Count leading eigenvalues above the edge of noise whose scale is estimated along the way, or known."""
    count, threshold = count_signals(spectrum.values, spectrum.samples, noise)
    threshold = threshold.clamp(min=spectrum.floor)
    above = (spectrum.values[:count] > threshold[:count]).tolist()
    return (above.index(False) if False in above else count), threshold


def kritchman_nadler(
    xy: Float[Tensor, "frames points 2"],
    frame: Float[Tensor, " frames"],
    point: Float[Tensor, " points"],
    floor: float,
) -> tuple[Spectrum, Float[Tensor, " frames"], Float[Tensor, " points"]]:
    """Spectrum of the stack, whitened by ``frame`` and ``point`` and by what the residuals say beyond them.

    Equal noise is tested first. Where the residuals of frames or points differ by more than chance, the matrix is
    whitened by them, shrunk towards a common value by their own uncertainty. The signals are then counted from below:
    with too many signals in the fit the noisiest points are fitted exactly and look quiet, with too few the signal
    is still far above any edge. At each number of signals the weights are refreshed until no further eigenvalue
    stands out, or else three more signals are admitted.

    Returns:
        (spectrum, frame, point): the whitened spectrum, and the standard deviations that whitened it.
    """
    matrix, space = whitened_stack(xy, frame, point)
    first = _spectrum(matrix, frame, point, floor)
    start, _ = kritchman_nadler_count(first)
    by_frame, by_point = _residual_factors(matrix, space, start)
    unequal = by_frame[0] > UNEQUAL, by_point[0] > UNEQUAL
    if not any(unequal):
        return first, frame, point
    limit, signals = min(matrix.shape) - 2, 0
    while True:
        for attempt in range(_ROUNDS + 1):
            matrix, space = whitened_stack(xy, frame, point)
            result = _spectrum(matrix, frame, point, floor)
            count, _ = kritchman_nadler_count(result)
            if (attempt and count <= signals) or attempt == _ROUNDS:
                break
            by_frame, by_point = _residual_factors(matrix, space, signals)
            frame = frame * by_frame[1] if unequal[0] else frame
            point = point * by_point[1] if unequal[1] else point
        if count <= signals or signals >= limit:
            return result, frame, point
        signals = min(signals + min(_STEP, count - signals), limit)


def _spectrum(matrix: Tensor, frame: Tensor, point: Tensor, floor: float) -> Spectrum:
    samples = max(matrix.shape)
    values: Tensor = torch.linalg.svdvals(matrix) ** 2 / samples
    return Spectrum(values, samples, "stack", floor / float((frame.min() * point.min()) ** 2))


def _residual_factors(
    matrix: Float[Tensor, "rows cols"], space: Complement, signals: int
) -> tuple[tuple[float, Tensor], tuple[float, Tensor]]:
    """For frames and for points: how unequal the residual of a fit is (a z score), and the factors to divide by."""
    u, s, vh = torch.linalg.svd(matrix, full_matrices=False)
    u, v = u[:, :signals], space.up(vh[:signals]).T
    residual2 = space.up(matrix - u @ (s[:signals, None] * vh[:signals])) ** 2
    # entries that the fit can follow have smaller residuals; 5 % keeps a point that is fitted exactly finite
    free_row = (1 - (u**2).sum(1)).clamp(min=0.05)
    free_point = (space.share - (v**2).sum(1)).clamp(min=0.05)
    scaled = residual2 / free_row[:, None] / free_point
    frames = scaled.shape[0] // 2
    dof_frame = free_row.view(frames, 2).sum(1) * (matrix.shape[1] - signals)
    dof_point = free_point * (matrix.shape[0] - signals)
    return shrunk(scaled.view(frames, 2, -1).mean((1, 2)), dof_frame), shrunk(scaled.mean(0), dof_point)


def shrunk(variance: Tensor, dof: Tensor) -> tuple[float, Tensor]:
    """Score of the spread of log variances, and standard deviations shrunk by empirical Bayes."""
    log = variance.clamp(min=torch.finfo(variance.dtype).tiny).log()
    chance = torch.special.polygamma(1, dof.clamp(min=2.0) / 2)
    offset = log - log.mean()
    score = float(((offset**2 / chance).mean() - 1) / math.sqrt(2 / max(len(log) - 1, 1)))
    between = float((offset**2 - chance).mean().clamp(min=0.0))
    factor = torch.exp((between / (between + chance) * offset).clamp(-_LOG_RANGE, _LOG_RANGE) / 2)
    return score, factor
