"""A human body of random build: constant bones, and round cones as flesh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.data.synthetic.random import chance, seed_of, uniform
from torchrecon.data.synthetic.skeleton import JOINTS, PARENTS, joint
from torchrecon.render.raycast import RoundCones

__all__ = ["BALL_RADIUS", "PART_NAMES", "Body", "sample_body"]

BALL_RADIUS = 0.12
"""Metres; a size-7 basketball."""


PART_NAMES = (
    "pelvis", "abdomen", "chest", "collar", "neck", "head",
    "l_upper_arm", "l_forearm", "l_hand", "r_upper_arm", "r_forearm", "r_hand",
    "l_thigh", "l_shank", "l_foot", "r_thigh", "r_shank", "r_foot",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Body:
    """One person. Lengths in metres, float64.

    Attributes:
        stature: standing height, 1.55-2.10.
        girth: factor on the thickness of all parts, 1 = average.
        right_handed: the hand that shoots and dribbles.
        offsets: rest offset of each joint from its parent, body axes (x left, y up, z forward).
        part_bones: the joint whose bone frame carries each part; the part sits at that bone's upper end.
        part_origins, part_rotations: placement of a part in its bone's frame.
        scale, length, radii: shape of the part, see ``RoundCones``.
        texture_seed: seed of kit and skin.
    """

    stature: float
    girth: float
    right_handed: bool
    offsets: Float[Tensor, "joints 3"]
    part_bones: Int[Tensor, " parts"]
    part_origins: Float[Tensor, "parts 3"]
    part_rotations: Float[Tensor, "parts 3 3"]
    scale: Float[Tensor, "parts 3"]
    length: Float[Tensor, " parts"]
    radii: Float[Tensor, "parts 2"]
    texture_seed: int

    @property
    def toe_height(self) -> float:
        """Height of the toe joint above the floor in stance: the radius of the sole there."""
        part = PART_NAMES.index("l_foot")
        return float(self.radii[part, 1] * self.scale[part, 1])

    def bone(self, name: str) -> float:
        """Length of the bone that ends at joint ``name``."""
        return float(self.offsets[joint(name)].norm())

    def place(self, joints: Float[Tensor, "frames joints 3"], frames: Float[Tensor, "frames joints 3 3"]) -> RoundCones:
        """The parts in the axes of ``joints``, batch = frames."""
        start = torch.tensor([max(PARENTS[b], 0) for b in self.part_bones.tolist()], device=joints.device)
        bone = frames[:, self.part_bones]
        origins = joints[:, start] + torch.einsum("fpij,pj->fpi", bone, self.part_origins.to(joints))
        rotations = bone @ self.part_rotations.to(joints)
        return RoundCones(rotations, origins, self.scale.to(joints), self.length.to(joints), self.radii.to(joints))


def sample_body(generator: torch.Generator | None = None) -> Body:
    """A random adult: stature, limb ratios, girth, handedness and texture seed vary independently.

    Example:
        >>> import torch
        >>> body = sample_body(torch.Generator().manual_seed(0))
        >>> 1.55 <= body.stature <= 2.10, body.offsets.shape
        (True, torch.Size([21, 3]))
    """
    g = generator
    stature = uniform(g, 1.55, 2.10)
    girth = uniform(g, 0.88, 1.2)
    leg, arm = uniform(g, 0.96, 1.04), uniform(g, 0.95, 1.06)
    shoulder, hip = uniform(g, 0.93, 1.09), uniform(g, 0.93, 1.07)
    right_handed = chance(g, 0.85)
    offsets = _offsets(stature, leg, arm, shoulder, hip)
    parts = _parts(stature, girth * uniform(g, 0.95, 1.05), girth, offsets)
    bones, origins, rotations, scale, length, radii = parts
    return Body(
        stature, girth, right_handed, offsets, bones, origins, rotations, scale, length, radii, seed_of(g)
    )  # fmt: skip


def _offsets(h: float, leg: float, arm: float, shoulder: float, hip: float) -> Tensor:
    """Rest offsets; the trunk takes up what longer or shorter legs leave of the stature."""
    legs = 0.491 * leg
    trunk = 0.267 + (0.491 - legs)
    table: dict[str, tuple[float, float, float]] = {
        "pelvis": (0.0, 0.0, 0.0),
        "spine": (0.0, 0.26 * trunk, -0.006),
        "chest": (0.0, 0.30 * trunk, -0.004),
        "neck": (0.0, 0.44 * trunk, 0.002),
        "head": (0.0, 0.080, 0.012),
    }
    for side, sign in (("l", 1.0), ("r", -1.0)):
        table[f"{side}_shoulder"] = (sign * 0.105 * shoulder, -0.012, 0.0)
        table[f"{side}_elbow"] = (0.0, -0.176 * arm, 0.0)
        table[f"{side}_wrist"] = (0.0, -0.150 * arm, 0.0)
        table[f"{side}_hand"] = (0.0, -0.052 * arm, 0.0)
        table[f"{side}_hip"] = (sign * 0.052 * hip, -0.030, 0.0)
        table[f"{side}_knee"] = (0.0, -0.5 * legs, 0.0)
        table[f"{side}_ankle"] = (0.0, -0.5 * legs, 0.0)
        table[f"{side}_toe"] = (0.0, -0.022, 0.090)
    return h * torch.tensor([table[name] for name in JOINTS], dtype=torch.float64)


class _Part(NamedTuple):
    """A round cone on a bone; lengths are fractions of stature."""

    name: str
    bone: str
    origin: tuple[float, float, float]
    turn: str
    scale: tuple[float, float, float]
    length: float
    r0: float
    r1: float


_TURNS = {
    "up": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "down": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    "forward": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
    "left": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
"""Which way the part's own y axis points in its bone's frame."""


def _trunk_parts(g: float, bone: dict[str, float], hips: float, shoulders: float) -> list[_Part]:
    """Pelvis to head; ``g`` is the girth."""
    round_, none = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    belly = bone["spine"] + 0.55 * bone["chest"]
    breast = 0.062 * g
    # The ribs end inside the shoulder joints, however broad or thick the body is.
    wide = (shoulders - 0.012) / breast
    return [
        _Part("pelvis", "pelvis", (0.0, -0.012, 0.0), "up", (hips + 0.046 * g, 0.066, 0.066 * g), 0.0, 1.0, 1.0),
        _Part("abdomen", "spine", (0.0, 0.005, 0.0), "up", (1.36, 1.0, 1.0), belly, 0.060 * g, 0.060 * g),
        _Part("chest", "neck", (0.0, 0.0, 0.002), "up", (wide, 1.0, 1.0), bone["neck"] - 0.062, 0.058 * g, breast),
        _Part("collar", "l_shoulder", (-0.75 * shoulders, -0.022, 0.0), "left", round_, 1.5 * shoulders, 0.034, 0.034),
        _Part("neck", "head", none, "up", round_, 0.055, 0.034 * g, 0.030 * g),
        _Part("head", "head", (0.0, bone["head"] + 0.018, 0.010), "up", (0.045, 0.066, 0.055), 0.0, 1.0, 1.0),
    ]


def _limb_parts(g: float, bone: dict[str, float], toe: tuple[float, float]) -> list[_Part]:
    """Arms and legs; ``toe`` is the rest offset of the toe joint from the ankle, up and forward."""
    round_, none = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
    arm, fore, hand = bone["l_elbow"], bone["l_wrist"], bone["l_hand"]
    thigh, shank = bone["l_knee"], bone["l_ankle"]
    # The foot runs from the heel, behind and below the ankle, to the toe joint; its sole is level when the foot is.
    heel, sole = -0.026, 0.017
    at, long = (0.0, toe[0] + 0.003, heel), toe[1] - heel
    parts = []
    for s in ("l", "r"):
        parts += [
            _Part(f"{s}_upper_arm", f"{s}_elbow", (0.0, 0.002, 0.0), "down", round_, arm, 0.034 * g, 0.024 * g),
            _Part(f"{s}_forearm", f"{s}_wrist", none, "down", round_, fore, 0.026 * g, 0.016 * g),
            _Part(f"{s}_hand", f"{s}_hand", (0.0, -0.8 * hand, 0.004), "up", (0.013, 0.056, 0.026), 0.0, 1.0, 1.0),
            _Part(f"{s}_thigh", f"{s}_knee", (0.0, -0.01, 0.0), "down", round_, thigh - 0.012, 0.053 * g, 0.033 * g),
            _Part(f"{s}_shank", f"{s}_ankle", none, "down", round_, shank, 0.033 * g, 0.020 * g),
            _Part(f"{s}_foot", f"{s}_toe", at, "forward", (1.15, 1.0, 1.0), long, sole + 0.003, sole),
        ]
    return parts


def _parts(h: float, trunk: float, limb: float, offsets: Tensor) -> tuple[Tensor, ...]:
    """Placement and shape of all parts in the order of ``PART_NAMES``, in metres."""
    bone = {name: float(offsets[joint(name)].norm()) / h for name in JOINTS}
    hips, shoulders = (abs(float(offsets[joint(name), 0])) / h for name in ("l_hip", "l_shoulder"))
    toe = (offsets[joint("l_toe")] / h).tolist()
    parts = _trunk_parts(trunk, bone, hips, shoulders) + _limb_parts(limb, bone, (toe[1], toe[2]))
    rows = sorted(parts, key=lambda part: PART_NAMES.index(part.name))

    def table(values: Sequence[object]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)

    length = table([r.length for r in rows]) * h
    scale, radii = table([r.scale for r in rows]), table([(r.r0, r.r1) for r in rows])
    flat = (length == 0)[:, None]
    return (
        torch.tensor([joint(r.bone) for r in rows]),
        table([r.origin for r in rows]) * h,
        table([_TURNS[r.turn] for r in rows]),
        # Ellipsoids carry metres in their scale, the others in their radii.
        torch.where(flat, scale * h, scale),
        length,
        torch.where(flat, radii, radii * h),
    )
