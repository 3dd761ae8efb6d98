"""People through the frames of a file that lists them frame by frame, in any order.

Detections are assigned to the people known so far by minimum total cost (Kuhn 1955), where the cost is the median
distance of the joints to where the person should be now, in units of the person's size; a person is predicted at
constant velocity and may be missed for some frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrecon.io.readers.base import FARTHEST, ReadOptions, warn
from torchrecon.io.readers.confidence import body_size
from torchrecon.io.readers.source import MAX_NUMBERS, Floats, Source

__all__ = ["Detection", "FollowParams", "Person", "alone", "choose", "follow"]

_MOST_PEOPLE = 100  # in one frame


@dataclass(frozen=True)
class FollowParams:
    """Parameters of the association.

    Attributes:
        reach: largest median joint distance to the prediction, body sizes, from one frame to the next.
        spread: growth of that distance per further frame of a gap, body sizes.
        gap: longest gap, frames.
        patience: a gap is at most this many frames longer than the person was seen before it, frames.
        smoothing: weight of the newest step in the velocity (no unit).
    """

    reach: float = 0.25
    spread: float = 0.05
    gap: int = 30
    patience: int = 5
    smoothing: float = 0.5


@dataclass(frozen=True, eq=False)
class Detection:
    """One body in one frame: (points, 2) pixels, (points,) confidence, and who it is where the file says so."""

    xy: Floats
    confidence: Floats
    identity: str | None = None


@dataclass(eq=False)
class Person:
    """One body through time.

    Attributes:
        seen: detection by frame.
        name: identity that the file gives, or empty.
    """

    seen: dict[int, Detection] = field(default_factory=dict)
    name: str = ""

    @property
    def evidence(self) -> float:
        """Sum of the confidence, at most 1 a point: long and sure beats short or doubtful."""
        return float(sum(np.clip(np.nan_to_num(d.confidence), 0.0, 1.0).sum() for d in self.seen.values()))

    def arrays(self, source: Source, frames: int) -> tuple[Floats, Floats]:
        """(frames, points, 2) with NaN, and (frames, points) with zero, where there is no detection."""
        points = len(next(iter(self.seen.values())).xy)
        if frames * points * 2 > MAX_NUMBERS:
            raise source.error(f"{frames} frames of {points} points are more than are read at once")
        xy, confidence = np.full((frames, points, 2), np.nan), np.zeros((frames, points))
        for frame, detection in self.seen.items():
            xy[frame], confidence[frame] = detection.xy, detection.confidence
        return xy, confidence


class _Followed(Person):
    """A person with the state of the prediction."""

    def __init__(self, frame: int, detection: Detection) -> None:
        super().__init__({frame: detection})
        self.last = frame
        self.velocity = np.zeros(2)
        self.position = detection.xy
        self.size = body_size(detection.xy[None])

    def take(self, frame: int, detection: Detection, smoothing: float) -> None:
        step = detection.xy - self.position
        moved = np.median(step[np.isfinite(step).all(-1)], axis=0) if np.isfinite(step).all(-1).any() else np.zeros(2)
        weight = smoothing if len(self.seen) > 1 else 1.0
        self.velocity = (1 - weight) * self.velocity + weight * moved / (frame - self.last)
        # A joint that is not seen now is carried along with the body.
        self.position = np.where(np.isfinite(detection.xy), detection.xy, self.position + moved)
        self.size = max(0.9 * self.size, body_size(detection.xy[None]))
        self.seen[frame] = detection
        self.last = frame


def follow(
    source: Source, frames: Mapping[int, Sequence[Detection]], params: FollowParams | None = None
) -> list[Person]:
    """People through the frames, the one with the most evidence first.

    Where every detection carries an identity, unique in its frame, that is believed. Coordinates that are not
    visible (confidence zero or less) are never read.

    Args:
        source: stands in the errors.
        frames: detections by frame index; all with the same number of points.
        params: see :class:`FollowParams`.

    Example:
        >>> import tempfile
        >>> body = np.array([[0.0, 0.0], [0.0, 100.0]])
        >>> walk = {t: [Detection(body + [5 * t, 0], np.ones(2)), Detection(body + 400, np.ones(2))] for t in range(4)}
        >>> walk[2].reverse()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     first, second = follow(Source(folder), walk)
        >>> [int(first.seen[t].xy[0, 0]) for t in range(4)]
        [0, 5, 10, 15]
    """
    p = params or FollowParams()
    clean: dict[int, list[Detection]] = {}
    for frame in sorted(frames):
        clean[frame] = [d for d in map(_clean, frames[frame]) if d is not None]
        if any((np.abs(np.nan_to_num(d.xy)) > FARTHEST).any() for d in clean[frame]):
            raise source.error(f"frame {frame}: a keypoint beyond {FARTHEST:g} pixels; repair it")
    if max((len(d) for d in clean.values()), default=0) > _MOST_PEOPLE:
        raise source.error(f"more than {_MOST_PEOPLE} people in a frame; keep those that matter")
    points = {len(d.xy) for found in clean.values() for d in found}
    if not points:
        raise source.error("nobody is found in any frame")
    if len(points) > 1:
        raise source.error(f"bodies of {sorted(points)} keypoints are mixed; keep those of one kind")
    named = _by_identity(clean)
    people = named if named is not None else _associate(clean, p)
    return sorted(people, key=lambda person: -person.evidence)


def alone(source: Source, options: ReadOptions) -> None:
    """Refuse to choose where there is nothing to choose from."""
    if options.person not in (None, 0):
        raise source.error(f"person {options.person} is not there: the file holds one set of points")


def choose(source: Source, options: ReadOptions, people: Sequence[Person], what: str = "people") -> Person:
    """The person that ``options`` names, or the first, with a word about it where there are several.

    Raises:
        ReconError: there is no such person; says how many there are.
    """
    if options.person is None:
        best = people[0]
        if len(people) > 1:
            shown = f" ({best.name})" if best.name else ""
            warn(
                source,
                f"{len(people)} {what} are found; the longest and surest, person 0{shown}, seen in {len(best.seen)} "
                f"frames, is taken; choose with person=0 to {len(people) - 1}",
            )
        return best
    if not 0 <= options.person < len(people):
        lengths = ", ".join(str(len(person.seen)) for person in people[:10])
        raise source.error(
            f"person {options.person} is not there: {len(people)} {what} are found (person 0 to {len(people) - 1}, "
            f"seen in {lengths}{' ...' if len(people) > 10 else ''} frames)"
        )
    return people[options.person]


def _clean(detection: Detection) -> Detection | None:
    """Coordinates that are not there as NaN; None where nothing is left."""
    c = np.nan_to_num(detection.confidence, nan=0.0, posinf=0.0, neginf=0.0)
    there = np.isfinite(detection.xy).all(-1) & (c > 0)
    if not there.any():
        return None
    return Detection(np.where(there[:, None], detection.xy, np.nan), np.where(there, c, 0.0), detection.identity)


def _by_identity(frames: Mapping[int, Sequence[Detection]]) -> list[Person] | None:
    people: dict[str, Person] = {}
    for frame, found in frames.items():
        names = [d.identity for d in found]
        if None in names or len(set(names)) < len(names):
            return None
        for detection in found:
            name = str(detection.identity)
            people.setdefault(name, Person(name=name)).seen[frame] = detection
    return list(people.values())


def _associate(frames: Mapping[int, Sequence[Detection]], p: FollowParams) -> list[Person]:
    from scipy.optimize import linear_sum_assignment

    people: list[_Followed] = []
    active: list[_Followed] = []
    for frame, found in frames.items():
        active = [a for a in active if frame - a.last - 1 <= min(p.gap, len(a.seen) + p.patience)]
        free = list(range(len(found)))
        if active and found:
            cost = _costs(active, found, frame, p)
            rows, columns = linear_sum_assignment(np.where(cost <= 1, cost, 1e3))
            for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
                if cost[row, column] <= 1:
                    active[row].take(frame, found[column], p.smoothing)
                    free.remove(column)
        new = [_Followed(frame, found[index]) for index in free]
        people += new
        active += new
    return list(people)


def _costs(active: Sequence[_Followed], found: Sequence[Detection], frame: int, p: FollowParams) -> Floats:
    """(active, found) median joint distance as a share of what may be moved in the gap; 2 where no joint is shared."""
    gaps = np.array([frame - a.last for a in active], dtype=np.float64)
    predicted = np.stack([a.position + (frame - a.last) * a.velocity for a in active])
    allowed = (p.reach + p.spread * (gaps - 1)) * np.maximum([a.size for a in active], 1e-6)
    distance = np.linalg.norm(predicted[:, None] - np.stack([d.xy for d in found]), axis=-1)
    ordered = np.sort(distance, axis=-1)  # NaN, where a joint is not seen on both sides, goes last
    count = np.isfinite(distance).sum(-1, keepdims=True)
    middle = [np.take_along_axis(ordered, np.maximum(at, 0), -1)[..., 0] for at in ((count - 1) // 2, count // 2)]
    return np.where(count[..., 0] > 0, (middle[0] + middle[1]) / 2 / allowed[:, None], 2.0)
