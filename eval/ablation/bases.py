"""Error against assumed K over true K: the paper's thesis is that its minimum lies near the true K.

Rows that take a K are given each of :data:`ASSUMED` in turn; the default takes none and is one line. Every answer is
scored with one scale and one depth sign a sequence, and read by Table 1's recogniser where a trained one is there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchrecon as tr
from eval.ablation.world import Person, film_person, noisy
from eval.figures.scatter import with_best_sign
from eval.job import Cache, read_arrays, run_parallel, write_arrays
from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.metrics import error3d_camera
from torchrecon.models.recogniser import Recogniser, classify_windows

__all__ = ["ASSUMED", "NEAR", "SOLVERS", "TRUE", "bases_lines", "measure_bases"]

TRUE = 4
ASSUMED = (2, 3, 4, 5, 6, 8)  # 0.5 to 2 times the true K
SOLVERS = ("em_ppca", "bmm", "csf")
FREE = "auto"  # takes no K
SNR = 30.0
NEAR = (0.75, 1.25)  # assumed over true K that counts as near


def _solve(work: tuple[Person, str]) -> None:
    """Every answer to one person's tracks, and K by the paper's and by our rule."""
    person, path = work
    scene = film_person(person)
    tracks = noisy(scene, person, SNR)
    arrays: dict[str, Any] = {
        f"K {rule}": np.asarray(tr.estimate_rank(tracks, rule=rule).rank) for rule in ("paper", "auto")
    }
    for solver, k in [*((solver, k) for solver in SOLVERS for k in ASSUMED), (FREE, TRUE)]:
        generator = torch.Generator().manual_seed(person.seed)
        try:
            answer = tr.reconstruct(tracks, rank=k, solver=solver, generator=generator)
        except ReconError as error:
            arrays[f"{solver} {k} note"] = np.asarray(str(error))
        else:
            arrays[f"{solver} {k}"] = answer.points3d
    write_arrays(path, {**arrays, "truth": scene.truth, "rotations": scene.rotations})


def misread(
    recogniser: Recogniser | None, action: str, points3d: Tensor, rotations: Float[Tensor, "frames 3 3"]
) -> float | None:
    """Per cent of windows that the recogniser names wrongly; None without a recogniser."""
    if recogniser is None:
        return None
    seen = torch.ones(points3d.shape[:-1], dtype=torch.bool)
    named = classify_windows(recogniser, points3d, seen, rotations).predicted.tolist()
    return 100 * sum(recogniser.classes[index] != action for index in named) / len(named)


def _mean(values: Sequence[float | None]) -> float | None:
    """None where an answer is missing: a mean over fewer persons is not comparable."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if values and len(known) == len(values) else None


def measure_bases(
    persons: Sequence[Person], cache: Cache, recogniser: Recogniser | None, workers: int
) -> dict[str, Any]:
    """Solve what is not cached, then score the cache.

    Returns:
        ``rows``: per solver the assumed K, mean ``error3d_camera`` and Table 1 error; ``default`` and ``ceiling`` (the
        truth, read); ``estimates``: K of each person by rule; ``minimum``: assumed over true K of the least error.
    """
    place: Mapping[Person, Path] = {person: cache.path("bases", f"{person}.npz") for person in persons}
    todo = [(person, str(path)) for person, path in place.items() if not path.is_file()]
    for _ in run_parallel(_solve, todo, workers, "assumed K", name=lambda work: str(work[0])):
        pass
    keys = [*((solver, k) for solver in SOLVERS for k in ASSUMED), (FREE, TRUE)]
    errors: dict[tuple[str, int], list[float | None]] = {key: [] for key in keys}
    read: dict[tuple[str, int], list[float | None]] = {key: [] for key in keys}
    ceiling: list[float | None] = []
    estimates: dict[str, list[int]] = {"paper": [], "auto": []}
    for person, path in place.items():
        arrays = read_arrays(path)
        truth, rotations = (torch.from_numpy(arrays[name]) for name in ("truth", "rotations"))
        ceiling.append(misread(recogniser, person.action, truth, rotations))
        for rule, found in estimates.items():
            found.append(int(arrays[f"K {rule}"]))
        for solver, k in keys:
            if f"{solver} {k}" not in arrays:
                errors[solver, k].append(None)
                read[solver, k].append(None)
                continue
            points = with_best_sign(torch.from_numpy(arrays[f"{solver} {k}"]), truth)
            errors[solver, k].append(float(error3d_camera(points, truth, align_scale="sequence")))
            read[solver, k].append(misread(recogniser, person.action, points, rotations))
    rows = []
    for solver in SOLVERS:
        error = [_mean(errors[solver, k]) for k in ASSUMED]
        rows.append({
            "solver": solver,
            "assumed": list(ASSUMED),
            "error3d_camera": error,
            "table1": [_mean(read[solver, k]) for k in ASSUMED],
            "minimum": least(error),
        })  # fmt: skip
    default = {"error3d_camera": _mean(errors[FREE, TRUE]), "table1": _mean(read[FREE, TRUE])}
    return {
        "true": TRUE, "snr": SNR, "persons": [str(person) for person in persons], "rows": rows, "default": default,
        "ceiling": _mean(ceiling), "estimates": estimates,
    }  # fmt: skip


def least(errors: Sequence[float | None]) -> float | None:
    """Assumed over true K at which the error is least; None where a K has no error.

    Example:
        >>> least([0.5, 0.3, 0.2, 0.25, 0.3, 0.4])
        1.0
    """
    known = [(error, k) for error, k in zip(errors, ASSUMED, strict=True) if error is not None]
    return min(known)[1] / TRUE if len(known) == len(ASSUMED) else None


def bases_lines(found: Mapping[str, Any]) -> list[str]:
    """The result as text, with what becomes of the thesis."""

    def shown(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    lines = [
        f"error3d_camera (Table 1 error, %) against assumed K; true K {found['true']}, {found['snr']:g} dB, all points "
        f"seen, {len(found['persons'])} persons",
        f"{'assumed / true':<16}" + "".join(f"{k / found['true']:>16.2f}" for k in ASSUMED),
    ]
    for row in found["rows"]:
        cells = zip(row["error3d_camera"], row["table1"], strict=True)
        lines.append(
            f"{row['solver']:<16}" + "".join(f"{shown(e, '.3f') + ' (' + shown(t, '.0f') + ')':>16}" for e, t in cells)
        )
    default = found["default"]
    lines += [
        f"default, and paper's rules with it, take no K: {shown(default['error3d_camera'], '.3f')} "
        f"({shown(default['table1'], '.0f')}); the truth is misread in {shown(found['ceiling'], '.0f')} %",
        *(f"K by rule '{rule}': {', '.join(map(str, k))}" for rule, k in found["estimates"].items()),
    ]
    for row in found["rows"]:
        low, first = row["minimum"], row["error3d_camera"]
        if low is None:
            lines.append(f"{row['solver']}: not judged, an answer is missing")
            continue
        at, best = first[ASSUMED.index(found["true"])], min(first)
        lines.append(
            f"{row['solver']}: least error at {low:g} x the true K, {100 * (1 - best / at):.0f} % below that at the "
            f"true K: the thesis {'holds' if NEAR[0] <= low <= NEAR[1] else 'does not hold'}"
        )
    return lines
