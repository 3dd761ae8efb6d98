"""What every gap filler is given and returns, and the covariance of a filled entry (paper, eq. 30)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement import FilledTracks, Tracks
from torchrecon.statespace import best_tracking_index

__all__ = ["Gaps", "Guess", "assemble", "gap_lengths", "neighbour_covariance", "open_gaps", "whole_gaps"]


@dataclass(frozen=True, eq=False)
class Gaps:
    """One sequence as the fillers see it, in float64.

    Attributes:
        xy: (frames, points, 2) pixels; zeros where nothing was seen.
        visible: (frames, points).
        covariance: (frames, points, 2, 2) px^2; of the measurement where visible, by (30) elsewhere.
        variance: (frames, points) mean of the u and v variances of ``covariance``.
        index: (points,) tracking index of each point, from the likelihood of its innovations.
        steps: frames - 1 time steps in units of the median one.
        inside: (frames, points) unseen with an observation before and after.
        length: (frames, points) length of the run of unseen frames an entry lies in, 0 where visible.
    """

    xy: Float[Tensor, "frames points 2"]
    visible: Bool[Tensor, "frames points"]
    covariance: Float[Tensor, "frames points 2 2"]
    variance: Float[Tensor, "frames points"]
    index: Float[Tensor, " points"]
    steps: list[float]
    inside: Bool[Tensor, "frames points"]
    length: Int[Tensor, "frames points"]


@dataclass(frozen=True, eq=False)
class Guess:
    """What a filler says: a value, a variance that is added to the neighbours' covariance, and whether to doubt it."""

    xy: Float[Tensor, "frames points 2"]
    growth: Float[Tensor, "frames points"]
    doubtful: Bool[Tensor, "frames points"]


def _neighbours(visible: Bool[Tensor, "frames points"]) -> tuple[Tensor, Tensor]:
    """Index of the last seen frame at or before, and of the next at or after; -1 and F where there is none."""
    frames = len(visible)
    order = torch.arange(frames, device=visible.device)[:, None]
    before = torch.where(visible, order, -1).cummax(0).values
    after = torch.where(visible, order, frames).flip(0).cummin(0).values.flip(0)
    return before, after


def gap_lengths(visible: Bool[Tensor, "frames points"]) -> Int[Tensor, "frames points"]:
    """Length of the run of unseen frames that an entry lies in; 0 where visible.

    Example:
        >>> import torch
        >>> gap_lengths(torch.tensor([[True], [False], [False], [True], [False]]))[:, 0].tolist()
        [0, 2, 2, 0, 1]
    """
    before, after = _neighbours(visible)
    return torch.where(visible, 0, after - before - 1)


def whole_gaps(
    entries: Bool[Tensor, "frames points"], visible: Bool[Tensor, "frames points"]
) -> Bool[Tensor, "frames points"]:
    """Every entry of the gaps in which at least one of ``entries`` lies.

    Example:
        >>> import torch
        >>> visible = torch.tensor([[True], [False], [False], [True], [False]])
        >>> whole_gaps(torch.tensor([[False], [False], [True], [False], [False]]), visible)[:, 0].tolist()
        [False, True, True, False, False]
    """
    gap = torch.where(visible, 0, _neighbours(visible)[0] + 2)
    any_of_gap = torch.zeros(len(visible) + 2, visible.shape[1], dtype=torch.uint8, device=visible.device)
    any_of_gap = any_of_gap.scatter_reduce(0, gap, entries.to(torch.uint8), "amax")
    return any_of_gap.gather(0, gap).bool() & ~visible


def neighbour_covariance(
    covariance: Float[Tensor, "frames points 2 2"],
    visible: Bool[Tensor, "frames points"],
    times: Float[Tensor, " frames"],
) -> Float[Tensor, "frames points 2 2"]:
    """Covariance that the neighbours in time suggest for unseen entries (paper, eq. 30, corrected).

    The paper prints the product of the neighbours' covariances, halved: its unit is px^4, it is not symmetric, and its
    index runs over points. Meant is the mean of the two neighbours in time; in a longer gap the two ends are
    interpolated linearly, before the first and after the last observation the nearest one is taken.

    Example:
        >>> import torch
        >>> q = torch.eye(2).expand(3, 1, 2, 2) * torch.tensor([1.0, 9.0, 3.0])[:, None, None, None]
        >>> visible = torch.tensor([[True], [False], [True]])
        >>> neighbour_covariance(q, visible, torch.arange(3.0))[1, 0].tolist()
        [[2.0, 0.0], [0.0, 2.0]]
    """
    before, after = _neighbours(visible)
    frames = len(visible)
    low = torch.where(before < 0, after, before).clamp(0, frames - 1)
    high = torch.where(after >= frames, low, after).clamp(0, frames - 1)
    span = times[high] - times[low]
    share = torch.where(span > 0, (times[:, None] - times[low]) / torch.where(span > 0, span, 1.0), 0.0)[
        ..., None, None
    ]
    column = torch.arange(visible.shape[1], device=visible.device)
    return (1 - share) * covariance[low, column] + share * covariance[high, column]


def open_gaps(tracks: Tracks) -> Gaps:
    """Prepare one sequence (batch shape ``()``).

    Without a covariance the measurement noise is taken as equal and estimated from the innovations of the
    constant-acceleration filter.

    Raises:
        ReconError: a point that is never seen.
    """
    visible = tracks.visible
    never = ~visible.any(0)
    if never.any():
        raise ReconError(f"visible: point {int(never.nonzero()[0])} is never seen, so nothing can fill it; drop it")
    xy = tracks.filled_xy().detach().to(torch.float64)
    times = tracks.times.to(torch.float64)
    steps = times.diff()
    relative = (steps / steps.median()).tolist() if len(steps) else []
    given = tracks.covariance is not None
    eye = torch.eye(2, dtype=xy.dtype, device=xy.device).expand(*visible.shape, 2, 2)
    covariance = tracks.covariance.detach().to(torch.float64) if tracks.covariance is not None else eye
    covariance = neighbour_covariance(torch.where(visible[..., None, None], covariance, eye), visible, times)
    variance = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    index, factor = best_tracking_index(xy, visible, variance, relative, scale_known=given)
    before, after = _neighbours(visible)
    return Gaps(
        xy,
        visible,
        covariance * factor,
        variance * factor,
        index,
        relative,
        ~visible & (before >= 0) & (after < len(visible)),
        gap_lengths(visible),
    )


def assemble(tracks: Tracks, gaps: Gaps, guess: Guess) -> FilledTracks:
    """Measured entries as they were, the others from the guess, with the covariance of (30) plus the growth."""
    unseen = ~gaps.visible
    eye = torch.eye(2, dtype=gaps.xy.dtype, device=gaps.xy.device)
    grown = gaps.covariance + guess.growth[..., None, None] * eye
    covariance = torch.where(unseen[..., None, None], grown, gaps.covariance).to(tracks.xy.dtype)
    if tracks.covariance is not None:
        covariance = torch.where(unseen[..., None, None], covariance, tracks.covariance)
    xy = torch.where(unseen[..., None], guess.xy.to(tracks.xy.dtype), tracks.xy)
    return FilledTracks(xy, covariance, unseen, unseen & guess.doubtful)
