"""Point trajectory approach, PTA (Akhter, Sheikh, Khan, Kanade 2008): every trajectory is a sum of K cosines.

Derived: with canonical shapes ``S = (T (x) I_3) A``, T the first K columns of the cosine transform, the first three
columns of the motion are the rotations times a constant, because the first cosine is constant. So one triplet Q of
the 3K column space is to have orthonormal rows in every frame (each of the three conditions counted once); with the
rotations known, A is a linear least-squares fit. Recalled, not read: that the original minimises the same
sum of squares over Q by a general optimiser from one fixed start. Here the start is the Gram matrix of least trace.

What it is not: no camera path is modelled, nothing is robust, tracks must be complete, and K bounds the frequencies
that a shape may have: motion faster than the K-th cosine is cut off. ``rank`` has to be given sensibly, 5 to 13 for
a few hundred frames of human motion; the estimate of ``rank="auto"`` counts shapes, not frequencies.
"""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg.dct import dct_basis
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.common import conclude, require_complete
from torchrecon.nrsfm.gram import gram_upgrade
from torchrecon.nrsfm.observations import observe

__all__ = ["cosine_shapes", "pta"]


def cosine_shapes(
    xy: Float[Tensor, "frames points 2"], rotations: Float[Tensor, "frames 3 3"], count: int
) -> Float[Tensor, "frames points 3"]:
    """Canonical shapes from ``count`` cosines per coordinate that fit centred orthographic tracks best.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> turn = rotation_from_vector(torch.linspace(0, 2, 12)[:, None] * torch.tensor([0.0, 1.0, 0.2]))
        >>> shape = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).expand(12, 5, 3)
        >>> bool((cosine_shapes((shape @ turn.mT)[..., :2], turn, 1) - shape).abs().max() < 1e-4)
        True
    """
    basis = dct_basis(xy.shape[0], count, dtype=xy.dtype, device=xy.device)
    design = torch.einsum("fij,fk->fikj", rotations[:, :2], basis).flatten(2).flatten(0, 1)
    fitted = torch.linalg.pinv(design) @ xy.mT.flatten(0, 1)
    return torch.einsum("fk,kip->fpi", basis, fitted.unflatten(0, (count, 3)))


def _solve(item: Tracks, rank: int, generator: torch.Generator) -> Reconstruction:
    data = observe(item)
    require_complete(data, "pta")
    translation = data.xy.mean(1)
    centred = data.xy - translation[:, None]
    scaled = item.intrinsics is not None
    found = gram_upgrade(centred.mT.flatten(0, 1), 3 * rank, scaled=scaled)
    count = min(rank, item.frames)
    shapes = cosine_shapes(centred / found.scale[:, None, None], found.rotations, count)
    return conclude(
        data,
        shapes @ found.rotations.mT,
        found.rotations,
        found.scale,
        translation,
        rank=rank,
        complaint=None if found.converged else "the metric upgrade still improved at its iteration limit",
        summary=f"{count} cosines, upgrade residual {found.residual:.1e}",
    )


def pta(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Trajectory-space factorisation of complete tracks; any leading batch.

    Args:
        tracks: every point seen in every frame; with intrinsics the views are weak perspective.
        rank: K, the number of cosines.
        generator: not used; the method has no random part.

    Raises:
        ReconError: an entry is missing.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> shape = torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.1]))
        >>> rec = pta(Tracks((shape @ turn.mT)[..., :2]), 1)
        >>> bool((rec.reproject() - (shape @ turn.mT)[..., :2]).abs().max() < 1e-3), rec.status.code
        (True, 'ok')
    """
    return solve_items(tracks, rank, _solve, generator)
