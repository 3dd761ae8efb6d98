"""Scree figure of a rank estimate: eigenvalues, the edge of the noise, and where K cuts."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from torchrecon.errors import ReconError
from torchrecon.measurement import RankEstimate
from torchrecon.viz.views import save_figure

__all__ = ["draw_scree"]


def draw_scree(estimate: RankEstimate, path: str | os.PathLike[str]) -> Path:
    """Eigenvalues on a logarithmic axis with the threshold of each, K and its interval shaded.

    Args:
        estimate: batch ``()``.
        path: picture file, replaced atomically.

    Raises:
        ReconError: a batch of estimates, no eigenvalues, or matplotlib is not installed.
    """
    if estimate.eigenvalues.ndim != 1:
        raise ReconError("draw_scree: one estimate at a time; estimate the items of the batch one by one")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ReconError("draw_scree: needs matplotlib; install it with pip install 'torchrecon[viz]'") from error
    values = estimate.eigenvalues.detach().cpu().numpy()
    if not (values > 0).any():
        raise ReconError("draw_scree: the estimate has no eigenvalues; its warnings say why")
    threshold = estimate.threshold.detach().cpu().numpy()
    per_basis = 6 if estimate.layout == "vector" else 3
    index = np.arange(1, len(values) + 1)
    shown = values > 0
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axis = figure.subplots()
    low, high = (int(end) for end in estimate.interval)
    axis.axvspan(per_basis * low + 0.5, per_basis * high + 0.5, color="C0", alpha=0.12, label=f"K from {low} to {high}")
    axis.axvline(per_basis * int(estimate.rank) + 0.5, color="C0", lw=1, label=f"K = {int(estimate.rank)}")
    axis.plot(index[shown], values[shown], "o-", color="0.2", ms=3, lw=0.8, label="eigenvalues")
    if np.isfinite(threshold).any():
        axis.plot(index, threshold, "--", color="C3", lw=1, label="edge of the noise")
    axis.set(
        xlabel=f"component ({per_basis} to a basis)",
        ylabel="eigenvalue",
        yscale="log",
        title=f"rule {estimate.rule}, layout {estimate.layout}, degree {float(estimate.deformation_degree):.2f}",
    )
    axis.legend(fontsize=8)
    return save_figure(figure, path)
