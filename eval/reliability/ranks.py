"""K by every rule: the grid, motions, noise that is told wrongly, gaps, and the paper's own closed form."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import scipy.integrate
import torch

from eval.job import run_parallel
from eval.reliability.world import low_rank_tracks
from torchrecon.rank import estimate_rank

__all__ = ["CLOSED_FORM", "Cell", "draw_ranks", "grid", "mass_above", "measure_ranks"]

CLOSED_FORM = ("kritchman_nadler", "tracy_widom", "mp", "gavish_donoho", "mdl")
_SNRS = (30.0, 20.0, 10.0, 0.0)
_TARGET = {30.0: (99, 98), 20.0: (96, 91), 10.0: (90, 77), 0.0: (None, 50)}  # detectable cells, all cells; percent
_SWEEPS = (0.25, 0.5, 1.0, 2.0, 4.0)  # factors on the variance that the covariance tells


@dataclass(frozen=True)
class Cell:
    """One experiment: how the tracks are made and which rules see them.

    Attributes:
        part: ``grid``, ``costly``, ``motion``, ``frames`` (noise that varies by frame), ``rigid``, ``told``, ``gaps``
            or ``paper``.
        frames, points, bases, snr: of the tracks.
        seed: of the first trial; trial i has seed + i.
        trials: count.
        motion, frame_spread, missing: as in ``low_rank_tracks``.
    """

    part: str
    frames: int
    points: int
    bases: int
    snr: float
    seed: int
    trials: int
    motion: str = "generic"
    frame_spread: float = 0.0
    missing: float = 0.0

    def __str__(self) -> str:
        return f"{self.part} F={self.frames} P={self.points} K={self.bases} {self.snr:g} dB {self.motion}"


def grid(config: Mapping[str, Any], full: bool) -> list[Cell]:
    """Every cell of a run, in the order of the config; seeds follow from a cell's place in the grid."""
    g = config["grid"]
    whole = [
        (f, p, k, snr) for snr in g["snr"] for f in g["frames"] for p in g["points"] for k in g["bases"]
    ]  # fmt: skip
    cells = [Cell("grid", f, p, k, snr, 1000 * i, g["trials"]) for i, (f, p, k, snr) in enumerate(whole)]
    costly = whole if full else [tuple(item) for item in config["costly"]["cells"]]
    for f, p, k, snr in costly:
        cells.append(Cell("costly", f, p, k, snr, 1000 * whole.index((f, p, k, snr)), config["costly"]["trials"]))
    side = config["side"]
    base = 10_000_000
    for motion in ("yaw", "swing", "static"):
        for k in side["bases"]:
            base += 1000
            cells.append(Cell("motion", side["frames"], side["points"], k, 20.0, base, side["trials"], motion))
    for k in side["bases"]:
        base += 1000
        cells.append(
            Cell("frames", side["frames"], side["points"], k, 20.0, base, side["trials"], frame_spread=0.7)
        )  # fmt: skip
    for f, p in config["rigid"]["sizes"]:
        for snr in config["rigid"]["snr"]:
            base += 1000
            cells.append(Cell("rigid", f, p, 1, snr, base, config["rigid"]["trials"]))
    base += 1000
    cells.append(Cell("told", side["frames"], side["points"], 3, 20.0, base, side["trials"]))
    for share in config["gaps"]["shares"]:
        for k in side["bases"]:
            base += 1000
            cells.append(
                Cell("gaps", side["frames"], side["points"], k, 20.0, base, config["gaps"]["trials"], missing=share)
            )  # fmt: skip
    for f, p, k in config["paper"]["cells"]:
        base += 1000
        cells.append(Cell("paper", f, p, k, 30.0, base, config["paper"]["trials"]))
    return cells


def _rules(cell: Cell) -> list[tuple[str, str | None, str]]:
    """(rule, layout, noise scale) that see the tracks of a cell."""
    if cell.part == "grid":
        both = [(rule, layout, "estimate") for layout in ("stack", "vector") for rule in CLOSED_FORM]
        return [("auto", None, "estimate"), ("paper", "vector", "given"), *both]
    if cell.part == "costly":
        return [("auto", None, "estimate"), ("bootstrap", "stack", "estimate"), ("cross_validation", None, "estimate")]
    if cell.part in ("motion", "frames"):
        known = [(rule, layout, "estimate") for layout in ("stack", "vector") for rule in ("tracy_widom",)]
        return [("auto", None, "estimate"), ("paper", "vector", "given"), *known]
    if cell.part == "told":
        stack = [(rule, "stack", "given") for rule in ("mp", "tracy_widom")]
        return [("auto", None, "estimate"), ("paper", "vector", "given"), *stack]
    return [("paper", "vector", "given")] if cell.part == "paper" else [("auto", None, "estimate")]


def run_cell(cell: Cell) -> list[dict[str, Any]]:
    """All trials of a cell: one record per trial, rule and told factor."""
    records = []
    for trial in range(cell.trials):
        seed = cell.seed + trial
        made = low_rank_tracks(
            cell.frames, cell.points, cell.bases, cell.snr, seed, cell.motion, cell.frame_spread, cell.missing
        )
        for factor in _SWEEPS if cell.part == "told" else (1.0,):
            # A covariance that is right up to one factor is what the tracker gives; only the noise scale is withheld.
            tracks = made.tracks(factor)
            for rule, layout, scale in _rules(cell):
                answer = estimate_rank(tracks, rule, layout, scale, generator=torch.Generator().manual_seed(seed))
                low, high = (int(end) for end in answer.interval)
                records.append(
                    {
                        "part": cell.part,
                        "frames": cell.frames,
                        "points": cell.points,
                        "bases": cell.bases,
                        "snr": cell.snr,
                        "motion": cell.motion,
                        "missing": cell.missing,
                        "told": factor,
                        "rule": rule,
                        "layout": layout or "auto",
                        "rank": int(answer.rank),
                        "degree": float(answer.deformation_degree),
                        "covered": low <= cell.bases <= high,
                        "warned": any("no information on depth" in text for text in answer.warnings),
                        "detectable": made.detectable,
                        "signal": made.signal,
                        "fits": 6 * cell.bases <= min(2 * cell.points - 2, cell.frames),
                    }
                )
    return records


def _share(records: Sequence[Mapping[str, Any]]) -> float:
    """Percent of exact K; NaN of nothing."""
    return 100 * sum(r["rank"] == r["bases"] for r in records) / len(records) if records else math.nan


def _bias(records: Sequence[Mapping[str, Any]]) -> float:
    return sum(r["rank"] - r["bases"] for r in records) / len(records) if records else math.nan


def mass_above(level: float, ratio: float) -> float:
    """Share of the Marchenko-Pastur law of this ratio (at most 1) above a level.

    Example:
        >>> round(mass_above(1.0, 58 / 100), 2)
        0.42
    """
    low, high = (1 - ratio**0.5) ** 2, (1 + ratio**0.5) ** 2

    def density(x: float) -> float:
        return math.sqrt(max((high - x) * (x - low), 0.0)) / (2 * math.pi * ratio * x)

    return float(scipy.integrate.quad(density, max(level, low), high)[0])


def _mark(value: float, target: float | None) -> str:
    return "" if target is None or math.isnan(value) else f" ({'hit' if value >= target else 'MISSED'}, {target:g})"


def _grid_lines(records: list[dict[str, Any]]) -> list[str]:
    lines = ["K exact, percent / mean bias, cells in which the basis fits the layout (6K <= min(2P-2, F)), by SNR:"]
    lines.append(f"{'rule':<28}" + "".join(f"{snr:>16g} dB" for snr in _SNRS))
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for record in records:
        groups[record["rule"], record["layout"]].append(record)
    for (rule, layout), rows in groups.items():
        cells = []
        for snr in _SNRS:
            kept = [r for r in rows if r["snr"] == snr and r["fits"]]
            cells.append(f"{_share(kept):>10.0f} / {_bias(kept):+6.2f}")
        lines.append(f"{rule + ' ' + layout:<28}" + "".join(cells))
    auto = groups["auto", "auto"]
    lines += ["", "Rule auto, noise scale not given; detectability of the weakest basis from the generator:"]
    for snr in _SNRS:
        rows = [r for r in auto if r["snr"] == snr]
        clear = [r for r in rows if r["signal"] >= 1.5]
        between = [r for r in rows if 1.0 <= r["signal"] < 1.5]
        strict = [r for r in rows if r["detectable"] >= 1.5]
        fit = [r for r in rows if r["fits"]]
        high, every = _TARGET[snr]
        lines.append(
            f"  {snr:>3g} dB: signal >= 1.5x its limit {_share(clear):.1f}{_mark(_share(clear), high)} of {len(clear)};"
            f" signal + noise >= 1.5x its limit {_share(strict):.1f} of {len(strict)}; "
            f"signal 1.0-1.5x {_share(between):.1f} of {len(between)}; "
            f"all cells that fit {_share(fit):.1f}{_mark(_share(fit), every)}, bias {_bias(fit):+.3f}; "
            f"all {_share(rows):.1f}"
        )
    return lines


def _costly_lines(records: list[dict[str, Any]]) -> list[str]:
    lines = ["Costly rules on the stratified part: K exact / bias / interval holds K, percent:"]
    for rule in ("auto", "bootstrap", "cross_validation"):
        rows = [r for r in records if r["rule"] == rule]
        seen = [r for r in rows if r["signal"] >= 1.5]
        covered = 100 * sum(r["covered"] for r in rows) / len(rows)
        sure = 100 * sum(r["covered"] for r in seen) / len(seen) if seen else math.nan
        lines.append(
            f"  {rule:<18} {_share(rows):.0f} / {_bias(rows):+.2f} / {covered:.0f}; "
            f"detectable {_share(seen):.0f} / {_bias(seen):+.2f} / {sure:.0f}"
        )
    return lines


def _side_lines(records: list[dict[str, Any]]) -> list[str]:
    lines = ["20 dB, exact K in percent (auto; Tracy-Widom stack, vector; paper):"]
    names = [("motion", motion) for motion in ("yaw", "swing", "static")] + [("frames", "generic")]
    for part, motion in names:
        rows = [r for r in records if r["part"] == part and r["motion"] == motion]
        if not rows:
            continue
        by = {key: [r for r in rows if (r["rule"], r["layout"]) == key] for key in (
            ("auto", "auto"), ("tracy_widom", "stack"), ("tracy_widom", "vector"), ("paper", "vector")
        )}  # fmt: skip
        label = motion if part == "motion" else "noise varying by frame (log-sd 0.7)"
        figures = [f"{_share(value):.0f}" for value in by.values()]
        auto = by["auto", "auto"]
        text = f"  {label}: {', '.join(figures)}"
        if motion == "static":
            text += f"; warned that depth is not seen: {100 * sum(r['warned'] for r in auto) / len(auto):.0f}"
        else:
            text += _mark(_share(auto), 95)
        lines.append(text)
    rigid = [r for r in records if r["part"] == "rigid"]
    lines.append(f"Rigid body and noise: K = 1 in {_share(rigid):.1f} of {len(rigid)}{_mark(_share(rigid), 97)}")
    for share, target in ((0.05, 95), (0.1, 95), (0.3, 85)):
        rows = [r for r in records if r["part"] == "gaps" and r["missing"] == share]
        if rows:
            lines.append(
                f"{100 * share:.0f} % missing in gaps of 3-15 frames, 20 dB: {_share(rows):.1f} of {len(rows)}"
                f"{_mark(_share(rows), target)}, bias {_bias(rows):+.2f}"
            )
    told = [r for r in records if r["part"] == "told"]
    if told:
        lines.append("Covariance told wrongly by a factor, K = 3, 20 dB: mean K")
        for rule in dict.fromkeys(r["rule"] for r in told):
            values = []
            for factor in _SWEEPS:
                rows = [r["rank"] for r in told if r["rule"] == rule and r["told"] == factor]
                values.append(f"{factor:g}: {sum(rows) / len(rows):.1f}")
            lines.append(f"  {rule:<16} " + ", ".join(values))
    return lines


def _paper_lines(records: list[dict[str, Any]]) -> list[str]:
    lines = ["The paper's rule against its closed form 6K + (2P-2-6K) x Marchenko-Pastur mass above 1 (counts):"]
    cells = dict.fromkeys((r["frames"], r["points"], r["bases"]) for r in records)
    for f, p, k in cells:
        rows = [6 * r["degree"] for r in records if (r["frames"], r["points"], r["bases"]) == (f, p, k)]
        measured = sum(rows) / len(rows)
        plain = 6 * k + (2 * p - 2 - 6 * k) * mass_above(1.0, (2 * p - 2) / f)
        # 6K samples went with the signals while the paper divides by all F
        free, left = 2 * p - 2 - 6 * k, f - 6 * k
        exact = 6 * k + free * mass_above(f / left, free / left)
        off = 100 * (measured / plain - 1)
        lines.append(
            f"  F = {f}, P = {p}, K = {k}: measured {measured:.1f}, closed form {plain:.1f} ({off:+.1f} %), "
            f"with the lost samples {exact:.1f} ({100 * (measured / exact - 1):+.1f} %); K^ = {measured / 6:.1f}"
        )
    return lines


def draw_ranks(records: Sequence[Mapping[str, Any]], ax: Any) -> None:
    """Share of exact K against SNR, over the cells that fit the layout."""
    of_grid = [r for r in records if r["part"] == "grid" and r["fits"]]
    for rule, layout in dict.fromkeys((r["rule"], r["layout"]) for r in of_grid):
        shares = [
            _share([r for r in of_grid if (r["rule"], r["layout"], r["snr"]) == (rule, layout, snr)]) for snr in _SNRS
        ]
        if rule == "auto":
            ax.plot(_SNRS, shares, "k-", linewidth=4, alpha=0.35, label="auto")
            continue
        colour = "k" if rule == "paper" else f"C{CLOSED_FORM.index(rule)}"
        style = ":" if layout == "vector" else "-"
        ax.plot(_SNRS, shares, style, color=colour, marker="o", label=f"{rule} {layout}")
    ax.set(xlabel="SNR, dB", ylabel="K exact, % of all cells that fit", ylim=(0, 101))
    ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))


def measure_ranks(config: Mapping[str, Any], full: bool, workers: int) -> tuple[dict[str, Any], list[str]]:
    """All records and the text about them."""
    cells = grid(config, full)
    # long ones first, so that the workers end together
    cells.sort(key=lambda c: -c.frames * c.points * c.trials * (50 if c.part in ("costly", "gaps") else 1))
    records = [record for _, found in run_parallel(run_cell, cells, workers, "K") for record in found]
    part = {name: [r for r in records if r["part"] == name] for name in ("grid", "costly", "paper")}
    lines = [*_grid_lines(part["grid"]), "", *_costly_lines(part["costly"]), "", *_side_lines(records)]
    return {"records": records}, [*lines, "", *_paper_lines(part["paper"])]
