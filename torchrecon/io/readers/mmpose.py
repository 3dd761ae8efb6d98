"""MMPose and rtmlib: keypoints with scores per frame and person, as npz or JSON (also a folder with one file a frame).

Sources: MMPose inferencer output (``instance_info[].instances[]`` with ``keypoints`` and ``keypoint_scores``); rtmlib
returns ``keypoints`` (people, points, 2) and ``scores`` (people, points) per frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrecon.io.readers.base import Format, ReadOptions, build, frame_numbers
from torchrecon.io.readers.layouts import COCO_17, MPII_16, Layout
from torchrecon.io.readers.people import Detection, choose, follow
from torchrecon.io.readers.source import Floats, Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["MMPOSE", "bodies", "layout_of", "read_mmpose"]

_SCORES = ("keypoint_scores", "scores", "keypoints_scores")


def _is_instance(value: Any) -> bool:
    return isinstance(value, dict) and "keypoints" in value and any(key in value for key in _SCORES)


def _instances(frame: Any) -> Any:
    """The list of people of a frame, in any of its forms; None where it is no frame."""
    if isinstance(frame, dict) and isinstance(frame.get("instances"), list):
        return frame["instances"]
    if _is_instance(frame):
        return [frame]
    return frame if isinstance(frame, list) else None


def _frames(content: Any) -> Any:
    if isinstance(content, dict):
        content = content.get("instance_info", content.get("frames"))
    return content if isinstance(content, list) else []


def _sniff(source: Source) -> bool:
    if source.kind == "npz":
        return "keypoints" in source.arrays and any(key in source.arrays for key in _SCORES)
    return source.is_json and any(
        any(map(_is_instance, (_instances(f) or [])[:10])) for f in _frames(source.json)[:1000]
    )


def bodies(source: Source, xy: Floats, scores: Floats, what: str) -> list[Detection]:
    """The people of a frame: (points, 2) or (people, points, 2), and scores of the shape before the last axis.

    Raises:
        ReconError: shapes that do not fit; ``what`` says where.
    """
    if xy.ndim == 2:
        xy = xy[None]
    if scores.ndim == 3 and scores.shape[-1] == 1:
        scores = scores[..., 0]
    if scores.ndim == 1:
        scores = scores[None]
    if xy.ndim != 3 or xy.shape[-1] not in (2, 3) or scores.shape != xy.shape[:-1]:
        raise source.error(
            f"{what}: keypoints {xy.shape} and scores {scores.shape}; ([people,] points, 2) and ([people,] points)"
        )
    return [Detection(body[:, :2], score) for body, score in zip(xy, scores, strict=True)]


def _instance(source: Source, value: Any, what: str) -> list[Detection]:
    if not _is_instance(value):
        raise source.error(f"{what}: has no keypoints and {_SCORES[0]}")
    scores = next(value[key] for key in _SCORES if key in value)
    if not value["keypoints"]:
        return []
    return bodies(source, numbers(source, value["keypoints"], what), numbers(source, scores, f"{what} scores"), what)


def _from_json(source: Source) -> tuple[list[int], list[list[Detection]], Layout | None]:
    content = source.json
    numbered, found = [], []
    frames = _frames(content)
    for index, (place, frame) in enumerate(zip(source.numbering(len(frames)), frames, strict=True)):
        instances = _instances(frame)
        if instances is None:
            raise source.error(f"frame {index}: has no instances")
        number = frame.get("frame_id", frame.get("frame", place)) if isinstance(frame, dict) else place
        if not isinstance(number, int):
            raise source.error(f"frame {index}: frame_id {str(number)[:40]!r} is no integer")
        numbered.append(number)
        found.append([d for i, v in enumerate(instances) for d in _instance(source, v, f"frame {index}, person {i}")])
    return numbered, found, _named(content)


def layout_of(points: int) -> Layout | None:
    """Seventeen points are taken as COCO's and sixteen as MPII's.

    Example:
        >>> layout_of(17).names[0], layout_of(5)
        ('nose', None)
    """
    return next((known for known in (COCO_17, MPII_16) if len(known.names) == points), None)


def _named(content: Any) -> Layout | None:
    """Names and bones of ``meta_info``, where the file has them."""
    meta = content.get("meta_info") if isinstance(content, dict) else None
    names = meta.get("keypoint_id2name") if isinstance(meta, dict) else None
    if not isinstance(meta, dict) or not isinstance(names, dict):
        return None
    listed = [str(names[str(i)])[:100] for i in range(len(names)) if str(i) in names]
    links = meta.get("skeleton_links")
    if isinstance(links, dict):  # some versions dump an array as {"__ndarray__": [...]}
        links = links.get("__ndarray__")
    pairs = [link for link in links if isinstance(link, list) and len(link) == 2] if isinstance(links, list) else []
    return Layout(
        tuple(listed),
        tuple((a, b) for a, b in pairs if all(type(x) is int and 0 <= x < len(listed) for x in (a, b))),
    )


def _from_arrays(source: Source) -> tuple[list[int], list[list[Detection]], None]:
    """keypoints (frames, [people,] points, 2) and scores without the last axis; filler people have no score."""
    xy = numbers(source, source.arrays["keypoints"], "keypoints")
    scores = numbers(source, next(source.arrays[key] for key in _SCORES if key in source.arrays), "scores")
    if xy.ndim not in (3, 4) or len(xy) != len(scores):
        raise source.error(
            f"keypoints {xy.shape} and scores {scores.shape}; (frames, [people,] points, 2) and the same without the 2"
        )
    found = [bodies(source, body, score, f"frame {i}") for i, (body, score) in enumerate(zip(xy, scores, strict=True))]
    return list(range(len(xy))), found, None


def read_mmpose(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Keypoints with scores; people are followed through the frames.

    Seventeen points are taken as COCO's and sixteen as MPII's unless the file names them.

    Raises:
        ReconError: keypoints and scores that do not fit, no people.
    """
    options = options or ReadOptions()
    numbered, found, layout = _from_arrays(source) if source.kind == "npz" else _from_json(source)
    places, count = frame_numbers(source, numbered)
    frames: dict[int, list[Detection]] = {}
    for frame, people in zip(places, found, strict=True):
        frames.setdefault(frame, []).extend(people)
    xy, confidence = choose(source, options, follow(source, frames)).arrays(source, count)
    return build(source, options, xy, np.asarray(confidence), layout=layout or layout_of(xy.shape[1]))


MMPOSE = Format("MMPose or rtmlib", _sniff, read_mmpose)
