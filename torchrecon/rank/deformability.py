"""Where and when a body deforms: the deformation degree over a sliding window of frames, and of parts of the points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement import RankEstimate, Tracks
from torchrecon.rank.estimate import estimate_rank

__all__ = ["Deformability", "deformability_over_time", "deformability_per_part"]


@dataclass(frozen=True, eq=False)
class Deformability:
    """Deformation degree in windows of frames.

    Attributes:
        start: (windows) first frame of each.
        length: of a window (frames).
        degree: (windows) count of signal eigenvalues over 3; 1 is a rigid body that turns.
        interval: (windows, 2) lowest and highest K that the data do not reject.
    """

    start: Int[Tensor, " windows"]
    length: int
    degree: Float[Tensor, " windows"]
    interval: Int[Tensor, "windows 2"]


def _part(tracks: Tracks, frames: slice, points: Sequence[int] | slice) -> Tracks:
    """The entries of some frames and points, with what of the container the estimate reads."""
    covariance = None if tracks.covariance is None else tracks.covariance[frames][:, points]
    return Tracks(tracks.xy[frames][:, points], tracks.visible[frames][:, points], covariance, fps=tracks.fps)


def deformability_over_time(
    tracks: Tracks,
    length: int = 60,
    step: int = 15,
    rule: str = "auto",
    generator: torch.Generator | None = None,
) -> Deformability:
    """Deformation degree in windows of ``length`` frames, ``step`` frames apart.

    A short window sees less of a slow deformation: compare windows of one length only. The last window ends with the
    sequence; a sequence shorter than a window is one window.

    Args:
        tracks: batch shape ``()``.
        rule: of :func:`estimate_rank`.
        generator: of :func:`estimate_rank`.

    Raises:
        ReconError: a batch; a window of fewer than 4 frames or a step below 1.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> a, b = torch.randn(120, 2, 6, generator=g), torch.randn(40, 6, generator=g)
        >>> a[:60, :, 3:] = 0  # the body bends in the second half only
        >>> xy = torch.einsum("fck,pk->fpc", a, b) + 0.05 * torch.randn(120, 40, 2, generator=g)
        >>> found = deformability_over_time(Tracks(xy), 60, 60)
        >>> found.start.tolist(), found.degree.tolist()
        ([0, 60], [1.0, 2.0])
    """
    if tracks.batch_shape:
        raise ReconError(f"tracks: batch shape {tuple(tracks.batch_shape)}; one sequence at a time, index the batch")
    if length < 4 or step < 1:
        raise ReconError(f"length {length} and step {step}: a window needs at least 4 frames, a step at least 1")
    length = min(length, tracks.frames)
    starts = list(range(0, tracks.frames - length + 1, step))
    if starts[-1] != tracks.frames - length:
        starts.append(tracks.frames - length)
    found = [
        estimate_rank(_part(tracks, slice(s, s + length), slice(None)), rule, generator=generator) for s in starts
    ]  # fmt: skip
    return Deformability(
        torch.tensor(starts),
        length,
        torch.tensor([float(item.deformation_degree) for item in found]),
        torch.tensor([[int(end) for end in item.interval] for item in found]),
    )


def deformability_per_part(
    tracks: Tracks,
    parts: Mapping[str, Sequence[int]],
    rule: str = "auto",
    generator: torch.Generator | None = None,
) -> dict[str, RankEstimate]:
    """The estimate for each named set of points alone.

    A part of P points shows at most (P - 1) / 3 bases; one that reaches them is warned about. Its own translation is
    free, so a rigid part of a bending body has K = 1.

    Args:
        tracks: any batch shape.
        parts: indices of points by name.

    Raises:
        ReconError: a part of fewer than 5 points, or an index out of range.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> a, b = torch.randn(80, 2, 6, generator=g), torch.randn(40, 6, generator=g)
        >>> b[:20, 3:] = 0  # the first half does not bend
        >>> xy = torch.einsum("fck,pk->fpc", a, b) + 0.05 * torch.randn(80, 40, 2, generator=g)
        >>> found = deformability_per_part(Tracks(xy), {"trunk": range(20), "arm": range(20, 40)})
        >>> {name: estimate.rank for name, estimate in found.items()}
        {'trunk': 1, 'arm': 2}
    """
    answers = {}
    for name, points in parts.items():
        index = list(points)
        if len(index) < 5 or min(index) < 0 or max(index) >= tracks.points:
            raise ReconError(
                f"parts: {name!r} must name at least 5 points between 0 and {tracks.points - 1}, has {index[:8]}"
            )
        covariance = None if tracks.covariance is None else tracks.covariance[..., index, :, :]
        some = Tracks(tracks.xy[..., index, :], tracks.visible[..., index], covariance, fps=tracks.fps)
        estimate = estimate_rank(some, rule, generator=generator)
        most = (len(index) - 1) // 3
        if int(torch.as_tensor(estimate.rank).max()) >= most:
            text = f"{name}: {len(index)} points show at most {most} bases; K is a lower limit."
            estimate = replace(estimate, warnings=(*estimate.warnings, text))
        answers[name] = estimate
    return answers
