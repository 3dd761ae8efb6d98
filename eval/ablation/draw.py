"""The drawing of the ablation: error against assumed K, and one group of bars for each set of stages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eval.ablation.stages import SOLVERS
from torchrecon.viz.views import save_figure

__all__ = ["draw"]


def _height(value: float | None) -> float:
    return math.nan if value is None else value


def _bases(ax: Any, found: Mapping[str, Any]) -> None:
    ratio = [k / found["true"] for k in found["rows"][0]["assumed"]]
    for row in found["rows"]:
        ax.plot(ratio, [_height(value) for value in row["error3d_camera"]], "o-", label=row["solver"])
    ax.axhline(_height(found["default"]["error3d_camera"]), color="k", ls="--", lw=1, label="default (takes no K)")
    ax.axvline(1.0, color="0.7", lw=0.8)
    ax.set(xlabel="assumed K / true K", ylabel="error3d_camera", ylim=(0, None))
    ax.legend(fontsize=7)


def _bars(ax: Any, labels: list[str], series: Mapping[str, list[float | None]]) -> None:
    width = 0.8 / len(series)
    for s, (name, values) in enumerate(series.items()):
        at = [i - 0.4 + (s + 0.5) * width for i in range(len(labels))]
        ax.barh(at, [_height(value) for value in values], width, label=name)
    ax.set_yticks(range(len(labels)), labels, fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("error3d_camera")
    ax.legend(fontsize=7)


def draw(result: Mapping[str, Any], path: Path) -> None:
    """A panel for each part that was run."""
    from matplotlib.figure import Figure

    parts = [part for part in ("bases", "stages", "depth") if part in result]
    figure = Figure(figsize=(6 * len(parts), 4.2), layout="constrained")
    for ax, part in zip(figure.subplots(1, len(parts), squeeze=False)[0], parts, strict=True):
        found = result[part]
        if part == "bases":
            _bases(ax, found)
            continue
        rows = found["variants"]
        series = {"default": [row["error3d_camera"] for row in rows]}
        if part == "stages":
            series = {s: [row["error3d_camera"][s] for row in rows] for s in SOLVERS}
        _bars(ax, [row["label"] for row in rows], series)
        ax.set_title("tracks of known K" if part == "stages" else "depth sensor", size=9)
    save_figure(figure, path)
