"""DRIBBLE (one- and two-handed, standing or walking) and IDLE."""

from __future__ import annotations

import math

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.actions_common import (
    GRAVITY,
    Performance,
    blend_arms,
    free_arms,
    grip,
    standing,
    to_world,
    vector,
)
from torchrecon.data.synthetic.body import BALL_RADIUS, Body
from torchrecon.data.synthetic.curves import smooth_noise, smoothstep
from torchrecon.data.synthetic.gait import Gait, step_along
from torchrecon.data.synthetic.pose import solve_trunk
from torchrecon.data.synthetic.random import chance, uniform

__all__ = ["bounce_cycle", "dribble", "idle"]


def bounce_cycle(
    t: Float[Tensor, " frames"], top: float, speed: float, contact: float, restitution: float = 0.82
) -> tuple[Float[Tensor, " frames"], Float[Tensor, " frames"]]:
    """Height of a dribbled ball over time, and how far the hand is on it.

    The hand leaves the ball at height ``top`` (metres) with downward ``speed``; the ball falls, bounces with
    ``restitution`` and meets the hand on its way up; the hand turns it round within ``contact`` seconds.

    Returns:
        height: metres.
        free: 0 while the hand is on the ball, rising to 1 at the bounce and back.
    """
    floor = BALL_RADIUS
    fall = (-speed + math.sqrt(speed * speed + 2 * GRAVITY * (top - floor))) / GRAVITY
    up = restitution * (speed + GRAVITY * fall)
    catch_height = min(floor + 0.94 * up * up / (2 * GRAVITY), top - 0.02)
    rest = math.sqrt(up * up - 2 * GRAVITY * (catch_height - floor))
    rise = (up - rest) / GRAVITY
    tau = torch.remainder(t, fall + rise + contact)
    falling = top - speed * tau - 0.5 * GRAVITY * tau * tau
    rising = floor + up * (tau - fall) - 0.5 * GRAVITY * (tau - fall) ** 2
    s = ((tau - fall - rise) / contact).clamp(0, 1)
    held = (
        (1 + 2 * s) * (1 - s) ** 2 * catch_height
        + s * (1 - s) ** 2 * contact * rest
        + s * s * (3 - 2 * s) * top
        - s * s * (s - 1) * contact * speed
    )
    height = torch.where(tau < fall, falling, torch.where(tau < fall + rise, rising, held))
    free = torch.where(tau < fall + rise, torch.sin(torch.pi * (tau / (fall + rise)).clamp(0, 1)), 0.0)
    return height, free


def dribble(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """A crouched player bounces the ball beside (one hand) or before (two hands) himself, standing or walking."""
    g, h = generator, body.stature
    two = chance(g, 0.35)
    crouch = uniform(g, 0.04, 0.12) * h
    if chance(g, 0.5):
        gait = Gait(
            speed=uniform(g, 0.7, 1.5), cycle=uniform(g, 0.95, 1.2), duty=0.6, turn=uniform(g, -0.5, 0.5),
            width=uniform(g, 0.08, 0.13) * h, push=0.6, kick=0.05 * h, step=0.03 * h, fold=0.75,
            bounce=0.008 * h, drop=crouch + 0.02 * h,
        )  # fmt: skip
        stance, stride = step_along(body, t, gait, uniform(g, 0.0, 1.0))
        stance.spine_turn[:, 0] = 0.1 * torch.cos(2 * torch.pi * stride)
    else:
        stance = standing(body, len(t), uniform(g, 0.15, 0.24), uniform(g, -0.12, 0.12), uniform(g, 0.1, 0.3))
        stance.root[:, 1] -= crouch
        stance.root[:, ::2] += 0.012 * h * smooth_noise(t, g, 0.7, 2)
    lean = uniform(g, 0.2, 0.45)
    stance.root_turn[:, 1] = 0.5 * lean
    stance.spine_turn[:, 1] = 0.6 * lean
    stance.root[:, 2] -= 0.02 * h
    stance.spine_turn += 0.03 * smooth_noise(t, g, 0.8, 3)
    stance.head_turn[:, 1] = -0.5 * lean
    stance.head_turn[:, :1] += 0.25 * smooth_noise(t, g, 0.6, 1)
    trunk = solve_trunk(body, stance)
    top = uniform(g, 0.40, 0.52) * h
    shifted = t + uniform(g, 0.0, 0.6)
    height, free = bounce_cycle(shifted, top, uniform(g, 1.2, 2.4), uniform(g, 0.16, 0.26))
    side = vector(0.0, 0.0, 0.27 * h) if two else vector(-uniform(g, 0.13, 0.19) * h, 0.0, uniform(g, 0.14, 0.22) * h)
    ball = trunk.stance.root + to_world(trunk, side.expand(len(t), 3))
    ball = torch.stack([ball[:, 0], height, ball[:, 2]], -1)
    # While the ball is down the hand waits a little above the place where it will come back.
    waiting = ball.clone()
    waiting[:, 1] = torch.maximum(height, torch.tensor(top - 0.05 * h)) + 0.03 * h * free
    spread = torch.stack([vector(0.45 if two else 0.8, 0.9, -0.15), vector(-0.45 if two else -0.05, 0.95, -0.15)])
    contact = to_world(trunk, spread.expand(len(t), 2, 3))
    palm = to_world(trunk, torch.stack([vector(-0.2, -0.1, 1.0), vector(0.2, -0.1, 1.0)]).expand(len(t), 2, 3))
    elbow = to_world(trunk, torch.stack([vector(0.7, 0.0, -0.7), vector(-0.7, 0.0, -0.7)]).expand(len(t), 2, 3))
    arms = grip(body, waiting, contact, palm, elbow)
    if not two:
        angle = torch.full((len(t), 2), uniform(g, 0.2, 0.7), dtype=torch.float64) + 0.06 * smooth_noise(t, g, 0.8, 2)
        guard = free_arms(body, trunk, angle, angle + uniform(g, 0.4, 1.0), 0 * angle + uniform(g, 0.25, 0.6))
        arms = blend_arms(arms, guard, torch.tensor([1.0, 0.0], dtype=torch.float64).expand(len(t), 2))
    return Performance(trunk, arms, ball)


def idle(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """Standing about: weight shifts, looking around, arms hanging, on the hips, or holding the ball."""
    g, h = generator, body.stature
    stance = standing(body, len(t), uniform(g, 0.12, 0.22), uniform(g, -0.08, 0.08), uniform(g, 0.05, 0.3))
    slow = smooth_noise(t, g, 0.6, 8)
    stance.root[:, 0] += 0.014 * h * slow[:, 0]
    stance.root[:, 2] += 0.006 * h * slow[:, 1]
    stance.root[:, 1] -= uniform(g, 0.0, 0.02) * h
    stance.root_turn[:, 0] = 0.06 * slow[:, 2]
    stance.root_turn[:, 2] = 0.025 * slow[:, 0]
    stance.spine_turn[:, 0] = uniform(g, 0.03, 0.2) * slow[:, 3]
    stance.spine_turn[:, 1] = uniform(g, 0.0, 0.15) + 0.03 * slow[:, 4]
    stance.head_turn[:, 0] = uniform(g, 0.1, 0.5) * slow[:, 5]
    stance.head_turn[:, 1] = 0.1 * slow[:, 6]
    trunk = solve_trunk(body, stance)
    angle = 0.06 + 0.05 * smooth_noise(t, g, 0.6, 2)
    arms = free_arms(body, trunk, angle, angle + uniform(g, 0.15, 0.5), 0 * angle + uniform(g, 0.1, 0.2))
    style = uniform(g, 0.0, 1.0)
    if style < 0.3:
        hips = torch.stack([vector(0.105 * h, 0.01 * h, 0.0), vector(-0.105 * h, 0.01 * h, 0.0)])
        akimbo = trunk.stance.root[:, None] + to_world(trunk, hips.expand(len(t), 2, 3))
        arms.wrist[:] = akimbo
        arms.palm = to_world(trunk, torch.stack([vector(-0.5, -0.6, 0.6), vector(0.5, -0.6, 0.6)]).expand(len(t), 2, 3))
        arms.elbow = to_world(
            trunk, torch.stack([vector(1.0, 0.0, -0.5), vector(-1.0, 0.0, -0.5)]).expand(len(t), 2, 3)
        )
        return Performance(trunk, arms)
    if style < 0.6:
        ball = trunk.position["neck"] + to_world(
            trunk, (h * vector(0.0, uniform(g, -0.32, -0.2), 0.19)).expand(len(t), 3)
        )
        ball[:, 1] += 0.012 * h * slow[:, 7]
        sides = torch.tensor([[1.0, 1, 1], [-1.0, 1, 1]], dtype=torch.float64)
        directions = [vector(0.9, -0.1, -0.3), vector(-0.1, 0.2, 1.0), vector(0.6, -0.8, -0.4)]
        both = [to_world(trunk, (d * sides).expand(len(t), 2, 3)) for d in directions]
        return Performance(trunk, grip(body, ball, both[0], both[1], both[2]), ball)
    gesture = smoothstep((t - uniform(g, 0.2, 0.8) * float(t[-1])) / 0.7)
    lifted = free_arms(body, trunk, angle + 0.3, angle + uniform(g, 0.6, 1.8), 0 * angle + 0.15)
    return Performance(trunk, blend_arms(arms, lifted, torch.stack([0 * gesture, gesture], -1)))
