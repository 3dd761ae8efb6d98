"""The recognisers that Table 1 reads with: where they are, and the training job where they are not there yet."""

from __future__ import annotations

import itertools
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from eval.job import ROOT
from eval.sequences import Sequence
from torchrecon.errors import ReconError
from torchrecon.models.recogniser import load_recogniser, weights_hash

__all__ = ["Reader", "readers_of"]

Views = Literal["3d", "2d"]
_SMOKE = ("--data.films", "48", "--data.validation_films", "0", "--trainer.max_epochs", "3")


@dataclass(frozen=True)
class Reader:
    """A trained recogniser: its weights file and their hash, which is recorded with every result."""

    path: str
    hash: str


def readers_of(
    sequences: list[Sequence], data: str | None, smoke: bool, folder: Path, seeds: int = 1
) -> dict[tuple[Views, int, int], Reader]:
    """The recogniser of 3D shapes and that of 2D views for every fold and seed; missing ones are trained by the job.

    Args:
        sequences: what will be read; a fold's recogniser is trained without the subjects of that fold.
        data: mocap file, or None for the synthetic world, which has a single fold and one shared checkpoint.
        smoke: a few epochs on few films, kept apart from the real ones.
        folder: for the checkpoints of smoke runs and of folds.
        seeds: recognisers of each kind; the first is the one that a single one is.
    """
    readers: dict[tuple[Views, int, int], Reader] = {}
    kinds: tuple[Views, ...] = ("3d", "2d")
    for fold in sorted({item.fold for item in sequences}):
        subjects = sorted({item.subject for item in sequences if item.fold == fold})
        for seed, views in itertools.product(range(seeds), kinds):
            tail = ("_2d" if views == "2d" else "") + (f"_seed{seed}" if seed else "")
            if data is None and not smoke:
                path = ROOT / "runs" / "recogniser" / f"recogniser{tail}.safetensors"
            else:
                path = folder / f"recogniser{'' if data is None else f'_fold{fold}'}{tail}.safetensors"
            arguments = ["--views", views, "--out", str(path)]
            if seed:
                arguments += ["--seed", str(seed)]
            if data is not None:
                arguments += ["--data", data, "--exclude", ",".join(subjects)]
            if smoke:
                arguments += _SMOKE
            if not _usable(path):
                _train(path, arguments)
            readers[views, fold, seed] = Reader(str(path), weights_hash(load_recogniser(path)))
    return readers


def _usable(path: Path) -> bool:
    """Weights that this version can read; those of an older read-out are trained again."""
    if not path.is_file():
        return False
    try:
        load_recogniser(path)
    except ReconError as error:
        print(f"{error}", flush=True)
        return False
    return True


def _train(path: Path, arguments: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, "-m", "train.recogniser", *arguments]
    print(f"no recogniser for this at {path}: training one first ({' '.join(command[1:])})", flush=True)
    done = subprocess.run(command, cwd=ROOT, check=False)
    if done.returncode != 0:
        raise ReconError(f"python -m train.recogniser ended with exit code {done.returncode}; its message stands above")
