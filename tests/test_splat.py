"""Splatting: mass, derivatives, and the fast sum against the obvious one."""

from __future__ import annotations

import math

import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.render.splat import splat


def _splat_naive(xy, weights, size, sigma):
    """Point by point and pixel by pixel, with the normal distribution's own cdf."""
    picture = torch.zeros(size)
    normal = torch.distributions.Normal(0.0, sigma)
    for (x, y), weight in zip(xy, weights, strict=True):
        for row in range(size[0]):
            for column in range(size[1]):
                across = normal.cdf(column + 0.5 - x) - normal.cdf(column - 0.5 - x)
                down = normal.cdf(row + 0.5 - y) - normal.cdf(row - 0.5 - y)
                picture[row, column] += weight * across * down
    return picture


@pytest.mark.parametrize("sigma", [0.2, 0.7, 2.0])
def test_mass_inside_the_picture_is_the_weight(generator, sigma):
    xy = 20 + 4 * torch.rand(30, 2, generator=generator)
    weights = torch.rand(30, generator=generator)
    picture = splat(xy, weights, (44, 44), sigma)
    torch.testing.assert_close(picture.sum(), weights.sum())


def test_a_wide_enough_point_keeps_its_place(generator):
    xy = 20 + 4 * torch.rand(30, 2, generator=generator)
    weights = torch.rand(30, generator=generator)
    picture, columns = splat(xy, weights, (44, 44), 2.0), torch.arange(44.0)
    torch.testing.assert_close((picture.sum(0) * columns).sum() / picture.sum(), (weights @ xy[:, 0]) / weights.sum())


def test_half_of_a_point_on_the_border_is_outside():
    picture = splat(torch.tensor([[-0.5, 10.0]]), torch.ones(1), (21, 21), 1.0)
    assert math.isclose(float(picture.sum()), 0.5, abs_tol=1e-12)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_batch_equals_the_obvious_loop(generator, batch):
    xy = 8 * torch.rand(*batch, 5, 2, generator=generator) - 1
    weights = torch.rand(*batch, 5, generator=generator)
    pictures = splat(xy, weights, (5, 7), 0.8).reshape(-1, 5, 7)
    for picture, points, weight in zip(pictures, xy.reshape(-1, 5, 2), weights.reshape(-1, 5), strict=True):
        torch.testing.assert_close(picture, _splat_naive(points, weight, (5, 7), 0.8))


def test_gradient_in_positions_and_weights(generator):
    xy = (6 * torch.rand(4, 2, generator=generator)).requires_grad_()
    weights = torch.rand(4, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, w: splat(p, w, (6, 5), 0.9), (xy, weights))


def test_unweighted_points_are_not_read_and_give_finite_gradients():
    xy = torch.tensor([[2.0, 2.0], [math.nan, math.nan]], requires_grad=True)
    picture = splat(xy, torch.tensor([1.0, 0.0]), (5, 5))
    torch.testing.assert_close(picture, splat(xy[:1], torch.ones(1), (5, 5)))
    picture[2, 3].backward()
    assert torch.isfinite(xy.grad).all()


@pytest.mark.parametrize(("size", "sigma"), [((0, 5), 1.0), ((5, 5), 0.0)])
def test_empty_picture_or_sharp_point_is_refused(size, sigma):
    with pytest.raises(ReconError, match="must be positive"):
        splat(torch.zeros(1, 2), torch.ones(1), size, sigma)
