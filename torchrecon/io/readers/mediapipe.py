"""MediaPipe landmarks as JSON: per frame a list of landmarks with x, y as shares of the image and a visibility.

There is no official file; accepted are the shapes that dumps of its results take: a list of frames, an object with
``frames``, or a folder with one file a frame; a frame is a list of landmarks, a list of such lists (people), or an
object with ``pose_landmarks`` or ``landmarks``; a landmark is an object with x, y[, z, visibility] or a list of these
numbers. z is not read: it is a guess of the detector's, not an observation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrecon.io.readers.base import FARTHEST, Format, ReadOptions, build, frame_numbers, pixels
from torchrecon.io.readers.layouts import MEDIAPIPE_33
from torchrecon.io.readers.people import Detection, choose, follow
from torchrecon.io.readers.source import Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["MEDIAPIPE", "read_mediapipe"]

_KEYS = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark")


def _is_landmark(value: Any) -> bool:
    return isinstance(value, dict) and "x" in value and "y" in value


def _people(frame: Any) -> list[Any] | None:
    """Lists of landmarks of a frame, one a person; None where it is no frame."""
    if isinstance(frame, dict):
        key = next((key for key in _KEYS if key in frame), None)
        if key is None:
            return None
        frame = frame[key]
        if frame is None:
            return []
        if isinstance(frame, dict):
            return _people(frame)
    if not isinstance(frame, list):
        return None
    if not frame:
        return []
    if _is_landmark(frame[0]):
        return [frame]
    inner = [p["landmark"] if isinstance(p, dict) and "landmark" in p else p for p in frame]
    if all(isinstance(person, list) for person in inner):
        listed = inner[0] and not isinstance(inner[0][0], (dict, list))
        return [inner] if listed else inner
    return None


def _frames(content: Any) -> list[Any]:
    if isinstance(content, dict):
        content = content.get("frames", [content])
    return content if isinstance(content, list) else []


def _sniff(source: Source) -> bool:
    if not source.is_json:
        return False
    for frame in _frames(source.json)[:1000]:
        keyed = isinstance(frame, dict) and any(key in frame for key in _KEYS)
        people = _people(frame) or []
        person = next((p for p in people if isinstance(p, list) and p), None)
        if person is not None and (_is_landmark(person[0]) or keyed):
            return True
    return False


def _body(source: Source, person: Any, what: str) -> Detection:
    if not isinstance(person, list) or not person:
        raise source.error(f"{what}: is no list of landmarks")
    if all(_is_landmark(point) for point in person):
        rows = [[p["x"], p["y"], p.get("visibility", p.get("score", 1.0))] for p in person]
        array = numbers(source, rows, what)
        return Detection(array[:, :2], array[:, 2])
    array = numbers(source, person, what)
    if array.ndim != 2 or array.shape[1] not in (2, 3, 4, 5):
        raise source.error(f"{what}: landmarks of shape {array.shape}; x, y, z, visibility are needed")
    return Detection(array[:, :2], array[:, 3] if array.shape[1] >= 4 else np.ones(len(array)))


def _size(content: Any) -> tuple[float, float] | None:
    """(height, width) that the file states, if it does."""
    if isinstance(content, dict):
        for height, width in (("image_height", "image_width"), ("height", "width")):
            found = (content.get(height), content.get(width))
            if all(isinstance(x, (int, float)) and 0 < x < FARTHEST for x in found):
                return float(found[0] or 0), float(found[1] or 0)
    return None


def read_mediapipe(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Landmarks in pixels; needs ``image_size=(height, width)`` unless the file has ``image_height, image_width``.

    Without either a square image is assumed and a warning says so.

    Raises:
        ReconError: a frame that holds no landmarks in a known form, nobody in any frame.
    """
    options = options or ReadOptions()
    content = source.json
    frames = _frames(content)
    listed = zip(source.numbering(len(frames)), frames, strict=True)
    where, count = frame_numbers(source, [_number(source, frame, i) for i, frame in listed])
    found: dict[int, list[Detection]] = {}
    for index, (place, frame) in enumerate(zip(where, frames, strict=True)):
        people = _people(frame)
        if people is None:
            raise source.error(f"frame {index}: holds no landmarks (one of {', '.join(_KEYS)})")
        bodies = [_body(source, person, f"frame {index}, person {i}") for i, person in enumerate(people)]
        found.setdefault(place, []).extend(bodies)
    bodies = [d for listed in found.values() for d in listed]
    every = np.concatenate([d.xy for d in bodies]) if bodies else np.zeros((0, 2))
    finite = np.abs(every[np.isfinite(every)])
    if finite.size and np.median(finite) <= 2.0:  # positions beyond two images are pixels already
        scaled = pixels(source, options, every, _size(content))
        cut = np.split(scaled, np.cumsum([len(d.xy) for d in bodies])[:-1])
        moved = iter([Detection(xy, d.confidence) for xy, d in zip(cut, bodies, strict=True)])
        found = {frame: [next(moved) for _ in listed] for frame, listed in found.items()}
    xy, confidence = choose(source, options, follow(source, found)).arrays(source, count)
    return build(source, options, xy, confidence, layout=MEDIAPIPE_33)


def _number(source: Source, frame: Any, index: int) -> int:
    if not isinstance(frame, dict):
        return index
    number = next((frame[key] for key in ("frame", "frame_id", "frame_index", "frame_number") if key in frame), index)
    if not isinstance(number, int):
        raise source.error(f"frame {index}: its number {str(number)[:40]!r} is no integer")
    return number


MEDIAPIPE = Format("MediaPipe landmarks JSON", _sniff, read_mediapipe)
