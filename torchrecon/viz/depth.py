"""Depth before and after the filter, and the body cut out of it: the panels of the paper's Fig. 3."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.viz.views import save_figure

__all__ = ["draw_depth"]


def draw_depth(
    measured: Float[Tensor, "height width"],
    filtered: Float[Tensor, "height width"],
    body: Bool[Tensor, "height width"],
    path: str | os.PathLike[str],
) -> Path:
    """Three panels on one colour scale, that of the body: measured, filtered, and the body alone.

    Args:
        measured, filtered: metres; NaN where there is none, drawn white.
        body: pixels of the body.
        path: picture file, replaced atomically.

    Raises:
        ReconError: no pixel of the body has a depth, or matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ReconError("draw_depth: needs matplotlib; install it with pip install 'torchrecon[viz]'") from error
    inside = measured[body & torch.isfinite(measured)]
    if not len(inside):
        raise ReconError("draw_depth: no pixel of the body has a depth")
    low, high = inside.double().quantile(torch.tensor([0.01, 0.99], dtype=torch.float64)).tolist()
    figure = Figure(figsize=(12, 3.4), layout="constrained")
    axes = figure.subplots(1, 3)
    cut = torch.where(body, filtered, torch.nan)
    for axis, image, title in zip(axes, (measured, filtered, cut), ("measured", "filtered", "body"), strict=True):
        shown = axis.imshow(image.cpu().numpy(), vmin=low, vmax=high, cmap="viridis")
        axis.set_title(title)
        axis.axis("off")
    figure.colorbar(shown, ax=axes, label="metres")
    return save_figure(figure, path)
