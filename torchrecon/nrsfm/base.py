"""What every solver promises, and what all of them share: batches, the mirror rule, the status of a weak view.

Contract: ``solve(tracks, rank, *, generator=None) -> Reconstruction``. Entries that are not visible are never read;
the same generator gives the same bits; the answer follows point order, image rotation and translation; the mirror
is chosen by :func:`mirror_sign` or by perspective, never silently; the status says what the data leave open.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement import Reconstruction, Status, Tracks

__all__ = ["check_size", "looks_static", "mirror_sign", "solve_items", "turn_of_view"]

_FIELDS = ("xy", "visible", "covariance", "depth", "depth_variance", "intrinsics", "times")
_RESULTS = ("points3d", "rotations", "scale", "translation", "covariance3d", "observed")

MIN_FRAMES = 3  # below this no rotation is constrained by orthographic views
MIN_POINTS = 4


def solve_items(
    tracks: Tracks,
    rank: int | Int[Tensor, "*batch"],
    solve_one: Callable[[Tracks, int, torch.Generator], Reconstruction],
    generator: torch.Generator | None,
) -> Reconstruction:
    """Apply a solver of single sequences to every item of a batch and stack the answers.

    Args:
        tracks: any leading batch dimensions.
        rank: one K for all, or one per item.
        solve_one: solver for batch ``()``.
        generator: source of randomness; None means seed 0. Every item starts from the same state, so an answer
            does not depend on its neighbours in the batch.
    """
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    batch = tracks.batch_shape
    ranks = torch.as_tensor(rank)
    if ranks.is_floating_point() or (ranks < 1).any():
        raise ReconError(f"rank: {rank!r} must be a positive integer, or one per batch item")
    if not batch:
        if ranks.ndim:
            raise ReconError(f"rank: shape {tuple(ranks.shape)} for a single sequence; give one integer")
        return solve_one(tracks, int(ranks), generator)
    try:
        flat_ranks = ranks.expand(batch).reshape(-1)
    except RuntimeError as error:
        raise ReconError(f"rank: shape {tuple(ranks.shape)} does not fit the batch {tuple(batch)}") from error
    state = generator.get_state()
    answers = []
    for index in range(flat_ranks.numel()):
        cut: dict[str, Any] = {
            name: value.flatten(0, len(batch) - 1)[index]
            for name in _FIELDS
            if (value := getattr(tracks, name)) is not None
        }
        generator.set_state(state)
        answers.append(solve_one(replace(tracks, **cut, extras=None), int(flat_ranks[index]), generator))
    stacked: dict[str, Any] = {}
    for name in _RESULTS:
        values = [getattr(answer, name) for answer in answers]
        stacked[name] = None if values[0] is None else torch.stack(values).unflatten(0, batch)
    largest = max(answer.basis.shape[-3] for answer in answers)
    pad = torch.nn.functional.pad
    basis = torch.stack([pad(a.basis, (0, 0, 0, 0, 0, largest - a.basis.shape[-3])) for a in answers])
    weights = torch.stack([pad(a.weights, (0, largest - a.weights.shape[-1])) for a in answers])
    known = {field.name for field in fields(Reconstruction)}
    stacked |= {"basis": basis.unflatten(0, batch), "weights": weights.unflatten(0, batch)}
    stacked |= {"rank": ranks.expand(batch).to(torch.int64).clone(), "intrinsics": tracks.intrinsics}
    stacked["deformation_degree"] = tracks.xy.new_tensor([a.deformation_degree for a in answers]).reshape(batch)
    stacked["status"] = tuple(status for answer in answers for status in answer.statuses)
    return Reconstruction(**{name: value for name, value in stacked.items() if name in known})


def mirror_sign(points3d: Float[Tensor, "*batch frames points 3"]) -> Float[Tensor, "*batch"]:
    """The documented mirror rule: +1 where the third moment of depth over the sequence is positive, else -1.

    Multiply every depth by it. The rule is arbitrary but depends on nothing else than the shape itself, so the
    same tracks in another order give the same choice.

    Example:
        >>> import torch
        >>> shape = torch.tensor([[[0.0, 0, -2.0], [1, 0, 1.0], [0, 1, 1.0]]])
        >>> float(mirror_sign(shape)), float(mirror_sign(-shape))
        (-1.0, 1.0)
    """
    depth = points3d[..., 2] - points3d[..., 2].mean(-1, keepdim=True)
    moment = depth.pow(3).sum((-1, -2))
    return torch.where(moment < 0, -1.0, 1.0).to(points3d.dtype)


def turn_of_view(rotations: Float[Tensor, "*batch frames 3 3"]) -> Float[Tensor, "*batch"]:
    """Largest angle in degrees between the first viewing direction and a later one, in the axes of the body.

    Only a change of the viewing direction carries depth; turning about the optical axis does not.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> roll = rotation_from_vector(torch.tensor([[0.0, 0, 0], [0, 0, 1.0]]))
        >>> yaw = rotation_from_vector(torch.tensor([[0.0, 0, 0], [0, 0.5, 0]]))
        >>> round(float(turn_of_view(roll)), 2), round(float(turn_of_view(yaw)), 2)
        (0.0, 28.65)
    """
    view = rotations[..., 2, :]
    cosine = (view * view[..., :1, :]).sum(-1)
    sine = torch.linalg.cross(view, view[..., :1, :].expand_as(view)).square().sum(-1).sqrt()
    return torch.rad2deg(torch.atan2(sine, cosine).amax(-1))


def looks_static(centred: Float[Tensor, "frames points 2"]) -> bool:
    """Whether complete tracks look as if the view never changed.

    Under a fixed view the F x 2P matrix of K bases has rank K and the 2F x P stack has rank 2K; a turning view gives
    the stack at most 3/2 of the other's rank. Ranks are counted to 1 % and to 0.1 % of the energy, both must agree.

    Example:
        >>> import torch
        >>> shape = torch.randn(1, 9, 2, generator=torch.Generator().manual_seed(0))
        >>> looks_static(shape.expand(12, 9, 2))
        True
    """
    ranks = []
    for matrix in (centred.mT.flatten(1), centred.mT.flatten(0, 1)):
        energy = torch.linalg.svdvals(matrix).square()
        left = energy.flip(0).cumsum(0).flip(0) / energy.sum().clamp_min(torch.finfo(energy.dtype).tiny)
        ranks.append([int((left > share).sum()) for share in (1e-2, 1e-3)])
    return all(stack >= 2 * vector for vector, stack in zip(*ranks, strict=True))


def check_size(tracks: Tracks, rank: int) -> Status | None:
    """A ``degenerate`` status when frames or points are too few for K bases, else None.

    A 2F x P matrix of K bases has rank 3K, so at least 3K + 1 points and 3K/2 frames are needed.
    """
    frames, points = tracks.frames, int(tracks.visible.any(-2).sum())
    if frames < max(MIN_FRAMES, (3 * rank + 1) // 2) or points < max(MIN_POINTS, 3 * rank + 1):
        return Status(
            "degenerate",
            f"{points} points in {frames} frames are too few for K = {rank} shape bases; at least {3 * rank + 1} "
            f"points and {max(MIN_FRAMES, (3 * rank + 1) // 2)} frames are needed",
        )
    return None
