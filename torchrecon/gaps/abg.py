"""The paper's filler: coasting with the alpha-beta-gamma filter (eqs. 28-30). Causal, for online use."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.gaps.base import Gaps, Guess
from torchrecon.statespace import abg_covariance, abg_gains, abg_predict, abg_tracking_index, abg_update

__all__ = ["fill_abg"]

_ALPHAS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
# innovations before this many observations of a point only show that its start was not known
_SETTLED = 6


def fill_abg(gaps: Gaps, alpha: float | None = None) -> Guess:
    """Predicted positions of a filter that saw only the past.

    A point starts at its first observation, takes its velocity from the first two, and coasts through every unseen
    frame with its last velocity and acceleration; this is the paper's rule, and it leaves the image in long gaps.
    Frames before the first observation have no past: there the same filter, run backward in time, is used.

    Args:
        alpha: position gain; None takes the one with the smallest one-step innovation on the observed samples.
    """
    if alpha is None:
        errors = [_run(gaps.xy, gaps.visible, gaps.steps, a)[1] for a in _ALPHAS]
        alpha = _ALPHAS[min(range(len(_ALPHAS)), key=errors.__getitem__)]
    forward, _ = _run(gaps.xy, gaps.visible, gaps.steps, alpha)
    backward, _ = _run(gaps.xy.flip(0), gaps.visible.flip(0), gaps.steps[::-1], alpha)
    started = gaps.visible.to(torch.int64).cumsum(0) > 0
    xy = torch.where(started[..., None], forward, backward.flip(0))
    since = torch.where(started, _since(gaps.visible), _since(gaps.visible.flip(0)).flip(0))
    return Guess(xy, coasting_growth(alpha, gaps.variance, since), ~gaps.inside | (since > 1))


def coasting_growth(
    alpha: float, variance: Float[Tensor, "frames points"], frames_since: Tensor
) -> Float[Tensor, "frames points"]:
    """Variance of a position predicted some frames ahead, px^2: steady-state state error carried on by the model.

    Example:
        >>> import torch
        >>> growth = coasting_growth(0.5, torch.ones(3, 1), torch.tensor([[0], [1], [2]]))
        >>> growth[0].item(), bool(growth[1] < growth[2])
        (0.0, True)
    """
    longest = int(frames_since.max()) if frames_since.numel() else 0
    cov = abg_covariance(torch.tensor(alpha, dtype=torch.float64)).to(variance)
    kick = cov.new_tensor([0.5, 1.0, 1.0])
    process = float(abg_tracking_index(alpha)) ** 2 * torch.outer(kick, kick)
    step = cov.new_tensor([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    ahead = [cov.new_zeros(())]
    for _ in range(longest):
        cov = step @ cov @ step.T + process
        ahead.append(cov[0, 0])
    return variance * torch.stack(ahead)[frames_since]


def _since(visible: Tensor) -> Tensor:
    """Frames since the last observation; 0 where visible and before the first."""
    order = torch.arange(len(visible), device=visible.device)[:, None]
    last = torch.where(visible, order, -1).cummax(0).values
    return torch.where(last < 0, 0, order - last)


def _run(xy: Tensor, visible: Tensor, steps: list[float], alpha: float) -> tuple[Tensor, float]:
    """Filter forward: the prediction of every entry (the measurement at the start), and the mean squared innovation."""
    gains = abg_gains(torch.tensor(alpha, dtype=xy.dtype))
    nan = xy.new_tensor(float("nan"))
    state = xy.new_zeros(*xy.shape[1:], 3)
    seen = torch.zeros_like(visible[0], dtype=torch.int64)
    last = torch.zeros_like(seen)
    clock = [0.0]
    for step in steps:
        clock.append(clock[-1] + step)
    times = xy.new_tensor(clock)
    out, total, used = [], 0.0, 0
    for frame in range(len(xy)):
        now = visible[frame]
        predicted = abg_predict(state, steps[frame - 1]) if frame else state
        predicted = torch.where((seen > 0)[:, None, None], predicted, state)
        count = now & (seen >= _SETTLED)
        total += float(((xy[frame] - predicted[..., 0])[count] ** 2).sum())
        used += int(count.sum())
        measured = torch.where(now[:, None], xy[frame], nan)
        updated = abg_update(predicted, measured, gains, steps[frame - 1] if frame else 1.0)
        fresh = torch.nn.functional.pad(xy[frame][..., None], (0, 2))
        elapsed = (times[frame] - times[last]).clamp(min=1e-9)[:, None]
        velocity = (xy[frame] - state[..., 0]) / elapsed
        # until the second observation a point stands still, so its state still holds the first one
        second = torch.stack([xy[frame], velocity, torch.zeros_like(velocity)], -1)
        state = torch.where((now & (seen == 0))[:, None, None], fresh, updated)
        state = torch.where((now & (seen == 1))[:, None, None], second, state)
        out.append(torch.where((seen > 0)[:, None], predicted[..., 0], xy[frame]))
        seen = seen + now
        last = torch.where(now, frame, last)
    return torch.stack(out), total / max(used, 1)
