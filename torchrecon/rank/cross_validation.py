"""Cross-validation: the number of bases that predicts held-out observations best. Takes any pattern of gaps."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.linalg.missing_factors import FactorModel, fit_factors, grow_factors, start_factors

__all__ = ["CrossValidationParams", "HeldOut", "cross_validate"]


@dataclass(frozen=True)
class CrossValidationParams:
    """Parameters of :func:`cross_validate`.

    Attributes:
        share: fraction of the observations that is held out.
        most_points: more points than this are thinned out at random; they all say the same about K.
        iterations: of the fit at each K.
        patience: stop after this many K without a better prediction.
        trim: largest share of held-out errors that is left out, so that a few lost tracks do not decide.
    """

    share: float = 0.05
    most_points: int = 500
    iterations: int = 60
    patience: int = 2
    trim: float = 0.05


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Result of :func:`cross_validate`.

    Attributes:
        rank: the smallest K that predicts as well as the best one, up to one standard error.
        interval: smallest and largest K within two standard errors of the best.
        errors: held-out root mean square error per coordinate for K = 1, 2, ..., pixels (or whitened).
        model: fit at ``rank`` to the observations that were not held out.
    """

    rank: int
    interval: tuple[int, int]
    errors: tuple[float, ...]
    model: FactorModel


def cross_validate(
    xy: Float[Tensor, "frames points 2"],
    visible: Bool[Tensor, "frames points"],
    most: int,
    generator: torch.Generator | None = None,
    params: CrossValidationParams | None = None,
) -> HeldOut:
    """Fit ``3K`` factors and a translation for K = 1, 2, ... and compare what they say about hidden observations.

    Args:
        xy: float64; entries that are not visible are never read.
        most: largest K to try.
        generator: draws which observations are held out; None: seed 0.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> a, b = torch.randn(40, 2, 3, generator=g).double(), torch.randn(50, 3, generator=g).double()
        >>> xy = torch.einsum("fck,pk->fpc", a, b) + 0.05 * torch.randn(40, 50, 2, generator=g).double()
        >>> cross_validate(xy, torch.rand(40, 50, generator=g) > 0.2, 4).rank
        1
    """
    params = params or CrossValidationParams()
    generator = generator if generator is not None else torch.Generator().manual_seed(0)
    if xy.shape[1] > params.most_points:
        chosen = torch.randperm(xy.shape[1], generator=generator)[: params.most_points].to(xy.device)
        xy, visible = xy[:, chosen], visible[:, chosen]
    draw = torch.where(visible, torch.rand(visible.shape, generator=generator).to(visible.device), 2.0)
    # an exact number, so that a short sequence is never judged by nothing
    count = max(5, round(params.share * int(visible.sum())))
    held = draw <= draw.flatten().kthvalue(count).values
    train = visible & ~held
    model = start_factors(xy, train)
    squared: list[Tensor] = []
    models: list[FactorModel] = []
    best, best_k = float("inf"), 0
    for k in range(1, most + 1):
        model = fit_factors(grow_factors(model, xy, train, 3), xy, train, params.iterations, 1e-3)
        squared.append(((model.predict() - xy) ** 2).sum(-1)[held] / 2)
        models.append(model)
        error = float(_trimmed(squared[-1], params.trim).mean())
        if error < best:
            best, best_k = error, k
        elif k - best_k >= params.patience:
            break
    winner = squared[best_k - 1]
    # paired over the same observations; the largest errors of either model stay out of both
    keep = torch.maximum(winner, squared[0]) <= torch.quantile(torch.maximum(winner, squared[0]), 1 - params.trim)
    close: dict[float, list[int]] = {1.0: [], 2.0: []}
    for k, candidate in enumerate(squared, 1):
        difference = (candidate - winner)[keep]
        chance = float(difference.std()) / max(len(difference), 1) ** 0.5 if k != best_k else 0.0
        for sigmas, members in close.items():
            if float(difference.mean()) <= sigmas * chance:
                members.append(k)
    rank = min(close[1.0])
    errors = tuple(float(_trimmed(e, params.trim).mean()) ** 0.5 for e in squared)
    return HeldOut(rank, (min(close[2.0]), max(close[2.0])), errors, models[rank - 1])


def _trimmed(errors: Tensor, share: float) -> Tensor:
    return errors.sort().values[: max(1, int(len(errors) * (1 - share)))]
