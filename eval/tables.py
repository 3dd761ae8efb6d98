"""Tables 2 to 5: definitions, the paper's numbers, scores from the cache, and the printed table.

``python -m eval.table2`` matching degree and reconstruction accuracy; ``eval.table3`` PSNR; ``eval.table4`` SSIM;
``eval.table5`` MSE. The four share one film and one cache (see ``eval.leftout``), so the first pays for all.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from eval.job import Profile, provenance, write_json, write_text
from eval.leftout import Answer, Solved, answers_of, smoke_or_full, solve_rows
from eval.rows import Row
from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement.camera import project_points
from torchrecon.metrics import error3d_camera, matching_degree, mse, pck3d, psnr, ssim
from torchrecon.render.splat import splat

__all__ = ["NAMES", "PAPER", "VIEWS", "default_out", "main", "score", "table_text", "view_pictures"]

NAMES = {2: "matching", 3: "psnr", 4: "ssim", 5: "mse"}
VIEWS = ("input", "side", "top")
RASTER = 96.0  # pixels of a picture per stature, in every view
SIGMA = 2.0  # pixels: a point is a blob of 2 % of the stature
MARGIN = 12  # pixels around the body

DEFINITION = {
    2: "Matching degree, %: true body points of the reference frame, left out of the solve, within 3 px of their "
    "reprojection.\nReconstruction accuracy, %: points of the whole film within 150 mm (at 1.80 m stature) after one "
    "similarity without reflection for the sequence; after a translation alone where the row measures depth.",
    3: "PSNR, dB, = -10 log10 MSE of the pictures of Table 5 (peak 1). Higher is better.",
    4: "SSIM of Wang et al. 2004, 11 x 11 Gaussian window, of the pictures of Table 5; the paper prints 100 times it. "
    "Higher is better.",
    5: "MSE of pictures in [0, 1): left-out points as Gaussian blobs of 2 % of the stature, 96 pixels per stature, one "
    "renderer for rows and truth, over the person's box. Lower is better.",
}
PAPER: dict[int, dict[str, tuple[float, ...]]] = {
    2: {
        "ref4": (65.28, 68.77, 70.25, 68.05),
        "ref5": (72.39, 79.65, 80.37, 75.94),
        "ref6": (71.62, 78.43, 82.46, 76.23),
        "ref7": (83.58, 81.69, 89.72, 84.76),
        "ref8": (83.99, 82.31, 88.29, 85.47),
        "default": (95.68, 93.47, 96.53, 95.98),
    },
    3: {
        "ref4": (70.56, 71.36, 70.25),
        "ref5": (71.32, 72.18, 73.10),
        "ref6": (72.13, 72.36, 72.65),
        "ref7": (73.15, 73.59, 73.79),
        "ref8": (76.64, 77.38, 76.81),
        "default": (93.55, 93.89, 94.56),
    },
    4: {
        "ref4": (70.34, 71.12, 69.98),
        "ref5": (72.23, 72.34, 72.65),
        "ref6": (76.92, 76.53, 75.15),
        "ref7": (78.59, 78.25, 78.28),
        "ref8": (78.56, 78.15, 79.35),
        "default": (92.96, 93.57, 93.78),
    },
    5: {
        "ref4": (0.93, 1.20, 0.99),
        "ref5": (0.90, 1.21, 1.01),
        "ref6": (1.05, 1.09, 1.13),
        "ref7": (1.02, 0.96, 1.23),
        "ref8": (0.98, 1.22, 0.97),
        "default": (0.09, 0.11, 0.13),
    },
}
"""Tables 2 to 5 as printed: the three reference frames, in Table 2 the accuracy after them."""
NOTHING = Row("nothing", "an empty picture")
"""The zero of Tables 3 to 5: most of a picture is background, so what no point at all scores must be known."""
SSIM_TARGET = {"input": 0.93, "side": 0.85, "top": 0.85}


def view_pictures(solved: Solved, answer: Answer, frame: int) -> list[Float[Tensor, "2 height width"]]:
    """Pictures of the left-out points of a frame in each of :data:`VIEWS`: the row's and the true one, peak 1.

    A point without a position is not drawn. The person's box is that of all true points, seen or not.
    """
    truth = solved.truth[frame]
    chosen = solved.left_out[frame] & solved.filmed.known
    image = project_points(truth, solved.intrinsics)
    focal = float(solved.intrinsics[0, 0])
    pixel = RASTER / solved.stature * float(truth[solved.filmed.known, 2].mean()) / focal
    metre = RASTER / solved.stature
    aligned = answer.aligned[frame]
    pairs = (
        (answer.pixels[frame] * pixel, image * pixel),
        (aligned[:, [2, 1]] * metre, truth[:, [2, 1]] * metre),
        (aligned[:, [0, 2]] * metre, truth[:, [0, 2]] * metre),
    )
    drawn = []
    for row, true in pairs:
        inside = true[solved.filmed.known]
        low = inside.amin(0) - MARGIN
        width, height = (int(v) for v in (inside.amax(0) + MARGIN - low).ceil())
        weights = torch.stack([chosen & torch.isfinite(row).all(-1), chosen]).double()
        blobs = splat(torch.stack([row - low, true - low]), weights, (height, width), SIGMA)
        # A single point peaks at 1 - 1/e; points in a crowd saturate instead of leaving the range.
        drawn.append(1 - torch.exp(-2 * math.pi * SIGMA**2 * blobs))
    return drawn


def score(solved: Solved) -> list[dict[str, Any]]:
    """What every cached answer is worth at every scored frame; everything that Tables 2 to 5 print."""
    answers, refusals = answers_of(solved)
    image = project_points(solved.truth, solved.intrinsics)
    chosen = solved.left_out & solved.filmed.known
    for frame in solved.protocol.scored:
        if not chosen[frame].any():
            raise ReconError(
                f"{solved.sequence.name}: no point of the body is left out of frame {frame}; use more tracks"
            )
    results = [_figures(solved, answer, image, chosen) for answer in answers]
    by_key = {row.key: row for row in solved.rows}
    results += [_row(by_key[key], f"no answer: {note}") for key, note in refusals.items()]
    if answers:
        first = answers[0]
        nowhere = {name: torch.full_like(getattr(first, name), torch.nan) for name in ("pixels", "aligned", "points3d")}
        empty = replace(first, **nowhere, row=NOTHING, found=torch.zeros_like(first.found), note="no point is drawn")
        results.append(_row(NOTHING, empty.note) | _picture_figures(solved, empty, image, chosen))
    return results


def _figures(solved: Solved, answer: Answer, image: Tensor, chosen: Tensor) -> dict[str, Any]:
    """Everything about one row; ``image``: true pixels, ``chosen``: left-out points of the body."""
    truth, points, aligned = solved.truth, torch.nan_to_num(answer.points3d), solved.alignment(answer.row)
    covered = float(answer.found.sum() / solved.scored.sum())
    near = pck3d(points, truth, answer.found, align=aligned, stature=solved.stature)
    return {
        **_row(answer.row, answer.note),
        "accuracy": covered * float(near),  # an entry without a position is a miss
        "error3d_camera": float(error3d_camera(points, truth, answer.found, align_scale="sequence")),
        "alignment": aligned,
        "covered": covered,
        **_picture_figures(solved, answer, image, chosen),
    }


def _picture_figures(solved: Solved, answer: Answer, image: Tensor, chosen: Tensor) -> dict[str, Any]:
    """What is read off the image plane and the three views, at every scored frame."""
    frames = solved.protocol.scored
    pictures = [view_pictures(solved, answer, frame) for frame in frames]
    figures: dict[str, Any] = {"matching": matching_degree(answer.pixels, image, chosen)[frames].tolist()}
    for name, metric in (("mse", mse), ("psnr", psnr), ("ssim", ssim)):
        figures[name] = {view: [float(metric(*pair[v])) for pair in pictures] for v, view in enumerate(VIEWS)}
    return figures


def _row(row: Row, note: str) -> dict[str, Any]:
    return {
        "key": row.key,
        "label": row.label,
        "supervised": row.supervised,
        "uses_depth": row.uses_depth,
        "note": note,
    }


def _columns(number: int, row: Mapping[str, Any], at: list[int]) -> list[tuple[str, float]]:
    """(heading, value) of every cell of a row but the paper's, unrounded."""
    name = NAMES[number]
    if number == 2:
        cells = [(f"({i + 1})", row[name][k]) for i, k in enumerate(at)]
        known = [value for value in row[name] if math.isfinite(value)]
        return [*cells, ("range", max(known) - min(known)), ("accuracy", row["accuracy"])]
    cells = [(f"{view} {i + 1}", row[name][view][k]) for view in VIEWS for i, k in enumerate(at)]
    return cells + [(f"{view} range", max(row[name][view]) - min(row[name][view])) for view in VIEWS]


def table_text(number: int, result: Mapping[str, Any]) -> str:
    """One table for people; rounding happens only here."""
    frames, reference = result["frames"], result["reference"]
    at = [frames.index(frame) for frame in reference]
    digits = {2: 1, 3: 2, 4: 3, 5: 4}[number]
    rows = [row for row in result["rows"] if NAMES[number] in row and (number != 2 or "accuracy" in row)]
    lines = [result["title"], "", DEFINITION[number]]
    lines.append(
        f"Columns 1 to 3: frames {', '.join(map(str, reference))}; range: over frames {frames[0]} to {frames[-1]}."
    )
    headings = [heading for heading, _ in _columns(number, rows[0], at)]
    width = max(9, *(len(heading) + 2 for heading in headings))
    lines += ["", f"{'':<28}" + "".join(f"{heading:>{width}}" for heading in headings) + "   printed in the paper"]
    for row in rows:
        cells = "".join(f"{value:>{width}.{digits}f}" for _, value in _columns(number, row, at))
        paper = ", ".join(f"{value:.2f}" for value in PAPER[number].get(row["key"], ()))
        lines.append(f"{row['label']:<28}{cells}   {paper or '-'}")
    refused = [f"{row['label']}: {row['note']}" for row in result["rows"] if row["note"].startswith("no answer")]
    return "\n".join([*lines, "", *refused, *_verdicts(number, rows, at)]) + "\n"


def _verdicts(number: int, rows: list[Mapping[str, Any]], at: list[int]) -> list[str]:
    """Where the default is best, by how much it is not, and what of the targets it meets."""
    cells = {row["key"]: _columns(number, row, at) for row in rows if row["key"] != NOTHING.key}
    if "default" not in cells:
        return []
    better = max if number != 5 else min
    lines = []
    for k, (heading, value) in enumerate(cells["default"]):
        # A row that answers nothing is steady too: the range is compared with the paper's methods alone.
        rivals = [key for key in cells if "range" not in heading or key in PAPER[number]]
        best = (min if "range" in heading else better)(rivals, key=lambda key: cells[key][k][1])
        says = "best" if value == cells[best][k][1] else f"behind {best} by {abs(value - cells[best][k][1]):.4g}"
        target = ""
        if number == 2 and heading != "range":
            wanted = PAPER[2]["default"][k if k < 3 else 3]
            target = f"; at least {wanted} {'met' if value >= wanted else 'not met'}"
        if number == 4 and "range" not in heading:
            wanted = SSIM_TARGET[heading.split()[0]]
            target = f"; at least {wanted} {'met' if value >= wanted else 'not met'}"
        lines.append(f"torchrecon default, {heading}: {value:.4g}, {says}{target}")
    return lines


def default_out(regime: str, smoke: bool) -> str:
    """The folder that the four tables and Figures 2 and 4 to 7 share."""
    return f"runs/tables-{regime}{'-smoke' if smoke else ''}"


def run(arguments: argparse.Namespace) -> tuple[Solved, dict[str, Any]]:
    """Both passes."""
    out = Path(arguments.out or default_out(arguments.regime, arguments.smoke))
    solved = solve_rows(out, *smoke_or_full(arguments.regime, arguments.smoke), arguments.seed, arguments.fresh)
    with solved.profile("scoring"):
        rows = score(solved)
    how = "static camera with depth sensor" if arguments.regime == "depth" else "camera turning 300 degrees, no depth"
    protocol = solved.protocol
    chosen = (solved.left_out & solved.filmed.known).sum(1)
    return solved, {
        "title": f"one film of a pass, {protocol.frames} frames, {how}{', SMOKE' if arguments.smoke else ''}; "
        f"{int(chosen[protocol.scored].sum())} points left out of {len(protocol.scored)} frames",
        "frames": protocol.scored,
        "reference": list(protocol.reference),
        "left_out": chosen[protocol.scored].tolist(),
        "rows": rows,
        "config": dict(solved.config),
        "profile": solved.profile.stages,
        "provenance": provenance("cpu", arguments.seed),
        "out": str(out),
    }


def main(number: int, argv: list[str] | None = None) -> int:
    """Command line of one table; exit code 2 with one sentence for input that cannot be used."""
    parser = argparse.ArgumentParser(
        prog=f"python -m eval.table{number}", description=DEFINITION[number].split("\n")[0]
    )
    parser.add_argument("--regime", choices=("turning", "depth"), default="turning")
    parser.add_argument("--smoke", action="store_true", help="small: ends in 90 s")
    parser.add_argument("--profile", action="store_true", help="print what each stage took")
    parser.add_argument("--fresh", action="store_true", help="throw away a cache of another configuration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", metavar="DIR", help="default: runs/tables-REGIME, shared by Tables 2 to 5")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    started = time.perf_counter()
    try:
        _, result = run(arguments)
    except ReconError as error:
        print(f"eval.table{number}: {error}", file=sys.stderr)
        return 2
    out = Path(result["out"])
    result["title"] = f"Table {number}: {result['title']}"
    result["definition"] = DEFINITION[number]
    result["paper"] = PAPER[number]
    result["wall_s"] = time.perf_counter() - started
    write_json(out / f"table{number}.json", result)
    text = table_text(number, result)
    write_text(out / f"table{number}.txt", text)
    print(text)
    if arguments.profile:
        print(Profile(result["profile"]).text())
    print(f"wrote {out}/table{number}.json and .txt after {result['wall_s']:.0f} s")
    return 0
