"""JUMP, and the leap that a jump shot shares with it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.synthetic.actions_common import GRAVITY, Performance, free_arms, standing
from torchrecon.data.synthetic.body import Body
from torchrecon.data.synthetic.curves import keys, smooth_noise, smoothstep
from torchrecon.data.synthetic.pose import Stance, solve_trunk
from torchrecon.data.synthetic.random import chance, uniform

__all__ = ["Leap", "jump"]


def _hermite(t: Tensor, t0: float, y0: float, v0: float, t1: float, y1: float, v1: float) -> Tensor:
    s = (t - t0) / (t1 - t0)
    d = t1 - t0
    return (
        (1 + 2 * s) * (1 - s) ** 2 * y0
        + s * (1 - s) ** 2 * d * v0
        + s * s * (3 - 2 * s) * y1
        + s * s * (s - 1) * d * v1
    )


class Leap:
    """One or more jumps on the spot: dip, push, flight on a parabola, landing.

    Args:
        takeoffs: seconds, ascending.
        height: rise of the pelvis in flight, metres.
        depth: of the dip before the push, metres.
        stretch: rise of the pelvis over standing at take-off (on the toes), metres.
        rest: seconds that the dip lasts; longer is calmer.
    """

    def __init__(
        self, takeoffs: Sequence[float], height: float, depth: float, stretch: float, rest: float = 0.35
    ) -> None:
        self.speed = math.sqrt(2 * GRAVITY * height)
        self.flight = 2 * self.speed / GRAVITY
        self.push = 2.1 * (depth + stretch) / self.speed
        self.takeoffs = tuple(takeoffs)
        self.landings = tuple(t + self.flight for t in takeoffs)
        self.height, self.depth, self.stretch, self.rest = height, depth, stretch, rest

    def rise(self, t: Float[Tensor, " frames"]) -> Float[Tensor, " frames"]:
        """Pelvis height over standing, metres."""
        depth, stretch, v = self.depth, self.stretch, self.speed
        dip = self.takeoffs[0] - self.push
        y = -depth * smoothstep((t - (dip - self.rest)) / self.rest)
        for index, (off, land) in enumerate(zip(self.takeoffs, self.landings, strict=True)):
            low = off - self.push
            y = torch.where(t >= low, _hermite(t, low, -depth, 0.0, off, stretch, v), y)
            tau = t - off
            y = torch.where(t >= off, stretch + v * tau - 0.5 * GRAVITY * tau * tau, y)
            absorbed = land + self.push
            y = torch.where(t >= land, _hermite(t, land, stretch, -v, absorbed, -depth, 0.0), y)
            last = index + 1 == len(self.takeoffs)
            y = torch.where(
                t >= absorbed, -depth * (1 - smoothstep((t - absorbed) / 0.6)) if last else -depth + 0 * t, y
            )
        return y

    def airborne(self, t: Float[Tensor, " frames"]) -> Bool[Tensor, " frames"]:
        """The toes are off the floor."""
        flags = torch.zeros_like(t, dtype=torch.bool)
        for off, land in zip(self.takeoffs, self.landings, strict=True):
            flags |= (t > off) & (t < land)
        return flags

    def heel(self, t: Float[Tensor, " frames"], takeoff: float = 0.95, flight: float = 0.7) -> Float[Tensor, " frames"]:
        """Foot pitch, radians."""
        times, values = [self.takeoffs[0] - self.push], [0.0]
        for off, land in zip(self.takeoffs, self.landings, strict=True):
            early = max(off - 0.45 * self.push, times[-1] + 0.01)
            times += [early, off, 0.5 * (off + land), land, land + 0.45 * self.push]
            values += [0.12, takeoff, flight, 0.75 * flight, 0.0]
        return keys(t, times, values)

    def apply(self, t: Float[Tensor, " frames"], stance: Stance, tuck: float = 0.0, forward: float = 0.0) -> None:
        """Write the leap into a stance: pelvis, toes, heels and contacts.

        Args:
            tuck: extra lift of the toes at the top of the flight, metres.
            forward: distance covered by each flight, metres.
        """
        y, air = self.rise(t), self.airborne(t)
        stance.root[:, 1] += y
        lift = torch.where(air, (y - self.stretch).clamp_min(0), 0.0)
        for off, land in zip(self.takeoffs, self.landings, strict=True):
            part = ((t - off) / (land - off)).clamp(0, 1)
            lift = lift + tuck * torch.sin(torch.pi * part) ** 2
            stance.toe[:, :, 2] += forward * smoothstep(part)[:, None]
            reach = 0.5 * self.push
            stance.root[:, 2] += forward * smoothstep((t - off + reach) / (land - off + 2 * reach))
        stance.toe[:, :, 1] += lift[:, None]
        stance.foot_pitch[:] = self.heel(t)[:, None]
        stance.planted[:] = ~air[:, None]


def jump(body: Body, t: Float[Tensor, " frames"], generator: torch.Generator | None) -> Performance:
    """Vertical or slightly forward jumps with an arm swing: one big jump, or rebounds one after the other."""
    g, h = generator, body.stature
    height = uniform(g, 0.13, 0.27) * h
    depth = uniform(g, 0.09, 0.16) * h
    duration = float(t[-1])
    leap = Leap([0.0], height, depth, 0.045 * h)
    period = leap.flight + 2 * leap.push + uniform(g, 0.0, 0.12)
    count = max(1, round((duration - 0.5) / period))
    first = 0.5 * (duration - (count - 1) * period - leap.flight) + uniform(g, -0.12, 0.12)
    leap = Leap([first + k * period for k in range(count)], height, depth, 0.045 * h)
    stance = standing(body, len(t), width=uniform(g, 0.10, 0.18), stagger=uniform(g, -0.03, 0.03))
    leap.apply(t, stance, tuck=uniform(g, 0.0, 0.09) * h, forward=uniform(g, -0.05, 0.22) * h)
    crouch = (-leap.rise(t) / depth).clamp(-0.3, 1)
    lean = uniform(g, 0.30, 0.5)
    stance.root_turn[:, 1] = lean * crouch.clamp_min(0)
    stance.root[:, 2] -= 0.06 * h * crouch.clamp_min(0)
    stance.spine_turn[:, 1] = 0.5 * lean * crouch
    stance.head_turn[:, 1] = -0.7 * lean * crouch
    sway = smooth_noise(t, g, 0.8, 3)
    stance.spine_turn[:, [0, 2]] += 0.02 * sway[:, :2]
    trunk = solve_trunk(body, stance)
    top = uniform(g, 1.5, 2.9)
    back = uniform(g, 0.5, 1.0)
    times, swing, flex = [leap.takeoffs[0] - leap.push - leap.rest], [0.05], [0.3]
    for off, land in zip(leap.takeoffs, leap.landings, strict=True):
        times += [off - 0.8 * leap.push, off + 0.02, off + 0.45 * leap.flight, land, land + 0.8 * leap.push]
        swing += [-back, 0.5 * top, top, 0.65 * top, 0.15]
        flex += [0.25, 0.7, 0.35, 0.6, 0.5]
    times += [times[-1] + 0.5]
    raise_, bend = keys(t, times, [*swing, 0.05]), keys(t, times, [*flex, 0.2])
    uneven = uniform(g, -0.15, 0.15) * (1 if chance(g, 0.5) else -1)
    both = torch.stack([raise_ * (1 + uneven), raise_ * (1 - uneven)], -1)
    out = torch.full_like(both, uniform(g, 0.12, 0.3))
    return Performance(trunk, free_arms(body, trunk, both, bend[:, None].expand_as(both), out))
