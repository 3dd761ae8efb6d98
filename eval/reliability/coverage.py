"""How often the ellipsoids of ``covariance3d`` hold the true points, at several levels: synthetic and public bodies.

One depth flip per sequence, chosen by the smaller error; points and truth are centred per frame, as the covariance is.
Synthetic sequences say whether the errors that follow from noise are stated rightly. The public ones are real motion
of which no finite family of shapes is true; their noise is added here and its level is not told.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import torchrecon as tr
from eval.job import run_parallel
from eval.reliability.world import low_rank_tracks
from torchrecon._typing import Float, Tensor
from torchrecon.data.benchmarks import SEQUENCES, load_benchmark

__all__ = ["LEVELS", "Sequence3D", "draw_coverage", "measure_coverage", "squared_distances"]

# quantiles of chi-square with three degrees of freedom
LEVELS = {0.5: 2.36597, 0.8: 4.64163, 0.9: 6.25139, 0.95: 7.81473, 0.99: 11.34487}
_TARGET = {"synthetic": (93.0, 97.0), "public": (90.0, 98.0)}


@dataclass(frozen=True)
class Sequence3D:
    """One sequence to solve.

    Attributes:
        source: ``synthetic`` or ``public``.
        name: of the public sequence, or frames, points and K of the synthetic one.
        snr: decibels.
        seed: of the body and the noise.
        folder: of the public sequences.
    """

    source: str
    name: str | tuple[int, int, int]
    snr: float
    seed: int
    folder: str = ""

    def __str__(self) -> str:
        return f"{self.name} {self.snr:g} dB"


def squared_distances(
    points3d: Float[Tensor, "frames points 3"],
    covariance3d: Float[Tensor, "frames points 3 3"],
    truth: Float[Tensor, "frames points 3"],
) -> Float[Tensor, "frames points"]:
    """Squared Mahalanobis distance of the truth, with one depth flip for the sequence.

    Example:
        >>> import torch
        >>> truth = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> seen = (truth - truth.mean(1, keepdim=True)) * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
        >>> moved = seen + torch.tensor([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]] + 3 * [[0.0] * 3]], dtype=torch.float64)
        >>> spread = 4 * torch.eye(3, dtype=torch.float64).expand(4, 5, 3, 3)
        >>> [round(value, 6) for value in squared_distances(moved, spread, truth)[0].tolist()]
        [0.25, 0.25, 0.0, 0.0, 0.0]
    """
    target = truth - truth.mean(-2, keepdim=True)
    centred = points3d - points3d.mean(-2, keepdim=True)
    flip = target.new_tensor([1.0, 1.0, -1.0])
    away, mirrored = centred - target, centred * flip - target
    if float(mirrored.square().sum()) < float(away.square().sum()):
        away, covariance3d = mirrored, covariance3d * flip * flip[:, None]
    return (away * torch.linalg.solve(covariance3d, away[..., None])[..., 0]).sum(-1)


def run_sequence(item: Sequence3D) -> dict[str, Any]:
    """Solve one sequence and compare its ellipsoids with the truth."""
    if item.source == "synthetic":
        frames, points, bases = (int(number) for number in item.name)
        made = low_rank_tracks(frames, points, bases, item.snr, item.seed)
        xy, truth = made.xy, made.points3d
    else:
        truth = load_benchmark(str(item.name), item.folder).points3d.double()
        truth = truth - truth.mean(-2, keepdim=True)
        generator = torch.Generator().manual_seed(item.seed)
        sigma = truth[..., :2].square().mean().sqrt() * 10 ** (-item.snr / 20)
        noise = torch.randn(truth[..., :2].shape, generator=generator, dtype=truth.dtype)
        xy = truth[..., :2] + sigma * noise
    answer = tr.reconstruct(tr.Tracks(xy))
    distances = squared_distances(answer.points3d, answer.covariance3d, truth)
    return {
        "source": item.source,
        "name": str(item.name),
        "snr": item.snr,
        "nees": float(distances.mean()) / 3,
        "held": {str(level): float((distances <= limit).double().mean()) for level, limit in LEVELS.items()},
        "status": str(answer.statuses[0]),
    }


def _mean(records: Sequence[Mapping[str, Any]], level: float) -> float:
    return 100 * sum(r["held"][str(level)] for r in records) / len(records)


def _lines(records: list[dict[str, Any]]) -> list[str]:
    head = "".join(f"{100 * level:>8g}" for level in LEVELS)
    lines = [f"True points inside the ellipsoid, percent, by its level:{head}   95: lowest sequence"]
    for source in dict.fromkeys(r["source"] for r in records):
        of = [r for r in records if r["source"] == source]
        low, high = _TARGET[source]
        groups = [(f"{snr:g} dB", [r for r in of if r["snr"] == snr]) for snr in sorted({r["snr"] for r in of})]
        if source == "public":
            groups += [(name, [r for r in of if r["name"] == name]) for name in dict.fromkeys(r["name"] for r in of)]
        for label, rows in [*groups, ("all", of)]:
            share = _mean(rows, 0.95)
            lowest = min(100 * r["held"]["0.95"] for r in rows)
            mark = "hit" if low <= share <= high else "MISSED"
            text = "".join(f"{_mean(rows, level):>8.1f}" for level in LEVELS)
            lines.append(f"  {source} {label} ({len(rows)})".ljust(55) + f"{text}   {lowest:.1f}  {mark}")
    return lines


def draw_coverage(records: Sequence[Mapping[str, Any]], ax: Any) -> None:
    """Reliability diagram: nominal against empirical coverage."""
    nominal = [100 * level for level in LEVELS]
    ax.plot([0, 100], [0, 100], color="0.7", linewidth=1)
    for source, snr in dict.fromkeys((r["source"], r["snr"]) for r in records):
        of = [r for r in records if (r["source"], r["snr"]) == (source, snr)]
        style = "-" if source == "synthetic" else "--"
        ax.plot(nominal, [_mean(of, level) for level in LEVELS], style, marker="o", label=f"{source} {snr:g} dB")
    ax.set(xlabel="level of the ellipsoid, %", ylabel="true points inside, %", xlim=(40, 101), ylim=(0, 101))
    ax.legend(fontsize=8)


def measure_coverage(
    config: Mapping[str, Any], data: Path | None, workers: int
) -> tuple[dict[str, Any], list[str]]:  # fmt: skip
    """All records and the text about them; public sequences where the data folder has them."""
    part = config["coverage"]
    items = [
        Sequence3D("synthetic", tuple(size), snr, 20_000_000 + 100 * i + j)
        for i, size in enumerate(part["sizes"])
        for snr in part["snr"]
        for j in range(part["trials"])
    ]
    if data is not None:
        chosen = SEQUENCES[: part["public"]]
        items = [
            *(Sequence3D("public", name, snr, 21_000_000, str(data / "nrsfm")) for name in chosen
              for snr in part["public_snr"]),
            *items,
        ]  # fmt: skip
    records = [found for _, found in run_parallel(run_sequence, items, workers, "3D coverage")]
    records.sort(key=lambda r: (r["source"] == "public", r["snr"], r["name"]))
    if math.isnan(sum(r["nees"] for r in records)):
        raise tr.ReconError("coverage: a covariance is not finite")
    return {"records": records}, _lines(records)
