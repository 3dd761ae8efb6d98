"""Band-limited: count signals only among the frequencies over time at which the tracks move.

Tracking noise is as strong at every frequency, a body moves slowly against the frame rate. What lies above the band of
the motion holds no signal, so it tells the noise scale, and leaving it out lowers the edge that a basis has to exceed:
``n`` and ``d`` of the Tracy-Widom test are those of the band. Derived here; where tracks move as fast as the frames,
the band is all of them and the test is that of Kritchman and Nadler.
Not for noise that is itself slow: drift of a tracker counts as motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg.dct import dct, dct_share, inverse_dct
from torchrecon.linalg.noise_edge import Complement, count_signals, spectrum
from torchrecon.rank.base import Spectrum, stack_spectrum, whitened_stack
from torchrecon.rank.kritchman_nadler import UNEQUAL, kritchman_nadler, shrunk

__all__ = ["BandParams", "MotionBand", "band_limited", "motion_band"]

# frames whose noise differs by less than this factor count as equal
_EQUAL_FRAMES = 1.05


@dataclass(frozen=True)
class BandParams:
    """Parameters of :func:`motion_band`.

    Attributes:
        step: factor by which the band shrinks while what it loses is noise (no unit).
        excess: standard deviations by which the lost power may exceed that of the frequencies above it (no unit).
        enough: multiple of the columns that has to be lost for the noise to be read off it (no unit).
    """

    step: float = 1.25
    excess: float = 3.0
    enough: float = 5.0


@dataclass(frozen=True, eq=False)
class MotionBand:
    """Rows of a whitened matrix at the frequencies at which it moves, and what is above them.

    Attributes:
        kept: (rows, cols) of the cosine transform over frames.
        quiet: (frames, parts, cols) over time what lies above the band: noise alone; None where too little is there.
        free: (frames) share of each frame's noise that is in ``quiet``.
        noise: variance of an entry of the noise; None where ``quiet`` is.
    """

    kept: Float[Tensor, "rows cols"]
    quiet: Float[Tensor, "frames parts cols"] | None
    free: Float[Tensor, " frames"]
    noise: float | None


def motion_band(rows: Float[Tensor, "frames parts cols"], params: BandParams | None = None) -> MotionBand:
    """Shrink the band of frequencies from the top while what goes is noise.

    What goes must have no eigenvalue above the edge of noise, and no more power than what went before.

    Args:
        rows: matrix without translation whose noise is white over frames; ``parts`` rows belong to each frame.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> time = torch.linspace(0, 6, 200, dtype=torch.float64)
        >>> wave = time.sin()[:, None, None] * torch.randn(2, 20, generator=g, dtype=torch.float64)
        >>> noise = 0.1 * torch.randn(200, 2, 20, generator=g, dtype=torch.float64)
        >>> band = motion_band(wave + noise)
        >>> len(band.kept) < 100, round(band.noise, 3)
        (True, 0.01)
    """
    p = params or BandParams()
    frames, parts, cols = rows.shape
    moved = dct(rows)
    band = frames
    while True:
        smaller = int(band / p.step)
        if smaller < 2:
            break
        values, n, _ = spectrum(moved[smaller:band].flatten(0, 1))
        if count_signals(values, n, None)[0]:
            break
        lost = moved[smaller:band]
        if band < frames:
            before = moved[band:]
            chance = math.sqrt(2 / lost.numel() + 2 / before.numel())
            if float(lost.square().mean()) > (1 + p.excess * chance) * float(before.square().mean()):
                break
        band = smaller
    above = moved[band:]
    free = 1 - dct_share(frames, band).to(rows)
    kept = moved[:band].flatten(0, 1)
    if len(above) * parts < p.enough * cols:
        return MotionBand(kept, None, free, None)
    quiet = inverse_dct(torch.cat([torch.zeros_like(moved[:band]), above]))
    return MotionBand(kept, quiet, free, float(above.square().mean()))


def band_limited(
    xy: Float[Tensor, "frames points 2"],
    frame: Float[Tensor, " frames"],
    point: Float[Tensor, " points"],
    floor: float,
    noise: float | None,
) -> tuple[Spectrum, float | None]:
    """Spectrum of the stack in the band of its motion, and the noise scale above it.

    Noise that differs between points is whitened by what is above the band; where it differs between frames the
    division would spread the motion over all frequencies, and the stack is treated as by Kritchman and Nadler.

    Args:
        frame, point: standard deviations of the noise up to one factor.
        noise: variance that ``frame`` and ``point`` leave, where it is known.
    """
    if float(frame.max()) < _EQUAL_FRAMES * float(frame.min()):
        matrix, space = whitened_stack(xy, frame, point)
        band = motion_band(matrix.unflatten(0, (len(xy), 2)))
        by_frame, by_point = (0.0, frame), (0.0, point)
        if noise is None and band.quiet is not None:
            by_frame, by_point = _residual_factors(band.quiet, band.free, space)
        if by_point[0] > UNEQUAL:
            point = point * by_point[1]
            matrix, space = whitened_stack(xy, frame, point)
            band = motion_band(matrix.unflatten(0, (len(xy), 2)))
        values, samples, _ = spectrum(band.kept)
        result = Spectrum(values, samples, "stack", floor / float((frame.min() * point.min()) ** 2))
        if by_frame[0] <= UNEQUAL and (noise is not None or band.quiet is not None):
            return result, band.noise if noise is None else noise
        other, *levels = kritchman_nadler(xy, frame, point, floor)
        # the band is kept where too little is above it to compare frames and the residuals see no difference either
        alike = band.quiet is None and levels[0] is frame and levels[1] is point
        return result if alike else other, None
    if noise is not None:
        return stack_spectrum(xy, frame, point, floor), noise
    return kritchman_nadler(xy, frame, point, floor)[0], None


def _residual_factors(
    quiet: Tensor, free: Tensor, space: Complement
) -> tuple[tuple[float, Tensor], tuple[float, Tensor]]:
    """For frames and for points: how unequal the noise above the band is (a z score), and factors to divide by."""
    squared, share = space.up(quiet).square(), space.share
    parts, cols = quiet.shape[1:]
    by_frame = shrunk(squared.mean((1, 2)) / free, parts * cols * free)
    return by_frame, shrunk(squared.mean((0, 1)) / share, parts * float(free.sum()) * share)
