"""Constant-acceleration Kalman filter and Rauch-Tung-Striebel smoother for many series with gaps at once.

The model is the one behind the alpha-beta-gamma gains: the acceleration changes by white noise from frame to frame,
which enters position, velocity and acceleration as ``[dt^2/2, dt, 1]``. Series differ in where they are observed and in
noise, not in model; the coordinates of a point share one covariance recursion.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["Smoothed", "best_tracking_index", "rts_smooth"]

# standard deviations of the unknown start about the first observation, in measurement standard deviations: position,
# velocity per frame, acceleration per frame squared
_START_POSITION = 1e4
_START_VELOCITY = 1e3
_START_ACCELERATION = 1e2
_INDICES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Smoothed positions.

    Attributes:
        position: (frames, series, coords).
        variance: (frames, series), of the position in each coordinate.
    """

    position: Float[Tensor, "frames series coords"]
    variance: Float[Tensor, "frames series"]


def _transition(dt: float, like: Tensor) -> tuple[Tensor, Tensor]:
    step = like.new_tensor([[1.0, dt, dt * dt / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    kick = like.new_tensor([dt * dt / 2, dt, 1.0])
    return step, torch.outer(kick, kick)


def _filter(
    values: Tensor, seen: Tensor, variance: Tensor, index: Tensor, steps: list[float]
) -> tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor], Tensor, Tensor, Tensor]:
    """Forward pass; returns predicted and updated means and covariances, and the innovation statistics per series."""
    frames, series, coords = values.shape
    clean = torch.where(seen[..., None], values, torch.zeros_like(values))
    counts = seen.sum(0).clamp(min=1)
    unit = torch.where(seen, variance, torch.zeros_like(variance)).sum(0) / counts
    process = (index**2 * unit)[:, None, None]
    start = torch.diag(values.new_tensor([_START_POSITION, _START_VELOCITY, _START_ACCELERATION]) ** 2)
    start = start * unit[:, None, None]
    mean, cov = values.new_zeros(series, 3, coords), start
    begun, observed = torch.zeros_like(seen[0]), torch.zeros_like(counts)
    predicted_mean, predicted_cov, means, covs = [], [], [], []
    squares, logs, used = values.new_zeros(series), values.new_zeros(series), values.new_zeros(series)
    for frame in range(frames):
        if frame:
            step, kick = _transition(steps[frame - 1], values)
            mean = torch.where(begun[:, None, None], step @ mean, mean)
            cov = torch.where(begun[:, None, None], step @ cov @ step.T + process * kick, cov)
        first = seen[frame] & ~begun
        if first.any():
            mean = torch.where(first[:, None, None], torch.nn.functional.pad(clean[frame][:, None], (0, 0, 0, 2)), mean)
        predicted_mean.append(mean)
        predicted_cov.append(cov)
        total = cov[:, 0, 0] + variance[frame].clamp(min=1e-300)
        innovation = clean[frame] - mean[:, 0]
        gain = torch.where(seen[frame], 1 / total, torch.zeros_like(total))[:, None] * cov[:, :, 0]
        # the first innovations only tell how unknown the start was
        count = seen[frame] & (observed >= 3)
        squares = squares + torch.where(count, (innovation**2).mean(-1) / total, 0.0)
        logs = logs + torch.where(count, total.log(), 0.0)
        used = used + count
        mean = mean + gain[:, :, None] * innovation[:, None, :]
        cov = cov - gain[:, :, None] * cov[:, None, 0, :]
        cov = (cov + cov.transpose(-1, -2)) / 2
        begun, observed = begun | seen[frame], observed + seen[frame]
        means.append(mean)
        covs.append(cov)
    return predicted_mean, predicted_cov, means, covs, squares, logs, used


def best_tracking_index(
    values: Float[Tensor, "frames series coords"],
    seen: Bool[Tensor, "frames series"],
    variance: Float[Tensor, "frames series"],
    steps: list[float] | None = None,
    scale_known: bool = True,
) -> tuple[Float[Tensor, " series"], float]:
    """Tracking index of each series by innovation likelihood, drawn towards that of all series.

    Args:
        values: float64; entries not seen are never read.
        variance: measurement variance, positive also where nothing is seen.
        steps: frames - 1 time steps; default 1 per frame.
        scale_known: False fits one factor to all variances.

    Returns:
        (index, factor): one index per series, and what the variances have to be multiplied by.
    """
    steps = [1.0] * (len(values) - 1) if steps is None else steps
    # all candidates in one pass: the recursion over frames is what takes the time
    copies, series = len(_INDICES), values.shape[1]
    index = values.new_tensor(_INDICES).repeat_interleave(series)
    *_, squares, logs, used = _filter(
        values.repeat(1, copies, 1), seen.repeat(1, copies), variance.repeat(1, copies), index, steps
    )
    squares, logs, used = (x.view(copies, series) for x in (squares, logs, used))
    total = used[0].sum()
    if not float(total) > 0:
        return values.new_full((values.shape[1],), _INDICES[len(_INDICES) // 2]), 1.0
    factor = values.new_ones(len(_INDICES)) if scale_known else squares.sum(1) / total
    shared = -0.5 * (squares.sum(1) / factor + logs.sum(1) + total * factor.log())
    best = int(shared.argmax())
    scale = float(factor[best].clamp(min=1e-12))
    own = -0.5 * (squares / scale + logs)
    # a short series says little about itself: the mean of all counts as much as ten of its own observations
    score = own + 10 * (own.sum(1) / total)[:, None]
    return values.new_tensor(_INDICES)[score.argmax(0)], scale


def rts_smooth(
    values: Float[Tensor, "frames series coords"],
    seen: Bool[Tensor, "frames series"],
    variance: Float[Tensor, "frames series"],
    index: Float[Tensor, " series"],
    steps: list[float] | None = None,
    memory: float = 4.0,
) -> Smoothed:
    """Smooth every series and fill its gaps from both sides.

    Beyond the first and the last observation of a series a parabola soon leaves the image; there the acceleration is
    dropped and the velocity decays, while the variance keeps growing as the model says.

    Args:
        values: positions, px; float64.
        seen: where they are measured; each series at least once.
        variance: of a measurement, px^2; positive everywhere.
        index: tracking index of each series, ``dt^2 sigma_w / sigma_v`` (see :mod:`torchrecon.statespace.abg`).
        steps: frames - 1 time steps, in frames; default 1.
        memory: time constant of the velocity beyond the ends, frames.

    Example:
        >>> import torch
        >>> t = torch.arange(12, dtype=torch.float64)
        >>> seen = torch.ones(12, 1, dtype=torch.bool)
        >>> seen[5:8] = False
        >>> values = (t**2)[:, None, None]
        >>> out = rts_smooth(values, seen, torch.full((12, 1), 1e-4).double(), torch.tensor([0.1]).double())
        >>> bool((out.position - values).abs().max() < 0.01), bool(out.variance[6] > out.variance[3])
        (True, True)
    """
    steps = [1.0] * (len(values) - 1) if steps is None else steps
    predicted_mean, predicted_cov, means, covs, *_ = _filter(values, seen, variance, index, steps)
    frames = len(values)
    began = seen.to(torch.int64).cumsum(0) > 0
    mean, cov = means[-1], covs[-1]
    out_mean, out_cov = [mean], [cov]
    counts = seen.sum(0).clamp(min=1)
    unit = torch.where(seen, variance, torch.zeros_like(variance)).sum(0) / counts
    process = (index**2 * unit)[:, None, None]
    for frame in range(frames - 2, -1, -1):
        step, kick = _transition(steps[frame], values)
        gain = torch.linalg.solve(predicted_cov[frame + 1], step @ covs[frame]).transpose(-1, -2)
        smooth = means[frame] + gain @ (mean - predicted_mean[frame + 1])
        smooth_cov = covs[frame] + gain @ (cov - predicted_cov[frame + 1]) @ gain.transpose(-1, -2)
        back = torch.linalg.inv(step)
        before = ~began[frame][:, None, None]
        mean = torch.where(before, back @ mean, smooth)
        cov = torch.where(before, back @ (cov + process * kick) @ back.T, smooth_cov)
        cov = (cov + cov.transpose(-1, -2)) / 2
        out_mean.append(mean)
        out_cov.append(cov)
    state = torch.stack(out_mean[::-1])
    spread = torch.stack(out_cov[::-1])[..., 0, 0].clamp(min=0)
    return Smoothed(_held_ends(state, seen, steps, memory), spread)


def _held_ends(state: Tensor, seen: Tensor, steps: list[float], memory: float) -> Tensor:
    """Positions, with decaying velocity before the first and after the last observation."""
    frames = len(seen)
    clock = torch.cat([state.new_zeros(1), state.new_tensor(steps).cumsum(0)])
    order = torch.arange(frames, device=seen.device)[:, None]
    first = torch.where(seen, order, frames).amin(0).clamp(max=frames - 1)
    last = torch.where(seen, order, -1).amax(0).clamp(min=0)
    series = torch.arange(seen.shape[1], device=seen.device)
    position = state[..., 0, :]
    for end, beyond in ((first, order < first), (last, order > last)):
        elapsed = clock[:, None] - clock[end]
        reach = memory * elapsed.sign() * (1 - torch.exp(-elapsed.abs() / memory))
        held = state[end, series, 0] + reach[..., None] * state[end, series, 1]
        position = torch.where(beyond[..., None], held, position)
    return position
