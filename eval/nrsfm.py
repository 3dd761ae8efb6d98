"""Solvers on sequences with known 3D: ``python -m eval.nrsfm [--data ../shared/data/nrsfm]``.

With ``--data``: the field's eight public sequences, complete tracks, orthographic; where the folder is that of the
keypoints, HumanEva: 15 joints of people before one real camera that stands (``--view``); where it is that of the motion
capture, 31 joints in a sample of everyday trials before a camera that turns. Without: surface points of the synthetic
world, seen in bands of 15 to 40 frames as real tracks are, pinhole camera turning about the player.
One configuration, nothing chosen per sequence, and no K given unless ``--rank`` says so: ``paper`` takes the K that
the papers of the known methods picked by hand for each sequence. Ground truth is read by the metric alone.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch

import torchrecon as tr
from eval.floor import known_subspace_floor
from eval.job import provenance, write_json
from eval.recordings import CAMERAS as VIEWS
from eval.recordings import FILE, FPS, at_image_scale, recording, recordings
from eval.trials import FILE as TRIALS
from eval.trials import sample, trial, trials
from torchrecon.data.benchmarks import SEQUENCES, Benchmark, load_benchmark
from torchrecon.data.synthetic import ACTIONS, SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.data.views import CAMERAS, degrade_tracks, film_again
from torchrecon.errors import ReconError
from torchrecon.metrics import error3d_akhter, error3d_camera, pa_mpjpe

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

# K as picked by hand per sequence in the papers of the methods (csf, and pta on walking and face: from memory), and
# the figures reported for it (error3d_akhter).
PAPER_RANK = {
    "pta": {"drink": 13, "pickup": 12, "yoga": 11, "stretch": 12, "dance": 5, "walking": 2, "face": 5},
    "csf": {"drink": 6, "pickup": 6, "yoga": 7, "stretch": 8, "dance": 2, "walking": 2, "face": 3, "shark": 3},
    "bmm": {"drink": 12, "pickup": 12, "yoga": 10, "stretch": 11, "dance": 10, "walking": 8, "face": 7, "shark": 4},
}
PAPER_AKHTER = {
    "pta": {"drink": 0.0250, "pickup": 0.2369, "yoga": 0.1625, "stretch": 0.1088, "dance": 0.2956},
    "bmm": {
        "drink": 0.0266,
        "pickup": 0.1731,
        "yoga": 0.1150,
        "stretch": 0.1034,
        "dance": 0.1864,
        "walking": 0.1298,
        "face": 0.0303,
        "shark": 0.2357,
    },
}


def chosen_rank(option: str, solver: str, sequence: str) -> int | Literal["auto"]:
    """K for one cell: an integer, the one of the paper, or the estimate (also where no paper's K is on record)."""
    if option == "paper":
        return PAPER_RANK.get(solver, {}).get(sequence, "auto")
    if option == "auto":
        return "auto"
    if not option.isdecimal() or int(option) < 1:
        raise ReconError(f"--rank {option}: is neither 'auto' nor 'paper' nor a positive integer")
    return int(option)


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


def _is_keypoints(data: str | None) -> bool:
    return data is not None and (Path(data) / FILE).is_file()


def _is_mocap(data: str | None) -> bool:
    return data is not None and (Path(data) / TRIALS).is_file()


def _public(name: str, arguments: argparse.Namespace) -> tuple[Benchmark, torch.Tensor]:
    """A sequence with its truth in the axes of the camera that is asked for."""
    mocap = _is_mocap(arguments.data)
    sequence = trial(name, Path(arguments.data)) if mocap else load_benchmark(name, arguments.data)
    if arguments.camera == "orbit":
        return sequence, sequence.points3d
    if sequence.canonical is None:
        raise ReconError(f"--camera {arguments.camera}: {name} has no world-frame truth to film again")
    return sequence, film_again(sequence.canonical, sequence.points3d, arguments.camera)


def measure(name: str, solver: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """One cell of the table."""
    generator = torch.Generator().manual_seed(arguments.seed)
    sequence = metres = None
    scale: Literal["none", "sequence"] = "sequence"
    if _is_keypoints(arguments.data):
        xy, metres = recording(name, arguments.view, Path(arguments.data))
        tracks = degrade_tracks(xy, arguments.noise, arguments.missing, arguments.gaps, generator=generator)
        tracks = replace(tracks, fps=FPS)
        truth = at_image_scale(metres, xy)
    elif arguments.data is not None:
        sequence, truth = _public(name, arguments)
        scale = "none"
        tracks = degrade_tracks(truth[..., :2], arguments.noise, arguments.missing, arguments.gaps, generator=generator)
    else:
        tracks, truth = band_tracks(name, arguments.seed, arguments.points, arguments.turn)
    rank = chosen_rank(arguments.rank, solver, name)
    start, cpu = time.perf_counter(), time.process_time()
    answer = tr.reconstruct(tracks, rank, solver=solver)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    flat = truth * truth.new_tensor([1.0, 1.0, 0.0])
    # Points that are filled are scored too where the truth is known everywhere; bands are scored where they are seen.
    scored = torch.ones_like(tracks.visible) if arguments.data is not None else tracks.visible
    row = {
        "sequence": name,
        "solver": solver,
        "frames": tracks.frames,
        "points": tracks.points,
        "error3d_camera": float(error3d_camera(answer.points3d, truth, scored, align_scale=scale)),
        "flat": float(error3d_camera(flat, truth, scored, align_scale=scale)),
        "rank": answer.rank,
        "rank_from": "estimate" if rank == "auto" else "paper" if arguments.rank == "paper" else "given",
        "seconds": seconds,
        "cpu_seconds": cpu,
        "status": str(answer.statuses[0]),
    }
    if metres is not None:
        # The better of the two mirror images, one for the sequence, as for error3d_camera.
        both = (answer.points3d, answer.mirrored().points3d)
        row["pa_mpjpe_mm"] = 1000 * min(float(pa_mpjpe(shape, metres)) for shape in both)
    if sequence is not None:
        # Shapes in world axes where the sequence has them, else with the estimated camera applied.
        world = sequence.canonical is not None and name != "dance" and arguments.camera == "orbit"
        world = world and not _is_mocap(arguments.data)
        pair = (answer.canonical, sequence.canonical) if world else (answer.points3d, truth)
        row["error3d_akhter"] = float(error3d_akhter(*pair))
        # The public figures are of complete, exact tracks from the first camera.
        clean = arguments.camera == "orbit" and arguments.noise == arguments.missing == 0
        known = REFERENCE.get(name, (None, None)) if clean else (None, None)
        row["reference"] = dict(zip(("pnd2", "best_known"), known, strict=True))
        if arguments.noise > 0 or arguments.missing > 0:
            # The unit of the noise is that of ``degrade_tracks``.
            centred = truth[..., :2] - truth[..., :2].mean(-2, keepdim=True)
            row["floor"] = known_subspace_floor(tracks, truth, arguments.noise * float(centred.abs().max()))
        row["reference"]["akhter"] = PAPER_AKHTER.get(solver, {}).get(name)
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as text."""
    public, people, floor = (key in rows[0] for key in ("reference", "pa_mpjpe_mm", "floor"))
    width = max(10, *(len(row["sequence"]) for row in rows))
    head = (
        f"{'sequence':{width}s} {'solver':10s} {'error3d_camera':>14s} {'flat':>6s} {'K':>4s} {'s':>6s} {'CPU s':>6s}"
    )
    head += f" {'PA mm':>6s}  status" if people else ""
    head += f" {'akhter':>7s} {'paper':>6s} {'PND2':>6s} {'best':>6s}" if public else ""
    lines = [head + (f" {'floor':>6s}" if floor else "")]
    for row in rows:
        line = f"{row['sequence']:{width}s} {row['solver']:10s} {row['error3d_camera']:14.4f} {row['flat']:6.3f}"
        star = "*" if row["rank_from"] == "estimate" else " "
        line += f" {row['rank']:3d}{star} {row['seconds']:6.1f} {row['cpu_seconds']:6.1f}"
        if public:
            known = (row["reference"][key] for key in ("akhter", "pnd2", "best_known"))
            line += f" {row['error3d_akhter']:7.4f} " + " ".join("     -" if k is None else f"{k:6.4f}" for k in known)
            line += f" {row['floor']:6.4f}" if floor else ""
        if people:
            line += f" {row['pa_mpjpe_mm']:6.0f}  {row['status'].split(':')[0]}"
        lines.append(line)
    note = "* K estimated from the tracks\nerror3d_camera: camera axes, centred per frame, one depth sign per sequence"
    legend = ["paper: error3d_akhter reported for the method, with its own K for each sequence"] if public else []
    if people:
        legend = [
            "at the scale of the image in every frame; PA mm: PA-MPJPE, millimetres, one mirror image per sequence"
        ]
    if floor:
        legend.append("floor: of one who knows views, mean, modes and their variances, frame by frame, at the best K")
    observed = "" if people else ", observed entries"
    return "\n".join([*lines, note + ("" if public else f", one scale per sequence{observed}"), *legend, ""])


def _gaps(text: str) -> tuple[int, int]:
    """``A-B`` as two numbers of frames."""
    first, _, last = text.partition("-")
    if not (first.isdecimal() and last.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form A-B")
    return int(first), int(last)


def main(arguments: list[str] | None = None) -> int:
    """Measure and write ``nrsfm.json`` and ``nrsfm.txt``."""
    parser = argparse.ArgumentParser(prog="python -m eval.nrsfm", description=__doc__)
    parser.add_argument("--data", metavar="DIR", help="nrsfm/, keypoints/ or mocap/ folder; default: synthetic")
    parser.add_argument("--sequence", nargs="+", metavar="NAME", help="default: all, or a sample of mocap/")
    parser.add_argument("--solver", nargs="+", default=["auto"], metavar="NAME")
    parser.add_argument("--rank", default="auto", metavar="auto|paper|K", help="number of shape bases")
    parser.add_argument("--camera", default="orbit", choices=("orbit", *CAMERAS), help="of public sequences and mocap")
    parser.add_argument("--view", type=int, default=0, choices=range(VIEWS), help="camera of HumanEva")
    parser.add_argument("--noise", type=float, default=0.0, metavar="S", help="std, share of the largest coordinate")
    parser.add_argument("--missing", type=float, default=0.0, metavar="SHARE", help="share of entries not seen")
    parser.add_argument("--gaps", type=_gaps, metavar="A-B", help="frames of a gap; default: entries drop out singly")
    parser.add_argument("--points", type=int, default=500, help="tracks per synthetic sequence")
    parser.add_argument("--turn", type=float, default=300.0, help="degrees that the synthetic camera turns in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", default="runs/nrsfm", metavar="DIR")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    try:
        if _is_keypoints(options.data):
            if options.camera != "orbit":
                raise ReconError(f"--camera {options.camera}: HumanEva is taken as filmed; --view picks a camera")
            known = asked = recordings(Path(options.data))
        elif _is_mocap(options.data):
            known, asked = trials(Path(options.data)), sample(Path(options.data))
        else:
            known = asked = list(SEQUENCES if options.data is not None else ACTIONS[:5])
        for name in options.sequence or asked:
            if name not in known:
                more = f" and {len(known) - 20} more" if len(known) > 20 else ""
                raise ReconError(f"--sequence {name}: is not one of {', '.join(known[:20])}{more}")
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
