"""Column space fitting, CSF (Gotardo and Martinez 2011): shape weights that are smooth in time, points eliminated.

Derived: with cameras R_f known the stack is ``W = M B``, where the rows of frame f are ``M_f = w_f (x) R_f[:2]`` and
w_f are the K weights of the shape bases. The weights are ``w = T x`` with T the slowest d cosines, so ``M`` is a
function of the d x K numbers x alone; B follows from x by least squares over the entries that were seen (variable
projection). x starts at the first K cosines, which is the model of trajectory space, and is improved by damped
Gauss-Newton with the bases eliminated from the normal equations; it takes shapes of a given K beyond the K-th cosine.
Recalled, not read: that the original takes its cameras from a metric upgrade, keeps them fixed, and uses about this
many cosines (it chooses them per sequence). Here d is a tenth of the frames always.

What it is not: the cameras are not refined, and shapes that change faster than the d-th cosine are smoothed. With
gaps the cameras come from a low-rank model of the tracks, which needs points that are seen for long. ``rank`` has to
be given sensibly: a K too small takes the cameras with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg.dct import dct_basis
from torchrecon.linalg.gauss_newton import damped_gauss_newton
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.bridging import bridging
from torchrecon.nrsfm.common import conclude, filled
from torchrecon.nrsfm.gram import GramParams, gram_upgrade
from torchrecon.nrsfm.observations import Observations, observe

__all__ = ["CsfParams", "csf"]


@dataclass(frozen=True)
class CsfParams:
    """Parameters of column space fitting.

    Attributes:
        upgrade: of the cameras.
        share: cosines per frame (no unit); never fewer than K and ``fewest``.
        fewest: cosines at least (count).
        iterations: Gauss-Newton steps in each round (count).
        rounds: of weights and translation in turn, where entries are missing; complete tracks need one (count).
        tolerance: relative fall of the cost that ends a round.
        ridge: relative to the mean diagonal of a point's normal matrix; bounds points that were seen in few frames.
    """

    upgrade: GramParams = field(default_factory=GramParams)
    share: float = 0.1
    fewest: int = 4
    iterations: int = 60
    rounds: int = 5
    tolerance: float = 1e-5
    ridge: float = 1e-9


@dataclass(frozen=True, eq=False)
class _Columns:
    """The cost of shape weights, bases eliminated.

    Attributes:
        xy: tracks without translation, in units of the scale of each frame.
        information: inverse covariances; zero where nothing is seen.
        rows: first two rows of the rotations.
        cosines: T, (frames, d).
        ridge: see :class:`CsfParams`.
    """

    xy: Float[Tensor, "frames points 2"]
    information: Float[Tensor, "frames points 2 2"]
    rows: Float[Tensor, "frames 2 3"]
    cosines: Float[Tensor, "frames d"]
    ridge: float

    def weights(self, flat: Float[Tensor, " unknowns"]) -> Float[Tensor, "frames rank"]:
        return self.cosines @ flat.unflatten(0, (self.cosines.shape[1], -1))

    def bases(self, weights: Float[Tensor, "frames rank"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Motion (F, 2, 3K), information times motion, Cholesky factors of the points, and their bases (P, 3K)."""
        motion = torch.einsum("fk,fai->faki", weights, self.rows).flatten(2)
        held = self.information @ motion[:, None]
        normal = torch.einsum("fai,fpaj->pij", motion, held)
        size = normal.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
        size = torch.where(size > 0, self.ridge * size, torch.ones_like(size))
        eye = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
        factor = torch.linalg.cholesky(normal + size * eye)
        right = torch.einsum("fpai,fpa->pi", held, self.xy)
        return motion, held, factor, torch.cholesky_solve(right[..., None], factor)[..., 0]

    def shapes(self, flat: Float[Tensor, " unknowns"]) -> Float[Tensor, "frames points 3"]:
        weights = self.weights(flat)
        bases = self.bases(weights)[3].unflatten(-1, (-1, 3))
        return torch.einsum("fk,pki->fpi", weights, bases)

    def evaluate(self, flat: Float[Tensor, " unknowns"]) -> tuple[Tensor, Tensor, Tensor]:
        """Cost, gradient and Gauss-Newton matrix in x: the joint one with the bases, less its Schur complement."""
        weights = self.weights(flat)
        motion, held, factor, bases = self.bases(weights)
        residual = self.xy - torch.einsum("fai,pi->fpa", motion, bases)
        slope = torch.einsum("fai,pki->fpak", self.rows, bases.unflatten(-1, (-1, 3)))
        weighted = self.information @ slope
        gradient = self.cosines.mT @ -torch.einsum("fpak,fpa->fk", weighted, residual)
        own = torch.einsum("fpak,fpal->fkl", slope, weighted)
        own = torch.einsum("fd,fkl,fe->dkel", self.cosines, own, self.cosines).flatten(2).flatten(0, 1)
        mixed = torch.einsum("fpak,fpai->fpki", slope, held)
        mixed = torch.einsum("fd,fpki->pdki", self.cosines, mixed).flatten(1, 2)
        half = torch.linalg.solve_triangular(factor, mixed.mT, upper=False).flatten(0, 1)
        cost = (residual * (self.information @ residual[..., None])[..., 0]).sum()
        return cost, gradient.flatten(), own - half.mT @ half


def _fit(
    data: Observations, rank: int, rotations: Tensor, scale: Tensor, translation: Tensor, params: CsfParams
) -> tuple[Tensor, Tensor, bool]:
    """Canonical shapes, translation and whether the last round converged."""
    frames = len(rotations)
    count = min(frames, max(rank, params.fewest, round(params.share * frames)))
    cosines = dct_basis(frames, count, dtype=data.xy.dtype, device=data.xy.device)
    flat = torch.eye(count, rank, dtype=data.xy.dtype, device=data.xy.device).flatten() * frames**0.5
    rows, factor = rotations[:, :2], scale[:, None, None]
    information = data.weight.mT @ data.weight * factor[..., None] ** 2
    complete = bool(data.visible.all())
    # Clean tracks of exactly this rank end at rounding, where the cost falls for ever.
    exact = torch.finfo(flat.dtype).eps * float(information.sum())
    shapes, converged = data.xy, False
    for _ in range(1 if complete else params.rounds):
        columns = _Columns((data.xy - translation[:, None]) / factor, information, rows, cosines, params.ridge)
        flat, _, done = damped_gauss_newton(columns.evaluate, flat, params.iterations, params.tolerance, exact)
        shapes, converged = columns.shapes(flat), bool(done)
        if not complete:
            residual = data.xy - shapes @ rows.mT * factor
            total = information.sum(1)
            pull = (information @ residual[..., None]).sum(1)
            translation = (torch.linalg.pinv(total, hermitian=True) @ pull)[..., 0]
    return shapes, translation, converged


def _solve(item: Tracks, rank: int, generator: torch.Generator, params: CsfParams | None = None) -> Reconstruction:
    params = params or CsfParams()
    data = observe(item)
    xy, translation = filled(data, 3 * rank)
    scaled = item.intrinsics is not None
    found = gram_upgrade((xy - translation[:, None]).mT.flatten(0, 1), 3 * rank, scaled=scaled, params=params.upgrade)
    count = min(rank, item.frames)
    shapes, translation, converged = _fit(data, count, found.rotations, found.scale, translation, params)
    complaint = None
    if not (converged and found.converged):
        part = "metric upgrade" if not found.converged else "fit of the shape weights"
        complaint = f"the {part} still improved at its iteration limit"
    return conclude(
        data,
        shapes @ found.rotations.mT,
        found.rotations,
        found.scale,
        translation,
        rank=rank,
        complaint=complaint,
        summary=f"{count} bases with smooth weights, upgrade residual {found.residual:.1e}",
    )


def csf(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Column space fitting; entries may be missing; any leading batch.

    Args:
        tracks: seen entries only are read; with intrinsics the views are weak perspective.
        rank: K.
        generator: not used; the method has no random part.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> shape = torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.1]))
        >>> rec = csf(Tracks((shape @ turn.mT)[..., :2]), 1)
        >>> bool((rec.reproject() - (shape @ turn.mT)[..., :2]).abs().max() < 1e-3), rec.status.code
        (True, 'ok')
    """
    return solve_items(tracks, rank, bridging(_solve), generator)
