"""Where noise ends among the eigenvalues of a matrix: Tracy-Widom edge, noise scale, number of signals.

Convention:
    A matrix of ``rows x cols`` independent noise entries of variance s^2 has the eigenvalues ``singular^2 / n`` with
    ``n = max(rows, cols)``, and ``d = min(rows, cols)`` of them; their mean is s^2. So a matrix and its transpose
    have the same eigenvalues and no case F < P has to be told apart.
"""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Bool, Float, Tensor

__all__ = [
    "Complement",
    "count_signals",
    "difference_noise",
    "kritchman_nadler_noise",
    "marchenko_pastur_tail",
    "spectrum",
    "tracy_widom_edge",
]

# quantiles of the Tracy-Widom distribution for real matrices
TRACY_WIDOM = {0.5: -1.2686, 0.95: 0.9793, 0.995: 2.4224, 0.999: 3.2724}


class Complement:
    """Orthonormal coordinates of everything orthogonal to a vector: a mirror that is never formed as a matrix.

    For a constant vector it is a Helmert-like centring.

    Example:
        >>> import torch
        >>> ones = torch.ones(4, dtype=torch.float64)
        >>> basis = Complement(ones).up(torch.eye(3, dtype=torch.float64))
        >>> torch.allclose(basis @ basis.T, torch.eye(3, dtype=torch.float64))
        True
        >>> float((basis @ ones).abs().max()) < 1e-12
        True
    """

    def __init__(self, vector: Float[Tensor, " dim"]) -> None:
        unit = vector / vector.norm()
        self.share: Float[Tensor, " dim"] = 1 - unit.square()
        """Squared length of each axis of the space within the complement."""
        self._mirror = unit.clone()
        self._mirror[0] += 1.0 if float(unit[0]) >= 0 else -1.0
        self._mirror /= self._mirror.norm()

    def down(self, rows: Float[Tensor, "*rows dim"]) -> Float[Tensor, "*rows inner"]:
        """Rows in these coordinates."""
        return (rows - 2 * (rows @ self._mirror)[..., None] * self._mirror)[..., 1:]

    def up(self, rows: Float[Tensor, "*rows inner"]) -> Float[Tensor, "*rows dim"]:
        """Back to the space; what :meth:`down` dropped is zero."""
        rows = torch.nn.functional.pad(rows, (1, 0))
        return rows - 2 * (rows @ self._mirror)[..., None] * self._mirror


def spectrum(matrix: Float[Tensor, "rows cols"]) -> tuple[Float[Tensor, " d"], int, int]:
    """Eigenvalues in units of the entries' variance, descending, with n and d (see the convention above)."""
    n, d = max(matrix.shape), min(matrix.shape)
    singular: Tensor = torch.linalg.svdvals(matrix.detach().to(torch.float64))
    return singular**2 / n, n, d


def tracy_widom_edge(n: int, d: int, quantile: float = 0.95) -> float:
    """What the largest of ``d`` noise eigenvalues of ``n`` samples stays below with probability ``quantile``.

    Johnstone's centring and scaling (2001), variance 1.

    Example:
        >>> round(tracy_widom_edge(1000, 100), 3)
        1.75
    """
    if d < 1:
        return math.inf
    a: float = math.sqrt(max(n, d) - 0.5)
    b: float = math.sqrt(min(n, d) - 0.5)
    centre = (a + b) ** 2 / n
    width = (a + b) / n * float((1 / a + 1 / b) ** (1 / 3))
    return centre + TRACY_WIDOM[quantile] * width


def kritchman_nadler_noise(eigenvalues: Float[Tensor, " d"], n: int, signals: int) -> float:
    """Noise variance behind ``signals`` signal eigenvalues (Kritchman and Nadler 2008).

    The mean of the remaining eigenvalues is too small because the signals took noise with them; their own
    eigenvalues are corrected for it and the difference is given back.
    """
    d = len(eigenvalues)
    values: list[float] = eigenvalues.tolist()
    rest = sum(values[signals:])
    free = d - signals
    noise = rest / free
    for _ in range(20):
        lost = 0.0
        for value in values[:signals]:
            b = value + noise - noise * free / n
            root = b * b - 4 * value * noise
            lost += value - (b + math.sqrt(root)) / 2 if root > 0 else 0.0
        updated = (rest + lost) / free
        if abs(updated - noise) <= 1e-8 * noise:
            break
        noise = updated
    return noise


def count_signals(
    eigenvalues: Float[Tensor, " d"], n: int, noise: float | None, quantile: float = 0.95, limit: int | None = None
) -> tuple[int, Float[Tensor, " d"]]:
    """Test the eigenvalues one after the other against the noise edge of those that remain.

    Args:
        eigenvalues: of :func:`spectrum`, descending.
        n: of :func:`spectrum`.
        noise: known noise variance; None estimates it anew at each step (Kritchman and Nadler).
        quantile: of the Tracy-Widom distribution: 0.5, 0.95, 0.995 or 0.999.
        limit: largest count; default: one eigenvalue is always left as noise.

    Returns:
        (count, threshold): the number of leading eigenvalues above their edge, and the edge of each.

    Example:
        >>> import torch
        >>> noise = torch.randn(200, 30, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> noise[:, :2] *= 4
        >>> values, n, d = spectrum(noise)
        >>> count_signals(values, n, None)[0]
        2
    """
    d = len(eigenvalues)
    limit = d - 1 if limit is None else min(limit, d - 1)
    thresholds, count, open_ = [], 0, True
    for k in range(d):
        scale = noise if noise is not None else kritchman_nadler_noise(eigenvalues, n, min(k, d - 1))
        thresholds.append(scale * tracy_widom_edge(n, d - k, quantile))
        open_ = open_ and k < limit and float(eigenvalues[k]) > thresholds[k]
        count += open_
        if not open_ and noise is None and k > count + 2:
            # below the first noise eigenvalue the scale estimate has no meaning of its own; keep the last edge
            thresholds.extend(thresholds[-1:] * (d - k - 1))
            break
    return count, eigenvalues.new_tensor(thresholds)


def difference_noise(
    xy: Float[Tensor, "*b frames points 2"], visible: Bool[Tensor, "*b frames points"]
) -> Float[Tensor, "*b"]:
    """Noise variance of evenly sampled smooth tracks from their third differences; what moves jerkily adds to it.

    Only entries that are seen in four frames on end are read; infinite where there are none.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> smooth = torch.linspace(0, 6, 300, dtype=torch.float64)[:, None, None].sin().expand(300, 9, 2)
        >>> noisy = smooth + 0.1 * torch.randn(300, 9, 2, generator=g, dtype=torch.float64)
        >>> round(float(difference_noise(noisy, torch.ones(300, 9, dtype=torch.bool)) ** 0.5), 2)
        0.1
    """
    if xy.shape[-3] < 4:
        return torch.full_like(xy[..., 0, 0, 0], torch.inf)
    xy = torch.where(visible[..., None], xy, xy.new_zeros(()))
    third = xy.diff(n=3, dim=-3)
    whole = visible.unfold(-2, 4, 1).all(-1)[..., None]
    total = torch.where(whole, third.square(), xy.new_zeros(())).sum((-1, -2, -3))
    # 20 = 1 + 9 + 9 + 1
    return torch.where(whole.sum((-1, -2, -3)) > 0, total / (40 * whole.sum((-1, -2, -3)).clamp_min(1)), torch.inf)


def marchenko_pastur_tail(ratio: float, share: float) -> float:
    """Mean of the smallest ``share`` of the eigenvalues of pure noise of variance 1 (Marchenko-Pastur law).

    Args:
        ratio: dimensions over samples, d / n, in (0, 1].
        share: in (0, 1].

    Example:
        >>> round(marchenko_pastur_tail(0.5, 1.0), 2), round(marchenko_pastur_tail(0.5, 0.25), 2)
        (1.0, 0.24)
    """
    low, high = (1 - ratio**0.5) ** 2, (1 + ratio**0.5) ** 2
    # x = middle + half * sin(a): the square roots at both edges become smooth in a.
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 4001, dtype=torch.float64)
    x = (low + high) / 2 + (high - low) / 2 * angle.sin()
    density = ((high - low) / 2 * angle.cos()) ** 2 / x.clamp_min(1e-300)
    mass = density.cumsum(0) / density.sum()
    inside = mass <= max(share, float(mass[1]))
    return float((density * x)[inside].sum() / density[inside].sum())
