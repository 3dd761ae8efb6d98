"""Eqs. 12-17: depth maps to points of the body."""

from __future__ import annotations

import math

import kornia
import pytest
import torch

from torchrecon.depth import (
    BilateralParams,
    SampleParams,
    auto_box,
    backproject,
    bilateral_depth,
    depth_cluster,
    range_box,
    sample_depth,
)
from torchrecon.errors import ReconError
from torchrecon.measurement import project_points

K = torch.tensor([[300.0, 0, 40], [0, 310, 30], [0, 0, 1]], dtype=torch.float64)


def test_eq12_backproject_project_identity(generator: torch.Generator) -> None:
    depth = 1 + torch.rand(2, 1, 60, 80, generator=generator)
    points = backproject(depth, torch.stack([K, K * torch.tensor([[1.1], [0.9], [1.0]])]))
    v, u = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    torch.testing.assert_close(points[:, 2], depth[:, 0])
    pixels = project_points(points[0].permute(1, 2, 0), K)
    torch.testing.assert_close(pixels, torch.stack([u, v], -1), atol=1e-9, rtol=0)


def test_eq12_tilted_plane_is_flat_and_holes_stay_holes() -> None:
    v, u = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    normal = torch.tensor([0.2, -0.3, 1.0])
    ray = torch.stack([(u - 40) / 300, (v - 30) / 310, torch.ones_like(u)], -1)
    depth = 2.0 / (ray @ normal)
    depth[3, 4], depth[5, 6] = 0.0, float("nan")
    points = backproject(depth[None, None], K)[0]
    bad = points.isnan().all(0)
    assert bad.nonzero().tolist() == [[3, 4], [5, 6]]
    assert float((normal @ points[:, ~bad] - 2.0).abs().max()) < 1e-12


def _reference_bilateral(
    depth: torch.Tensor, valid: torch.Tensor, space: float, span: float, radius: int
) -> torch.Tensor:
    """One pixel at a time; ``space`` and ``span`` are the full denominators; borders are left out of the window."""
    out = torch.full_like(depth, float("nan"))
    height, width = depth.shape
    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            total = norm = 0.0
            for q in range(max(0, y - radius), min(height, y + radius + 1)):
                for p in range(max(0, x - radius), min(width, x + radius + 1)):
                    if valid[q, p]:
                        d2 = (y - q) ** 2 + (x - p) ** 2
                        w = math.exp(-d2 / space) * math.exp(-(float(depth[y, x] - depth[q, p]) ** 2) / span)
                        total, norm = total + w * float(depth[q, p]), norm + w
            out[y, x] = total / norm
    return out


def test_eq13_14_masked_filter_equals_a_plain_loop(generator: torch.Generator) -> None:
    depth = 2 + 0.1 * torch.randn(18, 20, generator=generator)
    valid = torch.rand(18, 20, generator=generator) > 0.3
    poisoned = torch.where(valid, depth, torch.tensor(float("nan")))
    params = BilateralParams(s_space=1.3, s_range=0.08, radius=3)
    expected = _reference_bilateral(depth, valid, 2 * 1.3**2, 2 * 0.08**2, 3)
    inner = (slice(3, -3), slice(3, -3))
    for result in (bilateral_depth(poisoned, None, params), bilateral_depth(poisoned, valid, params)):
        torch.testing.assert_close(result[inner], expected[inner], equal_nan=True)
        assert torch.equal(result.isnan(), ~valid)


def test_eq13_14_full_mask_equals_kornia(generator: torch.Generator) -> None:
    depth = 2 + 0.2 * torch.rand(2, 1, 30, 40, generator=generator)
    ours = bilateral_depth(depth, None, BilateralParams(s_space=1.5, s_range=0.1, radius=4))
    theirs = kornia.filters.bilateral_blur(depth, (9, 9), 0.1, (1.5, 1.5))
    torch.testing.assert_close(ours, theirs, atol=1e-10, rtol=0)


def test_eq15_16_paper_literal_sigma_is_a_variance(generator: torch.Generator) -> None:
    depth = 2 + 0.2 * torch.rand(20, 20, generator=generator)
    literal = BilateralParams(s_space=2.0, s_range=0.01, radius=3, paper_literal_sigma=True)
    plain = BilateralParams(s_space=2.0**0.5, s_range=0.1, radius=3)
    torch.testing.assert_close(bilateral_depth(depth, None, literal), bilateral_depth(depth, None, plain))


def test_eq15_infinite_range_is_a_normalised_gaussian(generator: torch.Generator) -> None:
    depth = 2 + 0.2 * torch.rand(1, 1, 24, 24, generator=generator)
    valid = torch.rand(1, 1, 24, 24, generator=generator) > 0.2
    ours = bilateral_depth(depth, valid, BilateralParams(s_space=1.5, s_range=1e6, radius=4))
    blur = [kornia.filters.gaussian_blur2d(x, (9, 9), (1.5, 1.5)) for x in (depth * valid, valid.to(depth.dtype))]
    torch.testing.assert_close(ours[valid], (blur[0] / blur[1])[valid])


def test_eq16_zero_range_is_the_identity_and_steps_stand(generator: torch.Generator) -> None:
    depth = 2 + 0.2 * torch.rand(20, 20, generator=generator)
    torch.testing.assert_close(bilateral_depth(depth, None, BilateralParams(s_range=1e-9)), depth)
    step = torch.full((20, 20), 2.0)
    step[:, 10:] = 3.0
    assert float((bilateral_depth(step, None, BilateralParams(s_range=0.05)) - step).abs().max()) < 0.01


def test_eq13_noise_on_a_plane_falls_by_the_analytic_factor(generator: torch.Generator) -> None:
    noise = 0.01 * torch.randn(200, 200, generator=generator)
    out = bilateral_depth(2 + noise, None, BilateralParams(s_space=1.5, s_range=10.0, radius=5))
    kernel = torch.exp(-(torch.arange(-5.0, 6) ** 2) / (2 * 1.5**2))
    factor = float((kernel**2).sum() / kernel.sum() ** 2)  # product of the two axes' square roots
    assert float(out.std() / noise.std()) == pytest.approx(factor, rel=0.05)


def test_eq13_gradient(generator: torch.Generator) -> None:
    depth = (2 + 0.1 * torch.rand(6, 7, generator=generator)).requires_grad_()
    valid = torch.rand(6, 7, generator=generator) > 0.2
    params = BilateralParams(s_space=1.0, s_range=0.1, radius=2)
    assert torch.autograd.gradcheck(lambda d: bilateral_depth(d, valid, params)[valid], depth)
    bad = torch.where(valid, depth.detach(), torch.tensor(float("nan"))).requires_grad_()
    bilateral_depth(bad, valid, params)[valid].sum().backward()
    assert bad.grad is not None
    assert torch.isfinite(bad.grad).all()
    assert (bad.grad[~valid] == 0).all()


def test_eq13_bad_parameters_are_refused() -> None:
    with pytest.raises(ReconError, match="radius"):
        bilateral_depth(torch.ones(4, 4), None, BilateralParams(radius=4))
    with pytest.raises(ReconError, match="s_range"):
        bilateral_depth(torch.ones(9, 9), None, BilateralParams(s_range=0.0))


def test_eq17_range_box_exact_membership() -> None:
    points = torch.tensor([[1.0, 2, 3], [1.5, 2, 3], [1.51, 2, 3], [1, 3.0, 3], [1, 2, 3.76], [float("nan")] * 3])
    inside = range_box(points, torch.tensor([1.0, 2, 3]), torch.tensor([0.5, 1.0, 0.75]))
    assert inside.tolist() == [True, True, False, True, False, False]
    assert range_box(points.expand(2, 6, 3), torch.zeros(3), torch.ones(3)).shape == (2, 6)
    with pytest.raises(ReconError, match="half"):
        range_box(points, torch.zeros(3), torch.zeros(3))


def _person_and_wall() -> tuple[torch.Tensor, torch.Tensor]:
    """An upright ellipsoid with a cylinder arm at 2.5 m before a slanted wall at about 4 m, with sensor noise."""
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    wall = 4 + 0.004 * (u - 80)
    r2 = ((u - 78) / 16) ** 2 + ((v - 62) / 45) ** 2
    body = torch.where(r2 < 1, 2.5 - 0.15 * torch.sqrt((1 - r2).clamp(min=0)), torch.tensor(float("inf")))
    arm = (u > 90) & (u < 116) & ((v - 45).abs() < 5)
    body = torch.where(arm, torch.minimum(body, torch.tensor(2.45)), body)
    noise = 0.004 * torch.randn(120, 160, generator=torch.Generator().manual_seed(0))
    depth = torch.minimum(body, wall) + noise
    depth[::13, ::7] = float("nan")
    return depth, torch.isfinite(body) & torch.isfinite(depth)


def test_eq17_auto_box_finds_the_person_before_a_wall() -> None:
    depth, person = _person_and_wall()
    cloud = backproject(depth[None, None], torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]))[0]
    for mask in (None, person):
        centre, half = auto_box(cloud, mask)
        found = range_box(cloud.permute(1, 2, 0), centre, half)
        overlap = (found & person).sum() / (found | person).sum()
        assert float(overlap) >= 0.95
    assert float((depth_cluster(depth) & person).sum() / person.sum()) > 0.95


def test_eq17_an_arm_before_the_trunk_is_the_body_and_a_wall_in_the_mask_is_not() -> None:
    depth = torch.full((120, 160), 5.0)
    depth[30:110, 60:100] = 3.0
    depth[50:60, 40:120] = 2.6  # nearer by more than a step: a surface of its own
    mask = depth < 4
    mask[:20, :30] = True  # too much of a mask: the wall
    cloud = backproject(depth[None, None], torch.tensor([[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]))[0]
    found = range_box(cloud.permute(1, 2, 0), *auto_box(cloud, mask)) & mask
    assert torch.equal(found, depth < 4)


def test_eq17_nothing_in_the_mask_is_an_error() -> None:
    with pytest.raises(ReconError, match="mask"):
        depth_cluster(torch.ones(5, 5), torch.zeros(5, 5, dtype=torch.bool))


def test_sample_depth_is_exact_on_a_plane_and_nan_at_edges(generator: torch.Generator) -> None:
    v, u = torch.meshgrid(torch.arange(40.0), torch.arange(50.0), indexing="ij")
    depth = 2 + 0.01 * u - 0.005 * v
    xy = torch.rand(100, 2, generator=generator) * torch.tensor([43.0, 33.0]) + 3
    z, variance = sample_depth(depth, xy)
    torch.testing.assert_close(z, 2 + 0.01 * xy[:, 0] - 0.005 * xy[:, 1], atol=1e-6, rtol=0)
    assert float(variance.max()) <= SampleParams().noise_floor ** 2 * 1.0001
    cut = depth.clone()
    cut[:, 25:] += 1.0
    cut[10, 10] = float("nan")
    z, variance = sample_depth(cut, torch.tensor([[24.6, 20.0], [25.2, 20.0], [22.0, 20.0], [10.0, 10.0], [-3.0, 2.0]]))
    assert z.isnan().tolist() == [True, True, False, True, True]
    assert torch.equal(z.isnan(), variance.isnan())
    # two pixels from the edge the other surface must not leak into the fit
    z, _ = sample_depth(cut, torch.tensor([[23.4, 20.0]]))
    torch.testing.assert_close(z, torch.tensor([2 + 0.234 - 0.1]), atol=1e-6, rtol=0)


def test_where_two_surfaces_meet_the_depth_around_is_given_with_a_variance_that_spans_them() -> None:
    depth = torch.full((60, 60), torch.nan)
    depth[10:50, 10:30], depth[10:50, 30:50] = 3.0, 3.4
    xy = torch.tensor([[20.0, 30.0], [29.6, 30.0], [8.0, 30.0], [2.0, 2.0]])  # on one, between two, off the edge, away
    plain, _ = sample_depth(depth, xy)
    assert torch.isfinite(plain).tolist() == [True, False, False, False]
    value, variance = sample_depth(depth, xy, SampleParams(around=2.5))
    assert torch.isfinite(value).tolist() == torch.isfinite(variance).tolist() == [True, True, True, False]
    assert value[0] == plain[0]
    assert abs(float(value[1]) - 3.2) < 0.04
    assert 0.15 < float(variance[1] ** 0.5) < 0.25
    assert abs(float(value[2]) - 3.0) < 1e-4


def test_sample_depth_variance_is_the_pixel_noise(generator: torch.Generator) -> None:
    depth = 3 + 0.006 * torch.randn(2, 100, 100, generator=generator)
    xy = 5 + 90 * torch.rand(2, 2000, 2, generator=generator)
    z, variance = sample_depth(depth, xy)
    assert z.shape == (2, 2000)
    assert float(variance.nanmean()) == pytest.approx(0.006**2, rel=0.05)
    assert float(((z - 3) ** 2).nanmean()) < 0.006**2
