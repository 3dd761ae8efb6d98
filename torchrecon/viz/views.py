"""Front, side and top view of a reconstruction at a few frames (paper, Fig. 2)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrecon.errors import ReconError
from torchrecon.measurement import Reconstruction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["draw_views", "save_figure"]

_VIEWS = (("front", 0, 1), ("side", 2, 1), ("top", 0, 2))
_AXES = ("x right", "y down", "z away")


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a matplotlib figure so that the final name never holds half a picture."""
    target = Path(path)
    temporary = target.with_name(f".{target.name}.part{target.suffix}")
    figure.savefig(temporary, dpi=110)
    os.replace(temporary, target)
    return target


def draw_views(
    reconstruction: Reconstruction,
    path: str | os.PathLike[str],
    frames: Sequence[int] | None = None,
    edges: Sequence[tuple[int, int]] | None = None,
) -> Path:
    """One row per frame, columns front (x, y), side (z, y) and top (x, z), all on one scale.

    Observed points are filled and coloured by depth; points that the solver inferred are grey rings.

    Args:
        reconstruction: batch ``()``.
        path: picture file, replaced atomically.
        frames: indices to draw; default: first quarter, middle, last quarter.
        edges: pairs of points to join.

    Raises:
        ReconError: a batch of reconstructions, or matplotlib is not installed.
    """
    if reconstruction.points3d.ndim != 3:
        raise ReconError("draw_views: one reconstruction at a time; index the batch first")
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ReconError("draw_views: needs matplotlib; install it with pip install 'torchrecon[viz]'") from error
    points = reconstruction.points3d.detach().cpu().numpy()
    total = points.shape[0]
    chosen = [total // 4, total // 2, (3 * total) // 4] if frames is None else list(frames)
    seen = np.ones(points.shape[:2], bool)
    if reconstruction.observed is not None:
        seen = reconstruction.observed.cpu().numpy()
    # Wrongly tracked points must not decide the scale of the picture.
    reach = 1.15 * float(np.quantile(np.abs(points[seen]), 0.99)) or 1.0
    figure = Figure(figsize=(9, 3 * len(chosen)), layout="constrained")
    axes = figure.subplots(len(chosen), 3, squeeze=False)
    for row, frame in zip(axes, chosen, strict=True):
        shape, here = points[frame], seen[frame]
        for axis, (name, a, b) in zip(row, _VIEWS, strict=True):
            for start, end in edges or ():
                axis.plot(shape[[start, end], a], shape[[start, end], b], color="0.7", lw=0.8, zorder=0)
            axis.scatter(shape[~here, a], shape[~here, b], s=8, facecolors="none", edgecolors="0.8", lw=0.5)
            axis.scatter(shape[here, a], shape[here, b], s=9, c=shape[here, 2], cmap="viridis", vmin=-reach, vmax=reach)
            axis.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal", title=f"frame {frame}, {name}")
            axis.set(xlabel=_AXES[a], ylabel=_AXES[b])
            if name == "top":
                axis.invert_yaxis()
    statuses = "; ".join(str(status) for status in reconstruction.statuses)
    figure.suptitle(f"K = {reconstruction.rank}   {statuses}"[:110], fontsize=9)
    return save_figure(figure, path)
