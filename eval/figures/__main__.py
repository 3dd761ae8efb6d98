"""The paper's figures: ``python -m eval.figures [--figure 1 2 ...]``.

1: graph of the part model. 2: original, front, side and top. 3: filtered and cut-out depth of a squat. 4: reference
frames. 5 to 7: six methods at frames 50, 100 and 150. 8: reconstructed and true scatter by deflection. 9: Pro-D against
frames and SNR. Figures 2 and 4 to 7 read the films and answers of Tables 2 to 5 and make them where they are missing.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import torch

from eval.figures import curves, pictures, scatter
from eval.job import provenance, write_json, write_text
from eval.leftout import Answer, Solved, answers_of, smoke_or_full, solve_rows
from eval.tables import default_out
from torchrecon.errors import ReconError

__all__ = ["main"]

FIGURES = tuple(range(1, 10))
OF_THE_FILM = {2, 4, 5, 6, 7}


def _film(arguments: argparse.Namespace) -> tuple[Solved, dict[str, Answer]]:
    tables = Path(arguments.tables or default_out(arguments.regime, arguments.smoke))
    solved = solve_rows(tables, *smoke_or_full(arguments.regime, arguments.smoke), arguments.seed, arguments.fresh)
    answers, refusals = answers_of(solved)
    if "default" in refusals:
        raise ReconError(f"{tables}: the default has no answer to draw: {refusals['default']}")
    return solved, {answer.row.key: answer for answer in answers}


def _without_arrays(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{name: value for name, value in r.items() if name not in ("points3d", "truth")} for r in records]


def _deflection(arguments: argparse.Namespace, out: Path) -> tuple[dict[str, Any], list[str]]:
    small = arguments.smoke
    turns, steps = ((45.0, 90.0), (8.0,)) if small else (scatter.DEFLECTIONS, scatter.STEPS)
    cells = scatter.deflection_cells(turns, steps, snr=20.0)
    records = scatter.measure(cells, out, arguments.workers, arguments.fresh)
    curves.draw_scatter(records, out / "figure8.png")
    return {"snr": 20.0, "records": _without_arrays(records)}, curves.scatter_lines(records)


def _disparity(arguments: argparse.Namespace, out: Path) -> tuple[dict[str, Any], list[str]]:
    if arguments.smoke:
        cells = scatter.grid_cells((20, 50), (120.0,), (10.0, 30.0), ("rigid",), 1)
        cells += scatter.grid_cells((20,), (120.0,), (30.0,), ("auto",), 1)
    else:
        cells = scatter.grid_cells(
            (10, 20, 50, 100, 200), (60.0, 180.0), (0.0, 10.0, 20.0, 30.0), arguments.solver, arguments.trials
        )
    records = scatter.measure(cells, out, arguments.workers, arguments.fresh)
    curves.draw_curves(records, out / "figure9.png")
    return {"records": _without_arrays(records)}, [*curves.curve_lines(records), *scatter.target_lines(records)]


def run(arguments: argparse.Namespace, out: Path) -> tuple[dict[str, Any], list[str]]:
    """Draw every figure that was asked for; returns the numbers behind them and their text."""
    wanted = sorted(set(arguments.figure or FIGURES))
    numbers: dict[str, Any] = {}
    text: list[str] = []
    film = _film(arguments) if OF_THE_FILM & set(wanted) else None
    for figure in wanted:
        path = out / f"figure{figure}.png"
        lines: list[str] = []
        if figure == 1:
            numbers["1"] = pictures.draw_graph(path)
        elif figure == 3:
            numbers["3"] = pictures.draw_depth(path, (288, 384) if arguments.smoke else (576, 768))
        elif figure == 8:
            numbers["8"], lines = _deflection(arguments, out)
        elif figure == 9:
            numbers["9"], lines = _disparity(arguments, out)
        elif film is not None:
            solved, answers = film
            if figure == 2:
                numbers["2"] = pictures.draw_views(solved, answers, path)
            elif figure == 4:
                numbers["4"] = pictures.draw_reference(solved, path)
            else:
                frame = solved.protocol.reference[figure - 5]
                numbers[str(figure)] = pictures.draw_methods(solved, answers, frame, path)
        summary = [] if lines else [f"  {name}: {value}" for name, value in numbers[str(figure)].items()]
        text += [f"Figure {figure}: {path}", *lines, *summary, ""]
    return numbers, text


def main(argv: list[str] | None = None) -> int:
    """Command line of the job; exit code 2 with one sentence for input that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m eval.figures", description=__doc__.split("\n")[0])
    parser.add_argument("--figure", type=int, nargs="+", choices=FIGURES, metavar="N", help="1 to 9; default: all")
    parser.add_argument("--regime", choices=("turning", "depth"), default="turning", help="of Figures 2 and 4 to 7")
    parser.add_argument("--tables", metavar="DIR", help="results of Tables 2 to 5; default: runs/tables-REGIME")
    parser.add_argument("--trials", type=int, default=1, help="bodies and noises of every cell of Figure 9")
    parser.add_argument("--solver", nargs="+", default=["rigid", "auto"], metavar="NAME", help="of Figure 9")
    parser.add_argument("--smoke", action="store_true", help="small: ends in 90 s")
    parser.add_argument("--fresh", action="store_true", help="throw away caches of another configuration")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", metavar="DIR", help="default: runs/figures")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    started = time.perf_counter()
    out = Path(arguments.out or f"runs/figures{'-smoke' if arguments.smoke else ''}")
    out.mkdir(parents=True, exist_ok=True)
    try:
        numbers, text = run(arguments, out)
    except ReconError as error:
        print(f"eval.figures: {error}", file=sys.stderr)
        return 2
    result = {"figures": numbers, "smoke": arguments.smoke, "provenance": provenance("cpu", arguments.seed)}
    write_json(out / "figures.json", {**result, "wall_s": time.perf_counter() - started})
    write_text(out / "figures.txt", "\n".join(text))
    print("\n".join(text))
    print(f"wrote {out}/figures.json, .txt and .png after {time.perf_counter() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
