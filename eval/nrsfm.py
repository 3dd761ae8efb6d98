"""Solvers on sequences with known 3D: ``python -m eval.nrsfm [--data ../shared/data/nrsfm]``.

With ``--data``: the field's eight public sequences, complete tracks, orthographic. Without: surface points of the
synthetic world, seen in bands of 15 to 40 frames as real tracks are, pinhole camera turning about the player.
One configuration, no K given, nothing chosen per sequence. Ground truth is read by the metric alone.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import torch

import torchrecon as tr
from eval.job import provenance, write_json
from torchrecon.data.benchmarks import SEQUENCES, load_benchmark
from torchrecon.data.synthetic import ACTIONS, SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.errors import ReconError
from torchrecon.metrics import error3d_akhter, error3d_camera

__all__ = ["main"]

# Public figures under the same metric (error3d_camera): the strongest public code, run with its defaults (PND2), and
# the best figure of anybody. They are printed beside ours and take no part in anything.
REFERENCE = {
    "drink": (0.0031, 0.0031),
    "pickup": (0.0133, 0.0133),
    "yoga": (0.0128, 0.0122),
    "stretch": (0.0150, 0.0124),
    "dance": (0.1247, 0.0751),
    "walking": (0.0407, 0.0391),
    "face": (0.0150, 0.0150),
    "shark": (0.0272, 0.0135),
}


def band_tracks(action: str, seed: int, points: int, turn: float) -> tuple[tr.Tracks, torch.Tensor]:
    """Tracks of true surface points with 0.7 px noise, each seen 15 to 40 frames, and their true 3D."""
    g = torch.Generator().manual_seed(seed)
    body = sample_body(g)
    motion = sample_motion(action, body, frames=60, fps=25.0, generator=g)
    camera = turning_camera(motion, total_turn_deg=turn, distance=7.0, generator=g)
    clip = SyntheticClip(body, motion, camera, seed=seed)
    truth, seen = clip.trajectory(clip.sample_surface(2 * points, g))
    truth = truth.double()
    chosen: list[tuple[int, int, int]] = []
    edges = torch.nn.functional.pad(seen.T.to(torch.int8), (1, 1)).diff(dim=1)
    for point in range(truth.shape[1]):
        starts, ends = (edges[point] == 1).nonzero()[:, 0], (edges[point] == -1).nonzero()[:, 0]
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            if end - start >= 15:
                chosen.append((point, start, min(end, start + int(torch.randint(15, 41, (1,), generator=g)))))
    keep = [chosen[i] for i in torch.randperm(len(chosen), generator=g)[:points].tolist()]
    index = torch.tensor([p for p, _, _ in keep])
    visible = torch.zeros(60, len(keep), dtype=torch.bool)
    for column, (_, start, end) in enumerate(keep):
        visible[start:end, column] = True
    k = camera.intrinsics.double()
    pixels = truth[:, index] @ k.T
    xy = pixels[..., :2] / pixels[..., 2:] + 0.7 * torch.randn(60, len(keep), 2, generator=g).double()
    covariance = (0.49 * torch.eye(2, dtype=torch.float64)).expand(60, len(keep), 2, 2)
    return tr.Tracks(xy, visible, covariance, intrinsics=k), truth[:, index]


def measure(name: str, solver: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """One cell of the table."""
    if arguments.data is not None:
        sequence = load_benchmark(name, arguments.data)
        truth, tracks, scale = sequence.points3d, tr.Tracks(sequence.points3d[..., :2].clone()), "none"
    else:
        tracks, truth = band_tracks(name, arguments.seed, arguments.points, arguments.turn)
        scale = "sequence"
    start, cpu = time.perf_counter(), time.process_time()
    answer = tr.reconstruct(tracks, solver=solver)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    flat = truth * truth.new_tensor([1.0, 1.0, 0.0])
    row = {
        "sequence": name,
        "solver": solver,
        "frames": tracks.frames,
        "points": tracks.points,
        "error3d_camera": float(error3d_camera(answer.points3d, truth, tracks.visible, align_scale=scale)),
        "flat": float(error3d_camera(flat, truth, tracks.visible, align_scale=scale)),
        "rank": answer.rank,
        "seconds": seconds,
        "cpu_seconds": cpu,
        "status": str(answer.statuses[0]),
    }
    if arguments.data is not None:
        # Shapes in world axes where the sequence has them, else with the estimated camera applied.
        world = sequence.canonical is not None and name != "dance"
        pair = (answer.canonical, sequence.canonical) if world else (answer.points3d, truth)
        row["error3d_akhter"] = float(error3d_akhter(*pair))
        row["reference"] = dict(zip(("pnd2", "best_known"), REFERENCE[name], strict=True))
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as text."""
    head = f"{'sequence':10s} {'solver':10s} {'error3d_camera':>14s} {'flat':>6s} {'K':>3s} {'s':>6s} {'CPU s':>6s}"
    public = "reference" in rows[0]
    lines = [head + (f" {'akhter':>7s} {'PND2':>6s} {'best':>6s}" if public else "")]
    for row in rows:
        line = f"{row['sequence']:10s} {row['solver']:10s} {row['error3d_camera']:14.4f} {row['flat']:6.3f}"
        line += f" {row['rank']:3d} {row['seconds']:6.1f} {row['cpu_seconds']:6.1f}"
        if public:
            pnd2, best = row["reference"].values()
            line += f" {row['error3d_akhter']:7.4f} {pnd2:6.4f} {best:6.4f}"
        lines.append(line)
    note = "error3d_camera: camera axes, centred per frame, one depth sign per sequence"
    return "\n".join([*lines, note + ("" if public else ", one scale per sequence, observed entries"), ""])


def main(arguments: list[str] | None = None) -> int:
    """Measure and write ``nrsfm.json`` and ``nrsfm.txt``."""
    parser = argparse.ArgumentParser(prog="python -m eval.nrsfm", description=__doc__)
    parser.add_argument("--data", metavar="DIR", help="folder of the public sequences; default: the synthetic world")
    parser.add_argument("--sequence", nargs="+", metavar="NAME", help="default: all")
    parser.add_argument("--solver", nargs="+", default=["auto"], metavar="NAME")
    parser.add_argument("--points", type=int, default=500, help="tracks per synthetic sequence")
    parser.add_argument("--turn", type=float, default=300.0, help="degrees that the synthetic camera turns in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", default="runs/nrsfm", metavar="DIR")
    options = parser.parse_args(arguments)
    known = SEQUENCES if options.data is not None else ACTIONS[:5]
    rows: list[dict[str, Any]] = []
    try:
        for name in options.sequence or known:
            if name not in known:
                raise ReconError(f"--sequence {name}: is not one of {', '.join(known)}")
            for solver in options.solver:
                rows.append(measure(name, solver, options))
                print(table(rows[-1:]).splitlines()[1], file=sys.stderr, flush=True)
    except ReconError as error:
        print(f"eval.nrsfm: {error}", file=sys.stderr)
        return 2
    text = table(rows)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "nrsfm.json", {"rows": rows, "provenance": provenance("cpu", options.seed)})
    (out / "nrsfm.txt").write_text(text)
    print(text, end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
