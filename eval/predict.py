"""The first pass of Table 1: every sequence filmed and tracked once, every row's answer cached."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from collections.abc import Sequence as List
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eval.job import Cache, Profile, read_arrays, read_json, run_parallel, source_digest, write_arrays, write_json
from eval.rows import Context, Row, RowOutput, all_rows
from eval.rows.base import shared_rigid, without_depth
from eval.rows.template import load_prior
from eval.sequences import Filmed, Filming, Sequence, film
from torchrecon.errors import ReconError
from torchrecon.gaps import fill_gaps
from torchrecon.measurement import Tracks

__all__ = ["Work", "load_row", "open_caches", "predict", "predict_one", "row_path", "tracks_path"]


FILM_CODE = (
    "eval/sequences.py",
    *(f"torchrecon/{name}" for name in ("data", "depth", "features", "linalg", "measurement", "noise", "render")),
    "torchrecon/pipeline/depth.py",
    "torchrecon/statespace",
)
"""What tracks and truth depend on."""
ROW_CODE = ("eval/predict.py", "eval/rows", "torchrecon")
"""What a row's answer depends on besides."""


@dataclass(frozen=True)
class Work:
    """What a worker process needs to know of one sequence."""

    sequence: Sequence
    filming: Filming
    films: str
    folder: str
    prior: str
    keys: tuple[str, ...]
    seed: int

    def __str__(self) -> str:
        return self.sequence.name


def tracks_path(films: Path | str, name: str) -> Path:
    """Where the tracks and the truth of a sequence are cached."""
    return Path(films) / "tracks" / f"{name}.npz"


def row_path(folder: Path | str, key: str, name: str) -> Path:
    """Where the answer of a row on a sequence is cached."""
    return Path(folder) / "rows" / key / f"{name}.npz"


def load_row(folder: Path | str, key: str, name: str) -> RowOutput | str:
    """A cached answer, or the sentence with which the row said that it has none."""
    arrays = read_arrays(row_path(folder, key, name))
    note = str(arrays["note"])
    if "points3d" not in arrays:
        return note
    return RowOutput(torch.from_numpy(arrays["points3d"]), torch.from_numpy(arrays["visible"]), note)


def _save_row(path: Path, answer: RowOutput | str) -> None:
    if isinstance(answer, str):
        write_arrays(path, {"note": np.asarray(answer)})
    else:
        arrays = {"points3d": answer.points3d.float(), "visible": answer.visible, "note": np.asarray(answer.note)}
        write_arrays(path, arrays)


def predict_one(work: Work) -> None:
    """Film, track and solve one sequence; what is there already is kept, so a killed run goes on where it was."""
    place = tracks_path(work.films, work.sequence.name)
    if not place.is_file():
        filming = Profile()
        film(work.sequence, work.filming, filming).save(place)
        write_json(_times(work.films, work.sequence.name), filming.stages)
    profile = Profile()
    rows = [row for row in all_rows(work.filming.regime) if row.key in work.keys and row.solve is not None]
    rows = [row for row in rows if not row_path(work.folder, row.key, work.sequence.name).is_file()]
    if rows:
        _solve_rows(work, Filmed.load(place), rows, profile)
    # The times stand beside the predictions, so that a run that goes on still reports all that was spent.
    times = _times(work.folder, work.sequence.name)
    if times.is_file():
        earlier = Profile(read_json(times))
        earlier.merge(profile)
        profile = earlier
    write_json(times, profile.stages)


def _times(folder: Path | str, name: str) -> Path:
    return Path(folder) / "times" / f"{name}.json"


def _solve_rows(work: Work, filmed: Filmed, rows: List[Row], profile: Profile) -> None:
    # Methods reckon in double precision: metric upgrades square the condition of the tracks.
    tracks = filmed.tracks.to(dtype=torch.float64)
    with profile("rigid (shared)"):
        rigid = shared_rigid(without_depth(tracks), work.seed)
    filled = None
    if any(row.filled for row in rows):
        with profile("gap filling (abg)"):
            hessian = filmed.hessian.to(torch.float64)
            filled = fill_gaps(replace(without_depth(tracks), covariance=hessian), method="abg")
    prior = load_prior(Path(work.prior)) if any(row.supervised for row in rows) else None
    context = Context(rigid, filled, prior, work.seed)
    for row in rows:
        with profile(f"row {row.key}"):
            told = replace(context, rotations=filmed.rotations) if row.oracle else context
            answer = _attempt(row, tracks, told)
        _save_row(row_path(work.folder, row.key, work.sequence.name), answer)


def _attempt(row: Row, tracks: Tracks, context: Context) -> RowOutput | str:
    """A row's answer; where it refuses the sequence, its sentence, which is kept, counted as wrong and printed."""
    if row.solve is None:
        raise ValueError(f"row {row.key} is no method")
    try:
        return row.solve(tracks, context)
    except ReconError as error:
        return str(error)


def open_caches(
    out: Path, sequences: List[Sequence], filming: Filming, settings: Mapping[str, Any], fresh: bool
) -> tuple[Cache, Cache]:
    """The cache of the films and that of the rows: each knows the code that fills it, so that work on a solver does
    not throw the films away. A sequence's name and the settings below fix its film, so a run with more sequences
    goes on with the films of one with fewer.
    """
    data = sorted({item.data for item in sequences if item.data is not None})
    subject = {
        "data": [hashlib.sha256(Path(file).read_bytes()).hexdigest()[:16] for file in data],
        "first seed": min(item.seed - item.seed % 1000 for item in sequences),
        "frames": None if data else max(item.frames for item in sequences),
        "filming": asdict(filming),
    }
    films = {**subject, "code of films": source_digest(*FILM_CODE)}
    rows = {**films, **settings, "code of rows": source_digest(*ROW_CODE)}
    return Cache(out / "cache" / "films", films, fresh), Cache(out / "cache" / "answers", rows, fresh)


def predict(
    films: Cache,
    cache: Cache,
    sequences: List[Sequence],
    filming: Filming,
    prior: Path,
    keys: tuple[str, ...],
    seed: int,
    workers: int,
) -> Profile:
    """Run the first pass over all sequences.

    Args:
        films: cache of tracks and truth.
        cache: cache of the rows' answers.
        sequences, filming: what is filmed and how.
        prior: file of the shape prior.
        keys: rows that are wanted; none only films.
        seed: of the rows.
        workers: processes.

    Returns:
        The times of all of it, earlier runs of the same caches included.
    """
    folders = str(films.folder), str(cache.folder)
    works = [Work(item, filming, *folders, str(prior), keys, seed) for item in sequences]
    for _ in run_parallel(predict_one, works, workers, "films and rows"):
        pass
    total = Profile()
    for item in sequences:
        total.merge(Profile(read_json(_times(films.folder, item.name))))
        total.merge(Profile(read_json(_times(cache.folder, item.name))))
    return total
