"""What the page says in words: how the solve ended, what the numbers mean and what stays open."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchrecon.measurement import RankEstimate, Reconstruction, Tracks

__all__ = ["Unit", "Word", "absences", "unit_of", "words"]


@dataclass(frozen=True)
class Unit:
    """Unit of lengths in 3D.

    Attributes:
        short: put behind numbers.
        text: one sentence.
    """

    short: str
    text: str


@dataclass(frozen=True)
class Word:
    """One thing to know; ``kind`` is ``warn`` (limits what may be concluded) or ``note``."""

    kind: str
    title: str
    text: str


_CAUTION = "Take the shape as a sketch, not as a measurement."
_CAUTIONS = {
    "undetermined": "Left, right, up and down are as in the film. Distances towards the camera are a guess: do not "
    "measure along them.",
    "not_converged": _CAUTION + " More iterations may change it.",
    "degenerate": _CAUTION + " More points, more frames or a smaller K are needed.",
}
_HEADLINES = {
    "ok": "The views determine this shape",
    "not_converged": "The solver stopped before it had settled",
    "undetermined": "The views do not determine this shape",
    "degenerate": "Too few points or frames for this many shape bases",
}


def headline(code: str) -> str:
    """The status code as a sentence for people; a code of another solver stands as it is.

    Example:
        >>> headline("ok")
        'The views determine this shape'
    """
    return _HEADLINES.get(code, code)


def unit_of(reconstruction: Reconstruction, tracks: Tracks | None) -> Unit:
    """The unit of ``points3d``: it depends on what the camera and the depth say (see ``Reconstruction``).

    Example:
        >>> import torch
        >>> from torchrecon.measurement import Status
        >>> rec = Reconstruction.from_points(torch.randn(3, 4, 3), torch.eye(3).expand(3, 3, 3), rank=1,
        ...                                  status=Status("ok", "by hand"))
        >>> unit_of(rec, None).short
        'px'
    """
    if reconstruction.intrinsics is None:
        return Unit("px", "Lengths are pixels of the tracks: without a camera the true size is not known.")
    if tracks is not None and tracks.depth is not None:
        return Unit("m", "Lengths are metres: depth was measured.")
    if tracks is None:
        return Unit("u", "Lengths are metres if depth was measured, else metres up to one factor; no tracks say which.")
    return Unit("u", "Lengths are metres up to one factor, the same in all frames: the true size is not known.")


def words(
    reconstruction: Reconstruction, tracks: Tracks | None, rank: RankEstimate | None, seen_share: float, unknown: int
) -> list[Word]:
    """What limits the answer, most important first.

    Args:
        reconstruction: batch ``()``.
        tracks: the tracks it was made from, if they are at hand.
        rank: the estimate of K on these tracks, if there is one.
        seen_share: share of (frame, point) entries with a measurement.
        unknown: number of (frame, point) entries without a finite 3D position.
    """
    found: list[Word] = []
    code = reconstruction.statuses[0].code
    if code != "ok":
        found.append(Word("warn", "What may still be read off", _CAUTIONS.get(code, _CAUTION)))
    if rank is not None and int(rank.rank) != int(reconstruction.rank):
        low, high = (int(end) for end in rank.interval)
        text = (
            f"It was solved with K = {reconstruction.rank}; the tracks show K = {rank.rank} (between {low} and {high})."
        )
        found.append(Word("warn", "K is not what the tracks show", text))
    found.extend(Word("warn", "About K", text) for text in (rank.warnings if rank is not None else ()))
    if unknown:
        text = f"{unknown} of {reconstruction.points3d[..., 0].numel()} positions are not finite and are not drawn."
        found.append(Word("warn", "Positions are missing", text))
    if reconstruction.intrinsics is None:
        text = (
            "Without perspective, a shape and its mirror image in depth look the same. One was chosen by a fixed rule, "
            "for all frames together; press M for the other. Which one is true has to come from outside."
        )
        found.append(Word("note", "Near and far may be swapped", text))
    found.append(Word("note", "Unit", unit_of(reconstruction, tracks).text))
    found.append(
        Word(
            "note", "Place", "The 3D view is centred in every frame: it shows shape and turning, not the way travelled."
        )
    )
    if seen_share < 1:
        filled = 100 * (1 - seen_share)
        amount = f"{filled:.0f} %" if filled >= 1 else "Less than 1 %"
        text = f"{amount} of all positions were not seen and are inferred from the rest; they are drawn hollow."
        found.append(Word("note", "Inferred positions", text))
    return found


def absences(reconstruction: Reconstruction, tracks: Tracks | None, rank: RankEstimate | None, film: bool) -> list[str]:
    """What this page does not show, and why."""
    missing: list[str] = []
    if not film:
        missing.append("Video: none was given, so the points stand on an empty picture.")
    if tracks is None:
        missing.append("Tracks: none were given, so the picture shows where the reconstruction would be seen.")
    elif tracks.covariance is None:
        missing.append("Confidence of the tracks: they carry no covariance.")
    if reconstruction.covariance3d is None:
        missing.append("Uncertainty of the 3D points: this solver gives none.")
    if rank is None:
        missing.append("Eigenvalues behind K: they come from the tracks, which were not given.")
    elif not any(math.isfinite(float(value)) for value in rank.threshold.reshape(-1)):
        missing.append(f"Threshold of K: rule {rank.rule} has none.")
    if tracks is not None and not tracks.edges:
        missing.append("Bones: the tracks name none.")
    return missing
