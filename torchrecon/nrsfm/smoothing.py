"""Noisy tracks made smoother before shapes are sought: what time says, said before what space says.

A factorisation takes frames for independent draws; a moving body is filmed often enough that they are not. Every
coordinate is a Gaussian process whose power spectrum over cosine frequencies is read off all tracks together, less
that of the noise; the smoothed track is its posterior mean (a Wiener filter with gaps), with its posterior variance.
Exact tracks, and motion as fast as the frames, pass as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg.dct import dct_basis
from torchrecon.linalg.noise_edge import difference_noise
from torchrecon.nrsfm.shape_likelihood import Views

__all__ = ["SmoothingParams", "smoothed"]


@dataclass(frozen=True)
class SmoothingParams:
    """Parameters of the smoothing.

    Attributes:
        width: half-width of the average over frequencies, share of the frequency (no unit).
        least_width: half-width at low frequencies (frequencies).
        least_gain: share of a frequency's power that has to be signal for the frequency to be kept (no unit).
        worth: least reduction of the noise variance for which tracks are smoothed at all (share).
    """

    width: float = 0.125
    least_width: int = 2
    least_gain: float = 0.05
    worth: float = 0.1


def _spectrum(power: Float[Tensor, " frames"], params: SmoothingParams) -> Float[Tensor, " frames"]:
    """Average over neighbouring frequencies, wider at the high ones."""
    k = torch.arange(len(power), device=power.device)
    half = (params.width * k).long().clamp_min(params.least_width)
    total = torch.nn.functional.pad(power.cumsum(0), (1, 0))
    low, high = (k - half).clamp_min(0), (k + half + 1).clamp_max(len(power))
    return (total[high] - total[low]) / (high - low)


def smoothed(views: Views, complete: Float[Tensor, "frames points 2"], params: SmoothingParams | None = None) -> Views:
    """Smoother views of one sequence, with the covariance that is left; unseen entries stay unseen.

    Args:
        views: batch ``()``.
        complete: the same tracks with their gaps filled, from which the spectrum is read.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> time = torch.linspace(0, 6, 200, dtype=torch.float64)[:, None, None]
        >>> exact = torch.sin(time + torch.arange(80, dtype=torch.float64).view(1, 40, 2))
        >>> noisy = exact + 0.1 * torch.randn(200, 40, 2, generator=g, dtype=torch.float64)
        >>> noise = 0.01 * torch.eye(2, dtype=torch.float64).expand(200, 40, 2, 2)
        >>> calm = smoothed(Views(noisy, torch.ones(200, 40, dtype=torch.bool), noise), noisy)
        >>> bool((calm.xy - exact).square().mean() < 0.2 * (noisy - exact).square().mean())
        True
    """
    params = params or SmoothingParams()
    frames = len(complete)
    variance = views.noise.diagonal(dim1=-2, dim2=-1).mean(-1)
    weight = views.visible.to(variance.dtype)
    # Filled entries bring less noise than measured ones.
    floor = difference_noise(complete, torch.ones_like(views.visible))
    noise = torch.minimum((variance * weight).sum() / weight.sum(), floor)
    # What all points do together is free in the model of the shapes: a shaking camera does not hide a calm body.
    middle = complete.mean(1, keepdim=True)
    middle = middle + (complete - middle).mean(0, keepdim=True)
    basis = dct_basis(frames, frames, dtype=variance.dtype, device=variance.device)
    power = _spectrum((basis.mT @ (complete - middle).flatten(1)).square().mean(1), params)
    gain = (1 - noise / power.clamp_min(torch.finfo(power.dtype).tiny)).clamp(0, 1)
    kept = gain.detach() > params.least_gain
    # Where no frequency stands above the noise, time says nothing; a prior of nothing would say that all stands still.
    if not bool(kept.any()) or float(gain.detach()[kept].sum()) > (1 - params.worth) * frames:
        return views
    basis, prior = basis[:, kept], (gain * power)[kept]
    precision = weight / variance.clamp_min(torch.finfo(variance.dtype).tiny)
    system = torch.einsum("fk,fp,fl->pkl", basis, precision, basis) + torch.diag(1 / prior)
    factor = torch.linalg.cholesky(system)
    target = torch.einsum("fk,fpa->pka", basis, precision[..., None] * (views.xy - middle))
    xy = middle + torch.einsum("fk,pka->fpa", basis, torch.cholesky_solve(target, factor))
    root = torch.linalg.solve_triangular(factor, basis.mT.expand(len(factor), -1, -1), upper=False)
    left = (root.square().sum(1).mT / variance).clamp_max(1.0)
    return Views(xy, views.visible, views.noise * left[..., None, None])
