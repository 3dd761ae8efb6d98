"""Finding the mover: a textured disc that drifts over a textured wall, before a still and a drifting camera."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from torchrecon.contour import MoverParams, background_paths, find_mover, own_motion
from torchrecon.errors import ReconError


def _texture(height: int, width: int, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    image = torch.zeros(1, 3, height, width)
    for cells in (6, 14):
        noise = torch.rand(1, 3, height // cells, width // cells, generator=g)
        image += F.interpolate(noise, size=(height, width), mode="bilinear", align_corners=True)
    return (image[0] / image.max()).float()


def _clip(drift: float, frames: int = 24) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """A reddish disc of radius 26 on a bluish wall of 160 x 220; the camera shifts by ``drift`` px a frame."""
    wall = _texture(160, 320, 0) * torch.tensor([0.5, 0.7, 1.0], dtype=torch.float32)[:, None, None]
    skin = _texture(160, 220, 1) * torch.tensor([1.0, 0.55, 0.4], dtype=torch.float32)[:, None, None]
    y, x = torch.meshgrid(torch.arange(160.0), torch.arange(220.0), indexing="ij")
    images, masks = [], []
    for index in range(frames):
        shift = round(drift * index)
        centre = 60.0 + 3.0 * index
        mask = (x - centre) ** 2 + (y - 80.0) ** 2 < 26.0**2
        carried = torch.roll(skin, round(3.0 * index), 2)
        images.append(torch.where(mask, carried, wall[:, :, shift : shift + 220]))
        masks.append(mask)
    return images, masks


@pytest.mark.parametrize("drift", [0.0, 1.0])
def test_mover_is_found_before_a_still_and_a_drifting_camera(drift):
    images, truth = _clip(drift)
    found = list(find_mover(images))
    assert len(found) == len(images)
    overlap = [float((a & b).sum() / (a | b).sum()) for a, b in zip(found[2:-2], truth[2:-2], strict=True)]
    assert min(overlap) > 0.4
    assert sorted(overlap)[len(overlap) // 2] > 0.7


def _small(position: list[float], radius: float, seed: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """A disc at these columns of a picture of 240 x 480, before a still camera."""
    wall = _texture(240, 480, seed) * torch.tensor([0.5, 0.7, 1.0], dtype=torch.float32)[:, None, None]
    skin = _texture(240, 480, 1) * torch.tensor([1.0, 0.55, 0.4], dtype=torch.float32)[:, None, None]
    y, x = torch.meshgrid(torch.arange(240.0), torch.arange(480.0), indexing="ij")
    images, masks = [], []
    for centre in position:
        masks.append((x - centre) ** 2 + (y - 120.0) ** 2 < radius**2)
        images.append(torch.where(masks[-1], torch.roll(skin, round(centre) - 200, 2), wall))
    return images, masks


def _overlap(images: list[torch.Tensor], truth: list[torch.Tensor], params: MoverParams) -> float:
    found = find_mover(images, params)
    return float(torch.stack([(a & b).sum() / (a | b).sum() for a, b in zip(found, truth, strict=True)]).mean())


def test_motion_too_small_for_the_working_image_is_sought_in_a_larger_one():
    sway = [200.0 + 6.0 * math.sin(2 * math.pi * index / 24) for index in range(26)]
    images, truth = _small(sway, 16.0, 5)
    assert _overlap(images, truth, MoverParams(working_size=140)) > 0.8


def test_small_mover_is_looked_at_from_nearer_by():
    images, truth = _small([200.0 + 4.0 * index for index in range(20)], 26.0, 7)
    params = MoverParams(working_size=120)
    assert _overlap(images, truth, params) > 0.8
    assert _overlap(images, truth, replace(params, nearer=math.inf)) < 0.5


def test_background_path_follows_the_camera_not_the_mover():
    images, masks = _clip(1.0)
    paths = background_paths(images, masks)
    assert float((paths[-1, 0, 2] - (len(images) - 1)).abs()) < 0.6
    assert float(paths[-1, 1, 2].abs()) < 0.6
    wall = torch.tensor([[20.0 + 23.0, 20.0]]) - torch.arange(24.0)[:, None, None] * torch.tensor([1.0, 0.0])
    disc = torch.tensor([[60.0, 80.0]]) + torch.arange(24.0)[:, None, None] * torch.tensor([3.0, 0.0])
    xy = torch.cat([wall, disc], 1)
    visible = torch.ones(24, 2, dtype=torch.bool)
    xy[5, 0], visible[5, 0] = torch.nan, False  # an unseen entry must not be read
    motion = own_motion(xy, visible, paths)
    assert float(motion[0]) < 1.0
    assert float(motion[1]) == pytest.approx(23 * 4.0, abs=1.0)


def test_nothing_moves_and_too_few_frames():
    images, _ = _clip(0.0, frames=2)
    assert not any(bool(mask.any()) for mask in find_mover([images[0]] * 10))
    with pytest.raises(ReconError, match="too few"):
        next(find_mover(images))
