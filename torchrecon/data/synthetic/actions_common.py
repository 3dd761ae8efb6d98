"""What the actions share: standing, free arms, hands on the ball, the ball's flight."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.body import BALL_RADIUS, Body
from torchrecon.data.synthetic.pose import Arms, Stance, Trunk
from torchrecon.data.synthetic.skeleton import joint

__all__ = [
    "GRAVITY",
    "Performance",
    "blend_arms",
    "free_arms",
    "grip",
    "standing",
    "standing_height",
    "throw",
    "to_world",
    "vector",
]

GRAVITY = 9.81
"""Metres per second squared."""


class Performance:
    """What an action returns: trunk, arms and ball, played by a right-hander who starts out facing +z."""

    def __init__(self, trunk: Trunk, arms: Arms, ball: Tensor | None = None, release: int | None = None) -> None:
        self.trunk, self.arms, self.ball, self.release = trunk, arms, ball, release


def vector(*xyz: float) -> Float[Tensor, " 3"]:
    """A float64 vector."""
    return torch.tensor(xyz, dtype=torch.float64)


def standing_height(body: Body) -> float:
    """Pelvis height (metres) of the upright body with knees not quite locked."""
    legs = body.bone("l_knee") + body.bone("l_ankle")
    return body.toe_height - float(body.offsets[joint("l_toe"), 1] + body.offsets[joint("l_hip"), 1]) + 0.985 * legs


def standing(body: Body, frames: int, width: float = 0.13, stagger: float = 0.0, splay: float = 0.15) -> Stance:
    """Both feet on the floor, pelvis over them.

    Args:
        width: distance of the toes as a fraction of stature.
        stagger: how far the right foot stands ahead of the left, fraction of stature.
        splay: outward turn of the toes, radians.
    """
    h = body.stature
    zeros = torch.zeros(frames, 3, dtype=torch.float64)
    root = zeros + vector(0.0, standing_height(body), 0.0)
    toe = torch.stack(
        [
            vector(0.5 * width * h, body.toe_height, 0.065 * h - 0.5 * stagger * h),
            vector(-0.5 * width * h, body.toe_height, 0.065 * h + 0.5 * stagger * h),
        ]
    )
    yaw = torch.tensor([splay, -splay], dtype=torch.float64)
    return Stance(
        root=root,
        root_turn=zeros.clone(),
        spine_turn=zeros.clone(),
        head_turn=zeros.clone(),
        toe=toe.expand(frames, 2, 3).clone(),
        foot_pitch=zeros[:, :2].clone(),
        foot_yaw=yaw.expand(frames, 2).clone(),
        planted=torch.ones(frames, 2, dtype=torch.bool),
    )


def to_world(trunk: Trunk, local: Float[Tensor, "frames *n 3"]) -> Float[Tensor, "frames *n 3"]:
    """Directions given as (left, up, forward) of the pelvis heading."""
    return torch.einsum("fij,f...j->f...i", trunk.heading, local)


def free_arms(
    body: Body,
    trunk: Trunk,
    raise_: Float[Tensor, "frames 2"],
    flex: Float[Tensor, "frames 2"],
    out: Float[Tensor, "frames 2"],
    wrist_bend: float = 0.15,
) -> Arms:
    """Arms from joint angles in radians.

    Args:
        raise_: upper arm forward of hanging; pi is overhead.
        flex: bend of the elbow.
        out: upper arm away from the trunk, sideways.
        wrist_bend: further bend of the hand.
    """
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64)

    def direction(angle: Tensor, spread: Tensor) -> Tensor:
        local = torch.stack([sign * spread.sin(), -angle.cos() * spread.cos(), angle.sin() * spread.cos()], -1)
        return to_world(trunk, local)

    elbow = direction(raise_, out) * body.bone("l_elbow")
    forearm = direction(raise_ + flex, 0.4 * out)
    wrist = trunk.shoulders + elbow + forearm * body.bone("l_wrist")
    return Arms(wrist, direction(raise_ + flex + wrist_bend, 0.2 * out), elbow - 0.5 * (wrist - trunk.shoulders))


def grip(body: Body, ball: Float[Tensor, "frames 3"], contact: Tensor, palm: Tensor, elbow: Tensor) -> Arms:
    """Hands on the ball.

    Args:
        ball: centre, metres, world.
        contact: (frames, 2, 3) direction from the ball's centre to the middle of each palm, world.
        palm: (frames, 2, 3) direction of the fingers, world.
        elbow: (frames, 2, 3) where the elbows point, world.
    """
    centre = ball[:, None] + F.normalize(contact, dim=-1) * (BALL_RADIUS + 0.010 * body.stature)
    palm = F.normalize(palm, dim=-1)
    return Arms(centre - palm * (0.8 * body.bone("l_hand")), palm, elbow)


def blend_arms(first: Arms, second: Arms, weight: Float[Tensor, "frames 2"]) -> Arms:
    """From ``first`` (weight 0) to ``second`` (weight 1)."""
    w = weight[..., None]
    return Arms(
        first.wrist + w * (second.wrist - first.wrist),
        F.normalize(first.palm, dim=-1) * (1 - w) + F.normalize(second.palm, dim=-1) * w,
        F.normalize(first.elbow, dim=-1) * (1 - w) + F.normalize(second.elbow, dim=-1) * w,
    )


def throw(
    t: Float[Tensor, " frames"], start: Float[Tensor, " 3"], velocity: Float[Tensor, " 3"], bounce: float = 0.75
) -> Float[Tensor, "frames 3"]:
    """Flight under gravity from ``start`` at t = 0, with bounces off the floor (times in seconds, t >= 0)."""
    position = start + t[:, None] * velocity
    height, rise, begin = float(start[1]) - BALL_RADIUS, float(velocity[1]), 0.0
    y = torch.full_like(t, BALL_RADIUS)
    while rise > 0.05 or height > 0:
        landing = begin + (rise + (rise * rise + 2 * GRAVITY * height) ** 0.5) / GRAVITY
        tau = t - begin
        part = (tau >= 0) & (t < landing)
        y = torch.where(part, BALL_RADIUS + height + rise * tau - 0.5 * GRAVITY * tau * tau, y)
        rise = bounce * (GRAVITY * (landing - begin) - rise)
        begin, height = landing, 0.0
        if begin > float(t.max()):
            break
    return torch.stack([position[:, 0], y, position[:, 2]], -1)
