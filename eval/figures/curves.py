"""The drawings of Figures 8 and 9."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchrecon.viz.views import save_figure

__all__ = ["curve_lines", "draw_curves", "draw_scatter", "scatter_lines"]


def _means(records: Sequence[dict[str, Any]], name: str) -> dict[int, float]:
    """Mean over trials at each number of frames; a cell without an answer has no mean."""
    frames = sorted({record["frames"] for record in records})
    result = {}
    for f in frames:
        values = [math.nan if r[name] is None else r[name] for r in records if r["frames"] == f]
        result[f] = float(torch.tensor(values).mean())
    return result


def draw_curves(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Figure 9: M^2 against frames, one panel per body, solver and turn, one colour per SNR, the floor dashed."""
    from matplotlib.figure import Figure

    panels = list(dict.fromkeys((r["body"], r["solver"]) for r in records))
    turns = list(dict.fromkeys(r["turn"] for r in records))
    figure = Figure(figsize=(4.4 * len(panels), 3.8 * len(turns)), layout="constrained")
    axes = figure.subplots(len(turns), len(panels), squeeze=False, sharey=True)
    for line, turn in zip(axes, turns, strict=True):
        for ax, (body, solver) in zip(line, panels, strict=True):
            here = [r for r in records if (r["body"], r["solver"], r["turn"]) == (body, solver, turn)]
            for k, snr in enumerate(dict.fromkeys(r["snr"] for r in here)):
                cell = [r for r in here if r["snr"] == snr]
                found, floor = _means(cell, "disparity"), _means(cell, "floor")
                ax.loglog(list(found), list(found.values()), "o-", color=f"C{k}", label=f"{snr:g} dB")
                ax.loglog(list(floor), list(floor.values()), "--", color=f"C{k}", lw=1)
            ax.axhline(1e-3, color="0.6", lw=0.8)
            ax.set_title(f"{body} body, solver {solver}, turn {turn:g} degrees", size=9)
            ax.set(xlabel="frames F", ylabel="Pro-D, M^2")
    axes[0, 0].legend(title="dashed: floor, rotations known", fontsize=7, title_fontsize=7)
    save_figure(figure, path)


def curve_lines(records: Sequence[dict[str, Any]]) -> list[str]:
    """Figure 9 as text: M^2 (floor) of every cell."""
    lines = ["Pro-D M^2, mean over trials (in brackets: least squares with known rotations, rigid body)"]
    groups = dict.fromkeys((r["body"], r["solver"], r["turn"], r["snr"]) for r in records)
    for body, solver, turn, snr in groups:
        here = [r for r in records if (r["body"], r["solver"], r["turn"], r["snr"]) == (body, solver, turn, snr)]
        found, floor = _means(here, "disparity"), _means(here, "floor")
        cells = "   ".join(f"F {f}: {found[f]:.2e} ({floor[f]:.2e})" for f in found)
        lines.append(f"{body:<10}{solver:<7}{turn:>5g} deg {snr:>3g} dB   {cells}")
    return lines


def draw_scatter(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Figure 8: true (grey) and reconstructed (blue) scattering points of the middle frame, one panel per cell."""
    from matplotlib.figure import Figure

    turns = list(dict.fromkeys(r["turn"] for r in records))
    columns = [[r for r in records if r["turn"] == turn] for turn in turns]
    rows = max(len(column) for column in columns)
    half = 1.05 * max(float(record["truth"].abs().max()) for record in records)
    figure = Figure(figsize=(2.6 * len(turns), 3.6 * rows), layout="constrained")
    for c, column in enumerate(columns):
        for r, record in enumerate(column):
            ax: Any = figure.add_subplot(rows, len(turns), r * len(turns) + c + 1, projection="3d")
            middle = record["frames"] // 2
            x, y, z = record["truth"][middle].T
            ax.scatter(x, z, -y, s=8, c="0.6")
            error = "no answer"
            if record["disparity"] is not None:
                x, y, z = record["points3d"][middle].T
                ax.scatter(x, z, -y, s=8, c="tab:blue")
                error = f"M^2 {record['disparity']:.1e}"
            # One scale on all axes, or a shape without depth would look like a body.
            ax.set(xlim=(-half / 2, half / 2), ylim=(-half / 2, half / 2), zlim=(-half, half))
            ax.set_box_aspect((1, 1, 2))
            step = record["turn"] / (record["frames"] - 1)
            ax.set_title(f"{record['turn']:g} deg, {step:.2g} a frame, F {record['frames']}\n{error}", size=7)
            ax.tick_params(labelsize=5)
    save_figure(figure, path)


def scatter_lines(records: Sequence[dict[str, Any]]) -> list[str]:
    """Figure 8 as text."""
    lines = ["deflection, step, frames: M^2 (floor), status"]
    for r in records:
        found = "no answer" if r["disparity"] is None else f"{r['disparity']:.2e}"
        step = r["turn"] / (r["frames"] - 1)
        lines.append(f"{r['turn']:>5g} {step:>5.2g} {r['frames']:>4}: {found} ({r['floor']:.2e})  {r['note']}")
    return lines
