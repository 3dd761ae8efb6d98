"""RUN, and the stepping that a walking dribble shares with it: feet planted in the world, swings between plants."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.actions_common import Performance, free_arms, standing, standing_height
from torchrecon.data.synthetic.body import Body
from torchrecon.data.synthetic.curves import bridge, keys, smooth_noise
from torchrecon.data.synthetic.pose import Stance, solve_trunk
from torchrecon.data.synthetic.random import chance, uniform
from torchrecon.data.synthetic.skeleton import rotation_y

__all__ = ["Gait", "run", "step_along"]


@dataclass(frozen=True)
class Gait:
    """One way of stepping forward.

    Attributes:
        speed: metres per second.
        cycle: seconds from one plant of a foot to its next.
        duty: fraction of the cycle that a foot is planted; below 0.5 there are flight phases.
        turn: radians per second to the left.
        width: distance of the two lines of steps, metres.
        push: heel lift at toe-off, radians.
        kick: height of the toe in early swing, metres.
        step: height of the toe in late swing, metres.
        fold: heel lift in early swing, radians.
        bounce: half the rise and fall of the pelvis, metres.
        drop: mean lowering of the pelvis under standing, metres.
    """

    speed: float
    cycle: float
    duty: float
    turn: float
    width: float
    push: float
    kick: float
    step: float
    fold: float
    bounce: float
    drop: float


def _path(gait: Gait, t: Tensor) -> tuple[Tensor, Tensor]:
    """Place on the floor (metres, y = 0) and heading (radians) at time t."""
    heading = gait.turn * t
    if abs(gait.turn) < 1e-6:
        return torch.stack([0 * t, 0 * t, gait.speed * t], -1), heading
    radius = gait.speed / gait.turn
    return torch.stack([radius * (1 - heading.cos()), 0 * t, radius * heading.sin()], -1), heading


def step_along(
    body: Body, t: Float[Tensor, " frames"], gait: Gait, phase: float
) -> tuple[Stance, Float[Tensor, " frames"]]:
    """A stance that walks or runs.

    Args:
        phase: of the left foot's plant at t = 0, fraction of a cycle.

    Returns:
        stance: pelvis yaw follows the heading; lean and arms are left to the action.
        stride: phase of the left foot in cycles (0 = its plant); the right foot is half a cycle later.
    """
    stance = standing(body, len(t))
    place, heading = _path(gait, t)
    stride = t / gait.cycle + phase
    ground = body.toe_height
    stance.root_turn[:, 0] = heading
    middle = 0.5 * gait.duty
    # The pelvis is lowest in the middle of a stance in running, highest there in walking (an inverted pendulum).
    sign = -1.0 if gait.duty < 0.5 else 1.0
    wave = torch.cos(4 * torch.pi * (stride - middle))
    stance.root[:] = place
    stance.root[:, 1] = standing_height(body) - gait.drop + sign * gait.bounce * wave
    for side in range(2):
        local = stride - 0.5 * side
        cycle = torch.floor(local)
        for number in range(int(cycle.min()), int(cycle.max()) + 1):
            frames = cycle == number
            if frames.any():
                _one_cycle(body, stance, gait, t, local, number, side, 0.5 * side - phase, ground, frames)
    return stance, stride


def _one_cycle(
    body: Body, stance: Stance, gait: Gait, t: Tensor, local: Tensor, number: int, side: int, offset: float,
    ground: float, frames: Tensor,
) -> None:  # fmt: skip
    """Fill in one foot between two of its plants."""
    sign = 1.0 if side == 0 else -1.0
    h = body.stature

    def plant(cycle: int) -> tuple[Tensor, Tensor]:
        when = torch.tensor([(cycle + 0.5 * gait.duty + offset) * gait.cycle], dtype=torch.float64)
        place, heading = _path(gait, when)
        ahead = torch.tensor([sign * 0.5 * gait.width, ground, 0.045 * h], dtype=torch.float64)
        return (place + rotation_y(heading) @ ahead)[0], heading[0]

    here, here_yaw = plant(number)
    there, there_yaw = plant(number + 1)
    s = local - number
    down = frames & (s < gait.duty)
    stance.toe[down, side] = here
    stance.foot_yaw[down, side] = here_yaw
    stance.planted[:, side] = torch.where(frames, down, stance.planted[:, side])
    roll = keys(s[down] / gait.duty, [0.0, 0.4, 1.0], [0.0, 0.05 * gait.push, gait.push])
    stance.foot_pitch[down, side] = roll
    up = frames & ~down
    q = (s[up] - gait.duty) / (1 - gait.duty)
    if not len(q):
        return
    off = torch.tensor([(number + gait.duty + offset) * gait.cycle], dtype=torch.float64)
    on = torch.tensor([(number + 1 + offset) * gait.cycle], dtype=torch.float64)
    # Drawn relative to the moving body, so that a planted foot runs backwards at the body's speed at both ends.
    (off_place, off_heading), (on_place, on_heading) = _path(gait, off), _path(gait, on)
    start = rotation_y(-off_heading[0]) @ (here - off_place[0])
    end = rotation_y(-on_heading[0]) @ (there - on_place[0])
    slope = [0.0, 0.0, -gait.speed * (1 - gait.duty) * gait.cycle]
    x = sign * 0.5 * gait.width
    reach = float(end[2] - start[2])
    knots = [
        start.tolist(),
        [x, ground + gait.kick, float(start[2]) + 0.16 * reach],
        [x, ground + gait.step, float(start[2]) + 0.72 * reach],
        end.tolist(),
    ]
    curve = bridge(q, [0.0, 0.33, 0.68, 1.0], knots, slope, slope)
    curve[:, 1] = curve[:, 1].clamp_min(ground)
    place, heading = _path(gait, t[up])
    stance.toe[up, side] = place + torch.einsum("fij,fj->fi", rotation_y(heading), curve)
    stance.foot_pitch[up, side] = keys(q, [0.0, 0.3, 0.72, 0.95], [gait.push, gait.fold, 0.1, 0.0])
    blend = q * q * (3 - 2 * q)
    stance.foot_yaw[up, side] = here_yaw + blend * (there_yaw - here_yaw)


def run(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """Jog to fast run, straight or on a bend, arms pumping against the legs."""
    g, h = generator, body.stature
    speed = uniform(g, 2.8, 5.2) * (h / 1.8) ** 0.5
    vigour = (speed - 2.6) / 2.8
    bend = uniform(g, -0.9, 0.9) if chance(g, 0.4) else uniform(g, -0.12, 0.12)
    gait = Gait(
        speed=speed,
        cycle=(0.78 - 0.12 * vigour) * uniform(g, 0.94, 1.06) * (h / 1.8) ** 0.5,
        duty=0.40 - 0.10 * vigour,
        turn=bend,
        width=uniform(g, 0.04, 0.09) * h,
        push=uniform(g, 0.9, 1.15),
        kick=(0.13 + 0.12 * vigour) * h * uniform(g, 0.85, 1.15),
        step=(0.05 + 0.06 * vigour) * h * uniform(g, 0.85, 1.15),
        fold=1.25 + 0.35 * vigour,
        bounce=uniform(g, 0.014, 0.024) * h,
        drop=uniform(g, 0.030, 0.045) * h,
    )
    stance, stride = step_along(body, t, gait, uniform(g, 0.0, 1.0))
    beat = torch.cos(2 * torch.pi * (stride - 0.5 * gait.duty + 0.12))
    lean = uniform(g, 0.06, 0.16) + 0.06 * vigour
    stance.root_turn[:, 1] = 0.6 * lean
    stance.root_turn[:, 0] += 0.12 * beat
    stance.root_turn[:, 2] = -0.5 * math.atan(speed * bend / 9.81)
    stance.spine_turn[:, 1] = 0.6 * lean
    stance.spine_turn[:, 0] = -uniform(g, 0.22, 0.34) * beat
    stance.head_turn[:, 0] = 0.14 * beat
    stance.head_turn[:, 1] = -0.8 * lean
    stance.spine_turn[:, 2] += 0.02 * smooth_noise(t, g, 0.8, 1)[:, 0]
    trunk = solve_trunk(body, stance)
    amplitude = uniform(g, 0.55, 0.8) + 0.25 * vigour
    sway = torch.stack([-beat, beat], -1)
    raise_ = -0.12 + amplitude * sway
    flex = uniform(g, 1.35, 1.7) + uniform(g, 0.1, 0.3) * sway
    out = torch.full_like(raise_, uniform(g, 0.12, 0.28))
    return Performance(trunk, free_arms(body, trunk, raise_, flex, out))
