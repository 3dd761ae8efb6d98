"""Frames in which nothing is seen: taken out before a solve, bridged in the answer.

A factorisation has nothing to say of such a frame, and its pose, left free, would run away and take the unit of length
with it. Its body is put between those of its neighbours in time instead, or held before the first and after the last.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import interpolated
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.base import MIN_FRAMES, mirror_sign

__all__ = ["bridging"]

SolveOne = Callable[[Tracks, int, torch.Generator], Reconstruction]


def bridging(solve_one: SolveOne) -> SolveOne:
    """A solver of single sequences that is never asked about frames in which nothing is seen.

    Rotations, shapes in canonical axes, scale and translation change evenly over such frames; the covariance there is
    that of the neighbours plus what points moved, in frames that were seen, over the same number of frames.

    Example:
        >>> import torch
        >>> points = torch.randn(6, 5, 3, generator=torch.Generator().manual_seed(0))
        >>> eye = torch.eye(3).expand(6, 3, 3)
        >>> def solve(item, rank, generator):
        ...     shape = points[: item.frames]
        ...     return Reconstruction.from_points(shape, eye[: item.frames], rank=rank, status=Status("ok", "seen"))
        >>> visible = torch.ones(6, 5, dtype=torch.bool)
        >>> visible[2] = False
        >>> answer = bridging(solve)(Tracks(points[..., :2], visible), 1, torch.Generator())
        >>> answer.status.text
        'seen; 1 of 6 frames show nothing and are bridged'
    """

    @wraps(solve_one)
    def solve(item: Tracks, rank: int, generator: torch.Generator) -> Reconstruction:
        seen = item.visible.any(-1)
        if not MIN_FRAMES <= int(seen.sum()) < len(seen):
            return solve_one(item, rank, generator)
        index = seen.nonzero()[:, 0]
        return _bridged(solve_one(item.select(frames=index.cpu()), rank, generator), item, index)

    return solve


def _bridged(part: Reconstruction, item: Tracks, index: Int[Tensor, " seen"]) -> Reconstruction:
    """The answer for all frames from that for the frames ``index``."""
    seen = item.visible.any(-1)

    def blend(values: Tensor) -> Tensor:
        whole = values.new_zeros(item.frames, *values.shape[1:]).index_copy(0, index, values)
        return interpolated(whole, seen)

    # Gram-Schmidt: a polar factor has no gradient at a rotation, and most of these are ones.
    x, y, _ = blend(part.rotations).unbind(-2)
    x = torch.nn.functional.normalize(x, dim=-1)
    y = torch.nn.functional.normalize(y - (y * x).sum(-1, keepdim=True) * x, dim=-1)
    turned = torch.stack([x, y, torch.linalg.cross(x, y)], -2)
    rotations = torch.where(seen[:, None, None], blend(part.rotations), turned)
    points3d = torch.where(seen[:, None, None], blend(part.points3d), blend(part.canonical) @ rotations.mT)
    covariance = None
    if part.covariance3d is not None:
        frame = torch.arange(item.frames, device=index.device)
        before = torch.where(seen, frame, -item.frames).cummax(0).values
        after = torch.where(seen, frame, 2 * item.frames).flip(0).cummin(0).values.flip(0)
        away = torch.minimum(frame - before, after - frame)
        eye = torch.eye(3, dtype=points3d.dtype, device=points3d.device)
        covariance = blend(part.covariance3d) + _wandered(part.points3d, away)[:, None, None, None] * eye
    status = part.statuses[0]
    missing = item.frames - len(index)
    whole = Reconstruction.from_points(
        points3d,
        rotations,
        rank=part.rank,
        status=Status(status.code, f"{status.text}; {missing} of {item.frames} frames show nothing and are bridged"),
        deformation_degree=part.deformation_degree,
        scale=blend(part.scale),
        translation=blend(part.translation),
        covariance3d=covariance,
        intrinsics=part.intrinsics,
        observed=item.visible,
    )
    mirrored = item.intrinsics is None and float(mirror_sign(whole.points3d.detach())) < 0
    return whole.mirrored() if mirrored else whole


def _wandered(points3d: Float[Tensor, "seen points 3"], away: Int[Tensor, " frames"]) -> Float[Tensor, " frames"]:
    """Mean squared change of a coordinate over ``away`` frames: measured at powers of two, straight in between."""
    count = len(points3d)
    lags = [0] + [2**power for power in range((count - 1).bit_length()) if 2**power < count]
    change = [(points3d[lag:] - points3d[: count - lag]).detach().square().mean() for lag in lags]
    known, value = away.new_tensor(lags), torch.stack(change)
    right = torch.searchsorted(known, away).clamp(1, len(lags) - 1)
    left = right - 1
    share = ((away - known[left]) / (known[right] - known[left])).clamp(0, 1).to(value.dtype)
    return (1 - share) * value[left] + share * value[right]
