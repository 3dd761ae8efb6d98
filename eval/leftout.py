"""What Tables 2 to 5 share: one long film of a pass, observations left out of the solve, every row's answer to them.

In every scored frame a share of the tracks is hidden, together with the frames just around it; rows see the rest and
say where the hidden points are. Only tracks that are seen before and after are hidden, so every row has met the point.

A row's shape is placed into the input view by its own observed points, without truth (``place_in_view``). In 3D it is
brought onto the truth by centring per frame and one similarity without reflection for the sequence, or, where the row
measures depth, by centring alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from eval.job import Cache, Profile, read_json, write_json
from eval.predict import load_row, open_caches, predict, row_path, tracks_path
from eval.rows import FLAT, Row, rows_of
from eval.rows.template import save_prior, train_prior
from eval.sequences import ACTIONS, Filmed, Filming, Sequence, make_clip, synthetic_sequences
from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks
from torchrecon.measurement.camera import project_points
from torchrecon.metrics import centre_visible, place_in_view, similarity_align

__all__ = ["Answer", "Protocol", "Solved", "answers_of", "hide", "smoke_or_full", "solve_rows"]


@dataclass(frozen=True)
class Protocol:
    """How the film is cut.

    Attributes:
        frames: length of the film.
        reference: the three frames that tables and figures show.
        every: a scored frame every so many frames; the reference frames are among them.
        reach: frames before and after a scored frame in which its left-out points are hidden too.
        share: of the eligible tracks that are left out of a scored frame.
        prior_bodies: training bodies per action of the supervised row's prior.
    """

    frames: int = 160
    reference: tuple[int, int, int] = (50, 100, 150)
    every: int = 10
    reach: int = 2
    share: float = 1 / 3
    prior_bodies: int = 24

    @property
    def scored(self) -> list[int]:
        """The scored frames."""
        return list(range(self.every, self.frames - self.reach - 1, self.every))


def smoke_or_full(regime: str, smoke: bool) -> tuple[Protocol, Filming]:
    """The protocol and the filming of a run."""
    filming = Filming(regime="depth" if regime == "depth" else "turning")
    if smoke:
        return Protocol(40, (10, 20, 30), prior_bodies=4), replace(filming, size=(288, 384))
    return Protocol(), filming


def hide(tracks: Tracks, protocol: Protocol, seed: int) -> tuple[Tracks, Bool[Tensor, "frames points"]]:
    """Leave observations out of the tracks.

    Returns:
        tracks: without them.
        left_out: true at the scored frame of each hidden stretch (not at the frames around it).

    Example:
        >>> tracks = Tracks(torch.zeros(40, 6, 2))
        >>> rest, left_out = hide(tracks, Protocol(40), seed=0)
        >>> left_out.sum(1)[10].item(), rest.visible[10].sum().item(), rest.visible[7].all().item()
        (2, 4, True)
    """
    g = torch.Generator().manual_seed(980_000_000 + seed)
    visible = tracks.visible.clone()
    left_out = torch.zeros_like(visible)
    for f in protocol.scored:
        start, stop = f - protocol.reach, f + protocol.reach + 1
        eligible = (visible[f] & visible[:start].any(0) & visible[stop:].any(0)).nonzero()[:, 0]
        count = round(protocol.share * len(eligible))
        chosen = eligible[torch.randperm(len(eligible), generator=g)[:count]]
        left_out[f, chosen] = True
        visible[start:stop, chosen] = False
    gone = tracks.visible & ~visible
    # Nothing of a hidden observation may be left for a row to read.
    changed: dict[str, Any] = {"xy": tracks.xy.masked_fill(gone[..., None], torch.nan), "visible": visible}
    for name in ("covariance", "depth", "depth_variance"):
        value = getattr(tracks, name)
        if value is not None:
            changed[name] = value.masked_fill(gone.reshape(gone.shape + (1,) * (value.ndim - 2)), torch.nan)
    return replace(tracks, **changed), left_out


@dataclass(frozen=True, eq=False)
class Solved:
    """The film, whole and as the rows saw it, and where their answers are.

    Attributes:
        filmed: with everything that the tracker saw.
        given: the tracks that the rows saw.
        left_out: (frames, points) at scored frames.
        answers: folder of the rows' answers.
        sequence, filming, protocol: of the film.
        rows: that were run.
        stature: of the filmed body, metres.
        profile: CPU and wall seconds of each stage.
        config: of films and answers.
    """

    filmed: Filmed
    given: Tracks
    left_out: Bool[Tensor, "frames points"]
    answers: Path
    sequence: Sequence
    filming: Filming
    protocol: Protocol
    rows: tuple[Row, ...]
    stature: float
    profile: Profile
    config: Mapping[str, Any]

    @property
    def scored(self) -> Bool[Tensor, "frames points"]:
        """What the tracker saw of the body, left out or not: every such entry has a truth."""
        return self.filmed.tracks.visible & self.filmed.known

    @property
    def truth(self) -> Float[Tensor, "frames points 3"]:
        """Camera axes, metres, double precision; zero for tracks that are not on the body."""
        return torch.nan_to_num(self.filmed.truth.double())

    @property
    def intrinsics(self) -> Float[Tensor, "3 3"]:
        """Of the film, double precision."""
        if self.given.intrinsics is None:
            raise ReconError(f"{self.sequence.name}: the film has no intrinsics; film it again with --fresh")
        return self.given.intrinsics.double()

    def alignment(self, row: Row) -> Literal["similarity", "translation"]:
        """What is taken out before a row is compared in 3D: an answer with measured depth has true axes and metres."""
        return "translation" if row.uses_depth and self.filming.regime == "depth" else "similarity"


@dataclass(frozen=True, eq=False)
class Answer:
    """A row's answer, placed.

    Attributes:
        row: which.
        pixels: (frames, points, 2) where it would be seen; NaN where the row has no position.
        aligned: (frames, points, 3) camera axes, metres, brought onto the truth; NaN where not ``found``.
        points3d: (frames, points, 3) as the row gave it.
        found: (frames, points) scored entries with a position.
        note: the row's own sentence.
    """

    row: Row
    pixels: Float[Tensor, "frames points 2"]
    aligned: Float[Tensor, "frames points 3"]
    points3d: Float[Tensor, "frames points 3"]
    found: Bool[Tensor, "frames points"]
    note: str


def solve_rows(out: Path, protocol: Protocol, filming: Filming, seed: int, fresh: bool) -> Solved:
    """First pass: film the pass, hide observations, run every row; whatever is cached is kept."""
    passes = synthetic_sequences(1, protocol.frames, seed)
    sequence = next(item for item in passes if item.action == "pass")
    settings = {"seed": seed, "protocol": asdict(protocol)}
    films, answers = open_caches(out, [sequence], filming, settings, fresh)
    hidden = Cache(out / "cache" / "hidden", {**films.config, **settings}, fresh)
    prior = answers.path("prior.npz")
    film_place = tracks_path(films.folder, sequence.name)
    if not film_place.is_file():
        predict(films, answers, [sequence], filming, prior, (), seed, 1)  # a single film: one worker
    filmed = Filmed.load(film_place)
    given, left_out = hide(filmed.tracks, protocol, seed)
    rows = tuple(row for row in rows_of(filming.regime) if row.solve is not None)
    place = tracks_path(hidden.folder, sequence.name)
    if not place.is_file():
        write_json(hidden.path("times", f"{sequence.name}.json"), {})
        replace(filmed, tracks=given).save(place)
    profile = Profile(read_json(films.path("times", f"{sequence.name}.json")))
    if not prior.is_file():
        with profile("shape prior (Ref. 4)"):
            save_prior(prior, train_prior(ACTIONS, protocol.prior_bodies, seed=seed))
    if not all(row_path(answers.folder, row.key, sequence.name).is_file() for row in rows):
        predict(hidden, answers, [sequence], filming, prior, tuple(row.key for row in rows), seed, 1)
    profile.merge(Profile(read_json(answers.path("times", f"{sequence.name}.json"))))
    stature = make_clip(sequence, filming).body.stature
    config = {**films.config, **answers.config}
    return Solved(
        filmed, given, left_out, answers.folder, sequence, filming, protocol, rows, stature, profile, config
    )  # fmt: skip


def answers_of(solved: Solved) -> tuple[list[Answer], dict[str, str]]:
    """Second pass: every row's answer, placed and aligned; and the sentences of rows that have none."""
    given, scored = solved.given.to(dtype=torch.float64), solved.scored
    truth, intrinsics = solved.truth, solved.intrinsics
    found_answers, refusals = [], {}
    for row in solved.rows:
        output = load_row(solved.answers, row.key, solved.sequence.name)
        if isinstance(output, str):
            refusals[row.key] = output
            continue
        points = output.points3d.double()
        if row.key == FLAT.key:
            points = _between(points)
        finite = torch.isfinite(points).all(-1)
        shift = place_in_view(points, given.xy, given.visible & finite, intrinsics)
        pixels = project_points(points + shift[:, None], intrinsics)
        found = scored & finite
        if solved.alignment(row) == "similarity":
            aligned = similarity_align(points, truth, found)[0]
        else:
            aligned = centre_visible(points, found)
        aligned = aligned + (truth - centre_visible(truth, found))  # where found: the centre of the truth
        aligned = torch.where(found[..., None], aligned, torch.nan)
        found_answers.append(Answer(row, pixels, aligned, points, found, output.note))
    return found_answers, refusals


def _between(points: Float[Tensor, "frames points 3"]) -> Float[Tensor, "frames points 3"]:
    """Fill gaps by straight lines in time, so that the row without a method has an answer too."""
    known = torch.isfinite(points).all(-1)
    frames = torch.arange(len(points), device=points.device)[:, None]
    before = torch.where(known, frames, -1).cummax(0).values
    after = torch.where(known, frames, len(points)).flip(0).cummin(0).values.flip(0)
    inside = (before >= 0) & (after < len(points))
    before, after = before.clamp_min(0), after.clamp_max(len(points) - 1)
    share = (frames - before).to(points.dtype) / (after - before).clamp_min(1)
    columns = torch.arange(points.shape[1], device=points.device)
    line = points[before, columns] * (1 - share[..., None]) + points[after, columns] * share[..., None]
    return torch.where(inside[..., None], line, torch.nan)
