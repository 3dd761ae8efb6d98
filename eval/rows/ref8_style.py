"""Ref. 8-style: one direct, regularised linear solve, truncated by the noise (after Knudsen and Rasmussen 2021).

The original inverts a scattering transform truncated at a radius that the noise level sets: a direct regularisation.
Taken over to tracks: with known rotations the trajectory of a point about its rigid position is a truncated cosine
series, ``X(t) = S + sum_{k < K_t} theta_k(t) a_k``, and its coefficients are one ridge least-squares solve with
weights that grow like (1 + k)^2; K_t ends at the last frequency whose coefficients exceed twice their noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from eval.rows.base import Context, RowOutput, Views, in_camera, with_perspective
from torchrecon._typing import Float, Tensor
from torchrecon.measurement import Tracks

__all__ = ["SeriesParams", "cosines", "series_solve", "solve"]


@dataclass(frozen=True)
class SeriesParams:
    """Parameters of the truncated series."""

    largest: int = 12  # frequencies tried before truncation
    decay: float = 2.0  # ridge weights grow like (1 + k) to this power
    cut: float = 2.0  # a frequency counts while its coefficients exceed this many standard deviations


def cosines(frames: int, count: int) -> Float[Tensor, "frames count"]:
    """The first ``count`` vectors of the orthogonal DCT-II basis, scaled to mean square 1 over the frames."""
    t = (torch.arange(frames) + 0.5) * math.pi / frames
    basis = torch.cos(t[:, None] * torch.arange(count))
    return basis * torch.where(torch.arange(count) == 0, 1.0, math.sqrt(2.0))


def _coefficients(views: Views, count: int, spread: float, decay: float) -> tuple[Tensor, Tensor]:
    """Ridge solution a (points, count, 3) and the part of its standard deviation that measurement noise causes."""
    theta = cosines(views.xy.shape[0], count).to(views.xy)
    camera = views.rotations[:, :2]
    residual = torch.where(views.visible[..., None], views.seen - views.shape @ camera.mT, torch.zeros_like(views.seen))
    design = torch.einsum("fk,fai->faki", theta, camera).flatten(2)  # (frames, 2, 3 count)
    gram = torch.einsum("fp,fan,fam->pnm", views.weight, design, design)
    right = torch.einsum("fan,fpa->pn", design, residual)
    prior = (spread / (1 + torch.arange(count)) ** decay).repeat_interleave(3).to(views.xy)
    ridge = torch.diag(views.noise**2 / prior.square())
    # Without noise the ridge vanishes: the pseudo-inverse then gives the least-norm series through the data.
    inverse = torch.linalg.pinv(gram + ridge, rtol=1e-10, hermitian=True)
    answer = (inverse @ right[..., None])[..., 0].unflatten(-1, (count, 3))
    deviation = views.noise * (inverse @ gram @ inverse).diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    return answer, deviation.unflatten(-1, (count, 3))


def series_solve(views: Views, params: SeriesParams | None = None) -> Float[Tensor, "frames points 3"]:
    """Camera-axes points of the truncated series; the rms misfit of the rigid shape sets the scale of the ridge."""
    p = params or SeriesParams()
    misfit = (views.seen - views.shape @ views.rotations[:, :2].mT)[views.visible]
    spread = float(misfit.square().mean().sqrt())
    if spread == 0.0:
        return in_camera(views, views.shape @ views.rotations.mT)
    answer, deviation = _coefficients(views, p.largest, spread, p.decay)
    signal = answer.square().mean((0, 2)).sqrt()
    above = (signal > p.cut * deviation.square().mean((0, 2)).sqrt()).nonzero()
    count = int(above.max()) + 1 if len(above) else 1
    if count < p.largest:
        answer, _ = _coefficients(views, count, spread, p.decay)
    motion = torch.einsum("fk,pki->fpi", cosines(views.xy.shape[0], count).to(views.xy), answer)
    return in_camera(views, (views.shape + motion) @ views.rotations.mT)


def solve(tracks: Tracks, context: Context) -> RowOutput:
    """The row: truncated cosine series on the shared rotations."""
    return RowOutput(with_perspective(tracks, context.rigid, series_solve), tracks.visible)
