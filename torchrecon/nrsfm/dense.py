"""Dense sequences: shapes from some of the points, all others by regression; linear in the number of points.

A sample of the points gives cameras and the few numbers per frame that a low-rank shape has. Given those, the path of
every other point is linear in its own rest position and loadings, whose prior is what the sample has: one small ridge
regression per point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.linalg.noise_edge import difference_noise
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import mirror_sign

__all__ = ["DenseParams", "solve_dense"]


@dataclass(frozen=True)
class DenseParams:
    """Parameters of the dense solve.

    Attributes:
        most: points that are solved in one piece (count).
        sample: points that are solved first where there are more (count).
        modes: deformation modes that the others may follow, at most (count).
        energy: share of the sample's deformation that the modes leave out (no unit).
        rounds: of refitting the sample with the residual that it left (count).
        chunk: points whose regressions are solved at once (count).
    """

    most: int = 600
    sample: int = 300
    modes: int = 40
    energy: float = 1e-5
    rounds: int = 10
    chunk: int = 512


def _temporal(canonical: Float[Tensor, "frames points 3"], params: DenseParams) -> tuple[Tensor, Tensor]:
    """Weights (frames, 1 + modes), the first of them one, and the variance of their coefficients (1 + modes)."""
    points = canonical.shape[1]
    mean = canonical.mean(0)
    u, s, _ = torch.linalg.svd((canonical - mean).flatten(1), full_matrices=False)
    left = 1 - s.square().cumsum(0) / s.square().sum().clamp_min(torch.finfo(s.dtype).tiny)
    modes = min(params.modes, int((left > params.energy).sum()) + 1, len(s))
    weights = torch.cat([torch.ones_like(u[:, :1]), u[:, :modes]], 1)
    variance = torch.cat([mean.square().sum()[None], s[:modes].square()]) / (3 * points)
    return weights, variance


def solve_dense(
    item: Tracks,
    rank: int,
    generator: torch.Generator,
    solve_one: Callable[[Tracks, int, torch.Generator], Reconstruction],
    params: DenseParams | None = None,
) -> Reconstruction:
    """One orthographic sequence (batch ``()``) of many points, by ``solve_one`` on a sample of them.

    The covariance takes cameras and weights as known.
    """
    params = params or DenseParams()
    seen = item.visible.sum(0)
    # Points that are seen as long as most are, in random order: no rule that outliers could win.
    order = torch.randperm(item.points, generator=generator).to(seen.device)
    order = order[seen[order] >= seen.double().median()][: params.sample]
    base = solve_one(item.select(points=order), rank, generator)
    weights, variance = _temporal(base.canonical.detach(), params)
    scaled = base.scale[:, None, None] * base.rotations
    # Unknowns of a point: rest position and loadings, (1 + modes, 3) in a row.
    camera = torch.einsum("fk,fac->fakc", weights, scaled).flatten(2)
    target = item.xy - base.translation[:, None]
    ridge = torch.diag(1 / variance.clamp_min(1e-9 * variance.amax()).repeat_interleave(3))
    left, least = 1e-4 * variance.sum(), 1e-9 * variance.sum()  # below that the regressions are singular in float64
    for _ in range(params.rounds):
        fitted, _ = _regression(camera, target[:, order], item.visible[:, order], ridge, left)
        left = (fitted[..., :2] - target[:, order])[item.visible[:, order]].square().mean().clamp_min(least)
    noise = torch.minimum(left, _noise(item))
    gain = 1 - noise / left.clamp_min(torch.finfo(left.dtype).tiny)
    points3d, covariance = [], []
    for some in torch.arange(item.points, device=seen.device).split(params.chunk):
        visible = item.visible[:, some]
        fitted, spread = _regression(camera, target[:, some], visible, ridge, left)
        trusted = gain * visible[..., None].to(gain.dtype)
        rest = torch.where(visible[..., None], target[:, some] - fitted[..., :2], gain.new_zeros(()))
        points3d.append(torch.cat([fitted[..., :2] + trusted * rest, fitted[..., 2:]], -1))
        kept = 1 - torch.nn.functional.pad(trusted.expand(*visible.shape, 2), (0, 1))
        covariance.append(kept[..., None] * spread * kept[..., None, :] + torch.diag_embed((left - noise) * kept))
    points, scale = torch.cat(points3d, 1), base.scale
    result = Reconstruction.from_points(
        points / scale[:, None, None],
        base.rotations,
        rank=rank,
        status=replace(
            base.statuses[0], text=f"{base.statuses[0].text}; {len(order)} of {item.points} points give the cameras"
        ),
        scale=scale,
        translation=base.translation + points[..., :2].mean(1),
        covariance3d=torch.cat(covariance, 1) / scale[:, None, None, None].square(),
        observed=item.visible,
    )
    return result if float(mirror_sign(result.points3d)) > 0 else result.mirrored()


def _noise(item: Tracks) -> Tensor:
    """Mean noise variance of a coordinate: as given, or read off third differences."""
    if item.covariance is None:
        return difference_noise(item.xy, item.visible)
    return item.covariance[item.visible].diagonal(dim1=-2, dim2=-1).mean()


def _regression(
    camera: Float[Tensor, "frames 3 unknowns"],
    target: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    ridge: Float[Tensor, "unknowns unknowns"],
    variance: Float[Tensor, ""],
) -> tuple[Float[Tensor, "frames points 3"], Float[Tensor, "frames points 3 3"]]:
    """Posterior mean of the points in camera axes, scale included, and covariance of what the unknowns leave open."""
    plane = camera[:, :2]
    seen = torch.where(visible[..., None], target, target.new_zeros(()))
    gram = plane.mT @ plane
    whole = bool(visible.all())
    system = gram.sum(0)[None] if whole else torch.einsum("fp,fnm->pnm", visible.to(gram.dtype), gram)
    inverse = torch.linalg.inv(system / variance + ridge)
    pull = torch.einsum("fan,fpa->pn", plane, seen) / variance
    unknowns = (inverse @ pull[..., None])[..., 0]
    spread = torch.einsum("fan,pnm->fpam", camera, inverse) @ camera.mT[:, None]
    return torch.einsum("fan,pn->fpa", camera, unknowns), spread.expand(-1, target.shape[1], -1, -1)
