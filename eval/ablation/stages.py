"""Each stage of the tracks' road off in turn: whitening, rule for K, gap filter.

The tracks have a known K, anisotropic noise whose covariance differs between points, and gaps. ``whole`` is
torchrecon's road: covariance given, gaps left open, K by ``auto``. The other variants differ from it in one thing,
``paper`` in everything: filled by the alpha-beta-gamma filter, filled values as measured, K by eqs. 25-27. Each is
solved by the default (which takes no K) and by EM-PPCA (which does), scored at entries that were seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchrecon as tr
from eval.ablation.world import Person, film_person, noisy
from eval.job import Cache, read_arrays, run_parallel, write_arrays
from torchrecon.errors import ReconError
from torchrecon.gaps import fill_gaps
from torchrecon.measurement import Tracks
from torchrecon.metrics import error3d_camera

__all__ = ["VARIANTS", "Variant", "measure_stages", "stage_lines"]

SNR, ANISOTROPY, SPREAD, MISSING = 20.0, 3.0, 0.7, 0.1
SOLVERS = ("auto", "em_ppca")


def _whole(tracks: Tracks) -> Tracks:
    return tracks


def _without_covariance(tracks: Tracks) -> Tracks:
    return replace(tracks, covariance=None)


def _filled(method: str) -> Callable[[Tracks], Tracks]:
    """Every gap filled, filled values given as measurements with the filler's covariance."""

    def fill(tracks: Tracks) -> Tracks:
        filled = fill_gaps(tracks, method=method)
        return replace(
            tracks, xy=filled.xy, visible=torch.ones_like(tracks.visible), covariance=filled.covariance
        )  # fmt: skip

    return fill


@dataclass(frozen=True)
class Variant:
    """A road from tracks to shapes.

    Attributes:
        key, label: for people.
        prepare: what becomes of the tracks.
        rule: of ``estimate_rank``, or a fixed K.
        only_rank: differs from ``whole`` in K alone, so a solver that takes none has nothing new to say.
    """

    key: str
    label: str
    prepare: Callable[[Tracks], Tracks] = _whole
    rule: str | int = "auto"
    only_rank: bool = False


def variants(bases: int) -> tuple[Variant, ...]:
    """All roads; ``bases`` is the true K of the oracle."""
    return (
        Variant("whole", "torchrecon: covariance, open gaps, K by auto"),
        Variant("no-covariance", "covariance whitening off", _without_covariance),
        Variant("rank-paper", "K by the paper's rule", rule="paper", only_rank=True),
        Variant("rank-fixed", "K fixed to 2", rule=2, only_rank=True),
        Variant("rank-true", "K known (oracle)", rule=bases, only_rank=True),
        Variant("fill-abg", "gaps filled by alpha-beta-gamma", _filled("abg")),
        Variant("fill-auto", "gaps filled by auto", _filled("auto")),
        Variant("paper", "paper: alpha-beta-gamma, K by its rule", _filled("abg"), rule="paper"),
    )


VARIANTS = tuple(variant.key for variant in variants(1))


def _solve(work: tuple[Person, str]) -> None:
    """Every variant of one person's tracks; a refusal is kept as its sentence."""
    person, path = work
    scene = film_person(person)
    tracks = noisy(scene, person, SNR, ANISOTROPY, SPREAD, MISSING)
    arrays: dict[str, Any] = {}
    for variant in variants(person.bases):
        given = variant.prepare(tracks)
        k = variant.rule if isinstance(variant.rule, int) else int(tr.estimate_rank(given, rule=variant.rule).rank)
        arrays[f"{variant.key} K"] = np.asarray(k)
        for solver in SOLVERS:
            if variant.only_rank and solver == "auto":
                continue
            name = f"{variant.key} {solver}"
            try:
                answer = tr.reconstruct(
                    given, rank=k, solver=solver, generator=torch.Generator().manual_seed(person.seed)
                )
            except ReconError as error:
                arrays[f"{name} note"] = np.asarray(str(error))
            else:
                arrays[name] = answer.points3d
    write_arrays(path, {**arrays, "truth": scene.truth, "visible": tracks.visible})


def measure_stages(persons: Sequence[Person], cache: Cache, workers: int) -> dict[str, Any]:
    """Solve what is not cached, then score the cache.

    Returns:
        ``variants``: each with its ``error3d_camera`` by solver (None: not asked, or an answer is missing), the ``K``
        of each person, and ``notes``, the sentences of refusals.
    """
    place: Mapping[Person, Path] = {person: cache.path("stages", f"{person}.npz") for person in persons}
    todo = [(person, str(path)) for person, path in place.items() if not path.is_file()]
    for _ in run_parallel(_solve, todo, workers, "stages", name=lambda work: str(work[0])):
        pass
    loaded = [read_arrays(path) for path in place.values()]
    rows = []
    for variant in variants(1):
        errors: dict[str, float | None] = {}
        notes = {}
        for solver in SOLVERS:
            name = f"{variant.key} {solver}"
            values = []
            for person, arrays in zip(persons, loaded, strict=True):
                if f"{name} note" in arrays:
                    notes[f"{person}, {solver}"] = str(arrays[f"{name} note"])
                elif name in arrays:
                    points, truth, seen = (torch.from_numpy(arrays[key]) for key in (name, "truth", "visible"))
                    values.append(float(error3d_camera(points, truth, seen, align_scale="sequence")))
            errors[solver] = sum(values) / len(values) if len(values) == len(persons) else None
        ranks = [int(arrays[f"{variant.key} K"]) for arrays in loaded]
        rows.append({
            "key": variant.key, "label": variant.label, "error3d_camera": errors, "K": ranks, "notes": notes,
        })  # fmt: skip
    return {
        "snr": SNR, "anisotropy": ANISOTROPY, "missing": MISSING, "true": persons[0].bases,
        "persons": [str(person) for person in persons], "variants": rows,
    }  # fmt: skip


def stage_lines(found: Mapping[str, Any]) -> list[str]:
    """The result as text."""
    gaps = f"{100 * found['missing']:.0f} % of the entries in gaps"
    lines = [
        f"error3d_camera at seen entries, {len(found['persons'])} persons; true K {found['true']},",
        f"{found['snr']:g} dB, noise {found['anisotropy']:g} times as long as wide, {gaps}",
        f"{'':<46}{'default':>10}{'em_ppca':>10}  K of each person",
    ]
    for row in found["variants"]:
        cells = ("-" if row["error3d_camera"][s] is None else f"{row['error3d_camera'][s]:.3f}" for s in SOLVERS)
        lines.append(f"{row['label']:<46}" + "".join(f"{cell:>10}" for cell in cells) + f"  {row['K']}")
        lines += [f"    no answer, {who}: {note}" for who, note in row["notes"].items()]
    return lines
