"""Names and bones of the keypoint sets in use, in their published order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

__all__ = ["BODY_25", "COCO_17", "HUMANEVA_15", "MEDIAPIPE_33", "MPII_16", "OPENPOSE_18", "PENN_13", "Layout"]


@dataclass(frozen=True)
class Layout:
    """A keypoint set.

    Attributes:
        names: one per point.
        edges: pairs of point indices joined by a bone.
    """

    names: tuple[str, ...]
    edges: tuple[tuple[int, int], ...] = ()


def _layout(names: str, *chains: Sequence[int]) -> Layout:
    """Bones run along the chains."""
    return Layout(tuple(names.split()), tuple((a, b) for c in chains for a, b in pairwise(c)))


COCO_17 = _layout(
    "nose left_eye right_eye left_ear right_ear left_shoulder right_shoulder left_elbow right_elbow left_wrist "
    "right_wrist left_hip right_hip left_knee right_knee left_ankle right_ankle",
    (15, 13, 11, 12, 14, 16),
    (9, 7, 5, 6, 8, 10),
    (5, 11),
    (6, 12),
    (3, 1, 0, 2, 4),
)
BODY_25 = _layout(
    "nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist mid_hip right_hip "
    "right_knee right_ankle left_hip left_knee left_ankle right_eye left_eye right_ear left_ear left_big_toe "
    "left_small_toe left_heel right_big_toe right_small_toe right_heel",
    (4, 3, 2, 1, 5, 6, 7),
    (17, 15, 0, 16, 18),
    (0, 1, 8),
    (8, 9, 10, 11, 22, 23),
    (8, 12, 13, 14, 19, 20),
    (11, 24),
    (14, 21),
)
OPENPOSE_18 = _layout(
    "nose neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist right_hip right_knee "
    "right_ankle left_hip left_knee left_ankle right_eye left_eye right_ear left_ear",
    (4, 3, 2, 1, 5, 6, 7),
    (16, 14, 0, 15, 17),
    (0, 1),
    (1, 8, 9, 10),
    (1, 11, 12, 13),
)
MEDIAPIPE_33 = _layout(
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear "
    "mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_pinky "
    "right_pinky left_index right_index left_thumb right_thumb left_hip right_hip left_knee right_knee left_ankle "
    "right_ankle left_heel right_heel left_foot_index right_foot_index",
    (7, 3, 2, 1, 0, 4, 5, 6, 8),
    (9, 10),
    (15, 13, 11, 12, 14, 16),
    (11, 23, 24, 12),
    (21, 15, 17, 19, 15),
    (22, 16, 18, 20, 16),
    (23, 25, 27, 29, 31, 27),
    (24, 26, 28, 30, 32, 28),
)
MPII_16 = _layout(
    "right_ankle right_knee right_hip left_hip left_knee left_ankle pelvis thorax upper_neck head_top right_wrist "
    "right_elbow right_shoulder left_shoulder left_elbow left_wrist",
    (0, 1, 2, 6, 3, 4, 5),
    (6, 7, 8, 9),
    (10, 11, 12, 7, 13, 14, 15),
)
PENN_13 = _layout(
    "head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist left_hip right_hip left_knee "
    "right_knee left_ankle right_ankle",
    (5, 3, 1, 2, 4, 6),
    (11, 9, 7, 8, 10, 12),
    (1, 7),
    (2, 8),
    (1, 0, 2),
)
HUMANEVA_15 = _layout(
    "pelvis thorax left_shoulder left_elbow left_wrist right_shoulder right_elbow right_wrist left_hip left_knee "
    "left_ankle right_hip right_knee right_ankle head",
    (0, 1, 14),
    (1, 2, 3, 4),
    (1, 5, 6, 7),
    (0, 8, 9, 10),
    (0, 11, 12, 13),
)
