"""What a recogniser makes of films it has not seen: errors, confusion, calibration, and whether it reads depth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchrecon.models.recogniser import AROUND, Recogniser, classify_windows
from train.films import AS_TRACKED, Film, augment, flat

TRUE_AT_MOST, FLAT_AT_LEAST = 3.0, 25.0
"""Per cent of windows named wrongly, with which the protocol of Table 1 is valid."""

ASKED = ("shoot", "run", "jump", "pass")
"""The actions of the paper; the other classes are there to be told from them."""


class Reading(NamedTuple):
    """What is said of one film.

    Attributes:
        label: index of the true class.
        probabilities: (windows, classes).
    """

    label: int
    probabilities: Tensor


def read_films(recogniser: Recogniser, films: Iterable[Film]) -> list[Reading]:
    """A reading of each film, with the windows, yaws and frames around of Table 1."""
    return [
        Reading(
            film.label,
            classify_windows(recogniser, film.points3d, film.visible, film.rotations, around=AROUND).probabilities,
        )
        for film in films
    ]


def confusion(readings: Sequence[Reading], classes: Sequence[str]) -> dict[str, dict[str, int]]:
    """Windows by true class and by the name they are given.

    Example:
        >>> confusion([Reading(1, torch.tensor([[0.2, 0.8], [0.6, 0.4]]))], ("run", "jump"))
        {'jump': {'run': 1, 'jump': 1}}
    """
    table: dict[str, dict[str, int]] = {}
    for reading in readings:
        row = table.setdefault(classes[reading.label], dict.fromkeys(classes, 0))
        for index in reading.probabilities.argmax(-1).tolist():
            row[classes[index]] += 1
    return table


def error_rates(table: dict[str, dict[str, int]]) -> dict[str, float]:
    """Per cent of windows named wrongly, by class and over the four actions of the paper ("mean").

    Example:
        >>> error_rates({"run": {"run": 3, "jump": 1}, "jump": {"run": 0, "jump": 4}})
        {'run': 25.0, 'jump': 0.0, 'mean': 12.5}
    """
    rates = {name: 100 * (1 - row[name] / sum(row.values())) for name, row in table.items()}
    asked = [rates[name] for name in ASKED if name in rates]
    return {**rates, "mean": sum(asked) / len(asked)} if asked else rates


def calibration(readings: Sequence[Reading], bins: int = 10) -> dict[str, Any]:
    """Whether a verdict is right as often as its probability says.

    Args:
        bins: of equal width over the probability of the class that is named.

    Returns:
        ``ece``: expected calibration error, the mean over windows of |share that is right - mean probability| of their
        bin; ``bins``: the filled ones, each with ``windows``, ``probability`` and ``right``.

    Example:
        >>> calibration([Reading(0, torch.tensor([[0.75, 0.25], [0.25, 0.75]]))])["ece"]
        0.25
    """
    sure = torch.cat([reading.probabilities.amax(-1) for reading in readings]).double()
    right = torch.cat([reading.probabilities.argmax(-1) == reading.label for reading in readings]).double()
    place = (sure * bins).long().clamp(max=bins - 1)
    count = torch.zeros(bins, dtype=torch.float64).index_add(0, place, torch.ones_like(sure))
    total = [torch.zeros(bins, dtype=torch.float64).index_add(0, place, value) for value in (sure, right)]
    filled = count > 0
    probability, share = ((value[filled] / count[filled]) for value in total)
    ece = float(((share - probability).abs() * count[filled]).sum() / count.sum())
    rows = zip(count[filled].long().tolist(), probability.tolist(), share.tolist(), strict=True)
    return {"ece": ece, "bins": [{"windows": n, "probability": p, "right": r} for n, p, r in rows]}


def validity(recogniser: Recogniser, films: list[Film], sources: Sequence[str] | None = None) -> dict[str, Any]:
    """The error on true 3D and on the same points without depth, on bodies that were not trained on.

    Twice: every point that is tracked at some time, in all frames, which decides whether the protocol is valid; and
    ``as_tracked``, the points only while they are tracked and shortly around, which says what the gaps alone cost. For
    the recogniser of 2D views with and without depth are one and the same, so there is nothing to be valid.

    Args:
        sources: where each film comes from; the errors on true 3D are then also given ``by_source``.

    Returns:
        Per cent of windows by ``true_3d`` and ``flat`` (or ``views_2d``); of the first also ``confusion`` (windows)
        and ``calibration``; ``valid``; and ``as_tracked``.
    """
    tracked = [augment(film, AS_TRACKED, torch.Generator().manual_seed(index)) for index, film in enumerate(films)]
    filled = [replace(film, visible=torch.ones_like(film.visible)) for film in tracked]
    rows = [_figures(recogniser, shown, sources) for shown in (filled, tracked)]
    if "flat" not in rows[0]:
        return {**rows[0], "as_tracked": rows[1]}
    valid = rows[0]["true_3d"].get("mean", 0.0) <= TRUE_AT_MOST and rows[0]["flat"].get("mean", 100.0) >= FLAT_AT_LEAST
    return {**rows[0], "valid": valid, "as_tracked": rows[1]}


def _figures(recogniser: Recogniser, films: list[Film], sources: Sequence[str] | None) -> dict[str, Any]:
    classes, two_d = recogniser.classes, recogniser.params.views == ("camera",)
    readings = read_films(recogniser, films)
    table = confusion(readings, classes)
    figures: dict[str, Any] = {"views_2d" if two_d else "true_3d": error_rates(table)}
    if not two_d:
        figures["flat"] = error_rates(confusion(read_films(recogniser, map(flat, films)), classes))
    figures |= {"confusion": table, "calibration": calibration(readings)}
    if sources is not None:
        figures["by_source"] = {
            name: error_rates(confusion([r for r, of in zip(readings, sources, strict=True) if of == name], classes))
            for name in sorted(set(sources))
        }
    return figures


def report_text(figures: dict[str, Any]) -> str:
    """What :func:`validity` found, for people."""
    lines = []
    for shown, rows in (("all frames", figures), ("as tracked", figures["as_tracked"])):
        known = [row for row in ("true_3d", "flat", "views_2d") if row in rows]
        lines += [f"{shown}  {row:8s}  {_rates(rows[row])}" for row in known]
        lines += [f"{shown}    {name}: {_rates(rates)}" for name, rates in rows.get("by_source", {}).items()]
    table = figures["confusion"]
    names = list(next(iter(table.values())))
    lines.append("all frames, windows by true class (rows) and by what they are called; ")
    lines[-1] += f"expected calibration error {figures['calibration']['ece']:.3f}"
    lines.append(f"{'':10s}" + "".join(f"{name:>9s}" for name in names))
    lines += [f"{name:10s}" + "".join(f"{row[other]:9d}" for other in names) for name, row in table.items()]
    return "\n".join(f"  {line}" for line in lines)


def _rates(rates: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.1f} %" for name, value in rates.items())
