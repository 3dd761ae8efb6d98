"""Noise of tracks that come without a covariance, from what a low-rank model cannot explain."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg.missing_factors import fit_factors, grow_factors, start_factors
from torchrecon.measurement import Tracks

__all__ = ["ResidualParams", "residual_covariance"]

# median of a chi-square variable with two degrees of freedom: what |residual|^2 / variance is compared with
_MEDIAN_CHI2 = 1.3862943611198906


@dataclass(frozen=True)
class ResidualParams:
    """Parameters of :func:`residual_covariance`.

    Attributes:
        bases: K of the model; None stops where a further basis lowers the noise by less than ``gain``.
        most_bases: largest K to try.
        gain: fraction.
        iterations: of the fit at each K.
        min_std: smallest standard deviation that is reported, pixels.
    """

    bases: int | None = None
    most_bases: int = 8
    gain: float = 0.1
    iterations: int = 40
    min_std: float = 1e-3


def residual_covariance(
    tracks: Tracks, params: ResidualParams | None = None
) -> Float[Tensor, "*batch frames points 2 2"]:
    """One isotropic covariance for all observations of a sequence, from the residual of a low-rank fit.

    The model is ``t_f + A_f b_p`` of rank 3K, fitted to the observed entries only. The scale is the median of the
    squared residuals, each divided by the share of it that the fit leaves free, so that a few lost tracks do not
    enter. It is the noise that a factorisation will see: deformation too small or too rare to be modelled counts.

    Args:
        tracks: any pattern of gaps; a covariance in it is ignored.

    Returns:
        px^2, the same matrix for all entries of a sequence.

    Raises:
        ReconError: fewer observations than the smallest model (K = 1) has unknowns.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> a, b = torch.randn(40, 2, 3, generator=g), torch.randn(50, 3, generator=g)
        >>> xy = 20 * torch.einsum("fck,pk->fpc", a, b) + 0.5 * torch.randn(40, 50, 2, generator=g)
        >>> round(float(residual_covariance(Tracks(xy))[0, 0, 0, 0]) ** 0.5, 1)
        0.5
    """
    params = params or ResidualParams()
    lead = tracks.batch_shape
    xy = tracks.filled_xy().detach().to(torch.float64).reshape(-1, tracks.frames, tracks.points, 2)
    visible = tracks.visible.reshape(-1, tracks.frames, tracks.points)
    scale = torch.stack([_variance(xy[i], visible[i], params) for i in range(len(xy))]).view(*lead, 1, 1, 1, 1)
    eye = torch.eye(2, dtype=scale.dtype, device=scale.device)
    return (scale * eye).expand(*lead, tracks.frames, tracks.points, 2, 2).to(tracks.xy.dtype).contiguous()


def _variance(xy: Tensor, visible: Tensor, params: ResidualParams) -> Tensor:
    seen = visible.sum(0) >= 2
    xy, visible = xy[:, seen], visible[:, seen]
    frames, points = visible.shape
    numbers = 2 * int(visible.sum())
    most = params.bases if params.bases is not None else params.most_bases
    model, best = start_factors(xy, visible), None
    for k in range(1, most + 1):
        free = numbers - 2 * frames * (3 * k + 1) - points * 3 * k + 9 * k * k
        if free < max(20, numbers // 5):
            break
        model = fit_factors(grow_factors(model, xy, visible, 3), xy, visible, params.iterations, 1e-3)
        # the share of the numbers that is not used up by unknowns corrects the residual on the whole
        residual2 = ((model.predict() - xy) ** 2).sum(-1)[visible]
        variance = residual2.median() / _MEDIAN_CHI2 * numbers / free
        if best is not None and params.bases is None and float(variance) > (1 - params.gain) * float(best):
            return torch.minimum(best, variance).clamp(min=params.min_std**2)
        best = variance
    if best is None:
        raise ReconError(
            f"tracks: {numbers} observed coordinates of {points} points in {frames} frames are too few to tell noise "
            "from motion; give a covariance"
        )
    return best.clamp(min=params.min_std**2)
