"""Gaps of one lost joint: error of every filler by length of the gap, what is flagged, and whether variances hold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from eval.job import run_parallel
from eval.reliability.motions import Joints2D, humaneva_joints, mocap_joints, synthetic_joints
from torchrecon.gaps import fill_gaps
from torchrecon.measurement import Tracks

__all__ = ["draw_filling", "measure_filling"]

METHODS = ("auto", "abg", "rts", "low_rank")
_LOST = 10.0  # pixels: an error beyond it is a catastrophe unless it is flagged
_WINDOW = 120  # frames around the gap that the fillers see


@dataclass(frozen=True, eq=False)
class Trial:
    """One sequence of one source with its noise; every length of gap is tried on it."""

    source: str
    film: Joints2D
    lengths: tuple[int, ...]
    noise: float
    seed: int

    def __str__(self) -> str:
        return f"{self.source} {self.film.name}"


def run_trial(trial: Trial) -> list[dict[str, Any]]:
    """One joint lost for each length, filled by each method."""
    g = torch.Generator().manual_seed(trial.seed)
    truth = trial.film.xy[:_WINDOW]
    frames, joints, _ = truth.shape
    noisy = truth + trial.noise * torch.randn(truth.shape, generator=g, dtype=truth.dtype)
    covariance = (trial.noise**2 * torch.eye(2, dtype=truth.dtype)).expand(frames, joints, 2, 2)
    records = []
    for length in trial.lengths:
        joint = int(torch.randint(joints, (), generator=g))
        start = int(torch.randint(8, frames - length - 8, (), generator=g))
        visible = torch.ones(frames, joints, dtype=torch.bool)
        visible[start : start + length, joint] = False
        tracks = Tracks(noisy, visible, covariance, fps=trial.film.fps)
        for method in METHODS:
            filled = fill_gaps(tracks, method)
            inside = slice(start, start + length)
            away = filled.xy[inside, joint] - truth[inside, joint]
            solved = torch.linalg.solve(filled.covariance[inside, joint], away[..., None])[..., 0]
            distance = away.norm(dim=-1)
            records.append(
                {
                    "source": trial.source,
                    "film": trial.film.name,
                    "length": length,
                    "method": method,
                    "square": float(distance.square().mean()),
                    "nees": float((away * solved).sum(-1).mean()) / 2,
                    "lost": bool((distance > _LOST).any()),
                    "unflagged": bool(((distance > _LOST) & ~filled.low_confidence[inside, joint]).any()),
                    "flagged": bool(filled.low_confidence[inside, joint].any()),
                }
            )
    return records


def _lines(records: list[dict[str, Any]], lengths: Sequence[int]) -> list[str]:
    lines = []
    for source in dict.fromkeys(r["source"] for r in records):
        of = [r for r in records if r["source"] == source]
        films = len({r["film"] for r in of})
        lines.append(f"{source} ({films} sequences): RMSE px (median) inside a gap of n frames")
        lines.append(f"  {'method':<10}" + "".join(f"{n:>15}" for n in lengths))
        rmse: dict[tuple[str, int], float] = {}
        for method in METHODS:
            cells = []
            for n in lengths:
                squares = torch.tensor([r["square"] for r in of if r["method"] == method and r["length"] == n])
                rmse[method, n] = float(squares.mean().sqrt())
                cells.append(f"{rmse[method, n]:>6.2f} ({float(squares.median().sqrt()):.2f})".rjust(15))
            lines.append(f"  {method:<10}" + "".join(cells))
        ratios = [rmse["auto", n] / min(rmse[m, n] for m in METHODS if m != "auto") for n in lengths]
        marks = [f"{ratio:>11.2f} {'hit' if ratio <= 1.05 else 'no '}" for ratio in ratios]
        lines.append(f"  {'auto/best':<10}" + "".join(marks))
        nees = []
        for n in lengths:
            values = torch.tensor([r["nees"] for r in of if r["method"] == "auto" and r["length"] == n])
            nees.append(f"{float(values.median()):>15.2f}")
        lines.append(f"  {'NEES auto':<10}" + "".join(nees) + "   (median of gaps; honest: about 1)")
        auto = [r for r in of if r["method"] == "auto"]
        rates = [1000 * sum(r[key] for r in auto) / len(auto) for key in ("lost", "unflagged", "flagged")]
        lines.append(
            f"  auto, per 1000 gaps of {len(auto)}: {rates[0]:.0f} err by more than {_LOST:g} px, {rates[1]:.0f} of "
            f"them unflagged ({'hit' if rates[1] < 1 else 'MISSED'}, under 1); flagged {rates[2]:.0f}"
        )
    return lines


def draw_filling(records: Sequence[Mapping[str, Any]], ax: Any) -> None:
    """Median error against the length of the gap, all sources together."""
    lengths = sorted({r["length"] for r in records})
    for method in METHODS:
        of = [[r["square"] for r in records if r["method"] == method and r["length"] == n] for n in lengths]
        medians = [float(torch.tensor(squares).median().sqrt()) for squares in of]
        ax.plot(lengths, medians, "-" if method == "auto" else "--", marker="o", label=method)
    ax.set(xlabel="frames in the gap", ylabel="median error inside the gap, px", xscale="log", yscale="log")
    ax.set_xticks(lengths, [str(n) for n in lengths])
    ax.legend()


def measure_filling(config: Mapping[str, Any], data: Path | None, workers: int) -> tuple[dict[str, Any], list[str]]:
    """All records and the text about them; real sources where the data folder has them."""
    filling = config["filling"]
    films = filling["films"]
    sources = {"synthetic": synthetic_joints(films)}
    if data is not None:
        sources["mocap"] = mocap_joints(data / "mocap" / "dev.npz", films)
        sources["HumanEva"] = humaneva_joints(data / "keypoints" / "humaneva15_train.npz", films)
    lengths = tuple(filling["lengths"])
    noises = filling["noise"]
    trials = []
    for place, (source, found) in enumerate(sources.items()):
        for index, film in enumerate(found * math.ceil(films / len(found))):
            seed = 7_000_000 + 100_000 * place + index
            trials.append(Trial(source, film, lengths, noises[index % len(noises)], seed))
    records = [record for _, found in run_parallel(run_trial, trials, workers, "gaps") for record in found]
    records.sort(key=lambda r: (list(sources).index(r["source"]), r["film"], r["length"], r["method"]))
    return {"records": records}, _lines(records, lengths)
