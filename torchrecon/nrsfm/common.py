"""What the factorisation methods share: complete tracks to start from, and at the end mirror rule and status."""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg.missing_factors import fit_factors, grow_factors, start_factors
from torchrecon.measurement import Reconstruction, Status
from torchrecon.nrsfm.base import MIN_POINTS, check_size, looks_static, mirror_sign, turn_of_view
from torchrecon.nrsfm.observations import Observations

__all__ = ["conclude", "filled", "linked_frames", "require_complete"]

STATIC_TURN = 3.0  # degrees of change of view below which depth is called undetermined
LEAST_LINKED = 0.95  # share of frame pairs with points in common below which a low-rank model guesses the rest


def require_complete(data: Observations, name: str) -> None:
    """Raise ReconError where an entry is missing."""
    if not bool(data.visible.all()):
        frame, point = (~data.visible).nonzero()[0].tolist()
        raise ReconError(
            f"visible: solver {name!r} needs every point in every frame, and point {point} is not seen in frame "
            f"{frame}; use solver 'auto'"
        )


def filled(
    data: Observations, columns: int, iterations: int = 40
) -> tuple[Float[Tensor, "frames points 2"], Float[Tensor, "frames 2"]]:
    """Tracks without gaps and their translation: complete tracks as they are, others by a low-rank model.

    Args:
        columns: largest rank of the model; it grows by three.
        iterations: of expectation-maximisation at each rank.
    """
    if bool(data.visible.all()):
        return data.xy, data.xy.mean(1)
    frames, points = data.visible.shape
    known = data.xy.detach()
    model = start_factors(known, data.visible)
    first = model.noise
    for rank in range(3, min(columns, points - 1, 2 * frames - 1) + 1, 3):
        grown = grow_factors(model, known, data.visible, rank - model.rows.shape[-1])
        model = fit_factors(grown, known, data.visible, iterations)
        if model.noise <= 1e-8 * first:  # exact: nothing is left to fit
            break
    xy = torch.where(data.visible[..., None], data.xy, model.predict())
    return xy, xy.mean(1)


def linked_frames(visible: Bool[Tensor, "frames points"]) -> float:
    """Share of the pairs of frames that have at least four points in common; of at most about 200 frames.

    Example:
        >>> import torch
        >>> linked_frames(torch.ones(5, 4, dtype=torch.bool)), linked_frames(torch.eye(5, dtype=torch.bool))
        (1.0, 0.0)
    """
    seen = visible[:: max(1, len(visible) // 200)].to(torch.float32)
    return float((seen @ seen.T >= MIN_POINTS).to(torch.float32).mean())


def conclude(
    data: Observations,
    points3d: Float[Tensor, "frames points 3"],
    rotations: Float[Tensor, "frames 3 3"],
    scale: Float[Tensor, " frames"],
    translation: Float[Tensor, "frames 2"],
    *,
    rank: int,
    complaint: str | None,
    summary: str,
    doubt: str | None = None,
    covariance3d: Float[Tensor, "frames points 3 3"] | None = None,
) -> Reconstruction:
    """Apply the mirror rule and say what the data leave open.

    Args:
        points3d: camera axes.
        complaint: what had not converged; None where all had.
        doubt: why the depth is not determined, where the method found that out by itself.
        summary: text of the status ``ok``; the turn of the view is added.
    """
    flip = torch.ones(3, dtype=points3d.dtype, device=points3d.device)
    flip[2] = mirror_sign(points3d.detach())
    both = flip[:, None] * flip
    points3d, rotations = points3d * flip, rotations * both
    turn = float(turn_of_view(rotations.detach()))
    complete = bool(data.visible.all())
    status = check_size(data.tracks, rank)
    if status is None and (turn < STATIC_TURN or (complete and looks_static(data.xy - data.xy.mean(1, keepdim=True)))):
        status = Status(
            "undetermined", "the tracks look as from a view that never changes; they do not determine the depth"
        )
    linked = linked_frames(data.visible)
    if status is None and linked < LEAST_LINKED:
        status = Status(
            "undetermined",
            f"{1 - linked:.0%} of the pairs of frames share fewer than {MIN_POINTS} points; the cameras of this method "
            "need tracks that last, use solver 'trajectory'",
        )
    if status is None and doubt is not None:
        status = Status("undetermined", doubt)
    if status is None and complaint is not None:
        status = Status("not_converged", complaint)
    if status is None:
        status = Status("ok", f"{summary}, view turning by {turn:.0f} degrees")
    spread = None if covariance3d is None else covariance3d * both
    return data.reconstruction(points3d, rotations, scale, translation, rank=rank, status=status, covariance3d=spread)
