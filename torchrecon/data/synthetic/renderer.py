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
    scene: RoundCones, camera: Camera, index: int, textures: list[SolidTexture], court: Court
) -> SyntheticFrame:
    """Clean colours, exact depth and mask of one frame.

    The body is cast on a grid of half-pixel steps. Colours are weighted 1-2-1 across it in both directions, which
    suppresses what a pixel cannot resolve; depth and mask are those of the pixel's centre.

    Args:
        scene: parts in camera axes, the ball last.
        camera, index: which view.
        textures: one for each part of the scene.
        court: what lies behind.
    """
    boxes = _boxes(scene, camera, index)
    scene = RoundCones(
        scene.rotations.float(), scene.origins.float(), scene.scale.float(), scene.length.float(), scene.radii.float()
    )
    origin_map, direction_map = (m.float() for m in camera.ray_maps(index))
    rotation, translation = camera.rotations[index].float(), camera.translations[index].float()
    rgb, depth = _background(court, camera.size, origin_map, direction_map, rotation, translation)
    mask = torch.zeros(camera.size, dtype=torch.bool)
    filled = boxes[boxes[:, 2] > boxes[:, 0]]
    if not len(filled):
        return SyntheticFrame(rgb, depth, mask)
    left, top = filled[:, :2].amin(0).tolist()
    right, bottom = filled[:, 2:].amax(0).tolist()
    # Place (i, j) of the fine grid is the pixel (left + (i - 1) / 2, top + (j - 1) / 2) of the image.
    fine = torch.tensor([[0.5, 0.0, left - 0.5], [0.0, 0.5, top - 0.5], [0.0, 0.0, 1.0]]).to(origin_map)
    inner = (boxes - torch.tensor([left, top, left, top])) * 2
    inner[:, 2:] += (inner[:, 2:] > inner[:, :2]).long()
    size = (2 * (bottom - top) + 1, 2 * (right - left) + 1)
    maps = (origin_map @ fine, direction_map @ fine)
    z, part = cast_image(scene, *maps, inner, size)
    shaded = _shade(scene, textures, rotation, maps, z, part)
    blended = 0.25 * (shaded[:, :-1:2] + 2 * shaded[:, 1::2] + shaded[:, 2::2])
    blended = 0.25 * (blended[:, :, :-1:2] + 2 * blended[:, :, 1::2] + blended[:, :, 2::2])
    window = rgb[:, top:bottom, left:right]
    window.mul_(1 - blended[3]).add_(blended[:3])
    z, part = z[1::2, 1::2], part[1::2, 1::2]
    space = depth[top:bottom, left:right]
    space.copy_(torch.where(part >= 0, z, space))
    mask[top:bottom, left:right] = (part >= 0) & (part < len(textures) - 1)
    return SyntheticFrame(rgb, depth, mask)


def sense(frame: SyntheticFrame, noise: SensorNoise, generator: torch.Generator) -> SyntheticFrame:
    """What a camera with noise and a structured-light depth sensor would deliver of a clean frame."""
    size = frame.depth.shape
    rgb = frame.rgb + noise.image * torch.randn(3, *size, generator=generator, dtype=torch.float32)
    z = frame.depth
    lost = (z < noise.near) | (z > noise.far)
    down, right = (z[1:] - z[:-1]).abs() > noise.edge, (z[:, 1:] - z[:, :-1]).abs() > noise.edge
    lost[1:] |= down
    lost[:-1] |= down
    lost[:, 1:] |= right
    lost[:, :-1] |= right
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


def _shade(
    scene: RoundCones,
    textures: list[SolidTexture],
    rotation: Tensor,
    maps: tuple[Tensor, Tensor],
    depth: Tensor,
    part: Tensor,
) -> Float[Tensor, "4 height width"]:
    """Shaded colour and coverage of body and ball; all zero where nothing is hit."""
    light = F.normalize(rotation @ torch.tensor(_LIGHT).to(rotation), dim=0)
    up = rotation[:, 1]
    owner = part.flatten()
    canvas = torch.zeros(owner.shape[0], 4, dtype=depth.dtype, device=depth.device)
    where = (owner >= 0).nonzero()[:, 0]
    # One sort brings each part's pixels together.
    owner, order = owner[where].sort()
    where = where[order]
    width = depth.shape[1]
    pixel = torch.stack([where % width, where // width, torch.ones_like(where)], -1).to(depth)
    points = pixel @ maps[0].T + depth.flatten()[where][:, None] * (pixel @ maps[1].T)
    shaded = []
    begin = 0
    for index, count in enumerate(torch.bincount(owner, minlength=len(textures)).tolist()):
        if not count:
            continue
        block = slice(begin, begin + count)
        begin += count
        local = (points[block] - scene.origins[index]) @ scene.rotations[index]
        normal = surface_normals(scene, index, local) @ scene.rotations[index].T
        lamp, sky = (normal @ light).clamp_min(0), 0.5 + 0.5 * (normal @ up)
        shaded.append(sample_texture(textures[index], local) * (0.47 + 0.48 * lamp + 0.15 * sky)[:, None])
    if shaded:
        canvas[where] = F.pad(torch.cat(shaded).clamp(0, 1), (0, 1), value=1.0)
    return canvas.T.reshape(4, *depth.shape)
