"""Rendering of one frame of the synthetic world: body and ball over the hall, and what a sensor makes of it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.data.synthetic.cameras import Camera
from torchrecon.data.synthetic.court import Court
from torchrecon.data.synthetic.textures import SolidTexture, sample_texture
from torchrecon.render.raycast import RoundCones, cast_image, surface_normals

__all__ = ["SensorNoise", "SyntheticFrame", "render_frame", "sense"]

_LIGHT = (0.35, 0.85, 0.40)
"""World direction towards the lamp."""


@dataclass(frozen=True)
class SensorNoise:
    """Camera and depth sensor.

    Attributes:
        image: standard deviation of the colours, in [0, 1].
        depth: standard deviation at 1 m, metres; it grows with the square of the distance (structured light).
        step: depth quantisation at 1 m, metres; grows alike.
        dropout: probability that a depth pixel is lost; at depth edges it is always lost.
        edge: depth jump between neighbours that counts as an edge, metres.
        near, far: working range, metres.
    """

    image: float = 0.008
    depth: float = 0.0008
    step: float = 0.0006
    dropout: float = 0.005
    edge: float = 0.12
    near: float = 0.6
    far: float = 12.0


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One rendered frame.

    Attributes:
        rgb: float32 in [0, 1].
        depth: float32 metres along the optical axis, of body, ball and hall; NaN where the sensor gives none.
        mask: the body (not the ball) is seen at the pixel's centre.
    """

    rgb: Float[Tensor, "3 height width"]
    depth: Float[Tensor, "height width"]
    mask: Bool[Tensor, "height width"]


def render_frame(
    scene: RoundCones, camera: Camera, index: int, textures: list[SolidTexture], court: Court, supersample: int
) -> SyntheticFrame:
    """Clean colours, exact depth and mask of one frame.

    Args:
        scene: parts in camera axes, the ball last.
        camera, index: which view.
        textures: one for each part of the scene.
        court: what lies behind.
        supersample: colour samples per pixel and axis; depth and mask are taken at the pixel's centre.
    """
    boxes = _boxes(scene, camera, index)
    scene = RoundCones(
        scene.rotations.float(), scene.origins.float(), scene.scale.float(), scene.length.float(), scene.radii.float()
    )
    origin_map, direction_map = (m.float() for m in camera.ray_maps(index))
    rotation, translation = camera.rotations[index].float(), camera.translations[index].float()
    depth, part = cast_image(scene, origin_map, direction_map, boxes, camera.size)
    rgb, behind = _background(court, camera.size, origin_map, direction_map, rotation, translation)
    filled = boxes[boxes[:, 2] > boxes[:, 0]]
    if len(filled):
        left, top = filled[:, :2].amin(0).tolist()
        right, bottom = filled[:, 2:].amax(0).tolist()
        n = supersample
        # Pixel (i, j) of the fine grid is the place left + (i - (n - 1) / 2) / n of the image.
        fine = torch.tensor([[1 / n, 0, left - (n - 1) / (2 * n)], [0, 1 / n, top - (n - 1) / (2 * n)], [0, 0, 1]])
        fine = fine.to(origin_map)
        inner = (boxes - torch.tensor([left, top, left, top])) * n
        colour, cover = _colour(
            scene, textures, rotation, origin_map @ fine, direction_map @ fine, inner,
            ((bottom - top) * n, (right - left) * n),
        )  # fmt: skip
        window = rgb[:, top:bottom, left:right]
        window.mul_(1 - F.avg_pool2d(cover, n)[0]).add_(F.avg_pool2d(colour, n)[0])
    mask = (part >= 0) & (part < len(textures) - 1)
    return SyntheticFrame(rgb, torch.where(depth.isfinite(), depth, behind), mask)


def sense(frame: SyntheticFrame, noise: SensorNoise, generator: torch.Generator) -> SyntheticFrame:
    """What a camera with noise and a structured-light depth sensor would deliver of a clean frame."""
    size = frame.depth.shape
    rgb = frame.rgb + noise.image * torch.randn(3, *size, generator=generator, dtype=torch.float32)
    z = frame.depth
    high = F.max_pool2d(z[None, None], 3, 1, 1)[0, 0]
    low = -F.max_pool2d(-z[None, None], 3, 1, 1)[0, 0]
    lost = (high - low > noise.edge) | (z < noise.near) | (z > noise.far)
    lost |= torch.rand(size, generator=generator, dtype=torch.float32) < noise.dropout
    z = z + noise.depth * z * z * torch.randn(size, generator=generator, dtype=torch.float32)
    step = noise.step * z * z
    z = torch.round(z / step) * step
    return SyntheticFrame(rgb.clamp(0, 1), torch.where(lost, torch.nan, z), frame.mask)


def _boxes(scene: RoundCones, camera: Camera, index: int) -> Int[Tensor, "parts 4"]:
    """Pixel box of every part, clipped to the image; empty where the part is behind the camera."""
    corners = scene.corners()
    pinhole = camera.projection == "pinhole"
    depth = corners[..., 2:] if pinhole else camera.reference_depth[index].double()
    k = camera.intrinsics.double()
    xy = corners[..., :2] / depth @ k[:2, :2].T + k[:2, 2]
    height, width = camera.size
    limit = torch.tensor([width, height])
    low = xy.amin(1).floor().long().clamp_min(0).minimum(limit)
    high = (xy.amax(1).ceil().long() + 1).clamp_min(0).minimum(limit)
    behind = (corners[..., 2] <= 0.05).any(1)
    empty = behind | (high <= low).any(1)
    return torch.where(empty[:, None], 0, torch.cat([low, high], -1))


def _background(
    court: Court,
    size: tuple[int, int],
    origin_map: Tensor,
    direction_map: Tensor,
    rotation: Tensor,
    translation: Tensor,
) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"]]:
    """Colour of the hall, cast at every other pixel (a background slightly out of focus), and its depth."""
    height, width = size
    v, u = torch.meshgrid(
        torch.arange(0, height + 1, 2).to(origin_map), torch.arange(0, width + 1, 2).to(origin_map), indexing="ij"
    )
    pixel = torch.stack([u, v, torch.ones_like(u)], -1)
    directions = pixel @ (rotation.T @ direction_map).T
    origins = pixel @ (rotation.T @ origin_map).T - translation @ rotation
    rgb, depth = court.view(origins, directions)
    both = torch.cat([rgb, depth[None]])[None]
    # Odd rows and columns lie half-way between their neighbours.
    fine = F.interpolate(both, size=(2 * v.shape[0] - 1, 2 * v.shape[1] - 1), mode="bilinear", align_corners=True)
    fine = fine[0, :, :height, :width]
    return fine[:3].contiguous(), fine[3]


def _colour(
    scene: RoundCones, textures: list[SolidTexture], rotation: Tensor, origin_map: Tensor, direction_map: Tensor,
    boxes: Tensor, size: tuple[int, int],
) -> tuple[Float[Tensor, "1 3 h w"], Float[Tensor, "1 1 h w"]]:  # fmt: skip
    """Shaded colour (black where nothing is hit) and coverage of body and ball."""
    depth, part = cast_image(scene, origin_map, direction_map, boxes, size)
    light = F.normalize(rotation @ torch.tensor(_LIGHT).to(rotation), dim=0)
    up = rotation[:, 1]
    where = (part.flatten() >= 0).nonzero()[:, 0]
    owner = part.flatten()[where]
    # One sort brings each part's pixels together.
    owner, order = owner.sort(stable=True)
    where = where[order]
    pixel = torch.stack([where % size[1], where // size[1], torch.ones_like(where)], -1).to(origin_map)
    points = pixel @ origin_map.T + depth.flatten()[where][:, None] * (pixel @ direction_map.T)
    shaded = torch.empty_like(points)
    counts = torch.bincount(owner, minlength=len(textures)).tolist()
    begin = 0
    for index, count in enumerate(counts):
        if not count:
            continue
        block = slice(begin, begin + count)
        begin += count
        local = (points[block] - scene.origins[index]) @ scene.rotations[index]
        normal = surface_normals(scene, owner[block], local) @ scene.rotations[index].T
        lamp, sky = (normal @ light).clamp_min(0), 0.5 + 0.5 * (normal @ up)
        shaded[block] = sample_texture(textures[index], local) * (0.40 + 0.50 * lamp + 0.15 * sky)[:, None]
    colour = torch.zeros(3, size[0] * size[1], dtype=points.dtype, device=points.device)
    colour[:, where] = shaded.clamp(0, 1).T
    return colour.view(1, 3, *size), (part >= 0).to(points.dtype)[None, None]
