"""The outline of a silhouette: closed forms, connected components of scipy, and what cannot have an outline."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import ndimage

from torchrecon.contour.outline import align_start, fill_outline, mask_outline, normalise_outline
from torchrecon.errors import ReconError


def _disc(size: int, x: float, y: float, radius: float) -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(float(size)), torch.arange(float(size)), indexing="ij")
    return (u - x) ** 2 + (v - y) ** 2 < radius**2


def _blob(seed: int, size: int = 48) -> torch.Tensor:
    """Ragged parts with holes, some of them touching only at corners and at the image's border."""
    noise = torch.randn(1, 1, size // 4, size // 4, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(noise, size=(size, size), mode="bilinear")[0, 0] > 0.1


def _perimeter(xy: torch.Tensor) -> torch.Tensor:
    return (xy.roll(-1, -2) - xy).norm(dim=-1).sum(-1)


def test_outline_of_a_disc_is_its_circle_to_a_fifth_of_a_pixel():
    centre = torch.tensor([31.3, 29.8])
    xy = mask_outline(_disc(64, *centre.tolist(), 20.0), samples=180)
    radius = (xy - centre).norm(dim=-1)
    # the Gaussian of standard deviation 1 draws it in by 1 / (2 * 20)
    assert float(radius.mean()) == pytest.approx(20.0 - 0.025, abs=0.05)
    # where the circle runs along a row the mask itself is off by up to half a pixel
    assert float((radius - 20.0).abs().max()) < 0.5
    assert float((radius - 20.0).square().mean().sqrt()) < 0.2
    assert float(xy[0, 1]) == pytest.approx(float(xy[:, 1].min()))
    turn = torch.atan2(xy[:, 1] - centre[1], xy[:, 0] - centre[0]).diff().remainder(2 * math.pi)
    assert float(turn.max()) < math.pi / 20  # clockwise on the screen, evenly
    step = (xy.roll(-1, 0) - xy).norm(dim=-1)
    assert float(step.max() / step.min()) < 1.1


@pytest.mark.parametrize("seed", range(6))
def test_unsmoothed_outline_encloses_the_largest_component_with_its_holes_filled(seed):
    mask = _blob(seed)
    labels, count = ndimage.label(mask.numpy())
    filled = [ndimage.binary_fill_holes(labels == index + 1) for index in range(count)]
    largest = max(filled, key=lambda part: part.sum())
    xy = mask_outline(mask, samples=4000, smoothing=0.0)
    assert torch.equal(fill_outline(xy, (48, 48)), torch.from_numpy(largest))


def test_a_batch_is_its_frames_one_by_one_and_shifts_go_through():
    masks = torch.stack([_blob(seed) for seed in range(4)]).reshape(2, 2, 48, 48)
    together = mask_outline(masks, samples=50)
    for i in range(2):
        for j in range(2):
            assert torch.allclose(together[i, j], mask_outline(masks[i, j], samples=50))
    wide = torch.zeros(2, 2, 60, 70, dtype=torch.bool)
    wide[..., 5:53, 9:57] = masks
    assert torch.allclose(mask_outline(wide, samples=50), together + torch.tensor([9.0, 5.0]))


def test_parts_that_touch_at_a_corner_are_joined_only_where_the_smoothed_mask_says_so():
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[2:5, 2:5] = True
    mask[5:9, 5:9] = True
    xy = mask_outline(mask, samples=400, smoothing=0.0)
    assert int(fill_outline(xy, (12, 12)).sum()) == 16


def test_normalised_outline_and_back():
    xy = mask_outline(torch.stack([_blob(seed) for seed in range(3)]), samples=40)
    out = normalise_outline(xy)
    assert torch.allclose(out.restore(), xy)
    assert torch.allclose(out.shape.mean(-2), torch.zeros(3, 2), atol=1e-12)
    moved = normalise_outline(2.5 * xy + torch.tensor([7.0, -3.0]))
    assert torch.allclose(moved.shape, out.shape)
    assert torch.allclose(moved.scale, 2.5 * out.scale)


def test_align_start_finds_the_shift_by_brute_force():
    reference = mask_outline(_blob(1), samples=30)
    xy = reference.roll(11, 0) * 1.3 + 0.1 * torch.randn(30, 2, generator=torch.Generator().manual_seed(0)) + 4.0
    centred, target = (v - v.mean(0) for v in (xy, reference))
    costs = [float((centred.roll(-s, 0) - target).square().sum()) for s in range(30)]
    assert torch.equal(align_start(xy, reference), xy.roll(-min(range(30), key=costs.__getitem__), 0))


def test_what_has_no_outline_is_named():
    masks = torch.zeros(3, 20, 20, dtype=torch.bool)
    masks[:2, 5:15, 5:15] = True
    with pytest.raises(ReconError, match="frame 2 is empty"):
        mask_outline(masks)
    masks[2, 9, 9] = True
    with pytest.raises(ReconError, match="frame 2 is too thin"):
        mask_outline(masks)
    with pytest.raises(ReconError, match="the mask is empty"):
        mask_outline(torch.zeros(20, 20, dtype=torch.bool))
    with pytest.raises(ReconError, match="at least 3"):
        mask_outline(masks, samples=2)
    with pytest.raises(ReconError, match="no size"):
        normalise_outline(torch.zeros(5, 2))
    whole = torch.ones(20, 20, dtype=torch.bool)
    assert float(_perimeter(mask_outline(whole, 400, 0.0))) == pytest.approx(80.0, abs=3.0)


def test_fill_outline_counts_windings_beyond_the_image():
    square = torch.tensor([[-5.0, -5.0], [40.0, -5.0], [40.0, 2.5], [-5.0, 2.5]])
    mask = fill_outline(square, (6, 8))
    assert mask[:3].all()
    assert not mask[3:].any()
