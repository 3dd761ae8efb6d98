"""Tracks of a known warp: accuracy, covariance, births and deaths, and what the caller is told when nothing works."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from torchrecon.errors import ReconError
from torchrecon.features import TrackerParams, track_points
from torchrecon.features.align import align_window, identity_warp, make_templates, search_translation
from torchrecon.features.following import match_covariance
from torchrecon.features.patches import image_pyramid
from torchrecon.features.region import cut_region


def _texture(height: int, width: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    image = torch.zeros(1, 1, height, width)
    for cells in (5, 9, 17):
        noise = torch.rand(1, 1, height // cells, width // cells, generator=g)
        image += F.interpolate(noise, size=(height, width), mode="bicubic", align_corners=True)
    return (0.1 + 0.8 * (image - image.min()) / (image.max() - image.min()))[0, 0]


def _sample(image: torch.Tensor, inverse: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Image seen through x -> A x + t: every output pixel looks up the input at ``inverse`` (2, 3)."""
    y, x = torch.meshgrid(torch.arange(float(size[0])), torch.arange(float(size[1])), indexing="ij")
    points = torch.stack([x, y, torch.ones_like(x)], -1) @ inverse.T
    limit = torch.tensor([image.shape[1] - 1.0, image.shape[0] - 1.0])
    return F.grid_sample(image[None, None], (2 * points / limit - 1)[None], mode="bicubic", align_corners=True)[0, 0]


def _turning(frames: int, seed: int = 0, noise: float = 0.004) -> tuple[list[torch.Tensor], torch.Tensor]:
    """A textured plane that shifts, turns and grows; frames and, per frame, the map from the first (2, 3)."""
    image = _texture(220, 260, seed)
    g = torch.Generator().manual_seed(seed + 1)
    centre = torch.tensor([130.0, 110.0])
    shown, maps = [], []
    for index in range(frames):
        angle, scale = 0.02 * index, 1.0 + 0.006 * index
        c, s = scale * math.cos(angle), scale * math.sin(angle)
        a = torch.tensor([[c, -s], [s, c]])
        t = centre - a @ centre + index * torch.tensor([1.7, -0.9])
        maps.append(torch.cat([a, t[:, None]], 1))
        inverse = torch.linalg.inv(a)
        frame = _sample(image, torch.cat([inverse, -(inverse @ t)[:, None]], 1), (220, 260))
        shown.append((frame + noise * torch.randn(frame.shape, generator=g)).clamp(0, 1)[None].expand(3, -1, -1))
    return shown, torch.stack(maps)


def _errors(tracks, maps: torch.Tensor) -> torch.Tensor:
    """Track minus the true path of the point under its first observation (frames, points, 2)."""
    first = tracks.visible.int().argmax(0)
    start = tracks.xy[first, torch.arange(tracks.points)]
    inverse = torch.linalg.inv(maps[:, :, :2])[first]
    origin = (inverse @ (start - maps[first, :, 2])[..., None])[..., 0]
    truth = torch.einsum("fij,pj->fpi", maps[:, :, :2], origin) + maps[:, None, :, 2]
    return tracks.xy - truth


@pytest.fixture(scope="module")
def turning():
    torch.set_default_dtype(torch.float64)
    frames, maps = _turning(18)
    return track_points(frames, fps=30.0), maps


def test_known_warp_is_tracked_to_sub_pixel_precision(turning):
    tracks, maps = turning
    assert tracks.fps == 30.0
    age = tracks.extras["age"]
    errors = _errors(tracks, maps)[tracks.visible & (age > 0)].norm(dim=-1)
    assert int((tracks.visible.sum(0) >= 16).sum()) >= 100
    assert float(errors.median()) < 0.08
    assert float((errors < 0.5).double().mean()) > 0.98


def test_covariance_is_valid_and_neither_blind_nor_overconfident(turning):
    tracks, maps = turning
    chosen = tracks.visible & (tracks.extras["age"] > 0)
    q = tracks.covariance[chosen]
    assert float(torch.linalg.eigvalsh(q)[:, 0].min()) > 0
    e = _errors(tracks, maps)[chosen]
    squared = (e[:, None] @ torch.linalg.inv(q) @ e[..., None])[:, 0, 0] / 2
    # The misfit allowance is made for bent surfaces; on a plane the covariance may be too wide, never too narrow.
    assert 0.02 < float(squared.mean()) < 1.5


def test_unseen_entries_are_nan_and_ages_count_from_birth(turning):
    tracks, _ = turning
    age, score = tracks.extras["age"], tracks.extras["score"]
    assert bool(torch.isnan(tracks.xy[~tracks.visible]).all())
    assert bool(torch.isnan(score[~tracks.visible]).all())
    assert torch.equal(age >= 0, tracks.visible)
    first = tracks.visible.int().argmax(0)
    frame = torch.arange(tracks.frames)[:, None]
    assert torch.equal(age[tracks.visible], (frame - first)[tracks.visible])
    assert int(tracks.visible.sum(0).min()) >= TrackerParams().min_length


def test_new_points_keep_their_distance(turning):
    tracks, _ = turning
    for index in (0, 6, 9):
        born = tracks.extras["age"][index] == 0
        distance = torch.cdist(tracks.xy[index, born], tracks.xy[index, tracks.visible[index]])
        near = distance[distance > 1e-9]
        assert len(near) == 0 or float(near.min()) >= TrackerParams().min_distance - 1e-6


def test_same_frames_give_the_same_bits():
    frames, _ = _turning(6, seed=5)
    first, second = track_points(frames), track_points(iter(frames))
    assert torch.equal(torch.nan_to_num(first.xy), torch.nan_to_num(second.xy))


def test_gain_and_offset_of_the_light_do_not_matter():
    frames, maps = _turning(8, seed=2, noise=0.0)
    flicker = [(0.6 + 0.05 * i) * f for i, f in enumerate(frames)]
    errors = _errors(tracks := track_points(flicker), maps)[tracks.visible].norm(dim=-1)
    assert float((errors < 0.5).double().mean()) > 0.97


def test_tracks_stay_on_the_mask_and_end_where_it_ends():
    frames, _ = _turning(12, seed=3)
    masks = [torch.zeros(220, 260, dtype=torch.bool) for _ in frames]
    for index, mask in enumerate(masks):
        if index != 6:  # the person is out of the picture for one frame
            mask[60:170, 60:200] = True
    tracks = track_points(frames, masks)
    for index, mask in enumerate(masks):
        nearest = tracks.xy[index, tracks.visible[index]].round().long()
        assert bool(mask[nearest[:, 1], nearest[:, 0]].all())
    assert not bool(tracks.visible[6].any())
    assert bool(tracks.visible[:6].any())
    assert bool(tracks.visible[7:].any())
    assert not bool((tracks.visible[:6].any(0) & tracks.visible[7:].any(0)).any())


def test_depth_edges_are_avoided():
    frames, _ = _turning(6, seed=4)
    depth = torch.full((220, 260), 2.0)
    depth[:, 130:] = 3.0
    tracks = track_points(frames, depths=[depth] * 6)
    assert float((tracks.xy[..., 0][tracks.visible] - 129.5).abs().min()) > 1.0


def test_occluded_points_are_dropped_not_carried_along():
    frames, maps = _turning(14, seed=6)
    cover = _texture(220, 260, seed=9)
    for index in range(6, 14):
        frames[index] = frames[index].clone()
        frames[index][:, :, 100:160] = cover[:, 100:160]
    tracks = track_points(frames)
    born_before = tracks.visible[:5].any(0)
    errors = _errors(tracks, maps).norm(dim=-1)
    under = tracks.visible & born_before & (tracks.xy[..., 0] > 106) & (tracks.xy[..., 0] < 154)
    assert int(under[:5].sum()) > 20
    assert int(under[7:].sum()) <= 0.1 * int(under[5].sum()) * 7
    assert float((errors[tracks.visible & born_before] < 1.0).double().mean()) > 0.95


def test_useless_input_is_refused_with_a_reason():
    flat = [torch.full((3, 64, 64), 0.5)] * 6
    with pytest.raises(ReconError, match="0 points were found in 6 frames"):
        track_points(flat)
    with pytest.raises(ReconError, match="there is none"):
        track_points([])
    frames, _ = _turning(6)
    mask = torch.ones(220, 260, dtype=torch.bool)
    with pytest.raises(ReconError, match="masks: end at frame 3"):
        track_points(frames, [mask] * 3)
    with pytest.raises(ReconError, match="more than the 6 frames"):
        track_points(frames, [mask] * 7)
    with pytest.raises(ReconError, match="masks: frame 0"):
        track_points(frames, iter([mask[:10]] * 6))
    with pytest.raises(ReconError, match="window"):
        TrackerParams(window=0)
    with pytest.raises(ReconError, match="alpha"):
        TrackerParams(alpha=1.0)


def test_alignment_recovers_translation_and_affine_deformation():
    image = _texture(120, 140, seed=7)
    a = torch.tensor([[1.05, 0.08], [-0.05, 0.97]])
    t = torch.tensor([3.3, -2.6])
    inverse = torch.linalg.inv(a)
    other = _sample(image, torch.cat([inverse, -(inverse @ t)[:, None]], 1), (120, 140))
    xy = torch.tensor([[50.0, 60.0], [80.0, 70.0], [60.0, 40.0]])
    truth = xy @ a.T + t
    first, second = image_pyramid(image, 1)[0], image_pyramid(other, 1)[0]
    templates, eye = make_templates(first, xy, 7), identity_warp(3, xy)
    slid, kept, _, _ = align_window(templates, second, xy + (truth - xy) * 0.6, eye, 7, 10, deforms=False)
    assert float((slid - truth).norm(dim=-1).max()) < 0.7
    assert torch.equal(kept, eye)
    refined, warp, score, _ = align_window(templates, second, slid, eye, 7, 25)
    assert float((refined - truth).norm(dim=-1).max()) < 0.05
    assert float((warp[..., :2] - a).abs().max()) < 0.05
    assert float(score.min()) > 0.99


def test_a_window_that_collapsed_leaves_the_others_alone():
    image = image_pyramid(_texture(120, 140), 1)[0]
    xy = torch.tensor([[60.0, 50.0], [80.0, 70.0]])
    templates = make_templates(image, xy, 5)
    warp = identity_warp(2, xy)
    alone = align_window(templates.select(torch.tensor([1])), image, xy[1:] + 0.6, warp[1:], 5)
    warp[0, :, :2] = torch.tensor([[1.0, 2.0], [0.5, 1.0]])  # a line: not to be inverted
    both = align_window(templates, image, xy + 0.6, warp, 5)
    torch.testing.assert_close(both[0][1], alone[0][0])
    assert float(both[2][1]) > 0.99 > float(both[2][0])


def test_window_on_a_turning_cylinder_keeps_its_centre():
    """Closed form: a point at angle p of a cylinder of radius R is seen at R sin(p), turned by t at R sin(p + t)."""
    radius, turn = 24.0, math.radians(25.0)
    texture = _texture(260, 400, seed=21)
    y, x = torch.meshgrid(torch.arange(80.0), torch.arange(81.0) - 40.0, indexing="ij")

    def seen(angle: float) -> torch.Tensor:
        phi = torch.asin((x / radius).clamp(-0.999, 0.999)) - angle
        points = torch.stack([200.0 + radius * phi, 90.0 + y], -1)
        limit = torch.tensor([texture.shape[1] - 1.0, texture.shape[0] - 1.0])
        grid = (2 * points / limit - 1)[None]
        return F.grid_sample(texture[None, None], grid, mode="bicubic", align_corners=True)[0, 0]

    phi = torch.linspace(-0.35, 0.1, 10).repeat(4)
    row = torch.tensor([20.0, 33.0, 46.0, 59.0]).repeat_interleave(10)
    xy = torch.stack([40.0 + radius * torch.sin(phi), row], -1)
    truth = torch.stack([40.0 + radius * torch.sin(phi + turn), row], -1)
    stiffness = {"free": 0.0, "default": 2.0, "flat": 1e6}
    errors = {}
    for name, value in stiffness.items():
        templates = make_templates(seen(0.0), xy, 6, stiffness=value)
        position, warp = xy, identity_warp(len(xy), xy)
        for step in range(1, 11):
            position, warp, _, _ = align_window(templates, seen(turn * step / 10), position, warp, 6)
        errors[name] = float((position - truth).norm(dim=-1).median())
    assert errors["free"] < 0.6 * errors["flat"]
    assert errors["free"] < errors["default"] < 0.9 * errors["flat"]


def test_exhaustive_search_finds_a_shift_that_gradient_steps_miss():
    image = _texture(120, 140, seed=11)
    shift = torch.tensor([13.0, -9.0])
    other = _sample(image, torch.tensor([[1.0, 0.0, -13.0], [0.0, 1.0, 9.0]]), (120, 140))
    xy = torch.tensor([[50.0, 60.0], [80.0, 70.0], [60.0, 50.0]])
    found = search_translation(0.5 * image + 0.2, other, xy, xy, 5, 16)
    assert torch.equal(found, xy + shift)
    stepped = align_window(make_templates(image, xy, 5), other, xy, identity_warp(3, xy), 5, deforms=False)[0]
    assert float((stepped - xy - shift).norm(dim=-1).max()) > 2.0
    # Samples that belong to something else do not decide: the right half of the window is covered.
    covered = other.clone()
    covered[:, 64:] = _texture(120, 140, seed=12)[:, 64:]
    weights = (torch.arange(11) <= 5).double().repeat(11)[None]
    assert torch.equal(search_translation(image, covered, xy[:1], xy[:1], 5, 16, weights), xy[:1] + shift)


def test_a_thin_limb_before_a_still_trunk_keeps_its_points():
    """Its nearest neighbours are half on the trunk: the points must be judged by those that move with them."""
    trunk, limb = _texture(160, 240, seed=13), _texture(160, 240, seed=14)
    frames, steps = [], 10
    for index in range(steps):
        frame = trunk.clone()
        left = 40 + 6 * index
        frame[:, left : left + 18] = limb[:, 100:118]
        frames.append(frame[None])
    tracks = track_points(frames)
    middle = tracks.xy[..., 0] - 49 - 6.0 * torch.arange(steps)[:, None]
    first = tracks.visible.int().argmax(0)
    on_limb = middle[first, torch.arange(tracks.points)].abs() < 6
    step = (tracks.xy[1:] - tracks.xy[:-1])[:, on_limb]
    step = step[torch.isfinite(step).all(-1)]
    assert len(step) > 30
    assert float(((step - torch.tensor([6.0, 0.0])).norm(dim=-1) < 0.5).double().mean()) > 0.9


def test_match_covariance_predicts_the_scatter_of_matches(generator):
    """Monte Carlo: white noise on both images, many trials, against 2 s^2 J^-1 J2 J^-1."""
    image, noise, half, trials = _texture(80, 80, seed=8), 0.02, 7, 150
    xy = torch.tensor([[35.0, 42.0]])
    spread, predicted = [], []
    for _ in range(trials):
        first = image_pyramid(image + noise * torch.randn(80, 80, generator=generator), 1, sigma=0.0)
        second = image_pyramid(image + noise * torch.randn(80, 80, generator=generator), 1, sigma=0.0)
        templates = make_templates(first[0], xy, half, deformation_damping=1e6, bending_damping=1e6)
        found, _, _, residual = align_window(templates, second[0], xy, identity_warp(1, xy), half, 8)
        spread.append(found[0] - xy[0])
        predicted.append(match_covariance(templates, residual, half)[0])
    measured = torch.cov(torch.stack(spread).T)
    ratio = float(torch.trace(torch.stack(predicted).mean(0)) / torch.trace(measured))
    assert 0.6 < ratio < 1.7


def test_region_is_cut_to_the_mask():
    frame = torch.rand(3, 100, 120)
    mask = torch.zeros(100, 120, dtype=torch.bool)
    mask[40:60, 30:50] = True
    options = {"levels": 2, "margin": 6, "birth_margin": 2.0, "depth_jump": 0.1, "edge_radius": 2, "shading_sigma": 3.0}
    region = cut_region(frame, mask, None, torch.zeros(0, 2), **options)
    assert region.origin.tolist() == [24.0, 34.0]
    assert region.gray.shape == (32, 32)
    assert int(region.births.sum()) == 16 * 16
    assert region.size == pytest.approx(30.0)
    assert cut_region(frame, torch.zeros_like(mask), None, torch.zeros(0, 2), **options) is None
