"""Cameras of the synthetic world: static, turning, panning, hand-held; three projections.

A camera holds one pose per frame: X_camera = R X_world + t, camera axes x right, y down, z forward. The parallel
projections divide by a reference depth instead of each point's own: the clip's mean depth of the player (orthographic)
or that of the frame (weak perspective), so all three give images of the same size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.curves import smooth_noise, smoothstep
from torchrecon.data.synthetic.motion import Motion
from torchrecon.data.synthetic.random import chance, uniform
from torchrecon.errors import ReconError

__all__ = ["Camera", "handheld_camera", "panning_camera", "static_camera", "turning_camera"]

_PROJECTIONS = ("pinhole", "weak_perspective", "orthographic")
_FOCAL_PER_HEIGHT = 2.3
"""Default focal length over image height: 1.8 m at 7 m is about 340 of 576 pixels."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Poses and projection of a moving camera.

    Attributes:
        rotations: world -> camera.
        translations: metres; X_camera = R X_world + t.
        intrinsics: pixels; for the parallel projections the focal length acts at ``reference_depth``.
        size: (height, width) in pixels.
        projection: ``pinhole``, ``weak_perspective`` or ``orthographic``.
        reference_depth: metres; the depth by which parallel projections divide.
    """

    rotations: Float[Tensor, "frames 3 3"]
    translations: Float[Tensor, "frames 3"]
    intrinsics: Float[Tensor, "3 3"]
    size: tuple[int, int]
    projection: str
    reference_depth: Float[Tensor, " frames"]

    def to_camera(self, world: Float[Tensor, "frames points 3"]) -> Float[Tensor, "frames points 3"]:
        """World metres to camera axes, each frame by its own pose."""
        return world @ self.rotations.transpose(-1, -2) + self.translations[:, None]

    def project(self, points: Float[Tensor, "frames points 3"]) -> Float[Tensor, "frames points 2"]:
        """Camera axes (metres) to pixels."""
        depth = points[..., 2:] if self.projection == "pinhole" else self.reference_depth[:, None, None]
        return points[..., :2] / depth @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2]

    def ray_maps(self, frame: int) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 3"]]:
        """Matrices O, D such that pixel (u, v) sees ``O [u, v, 1] + z D [u, v, 1]``, z being the depth in metres."""
        inverse = torch.linalg.inv(self.intrinsics)
        if self.projection == "pinhole":
            return torch.zeros_like(inverse), inverse
        origin = inverse * self.reference_depth[frame]
        origin[2] = 0
        direction = torch.zeros_like(inverse)
        direction[2, 2] = 1
        return origin, direction


def _look_at(position: Tensor, target: Tensor) -> Tensor:
    """World -> camera rotations of level cameras."""
    forward = F.normalize(target - position, dim=-1)
    up = torch.tensor([0.0, 1.0, 0.0], dtype=position.dtype).expand_as(forward)
    right = F.normalize(torch.linalg.cross(forward, up), dim=-1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], -2)


def _camera(
    motion: Motion, position: Tensor, rotation: Tensor, size: tuple[int, int], focal: float | None,
    projection: str,
) -> Camera:  # fmt: skip
    if projection not in _PROJECTIONS:
        raise ReconError(f"projection: {projection!r} is not known; use one of {', '.join(_PROJECTIONS)}")
    height, width = size
    f = _zoom(motion, position, rotation, size) if focal is None else focal
    k = torch.tensor([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]], dtype=torch.float64)
    translation = -torch.einsum("fij,fj->fi", rotation, position)
    root = motion.joints[:, 0].double()
    depth = (rotation[:, 2] * root).sum(-1) + translation[:, 2]
    if projection == "orthographic":
        depth = depth.mean().expand_as(depth).clone()
    dtype = motion.joints.dtype
    return Camera(rotation.to(dtype), translation.to(dtype), k.to(dtype), (height, width), projection, depth.to(dtype))


def _zoom(motion: Motion, position: Tensor, rotation: Tensor, size: tuple[int, int]) -> float:
    """The default focal length, or the shorter one that keeps every joint within 96 % of the image."""
    height, width = size
    points = (motion.joints.double() - position[:, None]) @ rotation.transpose(-1, -2)
    half = torch.tensor([0.48 * width, 0.48 * height], dtype=torch.float64)
    fits = half * points[..., 2:] / points[..., :2].abs().clamp_min(1e-6)
    return min(_FOCAL_PER_HEIGHT * height, float(fits.amin()))


def _smooth_root(motion: Motion, seconds: float = 0.25) -> Tensor:
    """The pelvis path as a cameraman would follow it."""
    root = motion.joints[:, 0].double()
    radius = max(1, round(2 * seconds * motion.fps))
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=torch.float64) / (seconds * motion.fps)) ** 2)
    # Continued in a straight line at both ends, so that the camera does not lag there.
    steps = torch.arange(1, radius + 1, dtype=torch.float64)[:, None]
    lead = min(5, len(root) - 1)
    before = root[0] - steps.flip(0) * (root[lead] - root[0]) / lead
    after = root[-1] + steps * (root[-1] - root[-1 - lead]) / lead
    padded = torch.cat([before, root, after]).T[:, None]
    return torch.nn.functional.conv1d(padded, (taps / taps.sum())[None, None])[:, 0].T


def _aim(motion: Motion, follow: bool) -> Tensor:
    """The point that the camera looks at: over the pelvis, half-way up to the highest point that the clip reaches."""
    root = _smooth_root(motion)
    if not follow:
        root = 0.5 * (root.amin(0) + root.amax(0)).expand_as(root).clone()
    root[:, 1] = 0.5 * float(motion.joints[..., 1].max())
    return root


def turning_camera(
    motion: Motion,
    total_turn_deg: float = 300.0,
    distance: float = 7.0,
    size: tuple[int, int] = (576, 768),
    focal: float | None = None,
    generator: torch.Generator | None = None,
    projection: str = "pinhole",
) -> Camera:
    """A camera that orbits the player and follows him.

    Args:
        motion: whose pelvis is followed.
        total_turn_deg: angle of the orbit over the whole clip, degrees; the direction is drawn.
        distance: metres from the player.
        size: (height, width) pixels.
        focal: pixels; default 2.3 image heights (1.8 m at 7 m: about 340 of 576 pixels), or less where the
            player would leave the image.
        projection: ``pinhole``, ``weak_perspective`` or ``orthographic``.

    Example:
        >>> import torch
        >>> from torchrecon.data.synthetic import sample_body, sample_motion
        >>> g = torch.Generator().manual_seed(0)
        >>> motion = sample_motion("jump", sample_body(g), frames=10, generator=g)
        >>> camera = turning_camera(motion, total_turn_deg=90.0, distance=6.0, generator=g)
        >>> round(float(camera.to_camera(motion.joints)[:, 0, 2].mean()))
        6
    """
    g = generator
    aim = _aim(motion, follow=True)
    progress = torch.linspace(0, 1, len(motion), dtype=torch.float64)
    sign = 1.0 if chance(g, 0.5) else -1.0
    uneven = uniform(g, -0.15, 0.15) / (2 * torch.pi)
    progress = progress + uneven * torch.sin(2 * torch.pi * progress)
    angle = (
        uniform(g, 0.0, 2 * torch.pi) + sign * torch.deg2rad(torch.tensor(float(total_turn_deg)).double()) * progress
    )
    height = uniform(g, 0.9, 2.2)
    position = aim + distance * torch.stack([angle.sin(), 0 * angle, angle.cos()], -1)
    position[:, 1] = height
    return _camera(motion, position, _look_at(position, aim), size, focal, projection)


def _around(angle: float) -> Tensor:
    """Unit vector on the floor; 0 is world z."""
    return torch.tensor([math.sin(angle), 0.0, math.cos(angle)], dtype=torch.float64)


def _fixed_position(motion: Motion, distance: float, generator: torch.Generator | None) -> Tensor:
    """A place for a tripod: anywhere around a player who stays, nearly ahead of or behind one who travels."""
    root = motion.joints[:, 0].double()
    centre = 0.5 * (root.amin(0) + root.amax(0))
    travel = root[-1] - root[0]
    angle = uniform(generator, 0.0, 2 * torch.pi)
    if float(travel[[0, 2]].norm()) > 2.0:
        angle = float(torch.atan2(travel[0], travel[2])) + uniform(generator, -0.2, 0.2)
    position = centre + distance * _around(angle)
    position[1] = uniform(generator, 1.0, 2.2)
    return position


def static_camera(
    motion: Motion,
    distance: float = 7.0,
    size: tuple[int, int] = (576, 768),
    focal: float | None = None,
    generator: torch.Generator | None = None,
    projection: str = "pinhole",
) -> Camera:
    """A camera on a tripod.

    ``distance`` (metres, to the middle of the path) grows in steps of 5 % until every joint stays in the image, so a
    runner is seen from farther away than a shooter. Travelling players are filmed from nearly ahead.
    """
    at = _fixed_position(motion, distance, generator)
    focal = _FOCAL_PER_HEIGHT * size[0] if focal is None else focal
    aim = _aim(motion, follow=False)
    for _ in range(60):
        position = at.expand_as(aim)
        camera = _camera(motion, position, _look_at(position, aim), size, focal, projection)
        if _keeps_in_view(camera, motion):
            return camera
        level = aim[0] * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)
        at = level + (at - level) * torch.tensor([1.05, 1.0, 1.05], dtype=torch.float64)
    raise ReconError("static_camera: the player leaves the image at any distance; lower focal or use panning_camera")


def _keeps_in_view(camera: Camera, motion: Motion) -> bool:
    points = camera.to_camera(motion.joints)
    xy = camera.project(points)
    height, width = camera.size
    margin = 0.02 * height
    inside = (
        (xy[..., 0] > margin) & (xy[..., 0] < width - margin) & (xy[..., 1] > margin) & (xy[..., 1] < height - margin)
    )
    return bool((inside & (points[..., 2] > 1.0)).all())


def panning_camera(
    motion: Motion,
    distance: float = 7.0,
    size: tuple[int, int] = (576, 768),
    focal: float | None = None,
    generator: torch.Generator | None = None,
    projection: str = "pinhole",
) -> Camera:
    """A tripod whose head follows the player; ``distance`` is to the middle of his path, from the side if he runs."""
    root = motion.joints[:, 0].double()
    travel = root[-1] - root[0]
    angle = uniform(generator, 0.0, 2 * torch.pi)
    if float(travel[[0, 2]].norm()) > 2.0:
        side = torch.pi / 2 if chance(generator, 0.5) else -torch.pi / 2
        angle = float(torch.atan2(travel[0], travel[2])) + side + uniform(generator, -0.4, 0.4)
    aim = _aim(motion, follow=True)
    centre = 0.5 * (aim.amin(0) + aim.amax(0))
    position = centre + distance * _around(angle)
    position[1] = uniform(generator, 1.0, 2.2)
    position = position.expand_as(aim)
    return _camera(motion, position, _look_at(position, aim), size, focal, projection)


def handheld_camera(
    motion: Motion,
    distance: float = 7.0,
    size: tuple[int, int] = (576, 768),
    focal: float | None = None,
    generator: torch.Generator | None = None,
    projection: str = "pinhole",
    shake: float = 1.0,
) -> Camera:
    """A person who films while keeping the distance: slow drift, sway of some centimetres, aim off by some degrees.

    Args:
        shake: factor on the sway; 1 = 4 cm and 0.7 degrees.
    """
    g = generator
    aim = _aim(motion, follow=True)
    t = torch.arange(len(motion), dtype=torch.float64) / motion.fps
    drift = uniform(g, -0.35, 0.35) * smoothstep(t / max(float(t[-1]), 1e-6))
    angle = uniform(g, 0.0, 2 * torch.pi) + drift
    position = aim + distance * torch.stack([angle.sin(), 0 * angle, angle.cos()], -1)
    position[:, 1] = uniform(g, 1.4, 1.75)
    position = position + 0.04 * shake * smooth_noise(t, g, 1.5, 3)
    aim = aim + distance * 0.012 * shake * smooth_noise(t, g, 2.5, 3)
    return _camera(motion, position, _look_at(position, aim), size, focal, projection)
