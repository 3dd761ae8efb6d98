"""``fill_gaps``: a value and a covariance for every entry, by one of the fillers."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchrecon.errors import ReconError
from torchrecon.gaps.abg import fill_abg
from torchrecon.gaps.base import Gaps, Guess, assemble, open_gaps
from torchrecon.gaps.low_rank import LowRankParams, fill_low_rank
from torchrecon.gaps.rts import fill_rts
from torchrecon.measurement import FilledTracks, Tracks

__all__ = ["METHODS", "GapParams", "fill_gaps"]

METHODS = ("auto", "abg", "rts", "low_rank")


@dataclass(frozen=True)
class GapParams:
    """Parameters of :func:`fill_gaps`.

    Attributes:
        alpha: position gain of ``abg``; None chooses it from the innovations.
        low_rank: parameters of the low-rank fillers.
    """

    alpha: float | None = None
    low_rank: LowRankParams = field(default_factory=LowRankParams)


def fill_gaps(tracks: Tracks, method: str = "auto", params: GapParams | None = None) -> FilledTracks:
    """Estimate the entries that were not seen.

    Filled values are estimates for methods that need complete matrices, for gating and for drawing; counted as
    measurements they ruin the estimate of K and bias the shape.

    Args:
        tracks: any batch shape; items are treated one by one.
        method: ``abg``: causal coasting, the paper's rule (eqs. 28-30); ``rts``: constant-acceleration smoother;
            ``low_rank``: windowed low-rank completion; ``auto``: of both, of a low-rank model of the whole sequence and
            of their means, what predicts gaps best that are cut into the tracks for the purpose. Where there are too
            few points ``auto`` and ``low_rank`` are ``rts``.

    Returns:
        Measured entries unchanged. The covariance of a filled entry is that of its neighbours in time (eq. 30) plus
        what the filler does not know, which grows into the gap. Frames before the first and after the last
        observation of a point are always low in confidence.

    Raises:
        ReconError: unknown method, or a point that is never seen.

    Example:
        >>> import torch
        >>> xy = torch.arange(20.0)[:, None, None].repeat(1, 4, 2)
        >>> xy[7:9, 2] = float("nan")
        >>> filled = fill_gaps(Tracks(xy))
        >>> bool((filled.xy[7:9, 2] - xy[7:9, 1]).abs().max() < 0.1), int(filled.filled.sum())
        (True, 2)
    """
    if method not in METHODS:
        raise ReconError(f"method: {method!r} is not known; use one of {', '.join(METHODS)}")
    params = params or GapParams()
    if not tracks.batch_shape:
        return _single(tracks, method, params)
    lead = len(tracks.batch_shape)
    xy, visible = tracks.xy.flatten(0, lead - 1), tracks.visible.flatten(0, lead - 1)
    covariance = None if tracks.covariance is None else tracks.covariance.flatten(0, lead - 1)
    times = tracks.times.flatten(0, lead - 1)
    items = [
        _single(
            Tracks(xy[i], visible[i], None if covariance is None else covariance[i], fps=tracks.fps, times=times[i]),
            method,
            params,
        )
        for i in range(len(xy))
    ]
    return FilledTracks(
        torch.stack([item.xy for item in items]).view(tracks.xy.shape),
        torch.stack([item.covariance for item in items]).view(*tracks.xy.shape, 2),
        torch.stack([item.filled for item in items]).view(tracks.visible.shape),
        torch.stack([item.low_confidence for item in items]).view(tracks.visible.shape),
    )


def _single(tracks: Tracks, method: str, params: GapParams) -> FilledTracks:
    gaps = open_gaps(tracks)
    return assemble(tracks, gaps, _guess(gaps, method, params))


def _guess(gaps: Gaps, method: str, params: GapParams) -> Guess:
    if method == "abg":
        return fill_abg(gaps, params.alpha)
    return fill_rts(gaps) if method == "rts" else fill_low_rank(gaps, params.low_rank, choose=method == "auto")
