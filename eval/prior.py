"""The learned prior before a camera that stands: ``python -m eval.prior [--data ../shared/data]``.

With ``--data``: captured motion filmed anew (subjects that the prior has not seen) and HumanEva as it was filmed (never
trained on). Without: the synthetic world. No intrinsics, no depth, 15 named joints (21 in the synthetic world). Missing
weights are trained first. Predictions are cached, so a second run only scores; ground truth is read by metrics alone.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

import torchrecon as tr
from eval.job import (
    ROOT,
    Cache,
    provenance,
    read_arrays,
    run_parallel,
    source_digest,
    write_arrays,
    write_json,
    write_text,
)
from eval.people import FOLDS, TRAINING, Person, captured, few, folds_of, humaneva, synthetic
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_rotation
from torchrecon.metrics import error3d_camera, pa_mpjpe
from torchrecon.models.prior import load_prior

__all__ = ["ROWS", "mahalanobis", "main", "score"]

ROWS = {
    "prior": "torchrecon default with prior",
    "alone": "the prior alone, no solver",
    "default": "torchrecon default, no prior",
    "rigid": "rigid factorisation",
    "flat": "no depth at all",
}
TARGETS = {"dev": 60.0, "humaneva": 70.0}
"""PA-MPJPE, mm."""
TARGET_CAMERA = 0.12
"""error3d_camera in the synthetic world."""
LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)
SMOKE = ("--data.clips", "60", "--data.steps", "60", "--data.batch_size", "32")


@dataclass(frozen=True)
class _Task:
    person: Person
    weights: str
    paths: dict[str, Path]


def _solve(task: _Task) -> None:
    """The answers of the rows in ``paths`` for one sequence, stored."""
    tracks, prior = task.person.tracks, load_prior(task.weights)
    if "alone" in task.paths:
        belief = prior(tracks)
        arrays = {"points3d": belief.points3d, "covariance3d": belief.covariance3d, "status": "the prior's belief"}
        write_arrays(task.paths["alone"], arrays)
    if "default" not in task.paths:
        return
    xy = tracks.filled_xy()
    flat = torch.nn.functional.pad(xy - xy.mean(-2, keepdim=True), (0, 1))
    write_arrays(task.paths["flat"], {"points3d": flat, "status": "no depth"})
    default = tr.reconstruct(tracks)

    def solved(*_: Any, **__: Any) -> tr.Reconstruction:
        return default  # the same call with a prior solves the same thing first

    answers = {
        "default": default,
        "prior": tr.reconstruct(tracks, solver=solved, prior=prior),
        "rigid": tr.reconstruct(tracks, solver="rigid"),
    }
    for row, answer in answers.items():
        found = {"points3d": answer.points3d, "covariance3d": answer.covariance3d, "status": str(answer.status)}
        write_arrays(task.paths[row], found)


def mahalanobis(
    points3d: torch.Tensor, truth: torch.Tensor, covariance3d: torch.Tensor, in_camera: bool
) -> torch.Tensor:
    """Squared distance of the truth from each point in units of its covariance, (frames, points).

    Both centred per frame; the truth is brought to the unit of the answer by one factor for the sequence where it is in
    camera axes, else by a similarity in every frame, which makes distances smaller than they are.
    """
    answer, target = (value - value.mean(-2, keepdim=True) for value in (points3d, truth))
    if in_camera:
        target = target * (answer * target).sum() / target.square().sum()
    else:
        target = target @ nearest_rotation(target.mT @ answer)
        factor = (answer * target).sum((-1, -2)) / target.square().sum((-1, -2))
        target = target * factor[:, None, None]
    apart = (target - answer)[..., None]
    return (apart.mT @ torch.linalg.solve(covariance3d, apart))[..., 0, 0]


def score(person: Person, arrays: dict[str, Any]) -> dict[str, Any]:
    """Figures of one answer over the joints that are scored; millimetres."""
    points = torch.as_tensor(arrays["points3d"]).double()[:, person.scored]
    truth = person.truth.double()[:, person.scored]
    # A row that leaves the mirror open is given the better of the two, once for the sequence.
    flipped = points * points.new_tensor([1.0, 1.0, -1.0])
    pa = [float(1000 * pa_mpjpe(p, truth)) for p in (points, flipped)]
    row = {"name": person.name, "group": person.group, "source": person.source, "pa_mpjpe": pa[0], "pa_better": min(pa)}
    if person.in_camera:
        full = torch.as_tensor(arrays["points3d"]).double()
        row["error3d_camera"] = float(error3d_camera(full, person.truth.double(), align_scale="sequence"))
    if "covariance3d" in arrays:
        covariance = torch.as_tensor(arrays["covariance3d"]).double()[:, person.scored]
        distance = mahalanobis(points, truth, covariance, person.in_camera)
        row["within"] = [float((distance <= _ellipsoid(level)).double().mean()) for level in LEVELS]
    return row


def _ellipsoid(level: float) -> float:
    from scipy.stats import chi2

    return float(chi2.ppf(level, 3))


def _weights(data: Path | None, out: Path, smoke: bool, folder: Path) -> list[Path]:
    """Weights of every fold, made by the training job where they are not there or from other settings."""
    jobs: list[tuple[Path, list[str]]] = []
    if data is None:
        path = out / "prior.safetensors" if smoke else folder / "prior.safetensors"
        jobs.append((path, list(SMOKE) if smoke else []))
    else:
        files = [str(data / name) for name in TRAINING]
        for fold, subjects in enumerate(folds_of(data)):
            path = folder / f"fold{fold}.safetensors"
            jobs.append((path, ["--data", *files, "--exclude", ",".join(subjects), *(SMOKE if smoke else ())]))
            if smoke:
                jobs[-1] = (out / f"fold{fold}.safetensors", jobs[-1][1])
    for path, arguments in jobs:
        command = [sys.executable, "-m", "train.prior", *arguments, "--out", str(path)]
        print(f"{path}: {' '.join(command[1:])}", flush=True)
        if subprocess.run(command, cwd=ROOT, check=False).returncode != 0:
            raise ReconError("python -m train.prior failed; its message stands above")
    return [path for path, _ in jobs]


def table(records: Sequence[dict[str, Any]]) -> list[str]:
    """Means over sequences by group, source and row."""
    head = f"{'':<12}{'':<11}{'row':<32}{'n':>4}{'PA-MPJPE':>10}{'better':>8}{'camera':>8}{'in 95 %':>9}"
    lines = [head]
    for group in dict.fromkeys(r["group"] for r in records):
        of_group = [r for r in records if r["group"] == group]
        sources = list(dict.fromkeys(r["source"] for r in of_group))
        for source in [None, *sources] if len(sources) > 1 else [None]:
            for name, text in ROWS.items():
                here = [r for r in of_group if r["row"] == name and source in (None, r["source"])]
                if here:
                    lines.append(f"{group:<12}{source or 'all':<11}{text:<32}{len(here):>4}" + _cells(here))
    return lines


def _mean(records: Sequence[dict[str, Any]], key: str) -> float | None:
    values = [r[key] for r in records if key in r]
    return sum(values) / len(values) if values else None


def _cells(records: Sequence[dict[str, Any]]) -> str:
    within = [r["within"][LEVELS.index(0.95)] for r in records if "within" in r]
    camera = _mean(records, "error3d_camera")
    cells = f"{_mean(records, 'pa_mpjpe'):>10.1f}{_mean(records, 'pa_better'):>8.1f}"
    cells += f"{'-' if camera is None else f'{camera:.3f}':>8}"
    return cells + f"{'-' if not within else f'{100 * sum(within) / len(within):.1f} %':>9}"


def verdicts(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each target with what became of it."""
    found = []
    for group, limit in TARGETS.items():
        of_group = {row: [r for r in records if r["group"] == group and r["row"] == row] for row in ROWS}
        if not of_group["prior"]:
            continue
        for row in ("prior", "alone"):
            value = _mean(of_group[row], "pa_mpjpe")
            found.append(
                {"target": f"{group}, {ROWS[row]}: PA-MPJPE at most {limit:g} mm", "value": value, "limit": limit}
            )
        for key, how in (("pa_mpjpe", "as it answers"), ("pa_better", "given the better mirror")):
            best = min(v for row in ("default", "rigid", "flat") if (v := _mean(of_group[row], key)) is not None)
            text = f"{group}: at most half of the best row without a prior, {how} ({best:.1f} mm)"
            found.append({"target": text, "value": _mean(of_group["prior"], "pa_mpjpe"), "limit": best / 2})
    world = [r for r in records if r["group"] == "synthetic" and r["row"] == "prior"]
    if world:
        text = f"synthetic world: error3d_camera at most {TARGET_CAMERA}"
        found.append({"target": text, "value": _mean(world, "error3d_camera"), "limit": TARGET_CAMERA})
    return [{**item, "met": item["value"] <= item["limit"]} for item in found]


def draw(records: Sequence[dict[str, Any]], path: Path) -> None:
    """PA-MPJPE of all sequences, sorted, by row; and how much of the truth lies inside the ellipsoids."""
    from matplotlib.figure import Figure

    from torchrecon.viz.views import save_figure

    groups = list(dict.fromkeys(r["group"] for r in records))
    figure = Figure(figsize=(4.4 * (len(groups) + 1), 3.6), layout="constrained")
    axes = figure.subplots(1, len(groups) + 1, squeeze=False)[0]
    for ax, group in zip(axes, groups, strict=False):
        for row, text in ROWS.items():
            values = sorted(r["pa_mpjpe"] for r in records if r["group"] == group and r["row"] == row)
            if values:
                ax.plot([(i + 0.5) / len(values) for i in range(len(values))], values, label=text)
        if group in TARGETS:
            ax.axhline(TARGETS[group], color="0.6", lw=0.8)
        ax.set(title=group, xlabel="share of the sequences", ylabel="PA-MPJPE, mm", ylim=(0, None))
        within = [r["within"] for r in records if r["group"] == group and r["row"] == "alone"]
        axes[-1].plot(LEVELS, torch.tensor(within).mean(0).tolist(), "o-", label=group)
    axes[0].legend(fontsize=7)
    axes[-1].plot([0, 1], [0, 1], color="0.6", lw=0.8)
    axes[-1].set(title="prior alone", xlabel="ellipsoid", ylabel="share of the truth inside", xlim=(0, 1), ylim=(0, 1))
    axes[-1].legend(fontsize=7)
    save_figure(figure, path)


def main(argv: list[str] | None = None) -> int:
    """Train what is missing, predict, score; writes ``prior.json``, ``prior.txt`` and ``prior.png``."""
    parser = argparse.ArgumentParser(prog="python -m eval.prior", description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, metavar="DIR", help="holds mocap/ and keypoints/; default: synthetic")
    parser.add_argument(
        "--every", type=int, default=12, metavar="N", help="solvers run on every N-th captured sequence"
    )
    parser.add_argument("--weights", type=Path, default=ROOT / "runs" / "prior", metavar="DIR")
    parser.add_argument("--smoke", action="store_true", help="few sequences, a prior hardly trained")
    parser.add_argument("--fresh", action="store_true", help="throw away predictions of another configuration")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, default=Path("runs/prior-eval"), metavar="DIR")
    options = parser.parse_args(argv)
    started = time.perf_counter()
    try:
        weights = _weights(options.data, options.out, options.smoke, options.weights)
        if options.data is None:
            people = synthetic(options.seed, 1 if options.smoke else 3)
            people = people[:3] if options.smoke else people
            chosen = people
        else:
            people = captured(options.data, options.seed) + humaneva(options.data)
            people = people[::60] if options.smoke else people
            chosen = people[:2] if options.smoke else few(people, options.every)
        config = {
            "sources": source_digest("torchrecon/nrsfm", "torchrecon/models", "torchrecon/rank", "eval/people.py"),
            "weights": [hashlib.sha256(path.read_bytes()).hexdigest() for path in weights],
            "data": None if options.data is None else str(options.data.resolve()),
            "seed": options.seed,
        }
        cache = Cache(options.out / "cache", config, options.fresh)
        with_solvers = {person.name for person in chosen}
        tasks = []
        for person in people:
            rows = ROWS if person.name in with_solvers else ("alone",)
            paths = {row: cache.path(row, f"{person.name.replace(' ', '_')}.npz") for row in rows}
            tasks.append(_Task(person, str(weights[person.fold]), paths))
        missing = [task for task in tasks if not all(path.is_file() for path in task.paths.values())]
        for _ in run_parallel(_solve, missing, options.workers, "sequences", lambda task: task.person.name):
            pass
        records = []
        for task in tasks:
            for row, path in task.paths.items():
                arrays = read_arrays(path)
                records.append({"row": row, **score(task.person, arrays), "status": str(arrays["status"])})
    except ReconError as error:
        print(f"eval.prior: {error}", file=sys.stderr)
        return 2
    found = verdicts(records)
    lines = [
        "Static camera, no intrinsics. PA-MPJPE: mm, similarity in every frame, no reflection ('better': the better of",
        "both mirrors, once a sequence); camera: error3d_camera, one scale; in 95 %: truth inside the 95 % ellipsoids",
        *table(records),
        *(f"{'met ' if v['met'] else 'MISSED'}  {v['target']}: {v['value']:.3g}" for v in found),
    ]
    source = provenance("cpu", options.seed) | {"folds": FOLDS, "seconds": time.perf_counter() - started}
    write_json(
        options.out / "prior.json", {"records": records, "targets": found, "config": config, "provenance": source}
    )
    write_text(options.out / "prior.txt", "\n".join(lines) + "\n")
    draw(records, options.out / "prior.png")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
