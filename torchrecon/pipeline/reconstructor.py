"""Tracks in, reconstruction out: rank, then solver."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import nn

from torchrecon.errors import ReconError
from torchrecon.measurement import Reconstruction, ShapePrior, Solver, Tracks
from torchrecon.nrsfm import get_solver
from torchrecon.nrsfm.with_prior import with_prior
from torchrecon.rank import estimate_rank

__all__ = ["Reconstructor", "reconstruct"]


def reconstruct(
    tracks: Tracks,
    rank: int | Literal["auto"] = "auto",
    solver: str | Solver = "auto",
    prior: ShapePrior | None = None,
    generator: torch.Generator | None = None,
) -> Reconstruction:
    """Non-rigid structure from motion with one configuration and no K given.

    Args:
        tracks: any leading batch dimensions; entries that are not visible are never read.
        rank: number of shape bases K, the mean shape counted; ``"auto"`` takes
            :func:`torchrecon.estimate_rank`.
        solver: a name from ``torchrecon.nrsfm``, or a callable of the ``Solver`` protocol.
        prior: a learned shape prior (:func:`torchrecon.models.prior.load_prior`), for tracks with named human joints:
            where the view does not determine the shape the depth is the prior's, elsewhere it sharpens the answer.
        generator: source of all randomness; None means a fixed seed, so the answer is always the same.

    Returns:
        Reconstruction: with ``status`` saying in words whether the data determine the answer.

    Raises:
        ReconError: unknown solver, a rank that is no positive integer, unusable tracks, points that the prior does not
            know.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(12, 3, generator=g)
        >>> angle = torch.linspace(0, 3, 20)
        >>> c, s, o = angle.cos(), angle.sin(), torch.zeros(20)
        >>> turn = torch.stack([c, o, s, o, o + 1, o, -s, o, c], -1).reshape(20, 3, 3)
        >>> rec = reconstruct(Tracks((shape @ turn.mT)[..., :2]), rank=1, solver="rigid")
        >>> rec.points3d.shape, rec.status.code
        (torch.Size([20, 12, 3]), 'ok')
    """
    solve = get_solver(solver) if isinstance(solver, str) else solver
    if prior is not None:
        if not callable(prior):
            raise ReconError(
                f"prior: {type(prior).__name__} is no shape prior; torchrecon.models.prior.load_prior gives one"
            )
        solve = with_prior(solve, prior)
    if rank == "auto":
        estimate = estimate_rank(tracks.detach(), generator=generator)
        answer = solve(tracks, estimate.rank, generator=generator)
        return replace(answer, deformation_degree=estimate.deformation_degree)
    if isinstance(rank, bool) or not isinstance(rank, int) or rank < 1:
        raise ReconError(f"rank: {rank!r} is neither 'auto' nor a positive integer")
    return solve(tracks, rank, generator=generator)


class Reconstructor(nn.Module):
    """:func:`reconstruct` as a module, to be dropped into larger models.

    Example:
        >>> Reconstructor(rank=2, solver="rigid")
        Reconstructor(rank=2, solver='rigid')
    """

    def __init__(
        self,
        rank: int | Literal["auto"] = "auto",
        solver: str | Solver = "auto",
        prior: ShapePrior | None = None,
    ) -> None:
        super().__init__()
        self.rank: int | Literal["auto"] = rank
        self.solver = solver
        self.prior = prior

    def forward(self, tracks: Tracks, generator: torch.Generator | None = None) -> Reconstruction:
        """The same as ``reconstruct(tracks, rank, solver, prior, generator)``."""
        return reconstruct(tracks, self.rank, self.solver, self.prior, generator)

    def extra_repr(self) -> str:
        return f"rank={self.rank!r}, solver={self.solver!r}"
