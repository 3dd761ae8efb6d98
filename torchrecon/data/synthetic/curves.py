"""Smooth curves through key values: what the motions are drawn with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.interpolate import CubicSpline, PchipInterpolator

from torchrecon._typing import Float, Tensor

__all__ = ["bridge", "keys", "smooth_noise", "smoothstep", "upper_envelope"]


def keys(
    t: Float[Tensor, " frames"], times: Sequence[float], values: Sequence[object]
) -> Float[Tensor, " frames *rest"]:
    """Monotone cubic through ``(times, values)``, constant outside; it never overshoots a key.

    Args:
        t: where to evaluate, same unit as ``times``.
        values: numbers or vectors of one shape.

    Example:
        >>> import torch
        >>> keys(torch.tensor([0.0, 1.0, 3.0]), [0.0, 2.0], [0.0, 4.0]).tolist()
        [0.0, 2.0, 4.0]
    """
    rows = np.asarray([np.asarray(v, dtype=np.float64) for v in values])
    # A doubled last key makes the slope vanish at both ends, so the constant parts join smoothly.
    first, last = times[0] - 1.0, times[-1] + 1.0
    curve = PchipInterpolator([first, *times, last], np.concatenate([rows[:1], rows, rows[-1:]]))
    return torch.from_numpy(curve(t.double().clamp(times[0], times[-1]).numpy())).to(t.dtype)


def bridge(
    t: Float[Tensor, " n"], times: Sequence[float], values: Sequence[object], start_slope: object, end_slope: object
) -> Float[Tensor, "n 3"]:
    """C2 cubic through vectors with given velocities at both ends (a foot's swing between two plants)."""
    slopes = [np.asarray(s, dtype=np.float64) for s in (start_slope, end_slope)]
    rows = np.asarray([np.asarray(v, dtype=np.float64) for v in values])
    curve = CubicSpline(list(times), rows, bc_type=((1, slopes[0]), (1, slopes[1])))
    return torch.from_numpy(curve(t.double().numpy())).to(t.dtype)


def smoothstep(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """0 below 0, 1 above 1, minimum-jerk between.

    Example:
        >>> import torch
        >>> smoothstep(torch.tensor([-1.0, 0.5, 2.0])).tolist()
        [0.0, 0.5, 1.0]
    """
    x = x.clamp(0, 1)
    return x * x * x * (10 + x * (6 * x - 15))


def smooth_noise(
    t: Float[Tensor, " frames"], generator: torch.Generator | None, frequency: float, channels: int
) -> Float[Tensor, "frames channels"]:
    """Band-limited random sway, standard deviation about 1: five sines up to ``frequency`` hertz."""
    rate = frequency * (0.2 + 0.8 * torch.rand(channels, 5, generator=generator, dtype=torch.float64))
    phase = 2 * torch.pi * torch.rand(channels, 5, generator=generator, dtype=torch.float64)
    wave: Tensor = torch.sin(2 * torch.pi * rate * t.double()[:, None, None] + phase).sum(-1)
    return wave.mul((2 / 5) ** 0.5).to(t.dtype)


def upper_envelope(x: Float[Tensor, " frames"], radius: int) -> Float[Tensor, " frames"]:
    """A smooth curve that is nowhere below ``x``: sliding maximum, then a kernel of the same width."""
    pool = torch.nn.functional.max_pool1d(_edge(x, radius)[None], 2 * radius + 1, stride=1)[0]
    taps = torch.hann_window(2 * radius + 3, periodic=False, dtype=x.dtype)[1:-1]
    smooth: Tensor = torch.nn.functional.conv1d(_edge(pool, radius)[None, None], (taps / taps.sum())[None, None])[0, 0]
    return smooth


def _edge(x: Tensor, radius: int) -> Tensor:
    return torch.cat([x[:1].expand(radius), x, x[-1:].expand(radius)])
