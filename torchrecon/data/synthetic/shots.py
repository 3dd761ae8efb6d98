"""SHOOT: jump shot and set shot, with the ball's flight."""

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
from torchrecon.data.synthetic.leaps import Leap
from torchrecon.data.synthetic.pose import solve_trunk
from torchrecon.data.synthetic.random import chance, uniform

__all__ = ["shoot"]


def shoot(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """Ball from the waist over the set point above the forehead to the release overhead, then the follow-through."""
    g, h = generator, body.stature
    duration = float(t[-1])
    tempo = uniform(g, 0.85, 1.15)
    release = 0.5 * duration + uniform(g, -0.12, 0.12)
    stance = standing(body, len(t), uniform(g, 0.12, 0.19), uniform(g, 0.02, 0.09), uniform(g, 0.0, 0.2))
    depth = uniform(g, 0.06, 0.11) * h
    jumping = chance(g, 0.75)
    if jumping:
        leap = Leap([0.0], uniform(g, 0.06, 0.18) * h, depth, 0.045 * h, rest=0.4 * tempo)
        leap = Leap([release - uniform(g, 0.30, 0.48) * leap.flight], leap.height, depth, 0.045 * h, rest=0.4 * tempo)
        leap.apply(t, stance, tuck=uniform(g, 0.0, 0.03) * h, forward=uniform(g, -0.08, 0.06) * h)
        rise = leap.rise(t)
        dip = leap.takeoffs[0] - leap.push
    else:
        dip = release - 0.5 * tempo
        times = [dip - 0.45 * tempo, dip, release - 0.03, release + 0.25, release + 0.55]
        rise = keys(t, times, [0.0, -depth, 0.035 * h, 0.03 * h, 0.0])
        stance.root[:, 1] += rise
        stance.foot_pitch[:] = keys(t, [dip, *times[2:]], [0.0, 0.6, 0.55, 0.0])[:, None]
    crouch = (-rise / depth).clamp(0, 1)
    stance.root[:, 2] -= 0.045 * h * crouch
    stance.root_turn[:, 0] = uniform(g, 0.0, 0.35)
    stance.root_turn[:, 1] = uniform(g, 0.15, 0.3) * crouch
    stance.spine_turn[:, 1] = 0.2 * crouch - keys(
        t, [release - 0.4, release, release + 0.7], [0.0, uniform(g, 0.0, 0.15), 0]
    )
    stance.spine_turn[:, 0] = uniform(g, -0.1, 0.15) * smoothstep((t - dip) / 0.4)
    stance.spine_turn += 0.015 * smooth_noise(t, g, 0.8, 3)
    stance.head_turn[:, 1] = -0.25 - 0.1 * crouch
    stance.head_turn[:, 0] = -stance.root_turn[:, 0] * 0.7
    trunk = solve_trunk(body, stance)

    # Ball relative to the neck, in fractions of stature: (left, up, forward).
    set_point = release - uniform(g, 0.13, 0.2) * tempo
    hold = vector(uniform(g, -0.03, 0.03), uniform(g, -0.22, -0.12), 0.20)
    path = keys(
        t,
        [dip - 0.35 * tempo, dip + 0.02, 0.5 * (dip + set_point), set_point, release],
        [
            hold.tolist(),
            [-0.02, uniform(g, -0.30, -0.24), 0.17],
            [-0.045, -0.02, 0.19],
            [-0.05, uniform(g, 0.13, 0.19), uniform(g, 0.13, 0.17)],
            [-0.075, uniform(g, 0.33, 0.38), uniform(g, 0.16, 0.21)],
        ],
    )
    held = trunk.position["neck"] + to_world(trunk, path * h)
    under = smoothstep((t - dip) / max(set_point - dip, 0.1))[:, None]
    ones = torch.ones_like(under)
    # The right hand goes from the side of the ball to under and behind it, the left stays at its side.
    right_contact = (1 - under) * vector(-0.8, 0.1, -0.45) + under * vector(-0.12, -0.62, -0.75)
    right_palm = (1 - under) * vector(0.15, 0.1, 1.0) + under * vector(0.1, 0.85, 0.15)
    left_contact = (1 - under) * vector(0.85, 0.05, -0.4) + under * vector(0.98, 0.05, -0.1)
    left_palm = (1 - under) * vector(-0.15, 0.1, 1.0) + under * vector(-0.1, 1.0, 0.1)
    contact = to_world(trunk, torch.stack([left_contact, right_contact], 1))
    palm = to_world(trunk, torch.stack([left_palm, right_palm], 1))
    right_elbow = (1 - under) * vector(-0.6, -0.8, -0.5) + under * vector(-0.25, -0.9, 0.55)
    left_elbow = (1 - under) * vector(0.6, -0.8, -0.5) + under * vector(0.75, -0.7, 0.3)
    elbow = to_world(trunk, torch.stack([left_elbow * ones, right_elbow * ones], 1))
    arms = grip(body, held, contact, palm, elbow)

    # Follow-through: the shooting arm straight up and forward with a dropped wrist, the guide hand beside it.
    arm = body.bone("r_elbow") + body.bone("r_wrist")
    reach = torch.stack([vector(-0.05, 0.83, 0.44), vector(0.0, 0.86, 0.48)]) * arm * torch.tensor([[0.86], [0.985]])
    through = arms.__class__(
        trunk.shoulders + to_world(trunk, reach.expand(len(t), 2, 3)),
        to_world(trunk, torch.stack([vector(-0.2, 0.9, 0.4), vector(0.0, -0.35, 1.0)]).expand(len(t), 2, 3)),
        elbow,
    )
    drop = 0.35 + uniform(g, 0.05, 0.3)
    after = smoothstep((t - release) / 0.14)
    arms = blend_arms(arms, through, after[:, None].expand(-1, 2))
    low = torch.full((len(t), 2), 0.12, dtype=torch.float64)
    down = free_arms(body, trunk, low, low + 0.3, low + 0.05)
    arms = blend_arms(arms, down, smoothstep((t - release - drop) / 0.6)[:, None].expand(-1, 2))

    gone = t >= release
    index = int(gone.nonzero()[0]) if gone.any() else None
    ball = held.clone()
    if index is not None:
        forward = to_world(trunk, vector(0.0, 0.0, 1.0).expand(len(t), 3))[index]
        speed, angle = uniform(g, 7.0, 9.2), uniform(g, 0.80, 1.0)
        velocity = speed * (
            forward * torch.cos(torch.tensor(angle)) + vector(0.0, 1.0, 0.0) * torch.sin(torch.tensor(angle))
        )
        ball[index:] = throw(t[index:] - t[index], held[index], velocity)
    return Performance(trunk, arms, ball, index)
