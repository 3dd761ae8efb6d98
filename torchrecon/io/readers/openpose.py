"""OpenPose JSON: one file a frame in a folder, one file alone, or a list of frames.

Source: OpenPose output format (Cao et al. 2019): ``people[].pose_keypoints_2d`` is flat x, y, confidence in pixels,
BODY_25 or COCO-18; hands and faces are not read.
"""

from __future__ import annotations

from typing import Any

from torchrecon.io.readers.base import Format, ReadOptions, build, frame_numbers
from torchrecon.io.readers.layouts import BODY_25, OPENPOSE_18
from torchrecon.io.readers.people import Detection, choose, follow
from torchrecon.io.readers.source import Source, numbers
from torchrecon.measurement import Tracks

__all__ = ["OPENPOSE", "flat_keypoints", "read_openpose"]


def _is_frame(value: Any) -> bool:
    if not isinstance(value, dict) or not isinstance(value.get("people"), list):
        return False
    people = value["people"]
    return "version" in value or any(isinstance(p, dict) and "pose_keypoints_2d" in p for p in people)


def _sniff(source: Source) -> bool:
    content = source.json if source.is_json else None
    return _is_frame(content) or (isinstance(content, list) and any(_is_frame(frame) for frame in content[:100]))


def flat_keypoints(source: Source, value: Any, what: str, identity: str | None = None) -> Detection:
    """Flat or nested x, y, confidence triples as one body."""
    flat = numbers(source, value, what).reshape(-1)
    if flat.size == 0 or flat.size % 3:
        raise source.error(f"{what}: {flat.size} numbers; x, y, confidence per point are needed")
    triples = flat.reshape(-1, 3)
    return Detection(triples[:, :2], triples[:, 2], identity)


def _people(source: Source, frame: Any, what: str) -> list[Detection]:
    if not isinstance(frame, dict) or not isinstance(frame.get("people"), list):
        raise source.error(f"{what}: has no list 'people'")
    found = []
    for index, person in enumerate(frame["people"]):
        if not isinstance(person, dict):
            raise source.error(f"{what}: person {index} is no object with pose_keypoints_2d")
        points = person.get("pose_keypoints_2d")
        if points:
            found.append(flat_keypoints(source, points, f"{what}, person {index}"))
    return found


def read_openpose(source: Source, options: ReadOptions | None = None) -> Tracks:
    """Body keypoints of OpenPose; people are followed through the frames.

    Raises:
        ReconError: no people, mixed keypoint sets, a frame that is not OpenPose's.
    """
    options = options or ReadOptions()
    contents = source.json if isinstance(source.json, list) else [source.json]
    index, count = frame_numbers(source, source.numbering(len(contents)))
    frames: dict[int, list[Detection]] = {}
    for number, frame in zip(index, contents, strict=True):
        frames[number] = _people(source, frame, f"frame {number}")
    person = choose(source, options, follow(source, frames))
    xy, confidence = person.arrays(source, count)
    layout = next((known for known in (BODY_25, OPENPOSE_18) if len(known.names) == xy.shape[1]), None)
    return build(source, options, xy, confidence, layout=layout)


OPENPOSE = Format("OpenPose JSON", _sniff, read_openpose)
