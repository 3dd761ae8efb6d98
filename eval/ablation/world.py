"""Complete tracks of a person whose number of shape bases K is known.

A body of the synthetic world moves; points of its surface, centred in every frame and turned into body axes, are cut
down to their K leading shapes, so that K is exact while the motion stays that of the action. The body then turns by
180 degrees before a parallel camera that nods by 15 degrees. SNR: mean square of the image coordinates about their
centre over the mean noise variance per coordinate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, static_camera
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.render.raycast import local_to_outer

__all__ = ["Person", "Scene", "film_person", "noisy"]

_SEED = 980_000_000  # of bodies here; films of the tables and training take others
_EXTENT, _CENTRE = 100.0, 300.0  # pixels per metre, and where the body stands in the image
_TURN, _NOD = 180.0, 15.0  # degrees


@dataclass(frozen=True)
class Person:
    """Who moves how: everything of a scene follows from these fields.

    Attributes:
        action: of the synthetic world.
        seed: of body, motion, noise and gaps.
        frames, points, bases: size of the tracks and their true K, the mean shape counted.
    """

    action: str
    seed: int
    frames: int
    points: int
    bases: int

    def __str__(self) -> str:
        return f"{self.action}-{self.seed:02d}"


@dataclass(frozen=True, eq=False)
class Scene:
    """The truth of a person's tracks.

    Attributes:
        truth: (frames, points, 3) camera axes, pixels, centred per frame.
        rotations: (frames, 3, 3) world (y up) -> camera (y down).
    """

    truth: Float[Tensor, "frames points 3"]
    rotations: Float[Tensor, "frames 3 3"]


def film_person(person: Person) -> Scene:
    """The scene of a person, without noise.

    Example:
        >>> scene = film_person(Person("run", 0, 30, 20, 2))
        >>> body = scene.truth @ scene.rotations
        >>> int(torch.linalg.matrix_rank(body.flatten(1), rtol=1e-9))
        2
    """
    g = torch.Generator().manual_seed(_SEED + person.seed)
    body = sample_body(g)
    motion = sample_motion(person.action, body, frames=person.frames, generator=g)
    skin = SyntheticClip(body, motion, static_camera(motion, generator=g), seed=person.seed)
    surface = skin.sample_surface(person.points, g)
    world = local_to_outer(
        body.place(motion.joints.double(), motion.bones.double()), surface.part, surface.local.double()
    )
    shapes = _EXTENT * (world - world.mean(1, keepdim=True))
    u, s, vh = torch.linalg.svd(shapes.flatten(1), full_matrices=False)
    k = person.bases
    shapes = ((u[:, :k] * s[:k]) @ vh[:k]).view_as(shapes)  # still centred: combinations of centred shapes
    t = torch.linspace(-0.5, 0.5, person.frames, dtype=torch.float64)
    zero = torch.zeros_like(t)
    nod = rotation_from_vector(torch.stack([math.radians(_NOD) * torch.sin(2 * math.pi * t), zero, zero], -1))
    yaw = rotation_from_vector(torch.stack([zero, math.radians(_TURN) * t, zero], -1))
    upright = torch.diag(t.new_tensor([1.0, -1.0, -1.0]))  # y up, facing z -> y down, z away
    rotations = nod @ yaw @ upright
    return Scene(shapes @ rotations.mT, rotations)


def noisy(
    scene: Scene, person: Person, snr: float, anisotropy: float = 1.0, spread: float = 0.0, missing: float = 0.0
) -> Tracks:
    """Tracks with noise of known covariance, and gaps.

    Args:
        snr: decibels.
        anisotropy: long over short axis of every point's noise ellipse, at a random angle that the point keeps.
        spread: standard deviation of the logarithm of each point's noise level.
        missing: share of entries in gaps of 3 to 15 frames.

    Example:
        >>> person = Person("run", 0, 30, 20, 2)
        >>> tracks = noisy(film_person(person), person, 20.0, anisotropy=3.0, missing=0.1)
        >>> ratio = torch.linalg.eigvalsh(tracks.covariance[0, 0])
        >>> round(float((ratio[1] / ratio[0]).sqrt()), 6), bool((~tracks.visible).double().mean() >= 0.1)
        (3.0, True)
    """
    g = torch.Generator().manual_seed(_SEED + 500_000 + person.seed)
    xy = scene.truth[..., :2]
    frames, points = xy.shape[:2]
    angle = math.pi * torch.rand(points, generator=g, dtype=xy.dtype)
    level = torch.exp(spread * torch.randn(points, generator=g, dtype=xy.dtype))
    axes = torch.stack([torch.stack([angle.cos(), -angle.sin()], -1), torch.stack([angle.sin(), angle.cos()], -1)], -2)
    root = level[:, None, None] * axes * xy.new_tensor([anisotropy, 1.0])
    power = root.square().sum((-1, -2)).mean() / 2  # mean variance of a coordinate
    root = root * (xy.square().mean() * 10 ** (-snr / 10) / power).sqrt()
    noise = (root @ torch.randn(frames, points, 2, 1, generator=g, dtype=xy.dtype))[..., 0]
    covariance = (root @ root.mT).expand(frames, points, 2, 2)
    return Tracks(xy + noise + _CENTRE, _gaps(frames, points, missing, g), covariance)


def _gaps(frames: int, points: int, missing: float, generator: torch.Generator) -> Bool[Tensor, "frames points"]:
    """Entries that are seen; first and last frame of every point are, so that every gap has two ends."""
    visible = torch.ones(frames, points, dtype=torch.bool)
    while float((~visible).double().mean()) < missing:
        p, length = (
            int(torch.randint(points, (1,), generator=generator)),
            int(torch.randint(3, min(16, frames - 1), (1,), generator=generator)),
        )
        start = int(torch.randint(1, frames - length, (1,), generator=generator))
        visible[start : start + length, p] = False
    return visible
