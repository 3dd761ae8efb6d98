"""Error against how far the camera turns: ``python -m eval.turns``. With little turn no factorisation knows the depth.

Films of Table 1's kind, turned by 60 to 360 degrees in all, the same bodies and motions at every turn; the figure shows
the mean ``error3d_camera`` of each row. Writes turns.json, turns.txt and turns.png.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from eval.job import provenance, write_json, write_text
from eval.predict import load_row, open_caches, predict, tracks_path
from eval.rows import ROWS
from eval.sequences import Filmed, Filming, Sequence, synthetic_sequences
from torchrecon.errors import ReconError
from torchrecon.metrics import error3d_camera

__all__ = ["main"]

TURNS = (60.0, 120.0, 180.0, 240.0, 300.0, 360.0)
KEYS = ("ref5", "ref6", "ref7", "ref8", "rigid", "default", "flat")


def _errors(films: Path, folder: Path, sequences: list[Sequence]) -> dict[str, float]:
    """Mean error3d_camera of each row over the sequences it has an answer for; one scale per sequence."""
    sums: dict[str, list[float]] = {key: [] for key in KEYS}
    for item in sequences:
        filmed = Filmed.load(tracks_path(films, item.name))
        scored, truth = filmed.tracks.visible & filmed.known, torch.nan_to_num(filmed.truth)
        for key in KEYS:
            answer = load_row(folder, key, item.name)
            if not isinstance(answer, str):
                points = torch.nan_to_num(answer.points3d)
                sums[key].append(float(error3d_camera(points, truth, scored, align_scale="sequence")))
    return {key: sum(values) / len(values) if values else float("nan") for key, values in sums.items()}


def _draw(result: Mapping[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4.5), constrained_layout=True)
    label = {row.key: row.label for row in ROWS}
    for key in KEYS:
        style = "--" if key == "flat" else "-"
        axes.plot(TURNS, [result["errors"][f"{turn:g}"][key] for turn in TURNS], style, marker="o", label=label[key])
    axes.set_xlabel("turn of the camera over the film, degrees")
    axes.set_ylabel("error3d_camera")
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    """Command line of the job."""
    parser = argparse.ArgumentParser(prog="python -m eval.turns", description=__doc__.split("\n")[0])
    parser.add_argument("--per-action", type=int, default=1, help="sequences of each action at every turn")
    parser.add_argument("--fresh", action="store_true", help="throw away caches of another configuration")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", metavar="DIR", default="runs/turns")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    out = Path(arguments.out)
    sequences = synthetic_sequences(arguments.per_action, 60, arguments.seed)
    errors = {}
    try:
        for turn in TURNS:
            filming = Filming(turn=turn)
            settings = {"seed": arguments.seed}
            films, cache = open_caches(out / f"turn{turn:g}", sequences, filming, settings, arguments.fresh)
            print(f"camera turning {turn:g} degrees", flush=True)
            predict(films, cache, sequences, filming, out / "no-prior", KEYS, arguments.seed, arguments.workers)
            errors[f"{turn:g}"] = _errors(films.folder, cache.folder, sequences)
    except ReconError as error:
        print(f"eval.turns: {error}", file=sys.stderr)
        return 2
    result = {"errors": errors, "sequences": len(sequences), "provenance": provenance("cpu", arguments.seed)}
    write_json(out / "turns.json", result)
    lines = [f"{'turn':>6}" + "".join(f"{key:>9}" for key in KEYS)]
    lines += [f"{turn:>6}" + "".join(f"{row[key]:>9.3f}" for key in KEYS) for turn, row in errors.items()]
    text = "error3d_camera, one scale and one depth sign per sequence\n" + "\n".join(lines) + "\n"
    write_text(out / "turns.txt", text)
    _draw(result, out / "turns.png")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
