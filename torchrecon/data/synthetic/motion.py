"""Motions of the synthetic body: six procedural actions, placed in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.synthetic.actions_common import Performance
from torchrecon.data.synthetic.body import Body
from torchrecon.data.synthetic.distractors import dribble, idle
from torchrecon.data.synthetic.gait import run
from torchrecon.data.synthetic.hops import hop
from torchrecon.data.synthetic.leaps import jump
from torchrecon.data.synthetic.passes import pass_ball
from torchrecon.data.synthetic.pose import solve_pose
from torchrecon.data.synthetic.random import uniform
from torchrecon.data.synthetic.shots import shoot
from torchrecon.data.synthetic.skeleton import JOINTS, MIRROR, PARENTS, rotation_y
from torchrecon.errors import ReconError

__all__ = ["ACTIONS", "Motion", "sample_motion"]

_ACTORS: dict[str, Callable[[Body, Tensor, torch.Generator | None], Performance]] = {
    "shoot": shoot,
    "run": run,
    "jump": jump,
    "pass": pass_ball,
    "dribble": dribble,
    "idle": idle,
}
ACTIONS = tuple(_ACTORS)
"""Names of the actions; dribble and idle are there as distractors."""

_MORE = {"hop": hop}
"""What can be asked for by name besides: ways to move that only training films show."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A body's joints over time, in world axes (metres, y up, floor at y = 0).

    Attributes:
        joints: positions.
        bones: orientation of the bone that ends at each joint (the pelvis' own for joint 0): body axes -> world.
        ball: centre; NaN where there is none.
        contacts: toe planted, left and right.
        action: name.
        fps: frames per second.
        release: first frame in which the ball flies free, if it is thrown.
    """

    joints: Float[Tensor, "frames joints 3"]
    bones: Float[Tensor, "frames joints 3 3"]
    ball: Float[Tensor, "frames 3"]
    contacts: Bool[Tensor, "frames 2"]
    action: str
    fps: float
    release: int | None = None
    names: tuple[str, ...] = JOINTS
    parents: tuple[int, ...] = PARENTS

    def __len__(self) -> int:
        return self.joints.shape[0]


def sample_motion(
    action: str,
    body: Body,
    frames: int = 60,
    fps: float = 25.0,
    generator: torch.Generator | None = None,
) -> Motion:
    """One random performance of an action.

    Style, tempo, phase and amplitude vary. The key moment (release, take-off) lies near the middle of the clip; what a
    shorter clip cuts off is the preparation and the end. The body's own hand throws and dribbles. Tensors come in
    torch's default dtype; the draws do not depend on it.

    Args:
        action: one of ``ACTIONS``, or ``hop``: jumps on the spot as outside of a game, to train on.
        frames: number of frames; 60 at 25 fps hold any action whole.

    Raises:
        ReconError: unknown action, or fewer than 2 frames.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> from torchrecon.data.synthetic.body import sample_body
        >>> motion = sample_motion("jump", sample_body(g), frames=30, generator=g)
        >>> motion.joints.shape, bool(motion.ball.isnan().all())
        (torch.Size([30, 21, 3]), True)
    """
    actors = _ACTORS | _MORE
    if action not in actors:
        raise ReconError(f"action: {action!r} is not known; use one of {', '.join(ACTIONS)}")
    if frames < 2 or fps <= 0:
        raise ReconError(f"motion of {frames} frames at {fps} fps: at least 2 frames and a positive rate are needed")
    t = torch.arange(frames, dtype=torch.float64) / fps
    played = actors[action](body, t, generator)
    joints, bones = solve_pose(body, played.trunk, played.arms)
    contacts = played.trunk.stance.planted
    ball = torch.full((frames, 3), torch.nan, dtype=torch.float64) if played.ball is None else played.ball
    if not body.right_handed:
        flip = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
        joints, ball = joints[:, MIRROR] @ flip, ball @ flip
        bones, contacts = flip @ bones[:, MIRROR] @ flip, contacts.flip(-1)
    yaw = rotation_y(torch.tensor(uniform(generator, -torch.pi, torch.pi), dtype=torch.float64))
    centre = 0.5 * (joints[:, 0].amin(0) + joints[:, 0].amax(0))
    spot = [uniform(generator, -1.5, 1.5), 0.0, uniform(generator, -1.5, 1.5)]
    shift = torch.tensor(spot, dtype=torch.float64) - yaw @ torch.tensor([centre[0], 0.0, centre[2]])
    dtype = torch.get_default_dtype()
    return Motion(
        joints=(joints @ yaw.T + shift).to(dtype),
        bones=(yaw @ bones).to(dtype),
        ball=(ball @ yaw.T + shift).to(dtype),
        contacts=contacts,
        action=action,
        fps=float(fps),
        release=played.release,
    )
