"""COCO keypoint JSON: the results list (also AlphaPose's) and the annotations form.

Source: COCO data format (Lin et al. 2014): ``keypoints`` is flat x, y, v. In annotations v is a flag: 2 seen, 1 marked
though hidden, 0 absent; in results it is a score.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import PurePath
from typing import Any

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build, frame_numbers
from torchrecon.io.readers.layouts import COCO_17, MPII_16, Layout
from torchrecon.io.readers.openpose import flat_keypoints
from torchrecon.io.readers.people import Detection, choose, follow
from torchrecon.io.readers.source import Source
from torchrecon.measurement import Tracks

__all__ = ["COCO", "read_coco"]

_IDENTITY = ("track_id", "idx", "person_id")


def _entries(content: Any) -> list[Any] | None:
    if isinstance(content, dict):
        content = content.get("annotations")
    return content if isinstance(content, list) else None


def _is_entry(value: Any) -> bool:
    return isinstance(value, dict) and "image_id" in value and "keypoints" in value


def _sniff(source: Source) -> bool:
    return source.kind == "json" and any(_is_entry(entry) for entry in (_entries(source.json) or [])[:1000])


def _frame(source: Source, value: Any, names: dict[Any, Any]) -> int:
    """Frame number of an image id, or of the file name that stands for it."""
    value = names.get(value, value) if isinstance(value, (int, str)) else value
    if isinstance(value, (int, float)) and not isinstance(value, bool) and value == value and abs(value) < 1e18:
        return int(value)
    digits = re.findall(r"[0-9]+", PurePath(value).stem) if isinstance(value, str) else []
    if not digits:
        raise source.error(f"image_id {str(value)[:60]!r}: holds no frame number")
    return int(digits[-1][:15])


def _image_frames(content: Any) -> dict[Any, Any]:
    """Image id -> frame, where the images say which frame they are."""
    images = content.get("images") if isinstance(content, dict) else None
    known: dict[Any, Any] = {}
    for image in images if isinstance(images, list) else []:
        if isinstance(image, dict) and isinstance(image.get("id"), (int, str)):
            frame = image.get("frame_id", image.get("frame_index"))
            if isinstance(frame, int):
                known[image["id"]] = frame
    return known


def _layout(content: Any, points: int) -> Layout | None:
    """The set that the file's category names, else the usual one with that many points."""
    categories = content.get("categories") if isinstance(content, dict) else None
    for category in categories if isinstance(categories, list) else []:
        names = category.get("keypoints") if isinstance(category, dict) else None
        if not isinstance(names, list) or len(names) != points:
            continue
        bones = category.get("skeleton")
        pairs = [b for b in bones if isinstance(b, list) and len(b) == 2] if isinstance(bones, list) else []
        edges = [(b[0] - 1, b[1] - 1) for b in pairs if all(type(x) is int and 1 <= x <= points for x in b)]
        return Layout(tuple(str(name)[:100] for name in names), tuple(edges))
    return next((known for known in (COCO_17, MPII_16) if len(known.names) == points), None)


def read_coco(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Keypoints by image; ``image_id`` (a number, or a file name with one) is the frame.

    Raises:
        ReconError: entries without keypoints or frame, image ids too scattered to be a video's frames.
    """
    options = options or ReadOptions()
    content = source.json
    known = _image_frames(content)
    found, numbered = [], []
    for index, entry in enumerate(_entries(content) or []):
        if not _is_entry(entry):
            raise source.error(f"entry {index}: has no image_id and keypoints")
        if entry["keypoints"] and entry.get("num_keypoints") != 0:
            name = next((str(entry[key])[:50] for key in _IDENTITY if isinstance(entry.get(key), (int, str))), None)
            found.append(flat_keypoints(source, entry["keypoints"], f"entry {index}", name))
            numbered.append(_frame(source, entry["image_id"], known))
    places, count = frame_numbers(source, numbered)
    marks = np.concatenate([d.confidence for d in found])
    if np.isin(marks, (0, 1, 2)).all() and (marks == 2).any():  # flags: a hidden joint is marked, but less well
        found = [replace(d, confidence=d.confidence / 2) for d in found]
    frames: dict[int, list[Detection]] = {}
    for frame, detection in zip(places, found, strict=True):
        frames.setdefault(frame, []).append(detection)
    xy, confidence = choose(source, options, follow(source, frames)).arrays(source, count)
    return build(source, options, xy, confidence, layout=_layout(content, xy.shape[1]))


COCO = Format("COCO keypoint JSON", _sniff, read_coco)
