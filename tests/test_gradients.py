"""Gradients of the reconstruction with respect to what was measured, against differences of whole solves."""

from __future__ import annotations

import pytest
import torch

import torchrecon as tr
from torchrecon.linalg import rotation_from_vector
from torchrecon.nrsfm.implicit import ImplicitParams, attached, settled
from torchrecon.nrsfm.shape_likelihood import ShapeModel, Views, evaluate, tangents


def bending(frames: int, points: int, seed: int = 0) -> torch.Tensor:
    """Two bases before a turning view, about 100 units in size (frames, points, 3)."""
    g = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 3, frames, dtype=torch.float64)
    rest, mode = torch.randn(2, points, 3, generator=g, dtype=torch.float64)
    shape = 100 * (rest + 0.3 * torch.sin(2 * time + 1)[:, None, None] * mode)
    turn = rotation_from_vector(time[:, None] * torch.tensor([0.3, 1.0, 0.1], dtype=torch.float64))
    return (shape - shape.mean(1, keepdim=True)) @ turn.mT


@pytest.mark.parametrize("empty", [[], [0, 5]])
def test_gradient_of_the_default_solver_is_that_of_whole_solves(empty):
    g = torch.Generator().manual_seed(1)
    frames = 8 + len(empty)
    truth = bending(frames, 7)
    xy = (truth[..., :2] + torch.randn(frames, 7, 2, generator=g, dtype=torch.float64)).requires_grad_()
    noise = torch.eye(2, dtype=torch.float64).repeat(frames, 7, 1, 1).requires_grad_()
    visible = torch.ones(frames, 7, dtype=torch.bool)
    visible[empty] = False
    weight = torch.randn(truth.shape, generator=g, dtype=torch.float64)

    def score(xy: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return (tr.reconstruct(tr.Tracks(xy, visible, covariance=noise), 2).points3d * weight).sum()

    by_xy, by_noise = torch.autograd.grad(score(xy, noise), (xy, noise))
    step = torch.randn(xy.shape, generator=g, dtype=torch.float64)
    grow = torch.randn(noise.shape, generator=g, dtype=torch.float64)
    grow = 0.3 * (grow + grow.mT)
    h = 1e-3
    there = score(xy + h * step, noise + h * grow) - score(xy - h * step, noise - h * grow)
    slope = float((by_xy * step).sum() + (by_noise * grow).sum())
    assert slope == pytest.approx(float(there.detach()) / (2 * h), rel=1e-3)
    assert float((by_noise * grow).sum().abs()) > 1e-2 * abs(slope)  # both have their say


def test_gradient_holds_where_pairs_keep_their_distance():
    # Two rigid halves on a hinge: the pairs are found, so the optimum is that with their term.
    g = torch.Generator().manual_seed(3)
    time = torch.linspace(0, 3, 10, dtype=torch.float64)
    rest = torch.randn(16, 3, generator=g, dtype=torch.float64)
    hinge = rotation_from_vector(0.5 * torch.sin(2 * time + 1)[:, None] * torch.tensor([1.0, 0.0, 0.0]).double())
    shape = 100 * torch.cat([rest[:8].expand(10, 8, 3), rest[8:] @ hinge.mT], 1)
    turn = rotation_from_vector(time[:, None] * torch.tensor([0.3, 1.0, 0.1], dtype=torch.float64))
    truth = (shape - shape.mean(1, keepdim=True)) @ turn.mT
    xy = (truth[..., :2] + 0.3 * torch.randn(10, 16, 2, generator=g, dtype=torch.float64)).requires_grad_()
    noise = 0.1 * torch.eye(2, dtype=torch.float64).repeat(10, 16, 1, 1)
    weight = torch.randn(truth.shape, generator=g, dtype=torch.float64)

    def score(xy: torch.Tensor) -> torch.Tensor:
        return (tr.reconstruct(tr.Tracks(xy, covariance=noise), 2).points3d * weight).sum()

    step = torch.randn(xy.shape, generator=g, dtype=torch.float64)
    slope = float((torch.autograd.grad(score(xy), xy)[0] * step).sum())
    h = 1e-3
    there = float((score(xy + h * step) - score(xy - h * step)).detach())
    assert slope == pytest.approx(there / (2 * h), rel=1e-3)


def test_iterated_and_factorised_hessian_give_one_gradient():
    g = torch.Generator().manual_seed(2)
    truth = bending(10, 7) / 100
    xy = truth[..., :2] + 0.01 * torch.randn(10, 7, 2, generator=g, dtype=torch.float64)
    views = Views(
        xy[None].requires_grad_(),
        torch.rand(1, 10, 7, generator=g) < 0.9,
        1e-4 * torch.eye(2, dtype=torch.float64).expand(1, 10, 7, 2, 2),
    )
    turn = rotation_from_vector(
        torch.linspace(0, 3, 10, dtype=torch.float64)[:, None] * torch.tensor([0.3, 1.0, 0.1], dtype=torch.float64)
    )
    mean = (truth @ turn).mean(0)
    mode = torch.randn(7 * 3, 1, generator=g, dtype=torch.float64)
    model = ShapeModel(
        turn[None],
        torch.ones(1, 10, dtype=torch.float64),
        mean[None],
        0.2 * mode.view(1, 7, 3, 1),
        torch.linalg.qr(tangents(mean[None]))[0],
    )
    best = settled(Views(views.xy.detach(), views.visible, views.noise), model, 0.02)
    weight = torch.randn(1, 10, 7, 3, generator=g, dtype=torch.float64)
    weight = weight - weight.mean(-2, keepdim=True)
    gradients = []
    for dense in (1200, 0):
        there = attached(views, best, 0.02, ImplicitParams(dense=dense))
        gradients.append(torch.autograd.grad((evaluate(views, there, 0.02).points * weight).sum(), views.xy)[0])
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-5, atol=1e-6)
    assert not gradients[0][~views.visible].any()


def test_measured_depth_pulls_its_point():
    g = torch.Generator().manual_seed(3)
    camera = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=torch.float64)
    place = bending(16, 10) / 250 + torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64)
    image = place @ camera.mT
    depth = (place[..., 2] + 0.01 * torch.randn(16, 10, generator=g, dtype=torch.float64)).requires_grad_()
    tracks = tr.Tracks(
        image[..., :2] / image[..., 2:],
        covariance=torch.eye(2, dtype=torch.float64).expand(16, 10, 2, 2),
        depth=depth,
        depth_variance=torch.full_like(depth, 1e-4),
        intrinsics=camera,
    )
    answer = tr.reconstruct(tracks, 2)
    (pull,) = torch.autograd.grad(answer.points3d[7, 4, 2], depth)
    assert 0.05 < float(pull[7, 4]) < 1.0
    assert float(pull[7, 4]) > float(pull[:, 4].abs().median())
