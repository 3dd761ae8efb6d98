"""Complete orthographic tracks: metric upgrade from several K and starts, then the log-determinant descent."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchrecon._typing import Int, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.common import conclude
from torchrecon.nrsfm.logdet import LogDetParams, camera_points, lift_depths, rigid_depths
from torchrecon.nrsfm.observations import observe
from torchrecon.nrsfm.upgrade import UpgradeParams, upgraded_rotations

__all__ = ["LowRankParams", "logdet", "solve_complete"]


@dataclass(frozen=True)
class LowRankParams:
    """Parameters of the solver for complete tracks.

    Attributes:
        upgrade: of the metric upgrade, which supplies the starts.
        descent: of the log-determinant cost.
        short_iterations: steps spent on every start (count).
        long_iterations: steps spent on the best start (count).
        keep: starts that are tried, those of the lowest upgrade residual of each K first (count).
    """

    upgrade: UpgradeParams = field(default_factory=UpgradeParams)
    descent: LogDetParams = field(default_factory=LogDetParams)
    short_iterations: int = 40
    long_iterations: int = 400
    keep: int = 6


def solve_complete(
    item: Tracks, rank: int, generator: torch.Generator, params: LowRankParams | None = None
) -> Reconstruction:
    """Solve one sequence in which every point is seen in every frame; noise is not modelled.

    Computed in float64 (eps_fine is below what float32 can factorise), returned in the type of the tracks.
    """
    params = params or LowRankParams()
    dtype = item.xy.dtype
    data = observe(item.to(dtype=torch.float64))
    if not bool(data.visible.all()):
        raise ReconError("visible: this solver needs every point in every frame; use solver 'auto'")
    translation = data.xy.mean(1)
    xy = data.xy - translation[:, None]
    unit = xy.square().mean().sqrt()
    xy = xy / unit
    starts = sorted(upgraded_rotations(xy.mT.flatten(0, 1), params.upgrade, generator), key=lambda s: s[0])
    tried = [
        lift_depths(xy, rotations, rigid_depths(xy, rotations), params.short_iterations, params.descent)
        for _, _, rotations in starts[: params.keep]
    ]
    best = min(tried, key=lambda answer: answer[2])
    rotations, depth, _, converged = lift_depths(
        xy, best[0], best[1], params.long_iterations, params.descent, anneal=False
    )
    points3d = camera_points(xy, depth) * unit
    complaint = None if converged else f"the cost still fell after {params.long_iterations} steps from the best start"
    found = conclude(
        data,
        points3d,
        rotations,
        torch.ones_like(translation[:, 0]),
        translation,
        rank=rank,
        complaint=complaint,
        summary=f"best of {len(tried)} starts",
    )
    return found.to(dtype=dtype)


def logdet(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Log-determinant factorisation of complete tracks; any leading batch.

    The measured image positions are kept as they are; only depths and rotations are sought. ``rank`` is what the
    result reports; the solver itself needs none.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(12, 3, generator=g)
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.1]))
        >>> logdet(Tracks((shape @ turn.mT)[..., :2]), 1).points3d.shape
        torch.Size([15, 12, 3])
    """
    return solve_items(tracks, rank, solve_complete, generator)
