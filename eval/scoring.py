"""The second pass of Table 1: cells, intervals and the printed table from cached predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["PAPER", "Cell", "bootstrap_cells", "draw", "error_by_action", "table_text"]

PAPER: dict[str, tuple[float, float, float, float]] = {
    "ref4": (28.14, 27.46, 28.96, 28.36),
    "ref5": (27.62, 26.37, 27.37, 27.05),
    "ref6": (27.98, 26.82, 27.21, 26.82),
    "ref7": (25.37, 25.79, 25.07, 25.15),
    "ref8": (25.19, 25.17, 25.45, 25.03),
    "default": (21.22, 20.51, 20.97, 21.08),
}
"""Table 1 as printed: recognition error in per cent for shoot, run, jump, pass; the proposed method stands beside
the default. Other rows have no counterpart."""


@dataclass(frozen=True)
class Cell:
    """A share of windows in per cent with its 95 % bootstrap interval over sequences."""

    error: float
    low: float
    high: float
    windows: int
    sequences: int


def bootstrap_cells(
    wrong: Mapping[str, Sequence[tuple[float, int]]], seed: int = 0, draws: int = 2000
) -> dict[str, Cell]:
    """A cell per action and their ``mean``; sequences, not windows, are drawn anew, as windows of one film overlap.

    Args:
        wrong: per action a pair (wrong windows, windows) for each of its sequences; the former may be a mean over
            recognisers.
        seed: of the draws.
        draws: bootstrap samples.

    Example:
        >>> cells = bootstrap_cells({"run": [(2, 8), (0, 8)], "jump": [(4, 8), (4, 8)]})
        >>> cells["run"].error, cells["mean"].error, cells["jump"].low
        (12.5, 31.25, 50.0)
    """
    generator = torch.Generator().manual_seed(seed)
    cells: dict[str, Cell] = {}
    shares, samples = [], []
    for action, counts in wrong.items():
        table = torch.tensor(counts, dtype=torch.float64).reshape(-1, 2)
        chosen = torch.randint(len(table), (draws, len(table)), generator=generator)
        drawn = table[chosen].sum(1)
        sample = 100 * drawn[:, 0] / drawn[:, 1]
        share = float(100 * table[:, 0].sum() / table[:, 1].sum())
        cells[action] = _cell(share, sample, int(table[:, 1].sum()), len(table))
        shares.append(share)
        samples.append(sample)
    mean = torch.stack(samples).mean(0)
    windows = sum(cell.windows for cell in cells.values())
    count = sum(cell.sequences for cell in cells.values())
    cells["mean"] = _cell(sum(shares) / len(shares), mean, windows, count)
    return cells


def error_by_action(wrong: Mapping[str, Sequence[tuple[float, int]]]) -> dict[str, float]:
    """Per cent of windows that are wrong, per action and as their ``mean``.

    Example:
        >>> error_by_action({"run": [(2, 8), (0, 8)], "jump": [(4, 8), (4, 8)]})
        {'run': 12.5, 'jump': 50.0, 'mean': 31.25}
    """
    errors = {name: 100 * sum(w for w, _ in pairs) / sum(n for _, n in pairs) for name, pairs in wrong.items()}
    return {**errors, "mean": sum(errors.values()) / len(errors)}


def _cell(error: float, sample: Float[Tensor, " draws"], windows: int, sequences: int) -> Cell:
    low, high = (float(torch.quantile(sample, q)) for q in (0.025, 0.975))
    return Cell(error, low, high, windows, sequences)


def table_text(result: Mapping[str, Any]) -> str:
    """The result as a table for people; rounding happens only here."""
    actions = result["actions"]
    columns = [*actions, "mean"]
    head = f"{'':<28}" + "".join(f"{name:>24}" for name in columns)
    lines = [
        result["title"],
        "",
        "Misclassified windows, %  [95 % interval over sequences]  (printed in the paper)",
        head,
    ]
    for row in result["rows"]:
        text = f"{row['label']:<28}"
        for name in columns:
            cell = row["cells"].get(name)
            if cell is None:
                text += f"{'-':>24}"
                continue
            paper = row["paper"].get(name)
            shown = f"{cell['error']:.1f} [{cell['low']:.0f}-{cell['high']:.0f}]"
            text += f"{shown + (f' ({paper:.2f})' if paper is not None else ''):>24}"
        lines.append(text)
    lines += [
        "",
        "Eq. (31) as normalised RMSE, % | error3d_camera; observed entries, one scale and one depth sign per sequence",
        head,
    ]
    for row in result["rows"]:
        if not row["errors"]:
            continue
        text = f"{row['label']:<28}"
        for name in columns:
            pair = row["errors"].get(name)
            text += f"{'-' if pair is None else '{:.1f} | {:.3f}'.format(pair['nrmse'], pair['error3d_camera']):>24}"
        lines.append(text)
    return "\n".join([*lines, "", *result["remarks"]]) + "\n"


def draw(result: Mapping[str, Any], path: Path) -> Path:
    """Both blocks as a figure: one group of bars per row, the paper's numbers as lines across its bars."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    actions = result["actions"]
    rows = result["rows"]
    figure, (upper, lower) = plt.subplots(2, 1, figsize=(12, 8), sharex=True, constrained_layout=True)
    width = 0.8 / len(actions)
    for a, action in enumerate(actions):
        at = [i - 0.4 + (a + 0.5) * width for i in range(len(rows))]
        cells = [row["cells"].get(action) for row in rows]
        height = [0.0 if cell is None else cell["error"] for cell in cells]
        spread = [
            [0.0 if cell is None else cell["error"] - cell["low"] for cell in cells],
            [0.0 if cell is None else cell["high"] - cell["error"] for cell in cells],
        ]
        spread = [[max(0.0, value) for value in side] for side in spread]
        upper.bar(at, height, width, yerr=spread, label=action, error_kw={"elinewidth": 0.8})
        for x, row in zip(at, rows, strict=True):
            if action in row["paper"]:
                upper.plot([x - width / 2, x + width / 2], [row["paper"][action]] * 2, color="black", linewidth=1.5)
        errors = [row["errors"].get(action) for row in rows]
        lower.bar(at, [0.0 if pair is None else pair["error3d_camera"] for pair in errors], width)
    upper.set_ylabel("misclassified windows, %")
    upper.set_title(result["title"] + "\nblack: printed in the paper")
    upper.legend(ncols=len(actions))
    lower.set_ylabel("error3d_camera")
    lower.set_xticks(range(len(rows)), [row["label"] for row in rows], rotation=25, ha="right")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
