"""HOP: jumping on the spot as people do outside of a game, which no test film shows."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.actions_common import Performance, free_arms, standing, standing_height
from torchrecon.data.synthetic.body import Body
from torchrecon.data.synthetic.curves import smooth_noise
from torchrecon.data.synthetic.leaps import Leap
from torchrecon.data.synthetic.pose import Stance, solve_trunk
from torchrecon.data.synthetic.random import chance, uniform

__all__ = ["hop"]


def hop(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """Rebounds from before the clip to after it, low or high, on both feet or on one, feet together or apart.

    The arms hang, swing a little, are held bent, or go up and down sideways with each hop.
    """
    g, h = generator, body.stature
    one = chance(g, 0.2)
    height = uniform(g, 0.02, 0.14 if one else 0.22) * h
    depth = uniform(g, 0.015, 0.06 if one else 0.15) * h
    leap = Leap([0.0], height, depth, 0.03 * h)
    period = leap.flight + 2 * leap.push + uniform(g, 0.0, 0.3)
    first = -uniform(g, 0.0, 1.0) * period
    count = 2 + int((float(t[-1]) - first) / period)
    leap = Leap([first + k * period for k in range(count)], height, depth, 0.03 * h)
    stance = standing(body, len(t), uniform(g, 0.05, 0.35), uniform(g, -0.05, 0.05), uniform(g, 0.0, 0.3))
    leap.apply(t, stance, tuck=uniform(g, 0.0, 0.08) * h, forward=uniform(g, -0.03, 0.12) * h)
    if one:
        _lift_foot(body, stance, chance(g, 0.5), uniform(g, 0.12, 0.28) * h, uniform(g, -0.2, 0.12) * h)
    crouch = (-leap.rise(t) / depth).clamp(-0.3, 1)
    lean = uniform(g, 0.0, 0.45) * depth / (0.15 * h)
    stance.root_turn[:, 1] = lean * crouch.clamp_min(0) + uniform(g, 0.0, 0.1)
    stance.root[:, 2] -= 0.3 * depth * crouch.clamp_min(0)
    stance.root_turn[:, 0] = uniform(g, -0.6, 0.6) * smooth_noise(t, g, 1.5, 1)[:, 0]
    stance.spine_turn[:, 1] = 0.5 * lean * crouch
    stance.spine_turn[:, [0, 2]] += 0.04 * smooth_noise(t, g, 0.8, 2)
    trunk = solve_trunk(body, stance)
    beat = torch.sin(2 * torch.pi * ((t - first) / period + uniform(g, -0.25, 0.25)))[:, None].expand(len(t), 2)
    drift = smooth_noise(t, g, 0.8, 2)
    if chance(g, 0.15):  # a jumping jack
        top = uniform(g, 1.2, 2.8)
        out = 0.15 + top * (0.5 + 0.5 * beat)
        return Performance(trunk, free_arms(body, trunk, 0.1 * drift, 0.3 + 0 * out, out))
    side = torch.tensor([1.0, uniform(g, 0.6, 1.4)], dtype=torch.float64)
    raise_ = uniform(g, -0.1, 0.7) + uniform(g, 0.0, 0.5) * beat * side + 0.1 * drift
    flex = uniform(g, 0.1, 1.8) + uniform(g, 0.0, 0.4) * beat * side
    return Performance(trunk, free_arms(body, trunk, raise_, flex.clamp_min(0.05), 0 * raise_ + uniform(g, 0.05, 0.5)))


def _lift_foot(body: Body, stance: Stance, left: bool, up: float, ahead: float) -> None:
    """Take one foot off the floor; it goes with the pelvis.

    Args:
        up: height of its toes over the standing foot's when the body stands, metres.
        ahead: of its standing place, metres.
    """
    s = 0 if left else 1
    free = stance.toe[:, s]
    free[:, 1] = stance.root[:, 1] - standing_height(body) + body.toe_height + up
    free[:, 2] += ahead
    stance.foot_pitch[:, s] = 0.5
    stance.planted[:, s] = False
