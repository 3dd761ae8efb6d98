"""Kalman filter and Rauch-Tung-Striebel smoother of a given linear model whose whole state is measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["LinearModel", "SmoothedStates", "smooth_states"]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """``z[t+1] = step z[t] + offset + N(0, process)``, measured as ``z[t] + N(0, noise)``; ``z[0] ~ N(mean, spread)``.

    Attributes:
        step: (states, states).
        offset: (states).
        process: (states, states) covariance of what the model does not predict.
        noise: (states, states) covariance of a measurement.
        mean, spread: (states), (states, states) of the first state before anything is seen.
    """

    step: Float[Tensor, "states states"]
    offset: Float[Tensor, " states"]
    process: Float[Tensor, "states states"]
    noise: Float[Tensor, "states states"]
    mean: Float[Tensor, " states"]
    spread: Float[Tensor, "states states"]


@dataclass(frozen=True, eq=False)
class SmoothedStates:
    """What all measurements together say about each state.

    Attributes:
        mean: (frames, states).
        covariance: (frames, states, states).
        log_likelihood: of the measurements under the model.
    """

    mean: Float[Tensor, "frames states"]
    covariance: Float[Tensor, "frames states states"]
    log_likelihood: float


def smooth_states(
    values: Float[Tensor, "frames states"], seen: Bool[Tensor, " frames"], model: LinearModel
) -> SmoothedStates:
    """Posterior of every state given all measurements; frames that are not seen are filled from both sides.

    Args:
        values: measurements; rows that are not seen are not read.
        seen: which frames are measured.

    Example:
        >>> import torch
        >>> one = torch.eye(1)
        >>> model = LinearModel(one, torch.zeros(1), one, 1e-6 * one, torch.zeros(1), 100 * one)
        >>> values = torch.tensor([[1.0], [float("nan")], [3.0]])
        >>> out = smooth_states(values, torch.tensor([True, False, True]), model)
        >>> [round(v, 2) for v in out.mean[:, 0].tolist()], bool(out.covariance[1] > out.covariance[0])
        ([1.0, 2.0, 3.0], True)
    """
    identity = torch.eye(len(model.mean), dtype=values.dtype, device=values.device)
    mean, cov = model.mean, model.spread
    predicted, filtered = [], []
    log_likelihood = 0.0
    for frame, here in enumerate(seen.tolist()):
        if frame:
            mean = model.step @ mean + model.offset
            cov = model.step @ cov @ model.step.mT + model.process
        predicted.append((mean, cov))
        if here:
            factor = torch.linalg.cholesky((cov + cov.mT) / 2 + model.noise)
            innovation = values[frame] - mean
            white = torch.linalg.solve_triangular(factor, innovation[:, None], upper=False)
            log_likelihood -= float(white.square().sum() / 2 + factor.diagonal().log().sum())
            log_likelihood -= len(mean) * math.log(2 * math.pi) / 2
            gain = torch.cholesky_solve(cov, factor).mT
            mean = mean + gain @ innovation
            # Joseph's form stays positive
            cov = (identity - gain) @ cov @ (identity - gain).mT + gain @ model.noise @ gain.mT
        filtered.append((mean, cov))
    out = [filtered[-1]]
    for (mean, cov), (ahead, ahead_cov) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        gain = torch.linalg.solve(ahead_cov, model.step @ cov).mT
        after, after_cov = out[-1]
        smooth = cov + gain @ (after_cov - ahead_cov) @ gain.mT
        out.append((mean + gain @ (after - ahead), (smooth + smooth.mT) / 2))
    means, covs = zip(*out[::-1], strict=True)
    return SmoothedStates(torch.stack(means), torch.stack(covs), log_likelihood)
