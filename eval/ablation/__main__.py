"""What the paper's stages and its number of bases are worth: ``python -m eval.ablation``.

Parts: ``bases`` (3D error and Table 1 error against assumed over true K), ``stages`` (covariance whitening, rule for
K, gap filter off in turn) and ``depth`` (bilateral filter, range box, contour off in turn). Answers are cached, so a
killed run goes on where it was. Writes ablation.json, ablation.txt and ablation.png.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from eval.ablation.bases import ASSUMED, TRUE, bases_lines, measure_bases
from eval.ablation.depth import depth_lines, measure_depth
from eval.ablation.draw import draw
from eval.ablation.stages import measure_stages, stage_lines
from eval.ablation.world import Person
from eval.job import ROOT, Cache, provenance, source_digest, write_json, write_text
from eval.sequences import ACTIONS, Filming, synthetic_sequences
from torchrecon.errors import ReconError
from torchrecon.models.recogniser import Recogniser, load_recogniser, weights_hash

__all__ = ["main"]

PARTS = ("bases", "stages", "depth")
RECOGNISER = ROOT / "runs" / "recogniser" / "recogniser.safetensors"
ABSENT = (
    "Contour gating is absent: no match is gated by the contour model (eqs. 6-11); points are sought inside the "
    "silhouette, and its part in the depth stages is the variant 'contour off'."
)


def _recogniser(path: Path) -> Recogniser | None:
    """The one that Table 1 reads with, where it has been trained; it is not trained for this."""
    return load_recogniser(path) if path.is_file() else None


def run(arguments: argparse.Namespace, out: Path) -> tuple[dict[str, Any], list[str]]:
    """Every part that was asked for: its numbers and their text."""
    small, seed = arguments.smoke, 100 * arguments.seed
    trials = 1 if small else arguments.trials
    actions, size = (ACTIONS[:1], 30) if small else (ACTIONS, 60)
    persons = [Person(a, seed + 10 * i + t, size, size, TRUE) for i, a in enumerate(actions) for t in range(trials)]
    filming = Filming("depth", size=(216, 288) if small else (432, 576))
    films = synthetic_sequences(1, 12 if small else 40, arguments.seed)[: 1 if small else 4]
    code = source_digest("torchrecon", "eval/ablation", "eval/sequences.py")
    config = {"code": code, "assumed": ASSUMED, "seed": arguments.seed, "filming": asdict(filming), "smoke": small}
    cache = Cache(out / "cache", config, arguments.fresh)
    result: dict[str, Any] = {}
    text: list[str] = []
    for part in arguments.only or PARTS:
        if part == "bases":
            recogniser = _recogniser(Path(arguments.recogniser))
            result[part] = measure_bases(persons, cache, recogniser, arguments.workers)
            result[part]["recogniser"] = None if recogniser is None else weights_hash(recogniser)
            lines = bases_lines(result[part])
            if recogniser is None:
                lines.append(
                    f"no Table 1 error: no trained recogniser at {arguments.recogniser} (eval.table1 trains it)"
                )
        elif part == "stages":
            result[part] = measure_stages(persons, cache, arguments.workers)
            lines = stage_lines(result[part])
        else:
            result[part] = measure_depth(films, filming, cache, arguments.workers)
            lines = depth_lines(result[part])
        text += [f"== {part}{' (SMOKE)' if small else ''} ==", *lines, ""]
    return {**result, "absent": [ABSENT], "config": cache.config}, [*text, ABSENT]


def main(argv: list[str] | None = None) -> int:
    """Command line of the job; exit code 2 with one sentence for input that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m eval.ablation", description=__doc__.split("\n")[0])
    parser.add_argument("--only", choices=PARTS, action="append", help="this part only; may be repeated")
    parser.add_argument("--trials", type=int, default=2, help="persons of each action in bases and stages")
    parser.add_argument(
        "--recogniser", metavar="FILE", default=str(RECOGNISER), help="reads the answers, if it is there"
    )
    parser.add_argument("--smoke", action="store_true", help="small: ends in a minute")
    parser.add_argument("--fresh", action="store_true", help="throw away a cache of another configuration")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", metavar="DIR", help="default: runs/ablation")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    started = time.perf_counter()
    out = Path(arguments.out or f"runs/ablation{'-smoke' if arguments.smoke else ''}")
    try:
        result, text = run(arguments, out)
    except ReconError as error:
        print(f"eval.ablation: {error}", file=sys.stderr)
        return 2
    origin = {"smoke": arguments.smoke, "provenance": provenance("cpu", arguments.seed)}
    write_json(out / "ablation.json", {**result, **origin, "wall_s": time.perf_counter() - started})
    write_text(out / "ablation.txt", "\n".join(text) + "\n")
    draw(result, out / "ablation.png")
    print("\n".join(text))
    print(f"wrote {out}/ablation.json, .txt and .png after {time.perf_counter() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
