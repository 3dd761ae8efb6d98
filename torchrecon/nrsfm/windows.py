"""Long sequences in windows: cost and memory linear in the number of frames.

Overlapping windows are solved one after the other. In the frames that two windows share, the later one takes the
mirror image and the canonical axes of the earlier one, and the answers fade into each other. A window can only know
the depth if the view turns within it: a solve of every n-th frame says by how much, and where that is too little the
windows grow, up to a limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Tensor
from torchrecon.linalg import nearest_rotation
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.base import mirror_sign, turn_of_view

__all__ = ["WindowParams", "solve_windows", "window_starts"]

_BLENDED = ("points3d", "scale", "translation", "covariance3d")


@dataclass(frozen=True)
class WindowParams:
    """Parameters of the windows.

    Attributes:
        longest: sequence that is solved in one piece (frames).
        length: of a window (frames).
        overlap: of neighbouring windows, at least (frames).
        turn: by which the view has to change within a window (degrees).
        most: length up to which windows grow for that: cost and memory stay linear (frames).
    """

    longest: int = 1000
    length: int = 500
    overlap: int = 60
    turn: float = 90.0
    most: int = 2000


def window_starts(frames: int, params: WindowParams) -> list[int]:
    """First frames of windows of one length that cover the sequence, evenly spread.

    Example:
        >>> window_starts(1200, WindowParams())
        [0, 350, 700]
    """
    if frames <= params.length:
        return [0]
    count = -(-(frames - params.overlap) // (params.length - params.overlap))
    return [round(i * (frames - params.length) / (count - 1)) for i in range(count)]


def solve_windows(
    item: Tracks,
    rank: int,
    generator: torch.Generator,
    solve_one: Callable[[Tracks, int, torch.Generator], Reconstruction],
    params: WindowParams | None = None,
) -> Reconstruction:
    """One orthographic sequence (batch ``()``) by ``solve_one`` on windows of it.

    The status is that of the first window that is not ``ok``; its text says which one.
    """
    params = params or WindowParams()
    length = _telling_length(item, rank, generator, solve_one, params)
    if length >= item.frames:
        return solve_one(item, rank, generator)
    starts = window_starts(item.frames, replace(params, length=length))
    status = Status("ok", f"{len(starts)} windows of {length} frames")
    whole: dict[str, Tensor] = {}
    for number, first in enumerate(starts):
        answer = solve_one(item.select(frames=slice(first, first + length)), rank, generator)
        said = answer.statuses[0]
        if not said.ok and status.ok:
            frames = f"frames {first} to {first + length - 1}"
            status = replace(said, text=f"window {number + 1} of {len(starts)}, {frames}: {said.text}")
        if whole:
            shared = len(whole["scale"]) - first
            if float((whole["points3d"][first:, :, 2] * answer.points3d[:shared, :, 2]).sum()) < 0:
                answer = answer.mirrored()
        now = {name: value for name in _BLENDED if (value := getattr(answer, name)) is not None}
        rotations = answer.rotations
        if whole:
            rotations = rotations @ nearest_rotation((rotations[:shared].mT @ whole["rotations"][first:]).mean(0))
            # Half of the shared frames keep the earlier axes, half take the later; the points fade.
            rotations = torch.cat([whole["rotations"][: first + shared // 2], rotations[shared // 2 :]])
            now = {name: _faded(whole[name], value, first) for name, value in now.items()}
        whole = {**now, "rotations": rotations}
    result = Reconstruction.from_points(
        whole.pop("points3d"), whole.pop("rotations"), rank=rank, status=status, observed=item.visible, **whole
    )
    return result if float(mirror_sign(result.points3d)) > 0 else result.mirrored()


@torch.no_grad()
def _telling_length(
    item: Tracks,
    rank: int,
    generator: torch.Generator,
    solve_one: Callable[[Tracks, int, torch.Generator], Reconstruction],
    params: WindowParams,
) -> int:
    """The least length, doubled from that of the parameters, at which the view turns enough in every window."""
    every = -(-2 * item.frames // params.length)
    survey = solve_one(item.select(frames=slice(None, None, every)), rank, generator).rotations
    length = params.length
    while length < min(item.frames, params.most):
        starts = window_starts(item.frames, replace(params, length=length))
        views = [survey[first // every : (first + length) // every] for first in starts]
        if min(float(turn_of_view(view)) for view in views) >= params.turn:
            break
        length *= 2
    return length


def _faded(earlier: Tensor, later: Tensor, first: int) -> Tensor:
    """The earlier one up to frame ``first``, where the later one begins, then a linear change."""
    shared = len(earlier) - first
    share = (torch.arange(shared, dtype=later.dtype, device=later.device) + 1) / (shared + 1)
    share = share.view(-1, *[1] * (later.ndim - 1))
    return torch.cat([earlier[:first], (1 - share) * earlier[first:] + share * later[:shared], later[shared:]])
