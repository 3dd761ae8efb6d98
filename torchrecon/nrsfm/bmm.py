"""Block matrix method, BMM (Dai, Li, He 2012): rotations from a Gram matrix, shapes of least nuclear norm.

Derived: the rotations come from the 3K column space by :mod:`torchrecon.nrsfm.gram`, with the homogeneous conditions
(both rows of a frame equally long and orthogonal). The shapes S then minimise ``mu |S|_* + |W - R S|^2 / 2``, where
the nuclear norm is that of the F x 3P matrix (one row per frame) and ``mu = sigma (sqrt F + sqrt 2P)`` is the largest
singular value that noise of standard deviation sigma reaches; sigma is given with the tracks or is what the 3K
columns leave of them. Without noise that is the least norm among the shapes that project onto the tracks. The minimum
is found by alternating the pull to the tracks, closed because the image plane of a shape is measured and its depth
free, with the shrinkage of singular values (Douglas-Rachford). Recalled, not read: that the original solves the first
step with a general semidefinite solver and a non-linear refinement, and the second with a quadratic penalty of a
small fixed weight and a fixed-point iteration.

What it is not: smooth in time (frames may come in any order), robust, or able to take gaps. K sets the rotations and
sigma and has to be given sensibly; too small a K gives wrong rotations and nothing later mends them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg.shrinkage import shrink_singular_values
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.common import conclude, require_complete
from torchrecon.nrsfm.gram import GramParams, gram_upgrade
from torchrecon.nrsfm.observations import Observations, observe

__all__ = ["BmmParams", "bmm", "least_nuclear_shapes"]


@dataclass(frozen=True)
class BmmParams:
    """Parameters of the block matrix method.

    Attributes:
        upgrade: of the rotations.
        step: threshold of the shrinkage, relative to the largest singular value of the start (no unit).
        relaxation: over-relaxation of the splitting, 1 to 2 (no unit).
        iterations: of the splitting (count).
        tolerance: relative distance between the low-rank iterate and the one at the tracks that counts as converged.
    """

    upgrade: GramParams = field(default_factory=GramParams)
    step: float = 0.02
    relaxation: float = 1.9
    iterations: int = 600
    tolerance: float = 1e-4


def least_nuclear_shapes(
    xy: Float[Tensor, "frames points 2"],
    rotations: Float[Tensor, "frames 3 3"],
    noise: float = 0.0,
    params: BmmParams | None = None,
) -> tuple[Float[Tensor, "frames points 3"], bool]:
    """Canonical shapes of small nuclear norm (F x 3P) that project onto centred tracks.

    Args:
        noise: standard deviation of a coordinate; zero demands that the projection is exact.

    Returns:
        shapes, and whether the splitting converged before the limit.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 12)[:, None] * torch.tensor([0.0, 1.0, 0.2]))
        >>> shape = torch.randn(9, 3, generator=torch.Generator().manual_seed(0)).expand(12, 9, 3)
        >>> shapes, converged = least_nuclear_shapes((shape @ turn.mT)[..., :2], turn)
        >>> bool((shapes - shape).abs().max() < 1e-2), converged
        (True, True)
    """
    params = params or BmmParams()
    frames, points = xy.shape[:2]
    rows = rotations[:, :2]

    # z = sum of what the two maps disagree about; both meet at its fixed point
    z = xy @ rows
    tiny = torch.finfo(xy.dtype).tiny
    threshold = params.step * torch.linalg.matrix_norm(z.flatten(1), ord=2).clamp_min(tiny)
    gain = threshold / (threshold + noise * (frames**0.5 + (2 * points) ** 0.5))

    def project(shapes: Tensor) -> Tensor:
        return shapes + gain * (xy - shapes @ rows.mT) @ rows

    converged = False
    for _ in range(params.iterations):
        plane = project(z)
        low = shrink_singular_values((2 * plane - z).flatten(1), threshold).view_as(z)
        z = z + params.relaxation * (low - plane)
        if float((low - plane).norm()) <= params.tolerance * float(plane.norm()):
            converged = True
            break
    return project(z), converged


def _noise(data: Observations, centred: Float[Tensor, "frames points 2"], columns: int) -> float:
    """Standard deviation of a coordinate: of the given covariances, else from what the leading columns leave."""
    if data.noise_known:
        covariance = torch.linalg.inv(data.weight.mT @ data.weight)
        return float(covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt())
    frames, points = centred.shape[:2]
    left = torch.linalg.svdvals(centred.mT.flatten(0, 1))[columns:].square().sum()
    freedom = (2 * frames - columns) * (points - 1 - columns)
    return float((left / freedom).sqrt()) if points - 1 > columns and 2 * frames > columns else 0.0


def _solve(item: Tracks, rank: int, generator: torch.Generator, params: BmmParams | None = None) -> Reconstruction:
    params = params or BmmParams()
    data = observe(item)
    require_complete(data, "bmm")
    translation = data.xy.mean(1)
    centred = data.xy - translation[:, None]
    found = gram_upgrade(centred.mT.flatten(0, 1), 3 * rank, scaled=True, params=params.upgrade)
    scale = found.scale if item.intrinsics is not None else torch.ones_like(found.scale)
    noise = _noise(data, centred, 3 * rank)
    shapes, converged = least_nuclear_shapes(centred / scale[:, None, None], found.rotations, noise, params)
    complaint = None
    if not (converged and found.converged):
        part = "metric upgrade" if not found.converged else "nuclear-norm minimisation"
        complaint = f"the {part} still moved at its iteration limit"
    return conclude(
        data,
        shapes @ found.rotations.mT,
        found.rotations,
        scale,
        translation,
        rank=rank,
        complaint=complaint,
        summary=f"rotations from {3 * rank} columns, upgrade residual {found.residual:.1e}",
    )


def bmm(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Block matrix method on complete tracks; any leading batch.

    Args:
        tracks: every point seen in every frame; with intrinsics the views are weak perspective.
        rank: K of the rotations.
        generator: not used; the method has no random part.

    Raises:
        ReconError: an entry is missing.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> shape = torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.1]))
        >>> bmm(Tracks((shape @ turn.mT)[..., :2]), 1).status.code
        'ok'
    """
    return solve_items(tracks, rank, _solve, generator)
