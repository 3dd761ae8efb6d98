"""The joints that the shape prior knows, and the names under which files of tracks bring them."""

from __future__ import annotations

import re
from collections.abc import Sequence

from torchrecon.errors import ReconError

__all__ = ["JOINTS", "MIRROR", "NEEDED", "PARENTS", "match_joints"]

JOINTS = (
    "pelvis", "spine", "chest", "neck", "head",
    "l_shoulder", "l_elbow", "l_wrist", "l_hand",
    "r_shoulder", "r_elbow", "r_wrist", "r_hand",
    "l_hip", "l_knee", "l_ankle", "l_toe",
    "r_hip", "r_knee", "r_ankle", "r_toe",
)  # fmt: skip
PARENTS = (-1, 0, 1, 2, 3, 3, 5, 6, 7, 3, 9, 10, 11, 0, 13, 14, 15, 0, 17, 18, 19)
_OTHER = {"l": "r", "r": "l"}
MIRROR = tuple(JOINTS.index(_OTHER[n[0]] + n[1:]) if n[1] == "_" else index for index, n in enumerate(JOINTS))
"""Index of the joint on the other side of the body."""

NEEDED = ("l_shoulder", "r_shoulder", "l_hip", "r_hip")
LIMBS = tuple(f"{side}_{joint}" for side in "lr" for joint in ("elbow", "wrist", "knee", "ankle"))
LEAST_LIMBS = 3
"""Of the limb joints, beside all that are needed: fewer do not tell how a person stands."""

_ALIASES = {
    "pelvis": ("pelvis", "midhip", "hipcentre", "hipcenter", "root", "hips"),
    "spine": ("spine", "lowerback"),
    "chest": ("chest", "upperback"),
    "neck": ("neck", "thorax", "shouldercentre", "shouldercenter"),
    "head": ("head", "upperneck"),
    "shoulder": ("shoulder", "uarm", "clavicle"),
    "elbow": ("elbow", "humerus"),
    "wrist": ("wrist", "radius"),
    "hand": ("hand",),
    "hip": ("hip", "hipjoint"),
    "knee": ("knee", "femur"),
    "ankle": ("ankle", "tibia"),
    "toe": ("toe", "bigtoe", "footindex"),
}
_CENTRAL = ("pelvis", "spine", "chest", "neck", "head")
_SIDES = {"l": "l", "left": "l", "r": "r", "right": "r"}
# CMU's skeletons: each name is the bone that ends at the joint, the side is written without a separator.
_BONES = {"hipjoint", "femur", "tibia", "clavicle", "humerus", "radius", "foot", "hand"}
_CMU_FOOT = {"lfoot": "l_toe", "rfoot": "r_toe"}


def match_joints(names: Sequence[str] | None) -> tuple[int | None, ...]:
    """Which of :data:`JOINTS` each named point is; None where it is none of them.

    ``left_knee``, ``LeftKnee``, ``l_knee``, ``knee_l``, ``L Knee`` and CMU's ``lfemur`` are one joint; see the source
    for all. Where two points name one joint the first counts.

    Raises:
        ReconError: no names, or too few of the joints from which a person can be told; names those that are missing.

    Example:
        >>> limbs = [f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder", "hip", "knee", "elbow")]
        >>> [JOINTS[index] for index in match_joints(limbs)][:3]
        ['l_shoulder', 'l_hip', 'l_knee']
    """
    where = [None if name is None else JOINTS.index(name) for name in map(_joint, names or ())]
    seen: set[int] = set()
    for point, index in enumerate(where):
        if index is not None and index in seen:
            where[point] = None
        elif index is not None:
            seen.add(index)
    found = {JOINTS[index] for index in seen}
    missing = [name for name in NEEDED if name not in found]
    limbs = [name for name in LIMBS if name in found]
    if missing or len(limbs) < LEAST_LIMBS:
        lacks = ", ".join([*missing, *(name for name in LIMBS if name not in found and len(limbs) < LEAST_LIMBS)])
        raise ReconError(
            f"names: the prior knows human joints; both shoulders, both hips and {LEAST_LIMBS} of elbows, wrists, "
            f"knees and ankles are needed, and {'no point has a name' if not names else f'there is no {lacks}'}; "
            "name the points (left_hip, l_hip ...) or leave prior=None"
        )
    return tuple(where)


def _joint(name: str) -> str | None:
    """The joint of one name."""
    if name.lower() in _CMU_FOOT:
        return _CMU_FOOT[name.lower()]
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]
    sides = [_SIDES[word] for word in words if word in _SIDES]
    rest = "".join(word for word in words if word not in _SIDES)
    if not sides and rest[:1] in ("l", "r") and rest[1:] in _BONES:
        sides, rest = [rest[0]], rest[1:]
    for joint, aliases in _ALIASES.items():
        if rest in aliases and (joint in _CENTRAL) == (not sides) and len(sides) <= 1:
            return joint if not sides else f"{sides[0]}_{joint}"
    return None
