"""PASS: chest pass and overhead pass, two-handed, with a step."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.actions_common import (
    Performance,
    blend_arms,
    free_arms,
    grip,
    standing,
    throw,
    to_world,
    vector,
)
from torchrecon.data.synthetic.body import Body
from torchrecon.data.synthetic.curves import keys, smooth_noise, smoothstep
from torchrecon.data.synthetic.pose import Arms, solve_trunk
from torchrecon.data.synthetic.random import chance, uniform

__all__ = ["pass_ball"]


def pass_ball(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """Ball drawn in to the chest (or behind the head), a step, a two-handed push (or throw), arms stay out."""
    g, h = generator, body.stature
    overhead = chance(g, 0.4)
    tempo = uniform(g, 0.85, 1.2)
    release = 0.5 * float(t[-1]) + uniform(g, -0.10, 0.12)
    stance = standing(body, len(t), uniform(g, 0.12, 0.2), uniform(g, -0.05, 0.05), uniform(g, 0.05, 0.25))
    step_side = 0 if chance(g, 0.5) else 1
    length = uniform(g, 0.10, 0.26) * h
    lift, land = release - 0.42 * tempo, release - 0.06 * tempo
    part = ((t - lift) / (land - lift)).clamp(0, 1)
    stance.toe[:, step_side, 2] += length * smoothstep(part)
    stance.toe[:, step_side, 1] += 0.045 * h * torch.sin(torch.pi * part) ** 2
    stance.planted[:, step_side] = (part <= 0) | (part >= 1)
    stance.foot_pitch[:, step_side] = 0.35 * torch.sin(torch.pi * (1 - (1 - part) ** 2)).clamp_min(0)
    stance.foot_pitch[:, 1 - step_side] = keys(
        t, [lift, release, release + 0.35, release + 0.9], [0.0, 0.6, 0.65, uniform(g, 0.0, 0.3)]
    )
    shift = keys(t, [lift - 0.3, lift, release, release + 0.9], [0.0, -0.08, 0.62, uniform(g, 0.35, 0.6)])
    stance.root[:, 2] += length * shift
    crouch = uniform(g, 0.03, 0.08) * h
    stance.root[:, 1] -= crouch * keys(t, [lift - 0.7, lift, release, release + 0.8], [0.5, 1.0, 0.8, 0.3])
    lean = keys(t, [lift - 0.2, lift + 0.05, release + 0.05, release + 0.8], [0.10, 0.02, 0.26, 0.14])
    stance.root_turn[:, 1] = 0.5 * lean
    stance.spine_turn[:, 1] = lean * uniform(g, 0.6, 1.1) - 0.1
    stance.head_turn[:, 1] = -0.8 * lean
    stance.spine_turn += 0.02 * smooth_noise(t, g, 0.8, 3)
    if overhead:
        stance.spine_turn[:, 1] -= keys(t, [release - 0.5, release - 0.22, release], [0.0, 0.22, 0.0])
    trunk = solve_trunk(body, stance)

    draw = release - 0.30 * tempo
    hold = [0.0, uniform(g, -0.22, -0.13), uniform(g, 0.17, 0.22)]
    if overhead:
        times = [release - 0.95 * tempo, release - 0.55 * tempo, release - 0.22 * tempo, release]
        path = keys(t, times, [hold, [0, 0.20, 0.16], [0, 0.24, uniform(g, 0.0, 0.05)], [0, 0.25, 0.27]])
    else:
        times = [release - 0.85 * tempo, draw, release]
        path = keys(t, times, [hold, [0, uniform(g, -0.12, -0.07), 0.135], [0, uniform(g, -0.06, 0.0), 0.37]])
    neck = trunk.position["neck"]
    held = neck + to_world(trunk, path * h)
    up = smoothstep((path[:, 1] - 0.0) / 0.2)[:, None]
    sides = torch.tensor([1.0, -1.0], dtype=torch.float64)[:, None]
    mirror = torch.cat([sides, torch.ones(2, 2, dtype=torch.float64)], -1)

    def both(low: Tensor, high: Tensor) -> Tensor:
        """The same direction for both hands, mirrored: ``low`` at the chest, ``high`` overhead."""
        return to_world(trunk, ((1 - up) * low + up * high)[:, None] * mirror)

    arms = grip(
        body,
        held,
        both(vector(0.85, -0.05, -0.5), vector(0.9, -0.1, -0.4)),
        both(vector(-0.1, 0.45, 1.0), vector(-0.15, 1.0, 0.15)),
        both(vector(0.85, -0.55, -0.2), vector(0.7, -0.3, 0.7)),
    )
    reach = body.bone("l_elbow") + body.bone("l_wrist")
    aim = vector(0.10, 0.02, 0.98) if not overhead else vector(0.10, 0.30, 0.93)
    through = Arms(
        trunk.shoulders + to_world(trunk, (aim * mirror * (0.97 * reach)).expand(len(t), 2, 3)),
        to_world(trunk, (vector(0.55, -0.3, 0.8) * mirror).expand(len(t), 2, 3)),
        arms.elbow,
    )
    arms = blend_arms(arms, through, smoothstep((t - release) / 0.13)[:, None].expand(-1, 2))
    low = torch.full((len(t), 2), 0.15, dtype=torch.float64)
    down = free_arms(body, trunk, low, low + 0.25, low)
    hang = 0.35 + uniform(g, 0.0, 0.35)
    arms = blend_arms(arms, down, smoothstep((t - release - hang) / 0.7)[:, None].expand(-1, 2))

    gone = t >= release
    index = int(gone.nonzero()[0]) if gone.any() else None
    ball = held.clone()
    if index is not None:
        slope = uniform(g, 0.05, 0.2)
        direction = to_world(trunk, vector(0.0, slope, 1.0).expand(len(t), 3))[index]
        ball[index:] = throw(t[index:] - t[index], held[index], uniform(g, 7.5, 10.5) * direction)
    return Performance(trunk, arms, ball, index)
