"""Rates and coverage of every estimate: ``python -m eval.reliability [--data ../shared/data]``.

Parts: ``rank`` (K by every rule over the grid of the specification, motions, gaps, the paper's closed form),
``filling`` (gaps of a lost joint, by length), ``coverage`` (3D ellipsoids that hold the truth), ``heldout`` (K on real
motion by hidden entries, degree by action; only with ``--data``). ``--smoke``: a small run that ends in a minute;
``--full``: the costly rules on the whole grid. Writes reliability.json, reliability.txt and reliability.png.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import torch
import yaml

from eval.job import ROOT, provenance, write_json, write_text
from eval.reliability.coverage import draw_coverage, measure_coverage
from eval.reliability.filling import draw_filling, measure_filling
from eval.reliability.heldout import draw_heldout, measure_heldout
from eval.reliability.ranks import draw_ranks, measure_ranks
from torchrecon.errors import ReconError

__all__ = ["main"]

PARTS = ("rank", "filling", "coverage", "heldout")
_DRAW = {"rank": draw_ranks, "filling": draw_filling, "coverage": draw_coverage, "heldout": draw_heldout}
_MEASURE = {"filling": measure_filling, "coverage": measure_coverage, "heldout": measure_heldout}
_SMOKE = {
    "grid": {"frames": [50, 100], "points": [30], "trials": 1},
    "costly": {"trials": 1, "cells": [[50, 30, 2, 20.0], [100, 30, 3, 10.0]]},
    "side": {"frames": 80, "trials": 1},
    "rigid": {"trials": 4},
    "gaps": {"shares": [0.1], "trials": 1},
    "paper": {"trials": 2},
    "filling": {"films": 3, "lengths": [1, 5, 12]},
    "coverage": {"sizes": [[60, 30, 2]], "snr": [20.0], "trials": 1, "public": 1, "public_snr": [20.0]},
    "heldout": {"clips": 8},
}


def read_config(path: Path, smoke: bool) -> dict[str, Any]:
    """The grid of experiments, cut down for a smoke run.

    Raises:
        ReconError: the file is missing or lacks a part.
    """
    if not path.is_file():
        raise ReconError(f"{path}: no such file; give a config as configs/reliability.yaml is")
    config: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    missing = sorted(set(_SMOKE) - set(config or {}))
    if missing:
        raise ReconError(f"{path}: has no part {missing[0]!r}; see configs/reliability.yaml")
    if smoke:
        for part, small in _SMOKE.items():
            config[part].update(small)
    return config


def _draw(result: dict[str, Any], path: Path) -> None:
    """A panel for each part that was run."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(result), figsize=(6.5 * len(result), 4.5), squeeze=False, layout="constrained")
    for ax, part in zip(axes[0], result, strict=True):
        _DRAW[part](result[part]["records"], ax)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(argv: list[str] | None = None) -> int:
    """Command line of the job; exit code 2 with one sentence for input that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m eval.reliability", description=__doc__.split("\n")[0])
    parser.add_argument("--data", metavar="DIR", help="folder with mocap/ and keypoints/: real motion beside synthetic")
    parser.add_argument("--only", choices=PARTS, action="append", help="this part only; may be repeated")
    parser.add_argument("--smoke", action="store_true", help="small: ends in a minute")
    parser.add_argument("--full", action="store_true", help="bootstrap and cross-validation on the whole grid")
    parser.add_argument("--config", metavar="FILE", default=str(ROOT / "configs" / "reliability.yaml"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--out", metavar="DIR", default="runs/reliability")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    started = time.perf_counter()
    out = Path(arguments.out)
    data = None if arguments.data is None else Path(arguments.data)
    result: dict[str, Any] = {}
    text: list[str] = []
    try:
        config = read_config(Path(arguments.config), arguments.smoke)
        for part in arguments.only or (PARTS if data is not None else PARTS[:-1]):
            at = time.perf_counter()
            if part == "rank":
                result[part], lines = measure_ranks(config, arguments.full, arguments.workers)
            else:
                result[part], lines = _MEASURE[part](config, data, arguments.workers)
            title = f"== {part}{' (SMOKE)' if arguments.smoke else ''}, {time.perf_counter() - at:.0f} s =="
            text += [title, *lines, ""]
            # What is done is kept if a later part fails.
            write_json(out / "reliability.json", {**result, "config": config, "provenance": provenance("cpu", 0)})
            write_text(out / "reliability.txt", "\n".join(text))
        _draw(result, out / "reliability.png")
    except ReconError as error:
        print(f"eval.reliability: {error}", file=sys.stderr)
        return 2
    print("\n".join(text))
    print(f"wrote {out}/reliability.json, .txt and .png after {time.perf_counter() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
