"""Low-rank model of tracks with gaps: probabilistic principal components, fitted by expectation-maximisation.

A point's observations in all frames are one sample of 2F numbers, of which only those are used that were seen:
``x_p = t + A b_p + noise`` with ``b_p ~ N(0, I)``. The prior on ``b_p`` is what keeps a point that was seen in a few
frames from being thrown far away in the others, and it gives every prediction a variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["FactorModel", "fit_factors", "grow_factors", "start_factors"]


@dataclass(frozen=True, eq=False)
class FactorModel:
    """``x_fp = t_f + A_f b_p`` with isotropic noise.

    Attributes:
        rows: A, (frames, 2, rank).
        shift: t, (frames, 2) pixels.
        points: posterior means b, (points, rank).
        spread: posterior covariances of b, (points, rank, rank).
        noise: variance of an observed coordinate about the model, px^2.
    """

    rows: Float[Tensor, "frames 2 rank"]
    shift: Float[Tensor, "frames 2"]
    points: Float[Tensor, "points rank"]
    spread: Float[Tensor, "points rank rank"]
    noise: float

    def predict(self) -> Float[Tensor, "frames points 2"]:
        """Value of every entry, seen or not."""
        return torch.einsum("fck,pk->fpc", self.rows, self.points) + self.shift[:, None]

    def variance(self) -> Float[Tensor, "frames points 2 2"]:
        """Covariance of every predicted entry, without the noise of an observation."""
        return torch.einsum("fck,pkl,fdl->fpcd", self.rows, self.spread, self.rows)


def start_factors(xy: Float[Tensor, "frames points 2"], visible: Bool[Tensor, "frames points"]) -> FactorModel:
    """Model of rank 0: a translation per frame that follows the points common to neighbouring frames.

    A mean over the points of each frame would jump when points appear and disappear; steps between frames do not.
    """
    weight = visible.to(xy.dtype)
    clean = torch.where(visible[..., None], xy, torch.zeros_like(xy))
    common = weight[1:] * weight[:-1]
    count = common.sum(1)
    step = ((clean[1:] - clean[:-1]) * common[..., None]).sum(1) / count.clamp(min=1)[:, None]
    path = torch.cat([torch.zeros_like(step[:1]), step.cumsum(0)])
    offset = ((clean - path[:, None]) * weight[..., None]).sum((0, 1)) / weight.sum()
    shift = path + offset
    residual2 = (((clean - shift[:, None]) * weight[..., None]) ** 2).sum() / (2 * weight.sum())
    points = xy.shape[1]
    return FactorModel(
        xy.new_zeros(xy.shape[0], 2, 0), shift, xy.new_zeros(points, 0), xy.new_zeros(points, 0, 0), float(residual2)
    )


def grow_factors(
    model: FactorModel, xy: Float[Tensor, "frames points 2"], visible: Bool[Tensor, "frames points"], more: int
) -> FactorModel:
    """Add ``more`` directions: the leading ones of the residuals, unseen entries counted as zero."""
    residual = torch.where(visible[..., None], xy - model.predict(), torch.zeros_like(xy))
    matrix = residual.transpose(1, 2).flatten(0, 1)
    values, vectors = torch.linalg.eigh(matrix @ matrix.T)
    leading = vectors[:, -more:].flip(-1) * values[-more:].flip(-1).clamp(min=0).sqrt()
    # per sample, and as if the seen share of the entries were all of them
    scale = (xy.shape[1] * float(visible.to(xy.dtype).mean())) ** -0.5
    rows = torch.cat([model.rows, (leading * scale).view(xy.shape[0], 2, more)], -1)
    rank = rows.shape[-1]
    points = xy.new_zeros(xy.shape[1], rank)
    return FactorModel(rows, model.shift, points, xy.new_zeros(xy.shape[1], rank, rank), model.noise)


def fit_factors(
    model: FactorModel,
    xy: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    iterations: int = 30,
    tolerance: float = 1e-4,
) -> FactorModel:
    """Expectation-maximisation from a given model; entries that are not visible are never read.

    Args:
        model: start, of :func:`grow_factors` or an earlier fit.
        iterations: at most this many.
        tolerance: stop when the noise variance changes by less than this fraction.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> truth = torch.einsum("fck,pk->fpc", torch.randn(20, 2, 3, generator=g), torch.randn(40, 3, generator=g))
        >>> seen = torch.rand(20, 40, generator=g) > 0.2
        >>> model = grow_factors(start_factors(truth, seen), truth, seen, 3)
        >>> fit = fit_factors(model, truth, seen, 200)
        >>> bool((fit.predict() - truth).abs().max() < 0.05)
        True
    """
    frames, points = visible.shape
    rank = model.rows.shape[-1]
    weight = visible.to(xy.dtype)
    clean = torch.where(visible[..., None], xy, torch.zeros_like(xy))
    observed = 2 * float(weight.sum())
    smallest = float((clean**2).mean()) * torch.finfo(xy.dtype).eps ** 1.5
    rows, shift, noise = model.rows, model.shift, max(model.noise, smallest)
    eye = torch.eye(rank, dtype=xy.dtype, device=xy.device)
    bordered = torch.eye(rank + 1, dtype=xy.dtype, device=xy.device)

    def expect() -> tuple[Tensor, Tensor]:
        gram = torch.einsum("fck,fcl->fkl", rows, rows).flatten(1)
        normal = (weight.T @ gram).view(points, rank, rank) + noise * eye
        centred = (clean - shift[:, None]) * weight[..., None]
        right = centred.transpose(0, 1).flatten(1) @ rows.flatten(0, 1)
        factor = torch.linalg.cholesky(normal)
        return torch.cholesky_solve(right[..., None], factor)[..., 0], noise * torch.cholesky_inverse(factor)

    means, spread = expect()
    for _ in range(iterations):
        # every frame is regressed on [b, 1]
        design = torch.cat([means, torch.ones_like(means[:, :1])], -1)
        second = design[:, :, None] * design[:, None, :]
        second[:, :rank, :rank] += spread
        left = (weight @ second.flatten(1)).view(frames, rank + 1, rank + 1)
        target = torch.stack([(clean[..., axis] * weight) @ design for axis in (0, 1)], -1)
        # the ridge only matters in frames with fewer points than unknowns
        ridge = 1e-9 * (1 + left.diagonal(dim1=1, dim2=2).amax(1))
        solution = torch.linalg.solve(left + ridge[:, None, None] * bordered, target)
        rows, shift = solution[:, :rank].transpose(1, 2), solution[:, rank]
        residual = (clean - torch.einsum("fck,pk->fpc", rows, means) - shift[:, None]) * weight[..., None]
        gram = torch.einsum("fck,fcl->fkl", rows, rows).flatten(1)
        loose = float(((weight.T @ gram) * spread.flatten(1)).sum())
        previous, noise = noise, max((float((residual**2).sum()) + loose) / observed, smallest)
        means, spread = expect()
        if abs(previous - noise) < tolerance * previous:
            break
    return FactorModel(rows, shift, means, spread, noise)
