"""From a few targets (pelvis, toes, hands) to joints and bone frames, by closed-form two-bone chains.

All in body axes of the take-off point: x left, y up, z forward, metres. Legs are solved from the toe upwards, so a
planted toe cannot slide; where a planted leg would be too short, the pelvis comes down instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.synthetic.body import Body
from torchrecon.data.synthetic.curves import upper_envelope
from torchrecon.data.synthetic.skeleton import JOINTS, PARENTS, joint, rotation_x, rotation_y, rotation_z

__all__ = ["Arms", "Stance", "Trunk", "chain_frames", "solve_pose", "solve_trunk", "swing", "turn", "two_bone"]

_STRAIGHTEST = 0.996
"""Longest reach of a leg or arm as a fraction of its two bones: a locked knee has no bending plane."""


@dataclass
class Stance:
    """Pelvis, trunk and feet per frame; ``2`` is left, right.

    Attributes:
        root: pelvis position. ``solve_trunk`` lowers it where a planted leg would not reach.
        root_turn: pelvis yaw (left), pitch (forward), roll (right), radians.
        spine_turn: the same three, of the shoulders against the pelvis; spread over the trunk.
        head_turn: the same three, of the head against the shoulders.
        toe: position of the toe joints.
        foot_pitch: heel lift, radians; 0 = sole level.
        foot_yaw: toes to the left, radians.
        planted: the toe carries weight and must stay where it is.
    """

    root: Float[Tensor, "frames 3"]
    root_turn: Float[Tensor, "frames 3"]
    spine_turn: Float[Tensor, "frames 3"]
    head_turn: Float[Tensor, "frames 3"]
    toe: Float[Tensor, "frames 2 3"]
    foot_pitch: Float[Tensor, "frames 2"]
    foot_yaw: Float[Tensor, "frames 2"]
    planted: Bool[Tensor, "frames 2"]


@dataclass
class Arms:
    """Where the hands go, per frame; ``2`` is left, right.

    Attributes:
        wrist: position wanted for the wrists.
        palm: direction wrist -> fingers.
        elbow: direction in which the elbow points away from the line shoulder - wrist.
    """

    wrist: Float[Tensor, "frames 2 3"]
    palm: Float[Tensor, "frames 2 3"]
    elbow: Float[Tensor, "frames 2 3"]


@dataclass
class Trunk:
    """Everything above the hips that does not depend on the arms."""

    stance: Stance
    position: dict[str, Tensor]
    frames: dict[str, Tensor]
    ankle: Float[Tensor, "frames 2 3"]
    foot: Float[Tensor, "frames 2 3 3"]

    @property
    def shoulders(self) -> Float[Tensor, "frames 2 3"]:
        return torch.stack([self.position["l_shoulder"], self.position["r_shoulder"]], 1)

    @property
    def heading(self) -> Float[Tensor, "frames 3 3"]:
        """Upright axes that turn with the pelvis: left, up, forward."""
        return rotation_y(self.stance.root_turn[:, 0])


def turn(angles: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Yaw, pitch, roll (radians) to a rotation, applied roll first."""
    return rotation_y(angles[..., 0]) @ rotation_x(angles[..., 1]) @ rotation_z(angles[..., 2])


def two_bone(
    start: Float[Tensor, "*b 3"], end: Float[Tensor, "*b 3"], pole: Float[Tensor, "*b 3"], upper: float, lower: float
) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]:
    """Middle joint of a chain of two bones, bent towards ``pole``.

    Returns:
        middle: position of the middle joint.
        end: the end that is reached; it differs from the wanted one where that is too far or too near.
    """
    line = end - start
    distance = line.norm(dim=-1, keepdim=True)
    along = line / distance.clamp_min(1e-9)
    reach = distance.clamp(1.02 * abs(upper - lower) + 1e-3, _STRAIGHTEST * (upper + lower))
    side = F.normalize(pole - (pole * along).sum(-1, keepdim=True) * along, dim=-1)
    x = (reach * reach + upper * upper - lower * lower) / (2 * reach)
    y = (upper * upper - x * x).clamp_min(0).sqrt()
    return start + x * along + y * side, start + reach * along


def chain_frames(
    start: Tensor, middle: Tensor, end: Tensor, knee: bool
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3 3"]]:
    """Frames of the two bones of a bent chain: -y along the bone, x the common hinge axis.

    A knee bulges forward (+z), an elbow backward (-z), so that x points left in both.
    """
    bulge = middle - 0.5 * (start + end)
    forward = bulge if knee else -bulge
    frames = []
    for a, b in ((start, middle), (middle, end)):
        y = F.normalize(a - b, dim=-1)
        x = F.normalize(torch.linalg.cross(y, forward), dim=-1)
        frames.append(torch.stack([x, y, torch.linalg.cross(x, y)], -1))
    return frames[0], frames[1]


def swing(frame: Float[Tensor, "*b 3 3"], source: Float[Tensor, "*b 3"], aim: Float[Tensor, "*b 3"]) -> Tensor:
    """``frame`` turned by the smallest rotation that takes its direction ``source`` (outer axes) onto ``aim``."""
    a, b = F.normalize(source, dim=-1), F.normalize(aim, dim=-1)
    axis = torch.linalg.cross(a, b)
    cosine = (a * b).sum(-1).clamp_min(-0.9999)[..., None, None]
    k = torch.zeros_like(frame)
    k[..., 0, 1], k[..., 0, 2], k[..., 1, 2] = -axis[..., 2], axis[..., 1], -axis[..., 0]
    k = k - k.transpose(-1, -2)
    # Rodrigues' formula in sine and cosine: no angle is ever formed.
    rotation = torch.eye(3, dtype=frame.dtype, device=frame.device) + k + k @ k / (1 + cosine)
    return rotation @ frame


def solve_trunk(body: Body, stance: Stance) -> Trunk:
    """Pelvis, spine, head and shoulders, with the pelvis low enough for the planted feet."""
    pelvis = turn(stance.root_turn)
    foot = rotation_y(stance.foot_yaw) @ rotation_x(stance.foot_pitch)
    offset = torch.stack([body.offsets[joint("l_toe")], body.offsets[joint("r_toe")]])
    ankle = stance.toe - torch.einsum("fsij,sj->fsi", foot, offset)
    stance = replace(stance, root=_reachable_root(body, stance, pelvis, ankle))
    frames = {"pelvis": pelvis, "l_hip": pelvis, "r_hip": pelvis}
    for index, name in enumerate(("spine", "chest", "neck"), start=1):
        frames[name] = pelvis @ turn(stance.spine_turn * (index / 3))
    frames["head"] = frames["neck"] @ turn(stance.head_turn)
    frames["l_shoulder"] = frames["r_shoulder"] = frames["neck"]
    position = {"pelvis": stance.root}
    for name in ("spine", "chest", "neck", "head", "l_shoulder", "r_shoulder", "l_hip", "r_hip"):
        _extend(body, name, position, frames)
    return Trunk(stance, position, frames, ankle, foot)


def solve_pose(
    body: Body, trunk: Trunk, arms: Arms
) -> tuple[Float[Tensor, "frames 21 3"], Float[Tensor, "frames 21 3 3"]]:
    """Joints (metres) and bone frames of the whole body; bones keep their length exactly."""
    position, frames = dict(trunk.position), dict(trunk.frames)
    yaw = trunk.stance.foot_yaw
    for side, s in enumerate(("l", "r")):
        hip = position[f"{s}_hip"]
        pole = rotation_y(yaw[:, side])[..., 2] + 0.6 * frames["pelvis"][..., 2]
        knee, end = two_bone(hip, trunk.ankle[:, side], pole, body.bone(f"{s}_knee"), body.bone(f"{s}_ankle"))
        frames[f"{s}_knee"], frames[f"{s}_ankle"] = chain_frames(hip, knee, end, knee=True)
        frames[f"{s}_toe"] = trunk.foot[:, side]
        shoulder, pole = position[f"{s}_shoulder"], arms.elbow[:, side]
        elbow, end = two_bone(shoulder, arms.wrist[:, side], pole, body.bone(f"{s}_elbow"), body.bone(f"{s}_wrist"))
        frames[f"{s}_elbow"], forearm = chain_frames(shoulder, elbow, end, knee=False)
        frames[f"{s}_wrist"] = forearm
        frames[f"{s}_hand"] = swing(forearm, -forearm[..., 1], arms.palm[:, side])
        for name in ("knee", "ankle", "toe", "elbow", "wrist", "hand"):
            _extend(body, f"{s}_{name}", position, frames)
    return torch.stack([position[n] for n in JOINTS], 1), torch.stack([frames[n] for n in JOINTS], 1)


def _extend(body: Body, name: str, position: dict[str, Tensor], frames: dict[str, Tensor]) -> None:
    index = joint(name)
    step = torch.einsum("fij,j->fi", frames[name], body.offsets[index])
    position[name] = position[JOINTS[PARENTS[index]]] + step


def _reachable_root(body: Body, stance: Stance, pelvis: Tensor, ankle: Tensor) -> Tensor:
    """The wanted pelvis, lowered smoothly so that planted legs stay shorter than their bones."""
    excess = torch.zeros_like(stance.root[:, 1])
    for side, s in enumerate(("l", "r")):
        hip = stance.root + torch.einsum("fij,j->fi", pelvis, body.offsets[joint(f"{s}_hip")])
        leg = _STRAIGHTEST * (body.bone(f"{s}_knee") + body.bone(f"{s}_ankle"))
        away = hip - ankle[:, side]
        height = (leg * leg - away[:, 0] ** 2 - away[:, 2] ** 2).clamp_min(0).sqrt()
        excess = torch.maximum(excess, torch.where(stance.planted[:, side], away[:, 1] - height, 0.0))
    lowered = stance.root.clone()
    lowered[:, 1] -= upper_envelope(excess, 3)
    return lowered
