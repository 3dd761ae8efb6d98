"""Silhouettes from a prompt: a textured disc over a textured wall, before a still and a moving camera; Fig. 3."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from torchrecon.contour import follow_silhouette, silhouette_from_box
from torchrecon.errors import ReconError
from torchrecon.viz.depth import draw_depth


def _texture(height: int, width: int, seed: int) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    image = torch.zeros(1, 3, height, width)
    for cells in (5, 11):
        noise = torch.rand(1, 3, height // cells, width // cells, generator=g)
        image += F.interpolate(noise, size=(height, width), mode="bilinear", align_corners=True)
    return (image[0] / image.max()).float()


def _clip(drift: float, frames: int = 16, tint: float = 0.55) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """A disc of radius 22 that crosses a wall of 110 x 160; the camera shifts by ``drift`` px a frame."""
    wall = _texture(110, 260, 0) * torch.tensor([tint, 0.7, 1.0], dtype=torch.float32)[:, None, None]
    skin = _texture(110, 160, 1) * torch.tensor([1.0, 0.6, tint], dtype=torch.float32)[:, None, None]
    g = torch.Generator().manual_seed(2)
    y, x = torch.meshgrid(torch.arange(110.0), torch.arange(160.0), indexing="ij")
    images, masks = [], []
    for index in range(frames):
        shift = round(drift * index)
        mask = (x - 35.0 - 5.0 * index) ** 2 + (y - 55.0) ** 2 < 22.0**2
        image = torch.where(mask, torch.roll(skin, 5 * index, 2), wall[:, :, shift : shift + 160])
        images.append((image + 0.008 * torch.randn(image.shape, generator=g)).clamp(0, 1).float())
        masks.append(mask)
    return images, masks


def _overlap(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize(("drift", "least"), [(0.0, 0.99), (2.0, 0.9)])
def test_silhouette_is_followed_before_a_still_and_a_moving_camera(drift, least):
    images, truth = _clip(drift)
    found = list(follow_silhouette(images, truth[0]))
    assert torch.equal(found[0], truth[0])
    assert min(_overlap(a, b) for a, b in zip(found, truth, strict=True)) > least


def test_known_background_is_used_where_colours_do_not_tell():
    """Body and wall of one palette: only the background model knows which pixel is which."""
    images, truth = _clip(0.0, tint=1.0)
    found = list(follow_silhouette(images, truth[0]))
    assert sum(_overlap(a, b) for a, b in zip(found, truth, strict=True)) / len(found) > 0.98


def test_box_prompt_finds_the_disc_in_it():
    images, truth = _clip(0.0, frames=1)
    assert _overlap(silhouette_from_box(images[0], (8, 28, 62, 82)), truth[0]) > 0.9


def test_a_body_that_leaves_gives_empty_masks_and_bad_prompts_are_named():
    images, truth = _clip(0.0, frames=3)
    wall = [images[0].flip(2)] * 2
    gone = list(follow_silhouette([*images, *wall], truth[0]))
    assert len(gone) == 5
    with pytest.raises(ReconError, match="empty"):
        next(follow_silhouette(images, torch.zeros(110, 160, dtype=torch.bool)))
    with pytest.raises(ReconError, match="one pixel for each"):
        next(follow_silhouette(images, torch.ones(10, 10, dtype=torch.bool)))
    for box in ((-1, 0, 20, 20), (5, 5, 9, 40), (60, 10, 20, 50)):
        with pytest.raises(ReconError, match="left, top, right, bottom"):
            silhouette_from_box(images[0], box)


def test_depth_panels_are_drawn_and_a_body_without_depth_is_refused(tmp_path):
    pytest.importorskip("matplotlib")
    depth = torch.full((20, 30), 2.0)
    depth[3, 4] = torch.nan
    body = torch.zeros(20, 30, dtype=torch.bool)
    with pytest.raises(ReconError, match="no pixel"):
        draw_depth(depth, depth, body, tmp_path / "none.png")
    body[5:10, 5:10] = True
    assert draw_depth(depth, depth, body, tmp_path / "panels.png").stat().st_size > 1000
