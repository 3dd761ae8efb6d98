"""Tracks whose number of shape bases is known: low-rank bodies under a smooth motion, with noise and gaps.

The grid of section 5.5 of the project's specification: basis 1 with weight 1 +- 0.2, further bases with weights of
standard deviation ``0.5 * 0.8^k``, smooth rotation about three axes. SNR: mean square of the image coordinates about
their centre over the noise variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.linalg import rotation_from_vector
from torchrecon.linalg.noise_edge import spectrum
from torchrecon.measurement import Tracks, stack_matrix

__all__ = ["LowRank", "low_rank_tracks", "smooth_curves"]

_EXTENT = 30.0  # pixels per unit of the shapes
_WANDER = 40.0  # pixels: standard deviation of the body's path in the image
_CENTRE = 300.0  # pixels: where it wanders about


@dataclass(frozen=True, eq=False)
class LowRank:
    """Tracks with ``bases`` shape bases.

    Attributes:
        xy: (frames, points, 2) pixels, with noise, in every frame.
        visible: (frames, points).
        points3d: (frames, points, 3) the bodies without noise, camera axes, centred, pixels.
        sigma: standard deviation of the noise per coordinate, pixels.
        detectable: population eigenvalue of the weakest basis, noise included, over the limit ``1 + sqrt(d / n)``
            below which no rule sees it (Baik, Ben Arous and Peche 2005).
        signal: the same without the noise in either: the weakest eigenvalue over ``sqrt(d / n)``.
    """

    xy: Float[Tensor, "frames points 2"]
    visible: Bool[Tensor, "frames points"]
    points3d: Float[Tensor, "frames points 3"]
    sigma: float
    detectable: float
    signal: float

    def tracks(self, told: float | None = None) -> Tracks:
        """As a container; ``told``: the covariance is given, wrong by this factor on the variance."""
        covariance = None
        if told is not None:
            eye = torch.eye(2, dtype=self.xy.dtype)
            covariance = (told * self.sigma**2 * eye).expand(*self.visible.shape, 2, 2)
        return Tracks(self.xy, self.visible, covariance)


def smooth_curves(frames: int, count: int, cycles: int, generator: torch.Generator) -> Float[Tensor, "count frames"]:
    """Band-limited random curves of mean zero and unit variance.

    Example:
        >>> import torch
        >>> curves = smooth_curves(50, 2, 3, torch.Generator().manual_seed(0))
        >>> curves.shape, bool((curves.std(1) - 1).abs().max() < 1e-6)
        (torch.Size([2, 50]), True)
    """
    t = torch.arange(frames, dtype=torch.float64) / frames
    k = torch.arange(cycles + 1, dtype=torch.float64)
    amplitude = torch.randn(count, cycles + 1, 1, generator=generator, dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(count, cycles + 1, 1, generator=generator, dtype=torch.float64)
    x = (amplitude * torch.cos(2 * math.pi * k[:, None] * t + phase)).sum(1)
    x = x - x.mean(1, keepdim=True)
    return x / x.std(1, keepdim=True)


def low_rank_tracks(
    frames: int,
    points: int,
    bases: int,
    snr: float,
    seed: int,
    motion: str = "generic",
    frame_spread: float = 0.0,
    missing: float = 0.0,
) -> LowRank:
    """Orthographic tracks of a body with ``bases`` shape bases.

    Args:
        snr: decibels.
        motion: ``generic`` (three axes), ``yaw`` (one turn about the vertical), ``swing`` (20 degrees to either side),
            ``static``.
        frame_spread: standard deviation of the logarithm of each frame's noise level.
        missing: share of entries in gaps of 3 to 15 frames.

    Example:
        >>> low_rank_tracks(40, 20, 2, 20.0, seed=0).xy.shape
        torch.Size([40, 20, 2])
    """
    g = torch.Generator().manual_seed(seed)
    shapes = torch.randn(bases, 3, points, generator=g, dtype=torch.float64)
    shapes = shapes - shapes.mean(-1, keepdim=True)
    weights = [1 + 0.2 * smooth_curves(frames, 1, 4, g)]
    weights += [0.5 * 0.8**k * smooth_curves(frames, 1, 4, g) for k in range(1, bases)]
    if motion == "generic":
        turn = 1.2 * smooth_curves(frames, 3, 3, g).T
    else:
        phase = 2 * math.pi * torch.arange(frames, dtype=torch.float64) / frames
        angle = {"yaw": phase, "swing": math.radians(20) * torch.sin(phase), "static": 0 * phase}[motion]
        turn = torch.stack([0 * angle, angle, 0 * angle], -1)
    body = torch.einsum("kf,kap->fap", torch.cat(weights), shapes)
    points3d = _EXTENT * (rotation_from_vector(turn) @ body).mT
    xy = points3d[..., :2]
    sigma = float(xy.square().mean().sqrt()) * 10 ** (-snr / 20)
    level = torch.exp(frame_spread * torch.randn(frames, 1, 1, generator=g, dtype=torch.float64))
    noise = torch.randn(frames, points, 2, generator=g, dtype=torch.float64)
    noise = sigma * level / level.square().mean().sqrt() * noise
    values, n, d = spectrum(stack_matrix(xy) / sigma)
    weakest = float(values[3 * bases - 1]) if len(values) >= 3 * bases else 0.0
    edge = math.sqrt(min(d, points - 1) / n)
    visible = torch.ones(frames, points, dtype=torch.bool)
    while float((~visible).double().mean()) < missing:
        p, start, length = (int(torch.randint(high, (1,), generator=g)) for high in (points, frames, 13))
        visible[start : start + length + 3, p] = False
    place = _WANDER * smooth_curves(frames, 2, 2, g).T[:, None] + _CENTRE
    return LowRank(xy + noise + place, visible, points3d, sigma, (1 + weakest) / (1 + edge), weakest / edge)
