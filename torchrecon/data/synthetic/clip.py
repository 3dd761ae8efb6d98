"""A clip of the synthetic world: rendered frame by frame, with the true 3D path of every body point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.data.synthetic.body import BALL_RADIUS, Body
from torchrecon.data.synthetic.cameras import Camera
from torchrecon.data.synthetic.court import Court, sample_court
from torchrecon.data.synthetic.motion import Motion
from torchrecon.data.synthetic.renderer import SensorNoise, SyntheticFrame, render_frame, sense
from torchrecon.data.synthetic.skeleton import rotation_x
from torchrecon.data.synthetic.textures import SolidTexture, ball_texture, body_textures
from torchrecon.errors import ReconError
from torchrecon.render.raycast import RoundCones, cast_rays, local_to_outer

__all__ = ["SurfacePoints", "SyntheticClip"]

_TOLERANCE = 2e-3
"""Metres by which a surface point may lie behind the first hit of its own pixel's ray and still count as seen."""
_CHUNK = 2_000_000
"""Rays cast at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points fixed to the body: part index (-1: not on the body) and part coordinates in metres (NaN there)."""

    part: Int[Tensor, " points"]
    local: Float[Tensor, "points 3"]

    def __len__(self) -> int:
        return self.part.shape[0]

    def __getitem__(self, index: Tensor | slice) -> SurfacePoints:
        return SurfacePoints(self.part[index], self.local[index])


class SyntheticClip:
    """A body in motion before a camera. Nothing is stored but geometry and textures; the same arguments give the same
    bits, in any order of calls.

    Args:
        body, motion, camera: see ``sample_body``, ``sample_motion``, ``turning_camera``.
        seed: of hall and sensor noise.
        sensor_noise: None renders clean colours and exact depth.

    Example:
        >>> import torch
        >>> from torchrecon.data.synthetic import sample_body, sample_motion, static_camera
        >>> g = torch.Generator().manual_seed(0)
        >>> body = sample_body(g)
        >>> motion = sample_motion("idle", body, frames=2, generator=g)
        >>> clip = SyntheticClip(body, motion, static_camera(motion, size=(96, 128), generator=g))
        >>> frame = clip.render(0)
        >>> frame.rgb.shape, bool(frame.mask.any())
        (torch.Size([3, 96, 128]), True)
    """

    def __init__(
        self,
        body: Body,
        motion: Motion,
        camera: Camera,
        seed: int = 0,
        sensor_noise: SensorNoise | None = None,
    ) -> None:
        if len(motion) != camera.rotations.shape[0]:
            raise ReconError(
                f"motion has {len(motion)} frames, camera {camera.rotations.shape[0]}; make the camera from this motion"
            )
        self.body, self.motion, self.camera = body, motion, camera
        self.seed, self.sensor_noise = seed, sensor_noise

    def __len__(self) -> int:
        return len(self.motion)

    @property
    def fps(self) -> float:
        return self.motion.fps

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.size

    @cached_property
    def joints3d(self) -> Float[Tensor, "frames joints 3"]:
        """Joints in camera axes, metres."""
        return self.camera.to_camera(self.motion.joints)

    @cached_property
    def joints2d(self) -> Float[Tensor, "frames joints 2"]:
        """Joints in pixels."""
        return self.camera.project(self.joints3d)

    @cached_property
    def _scene(self) -> RoundCones:
        """Body parts and, as the last one, the ball, in camera axes; float64. A missing ball is behind the camera."""
        rotation = self.camera.rotations.double()
        joints = self.camera.to_camera(self.motion.joints).double()
        parts = self.body.place(joints, rotation[:, None] @ self.motion.bones.double())
        ball = self.camera.to_camera(self.motion.ball[:, None]).double()
        away = torch.tensor([0.0, 0.0, -1e3], dtype=torch.float64)
        ball = torch.where(ball.isfinite().all(-1, keepdim=True), ball, away)
        t = torch.arange(len(self), dtype=torch.float64) / self.fps
        spin = (rotation @ rotation_x(-6.0 * t))[:, None]
        size = torch.full((1, 3), BALL_RADIUS, dtype=torch.float64)
        return RoundCones(
            torch.cat([parts.rotations, spin], 1),
            torch.cat([parts.origins, ball], 1),
            torch.cat([parts.scale, size]),
            torch.cat([parts.length, torch.zeros(1, dtype=torch.float64)]),
            torch.cat([parts.radii, torch.ones(1, 2, dtype=torch.float64)]),
        )

    @cached_property
    def _textures(self) -> list[SolidTexture]:
        return [*body_textures(self.body), ball_texture()]

    @property
    def _court(self) -> Court:
        return sample_court(self.seed % 1000)

    def _scene_at(self, index: int) -> RoundCones:
        if not 0 <= index < len(self):
            raise ReconError(f"frame {index} does not exist; the clip has {len(self)} (the first is 0)")
        s = self._scene
        return RoundCones(s.rotations[index], s.origins[index], s.scale, s.length, s.radii)

    def render(self, index: int) -> SyntheticFrame:
        """Render one frame (0-based); about 0.1 s of CPU at 768 x 576."""
        frame = render_frame(self._scene_at(index), self.camera, index, self._textures, self._court)
        if self.sensor_noise is None:
            return frame
        generator = torch.Generator().manual_seed(1_000_003 * (self.seed + 1) + index)
        return sense(frame, self.sensor_noise, generator)

    def surface_at(self, index: int, xy: Float[Tensor, "points 2"]) -> SurfacePoints:
        """The body point under each pixel of a frame; ``part`` is -1 where the pixel shows ball or hall."""
        scene = self._scene_at(index)
        origins, directions = self._rays(index, xy.double())
        t, part = cast_rays(scene, origins, directions)
        part = torch.where(part == len(scene.length) - 1, -1, part)
        points = origins + t[:, None] * directions
        known = part.clamp_min(0)
        local = torch.einsum("nji,nj->ni", scene.rotations[known], points - scene.origins[known])
        local = torch.where((part >= 0)[:, None], local, torch.nan)
        return SurfacePoints(part, local.to(self.motion.joints.dtype))

    def trajectory(
        self, points: SurfacePoints
    ) -> tuple[Float[Tensor, "frames points 3"], Bool[Tensor, "frames points"]]:
        """Where body points are, and where they can be seen.

        Returns:
            xyz: camera axes, metres; NaN for points with part -1.
            seen: inside the image and hidden neither by the body itself nor by the ball.
        """
        scene = self._scene
        known = points.part >= 0
        part, local = points.part.clamp_min(0), torch.nan_to_num(points.local.double())
        xyz = local_to_outer(scene, part, local)
        pixel = self.camera.project(xyz.to(self.motion.joints.dtype)).double()
        height, width = self.size
        seen = known & (xyz[..., 2] > 0)
        seen &= (pixel >= -0.5).all(-1) & (pixel[..., 0] < width - 0.5) & (pixel[..., 1] < height - 0.5)
        step = max(1, _CHUNK // max(1, len(points)))
        for begin in range(0, len(self), step):
            block = slice(begin, begin + step)
            cones = RoundCones(scene.rotations[block], scene.origins[block], scene.scale, scene.length, scene.radii)
            origins, directions = self._sight(xyz[block])
            first, _ = cast_rays(cones, origins, directions)
            seen[block] &= xyz[block][..., 2] <= first + _TOLERANCE
        xyz = torch.where(known[:, None], xyz, torch.nan)
        return xyz.to(self.motion.joints.dtype), seen

    def sample_surface(self, count: int, generator: torch.Generator | None = None) -> SurfacePoints:
        """Points spread evenly over the skin of the parts (also where parts overlap and nothing can ever be seen)."""
        scene = self._scene_at(0)
        parts = len(scene.length) - 1
        chosen, places = [], []
        # Candidates by generating curve, drawn again by the area that each stands for.
        per = 40 * count // parts + 64
        for part in range(parts):
            local, weight = _skin(scene, part, per, generator)
            chosen.append(weight)
            places.append(local)
        weights = torch.stack(chosen)
        pick = torch.multinomial(weights.flatten(), count, replacement=True, generator=generator)
        local = torch.stack(places).flatten(0, 1)[pick]
        return SurfacePoints(pick // per, local.to(self.motion.joints.dtype))

    def _rays(self, index: int, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit-z directions of the rays through pixels of one frame."""
        pixel = torch.cat([xy, torch.ones_like(xy[:, :1])], -1)
        origin_map, direction_map = (m.double() for m in self.camera.ray_maps(index))
        return pixel @ origin_map.T, pixel @ direction_map.T

    def _sight(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """The rays on which the camera sees given points."""
        if self.camera.projection == "pinhole":
            return torch.zeros_like(xyz), xyz / xyz[..., 2:]
        origins = xyz.clone()
        origins[..., 2] = 0
        return origins, torch.tensor([0.0, 0.0, 1.0], dtype=xyz.dtype).expand_as(xyz)


def _skin(scene: RoundCones, part: int, count: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Random points of one part's surface and the area that each stands for."""
    length, (r0, r1) = float(scene.length[part]), scene.radii[part].tolist()
    azimuth = 2 * torch.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    height = torch.rand(count, generator=generator, dtype=torch.float64)
    # The generating curve of the hull, by arc length: cap, straight side, cap.
    slope = torch.asin(torch.tensor((r0 - r1) / length if length > 0 else 0.0, dtype=torch.float64))
    low, side, high = r0 * (torch.pi / 2 + slope), length * slope.cos(), r1 * (torch.pi / 2 - slope)
    s = height * (low + side + high)
    angle = torch.where(s < low, -torch.pi / 2 + s / r0, slope + (s - low - side) / r1)
    along = ((s - low) / side).clamp(0, 1) if length > 0 else torch.zeros_like(s)
    on_side = (s >= low) & (s <= low + side)
    angle = torch.where(on_side, slope, angle)
    radius = torch.where(on_side, r0 + along * (r1 - r0), torch.where(s < low, r0, r1))
    centre = torch.where(on_side, along * length, torch.where(s < low, 0.0, length))
    ring = radius * angle.cos()
    q = torch.stack([ring * azimuth.cos(), centre + radius * angle.sin(), ring * azimuth.sin()], -1)
    # Area element of the scaled surface: det(S) |S^-1 n| times that of the unscaled one (ring * ds * d azimuth).
    normal = torch.stack([angle.cos() * azimuth.cos(), angle.sin(), angle.cos() * azimuth.sin()], -1)
    scale = scene.scale[part]
    stretch = scale.prod() * (normal / scale).norm(dim=-1)
    return q * scale, ring.clamp_min(0) * (low + side + high) * stretch
