"""A human body of random build: constant bones, and round cones as flesh."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.data.synthetic.random import chance, seed_of, uniform
from torchrecon.data.synthetic.skeleton import JOINTS, joint
from torchrecon.render.raycast import RoundCones

__all__ = ["PART_NAMES", "Body", "sample_body"]

BALL_RADIUS = 0.12
"""Metres; a size-7 basketball."""


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
    part_bones: Int[Tensor, "parts"]
    part_origins: Float[Tensor, "parts 3"]
    part_rotations: Float[Tensor, "parts 3 3"]
    scale: Float[Tensor, "parts 3"]
    length: Float[Tensor, "parts"]
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

    def place(
        self, joints: Float[Tensor, "frames joints 3"], frames: Float[Tensor, "frames joints 3 3"]
    ) -> RoundCones:
        """The parts in the axes of ``joints``, batch = frames."""
        start = torch.tensor([max(p, 0) for p in _part_parents(self.part_bones)], device=joints.device)
        bone = frames[:, self.part_bones]
        origins = joints[:, start] + torch.einsum("fpij,pj->fpi", bone, self.part_origins.to(joints))
        rotations = bone @ self.part_rotations.to(joints)
        return RoundCones(
            rotations, origins, self.scale.to(joints), self.length.to(joints), self.radii.to(joints)
        )


def _part_parents(bones: Tensor) -> list[int]:
    from torchrecon.data.synthetic.skeleton import PARENTS

    return [PARENTS[b] for b in bones.tolist()]


PART_NAMES = (
    "pelvis", "abdomen", "chest", "neck", "head",
    "l_upper_arm", "l_forearm", "l_hand", "r_upper_arm", "r_forearm", "r_hand",
    "l_thigh", "l_shank", "l_foot", "r_thigh", "r_shank", "r_foot",
)  # fmt: skip


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
        "pelvis": (0, 0, 0),
        "spine": (0, 0.26 * trunk, -0.006),
        "chest": (0, 0.30 * trunk, -0.004),
        "neck": (0, 0.44 * trunk, 0.002),
        "head": (0, 0.080, 0.012),
    }
    for side, sign in (("l", 1.0), ("r", -1.0)):
        table[f"{side}_shoulder"] = (sign * 0.105 * shoulder, -0.012, 0.0)
        table[f"{side}_elbow"] = (0, -0.176 * arm, 0)
        table[f"{side}_wrist"] = (0, -0.150 * arm, 0)
        table[f"{side}_hand"] = (0, -0.052 * arm, 0)
        table[f"{side}_hip"] = (sign * 0.052 * hip, -0.030, 0)
        table[f"{side}_knee"] = (0, -0.5 * legs, 0)
        table[f"{side}_ankle"] = (0, -0.5 * legs, 0)
        table[f"{side}_toe"] = (0, -0.022, 0.090)
    return h * torch.tensor([table[name] for name in JOINTS], dtype=torch.float64)


def _parts(h: float, g: float, limb: float, offsets: Tensor) -> tuple[Tensor, ...]:
    """Placement and shape of the 17 parts; numbers are fractions of stature for an average build."""
    eye = torch.eye(3, dtype=torch.float64)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    rows: list[tuple[str, str, tuple[float, float, float], Tensor, tuple[float, float, float], float, float, float]] = []

    def add(
        name: str, bone: str, origin: tuple[float, float, float], turn: Tensor,
        scale: tuple[float, float, float], length: float, r0: float, r1: float,
    ) -> None:  # fmt: skip
        rows.append((name, bone, origin, turn, scale, length, r0, r1))

    def size(name: str) -> float:
        return float(offsets[joint(name)].norm()) / h

    hips = abs(float(offsets[joint("l_hip"), 0])) / h
    shoulders = abs(float(offsets[joint("l_shoulder"), 0])) / h
    add("pelvis", "pelvis", (0, -0.012, 0), eye, (hips + 0.046 * g, 0.066, 0.066 * g), 0, 1, 1)
    add("abdomen", "spine", (0, 0.005, 0), eye, (1.38, 1, 1), size("spine") + 0.55 * size("chest"), 0.060 * g, 0.063 * g)
    wide = (shoulders - 0.010) / (0.068 * g) if g < 1.15 else (shoulders - 0.004) / (0.068 * g)
    add("chest", "neck", (0, -0.01, 0), eye, (wide, 1, 1), size("neck") - 0.035, 0.062 * g, 0.068 * g)
    add("neck", "head", (0, -0.012, 0), eye, (1, 1, 1), 0.06, 0.034 * limb, 0.031 * limb)
    add("head", "head", (0, size("head") + 0.018, 0.010), eye, (0.045, 0.066, 0.055), 0, 1, 1)
    for s in ("l", "r"):
        add(f"{s}_upper_arm", f"{s}_elbow", (0, 0.002, 0), down, (1, 1, 1), size(f"{s}_elbow"), 0.033 * limb, 0.024 * limb)
        add(f"{s}_forearm", f"{s}_wrist", (0, 0, 0), down, (1, 1, 1), size(f"{s}_wrist"), 0.025 * limb, 0.016 * limb)
        add(f"{s}_hand", f"{s}_hand", (0, -0.8 * size(f"{s}_hand"), 0.004), eye, (0.013, 0.056, 0.026), 0, 1, 1)
        add(f"{s}_thigh", f"{s}_knee", (0, -0.01, 0), down, (1, 1, 1), size(f"{s}_knee") - 0.012, 0.052 * limb, 0.032 * limb)
        add(f"{s}_shank", f"{s}_ankle", (0, 0, 0), down, (1, 1, 1), size(f"{s}_ankle"), 0.032 * limb, 0.020 * limb)
        # From the heel, behind and below the ankle, to the toe joint; the sole is level when the foot is.
        toe = offsets[joint(f"{s}_toe")] / h
        sole = 0.017
        drop, heel = float(toe[1]), -0.026
        level = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
        add(f"{s}_foot", f"{s}_toe", (0, drop + 0.003, heel), level, (1.15, 1, 1), float(toe[2]) - heel, sole + 0.003, sole)
    rows.sort(key=lambda row: PART_NAMES.index(row[0]))
    f64 = torch.float64
    lengths = torch.tensor([r[5] for r in rows], dtype=f64) * h
    scale = torch.tensor([r[4] for r in rows], dtype=f64)
    radii = torch.tensor([[r[6], r[7]] for r in rows], dtype=f64)
    flat = (lengths == 0)[:, None]
    # Ellipsoids carry metres in their scale, the others in their radii.
    return (
        torch.tensor([joint(r[1]) for r in rows]),
        h * torch.tensor([r[2] for r in rows], dtype=f64),
        torch.stack([r[3] for r in rows]),
        torch.where(flat, scale * h, scale),
        lengths,
        torch.where(flat, radii, radii * h),
    )
