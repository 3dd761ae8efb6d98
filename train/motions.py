"""Windows of 3D motion before random cameras: what the shape prior is trained on.

A handful of subjects is all there is, so every window is of another body (bones are scaled alike on both sides), before
another camera, and shows another choice of joints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.mocap import MocapClip
from torchrecon.data.synthetic import ACTIONS, sample_body, sample_motion
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.models.joints import JOINTS, MIRROR, PARENTS, match_joints
from torchrecon.models.lifting import centre_and_size
from torchrecon.models.prior import RATE, WINDOW

__all__ = ["Batch", "Clip", "Variation", "Windows", "joints_of", "synthetic_clip"]

_SPREAD = {
    "spine": 0.15, "chest": 0.15, "neck": 0.15, "head": 0.25, "shoulder": 0.2, "elbow": 0.08, "wrist": 0.08,
    "hand": 0.2, "hip": 0.35, "knee": 0.08, "ankle": 0.08, "toe": 0.2,
}  # fmt: skip
"""Log spread of the length of the bone that ends at a joint: people's for limbs; where skeletons do not agree on what
they call a hip or a head, as much as they differ."""
_OFTEN_ABSENT = (("spine",), ("chest",), ("l_hand", "r_hand"), ("l_toe", "r_toe"), ("pelvis",), ("neck",), ("head",))
_STATURE = 1.7


class Clip(NamedTuple):
    """Joints of the prior in metres, Y up, and frames per second."""

    joints: Float[Tensor, "frames joints 3"]
    fps: float


def joints_of(clip: MocapClip) -> Clip:
    """A captured clip with the prior's joints in the prior's order; raises ReconError where one is missing."""
    where = match_joints(clip.names)
    absent = [name for index, name in enumerate(JOINTS) if index not in where]
    if absent:
        raise ReconError(
            f"clip {clip.trial}: has no joint that is {absent[0]}; the prior is trained on all of {JOINTS}"
        )
    return Clip(clip.joints[:, [where.index(index) for index in range(len(JOINTS))]].float(), clip.fps)


def synthetic_clip(seed: int) -> Clip:
    """One motion of the synthetic world; the action is decided by the seed."""
    g = torch.Generator().manual_seed(seed)
    motion = sample_motion(ACTIONS[seed % len(ACTIONS)], sample_body(g), frames=75, fps=30.0, generator=g)
    order = [motion.names.index(name) for name in JOINTS]
    return Clip(motion.joints[:, order].float(), motion.fps)


@dataclass(frozen=True)
class Variation:
    """How windows vary.

    Attributes:
        tempo: relative speed.
        bones: factor on the log spread of bone lengths.
        turn: odds of a camera that turns about the person, by up to half a turn per window.
        tilt: of a camera that looks down, radians.
        roll: standard deviation, radians.
        distance: of the camera, statures.
        follow: odds of a camera that keeps the person in the middle.
        whole: odds of a window in which every joint is seen.
        absent: odds that a joint is not tracked at all, of those that many keypoint sets lack.
        lost: odds that any joint is not tracked at all, and that it has a gap.
        gap: longest gap, frames.
        noise: least and most standard deviation of the image position, statures.
    """

    tempo: tuple[float, float] = (0.7, 1.35)
    bones: float = 1.0
    turn: float = 0.25
    tilt: tuple[float, float] = (-0.15, 0.5)
    roll: float = 0.06
    distance: tuple[float, float] = (1.5, 7.0)
    follow: float = 0.5
    whole: float = 0.25
    absent: float = 0.5
    lost: tuple[float, float] = (0.05, 0.1)
    gap: int = 14
    noise: tuple[float, float] = (5e-4, 0.01)


class Batch(NamedTuple):
    """What the network sees and should say, in its own unit (:class:`torchrecon.models.lifting.Lifting`)."""

    xy: Float[Tensor, "windows frames joints 2"]
    seen: Bool[Tensor, "windows frames joints"]
    points3d: Float[Tensor, "windows frames joints 3"]


class Windows:
    """Draws windows from clips.

    Args:
        clips: a long one is drawn more often than a short one.
        variation: of the windows.
        seed: the same seed gives the same windows in the same order.
    """

    def __init__(self, clips: Sequence[Clip], variation: Variation, seed: int) -> None:
        if not clips:
            raise ReconError("clips: there is none to train on")
        self.variation = variation
        self.generator = torch.Generator().manual_seed(seed)
        self.joints = torch.cat([clip.joints for clip in clips])
        self.length = torch.tensor([len(clip.joints) for clip in clips])
        self.first = self.length.cumsum(0) - self.length
        self.step = torch.tensor([clip.fps / RATE for clip in clips])

    def bones(self) -> float:
        """Mean over the frames of the sum of the bone lengths, metres."""
        return float(_bones(self.joints).norm(dim=-1).sum(-1).mean())

    def draw(self, count: int) -> Batch:
        """``count`` windows, each before a camera of its own."""
        world = self._bodies(count)
        camera = self._camera(count, world.shape[1]) @ (world - world[:, :, :1].mean(1, keepdim=True)).mT
        return self._seen(camera.mT)

    def _uniform(self, *shape: int, between: tuple[float, float] = (0.0, 1.0)) -> Tensor:
        return between[0] + (between[1] - between[0]) * torch.rand(*shape, generator=self.generator)

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self.generator)

    def _bodies(self, count: int) -> Tensor:
        """(windows, frames, joints, 3) of bodies that nobody has."""
        v = self.variation
        clip = torch.multinomial(self.length.float().clamp_min(20), count, replacement=True, generator=self.generator)
        last = (self.length[clip] - 1).float()
        pace = self.step[clip] * self._uniform(count, between=v.tempo)
        # A window may begin a little before its clip and end a little after it: the pose is held there.
        room = last - pace * WINDOW
        start = torch.where(room > 0, (room + 10) * self._uniform(count) - 5, self._uniform(count))
        time = (start[:, None] + pace[:, None] * torch.arange(WINDOW)).clamp_min(0).minimum(last[:, None])
        before = time.floor().long()
        after = (before + 1).minimum(last[:, None].long())
        share = (time - before)[..., None, None]
        first = self.first[clip][:, None]
        world = self.joints[first + before] * (1 - share) + self.joints[first + after] * share
        mirrored = world[:, :, list(MIRROR)] * torch.tensor([-1.0, 1.0, 1.0])
        world = torch.where((self._uniform(count) < 0.5)[:, None, None, None], mirrored, world)
        factor = torch.ones(count, len(JOINTS))
        for kind, spread in _SPREAD.items():
            scale = torch.exp(v.bones * spread * self._normal(count).clamp(-2, 2))
            for index, name in enumerate(JOINTS):
                if name.split("_")[-1] == kind:
                    factor[:, index] = scale
        bones = torch.nn.functional.pad(_bones(world), (0, 0, 1, 0)) * factor[:, None, :, None]
        return world[:, :, :1] + torch.einsum("jk,wfkc->wfjc", _CHAIN, bones)

    def _camera(self, count: int, frames: int) -> Tensor:
        """World -> camera rotations (windows, frames, 3, 3)."""
        v, none = self.variation, torch.zeros(count)
        rate = torch.where(self._uniform(count) < v.turn, self._uniform(count, between=(-math.pi, math.pi)), none)
        yaw = self._uniform(count, 1, between=(-math.pi, math.pi)) + rate[:, None] * torch.linspace(-0.5, 0.5, frames)
        about = rotation_from_vector(torch.stack([0 * yaw, yaw, 0 * yaw], -1))
        tilt = rotation_from_vector(torch.stack([self._uniform(count, between=v.tilt), none, none], -1))
        roll = rotation_from_vector(torch.stack([none, none, v.roll * self._normal(count)], -1))
        # World axes have Y up and the camera's has it down.
        return (roll @ tilt @ torch.diag(torch.tensor([1.0, -1.0, -1.0])))[:, None] @ about

    def _seen(self, turned: Tensor) -> Batch:
        """What a pinhole camera sees of joints in its axes, its distance yet to be chosen."""
        v, (count, frames) = self.variation, turned.shape[:2]
        aside = turned[:, :, :1] * torch.tensor([1.0, 1.0, 0.0])
        turned = torch.where((self._uniform(count) < v.follow)[:, None, None, None], turned - aside, turned)
        near, far = v.distance
        distance = _STATURE * torch.exp(self._uniform(count, between=(math.log(near), math.log(far))))
        depth = (turned[..., 2:] + distance[:, None, None, None]).clamp_min(0.5)
        exact = turned[..., :2] / depth
        own = depth[:, :, :1]
        weak = (turned[..., :2] - turned[:, :, :1, :2]) / own + exact[:, :, :1]
        low, high = v.noise
        noise = _STATURE / distance * torch.exp(self._uniform(count, between=(math.log(low), math.log(high))))
        xy = exact + noise[:, None, None, None] * self._normal(*exact.shape)
        seen = self._tracked(count, frames)
        centre, size = centre_and_size(xy, seen)
        size = size * torch.exp(0.1 * self._normal(count))[:, None, None, None]
        ahead = depth / own
        points = torch.cat([(weak - centre) / size, (ahead - ahead.mean(2, keepdim=True)) / size], -1)
        return Batch(torch.where(seen[..., None], (xy - centre) / size, torch.zeros(())), seen, points)

    def _tracked(self, count: int, frames: int) -> Tensor:
        """Which entries are measured (windows, frames, joints)."""
        v = self.variation
        absent = self._uniform(count, len(JOINTS)) < v.lost[0]
        for names in _OFTEN_ABSENT:
            chosen = self._uniform(count) < v.absent
            for name in names:
                absent[:, JOINTS.index(name)] |= chosen
        start = frames * self._uniform(count, 1, len(JOINTS))
        length = self._uniform(count, 1, len(JOINTS), between=(1.0, v.gap))
        length = length * (self._uniform(count, 1, len(JOINTS)) < v.lost[1])
        frame = torch.arange(frames)[None, :, None]
        missing = absent[:, None] | ((frame >= start) & (frame < start + length))
        return ~missing | (self._uniform(count) < v.whole)[:, None, None]


def _bones(joints: Tensor) -> Tensor:
    """(..., joints - 1, 3): from the parent to the joint, the pelvis left out."""
    return joints[..., 1:, :] - joints[..., list(PARENTS[1:]), :]


def _chain() -> Tensor:
    """(joints, joints): the bones that lead from the pelvis to each joint."""
    chain = torch.zeros(len(JOINTS), len(JOINTS))
    for index, parent in enumerate(PARENTS):
        if parent >= 0:
            chain[index] = chain[parent]
            chain[index, index] = 1
    return chain


_CHAIN = _chain()
