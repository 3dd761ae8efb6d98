"""Parametric bootstrap: the edge of the noise, and the spread of K, from noise drawn with the tracks' own covariance.

The closed-form edges take the entries of the whitened matrix as independent and of equal variance. Here noise is drawn
with the covariance of every observation and whitened and centred as the tracks are, so what whitening leaves
behind (u and v of one observation correlated, a covariance that one factor per row and column does not describe) is
in the edge. The interval comes from adding fresh noise to the signal that was found and counting again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg.noise_edge import kritchman_nadler_noise, spectrum, tracy_widom_edge

__all__ = ["BootstrapCount", "BootstrapParams", "bootstrap_count"]


@dataclass(frozen=True)
class BootstrapParams:
    """Parameters of :func:`bootstrap_count`.

    Attributes:
        noise_draws: draws of noise alone, for the edge (count).
        signal_draws: draws of the signal with fresh noise, for the interval (count).
        quantile: of the largest noise eigenvalue that the edge is.
        coverage: of the interval.
    """

    noise_draws: int = 200
    signal_draws: int = 100
    quantile: float = 0.95
    coverage: float = 0.95


@dataclass(frozen=True, eq=False)
class BootstrapCount:
    """Number of leading eigenvalues above the edge, the eigenvalues and edges, and the counts of the interval's ends.

    Attributes:
        count: eigenvalues that stand out.
        eigenvalues, threshold: (d,), descending.
        interval: lowest and highest count.
    """

    count: int
    eigenvalues: Float[Tensor, " d"]
    threshold: Float[Tensor, " d"]
    interval: tuple[int, int]


def bootstrap_count(
    matrix: Float[Tensor, "rows cols"],
    draw: Callable[[], Float[Tensor, "rows cols"]],
    noise: float | None,
    floor: float = 0.0,
    params: BootstrapParams | None = None,
) -> BootstrapCount:
    """Count the signals of a whitened matrix.

    The edge of the largest of all noise eigenvalues is drawn; that of the largest after k signals follows from it as
    the Tracy-Widom edge does.

    Args:
        matrix: whitened and centred.
        draw: noise as the whitened, centred tracks would have it without a signal.
        noise: its scale where it is known; None estimates it at each step (Kritchman and Nadler).
        floor: eigenvalue that rounding alone can cause.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> signal = 3 * torch.randn(80, 1, generator=g) @ torch.randn(1, 20, generator=g)
        >>> draw = lambda: torch.randn(80, 20, generator=g)
        >>> bootstrap_count(signal + draw(), draw, None).count
        1
    """
    p = params or BootstrapParams()
    values, n, d = spectrum(matrix)
    largest, level = [], []
    for _ in range(p.noise_draws):
        drawn, _, _ = spectrum(draw())
        mean = float(drawn.mean())
        largest.append(float(drawn[0]) / (mean if noise is None else 1.0))
        level.append(mean)
    edge = float(torch.tensor(largest, dtype=torch.float64).quantile(p.quantile))
    first = tracy_widom_edge(n, d)
    edges = [edge * tracy_widom_edge(n, d - k) / first for k in range(d)]

    def above(eigenvalues: Tensor) -> tuple[int, Tensor]:
        # the scale is estimated anew at each step, up to the first eigenvalue that is noise
        thresholds: list[float] = []
        for k, value in enumerate(eigenvalues[:-1].tolist()):
            scale = kritchman_nadler_noise(eigenvalues, n, k) if noise is None else noise
            thresholds.append(max(scale * edges[k], floor))
            if value <= thresholds[-1]:
                break
        count = len(thresholds) - (float(eigenvalues[len(thresholds) - 1]) <= thresholds[-1])
        return count, eigenvalues.new_tensor(thresholds + thresholds[-1:] * (d - len(thresholds)))

    count, threshold = above(values)
    variance = kritchman_nadler_noise(values, n, count) if noise is None else noise
    scale = 1.0 if noise is not None else math.sqrt(variance * len(level) / sum(level))
    u, _, vh = torch.linalg.svd(matrix.detach().to(torch.float64), full_matrices=False)
    # noise has lifted the signal eigenvalues; taken back as in the scale estimate
    b = values[:count] + variance - variance * (d - count) / n
    root = (b.square() - 4 * values[:count] * variance).clamp_min(0).sqrt()
    signal = u[:, :count] * (n * ((b + root) / 2 - variance).clamp_min(0)).sqrt() @ vh[:count]
    counts = torch.tensor([above(spectrum(signal + scale * draw())[0])[0] for _ in range(p.signal_draws)])
    tail = (1 - p.coverage) / 2
    low, high = (int(torch.quantile(counts.double(), share).round()) for share in (tail, 1 - tail))
    return BootstrapCount(count, values, threshold, (min(low, count), max(high, count)))
