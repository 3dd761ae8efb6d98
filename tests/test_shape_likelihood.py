"""The likelihood of low-rank shapes against a dense Gaussian, finite differences and the promise of EM."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise

import pytest
import torch

from torchrecon.linalg import rotation_from_vector
from torchrecon.nrsfm.quasi_newton import DescentParams, descend
from torchrecon.nrsfm.shape_likelihood import ShapeModel, Views, evaluate, grow_loadings, moved, tangents

B, F, P, MODES, EPS = 2, 7, 9, 3, 0.3


def _problem(seed: int = 0) -> tuple[Views, ShapeModel]:
    g = torch.Generator().manual_seed(seed)
    root = 0.2 * torch.randn(B, F, P, 2, 2, generator=g)
    views = Views(torch.randn(B, F, P, 2, generator=g), torch.rand(B, F, P, generator=g) < 0.8, root @ root.mT)
    mean = torch.randn(B, P, 3, generator=g)
    mean = mean - mean.mean(-2, keepdim=True)
    avoided = torch.linalg.qr(tangents(mean))[0]
    loadings = torch.randn(B, 3 * P, MODES, generator=g)
    loadings = (loadings - avoided @ (avoided.mT @ loadings)).view(B, P, 3, MODES)
    scale = torch.exp(0.1 * torch.randn(B, F, generator=g))
    scale = scale / scale.log().mean(-1, keepdim=True).exp()
    return views, ShapeModel(rotation_from_vector(torch.randn(B, F, 3, generator=g)), scale, mean, loadings, avoided)


def _dense(views: Views, model: ShapeModel, item: int, frame: int):
    """Mean and covariance of the visible coordinates, the translation as an almost flat Gaussian."""
    seen = views.visible[item, frame].nonzero()[:, 0]
    rows = model.scale[item, frame] * model.rotations[item, frame, :2]
    mean = (model.mean[item, seen] @ rows.T).reshape(-1)
    loading = torch.einsum("ci,pik->pck", rows, model.loadings[item, seen]).reshape(-1, MODES)
    noise = torch.block_diag(
        *[views.noise[item, frame, p] + (model.scale[item, frame] * EPS) ** 2 * torch.eye(2) for p in seen.tolist()]
    )
    shift = torch.eye(2).repeat(len(seen), 1)
    return seen, mean, loading @ loading.T + noise + 1e9 * shift @ shift.T


def test_value_is_that_of_a_dense_gaussian():
    views, model = _problem()
    value = evaluate(views, model, EPS).value
    for item in range(B):
        total = torch.zeros(())
        for frame in range(F):
            seen, mean, covariance = _dense(views, model, item, frame)
            rest = views.xy[item, frame, seen].reshape(-1) - mean
            total += 0.5 * (torch.logdet(covariance) + rest @ torch.linalg.solve(covariance, rest))
        torch.testing.assert_close(value[item], total - F * torch.log(torch.tensor(1e9)), rtol=1e-6, atol=1e-4)


def test_gradient_is_that_of_finite_differences():
    views, model = _problem()
    g = torch.Generator().manual_seed(1)
    pose, mean = torch.randn(B, F, 4, generator=g), torch.randn(B, P, 3, generator=g)
    pose[..., 3] -= pose[..., 3].mean(-1, keepdim=True)
    mean = mean - mean.mean(-2, keepdim=True)
    loadings = torch.randn(B, 3 * P, MODES, generator=g)
    loadings = (loadings - model.avoided @ (model.avoided.mT @ loadings)).view(B, P, 3, MODES)
    ends = [evaluate(views, moved(model, h * pose, h * mean, h * loadings), EPS).value for h in (1e-5, -1e-5)]
    at = evaluate(views, model, EPS)
    slope = (at.pose * pose).sum((-1, -2)) + (at.mean * mean).sum((-1, -2)) + (at.loadings * loadings).sum((-1, -2, -3))
    torch.testing.assert_close((ends[0] - ends[1]) / 2e-5, slope, rtol=1e-6, atol=1e-5)


def test_points_and_spread_are_the_posterior_of_the_shapes():
    views, model = _problem()
    at = evaluate(views, model, EPS, with_spread=True)
    item, frame = 1, 3
    pose = model.scale[item, frame] * model.rotations[item, frame]
    seen, mean, covariance = _dense(views, model, item, frame)
    # All camera coordinates of all points, jointly with the seen ones; the residual is isotropic.
    loading = torch.einsum("ci,pik->pck", pose, model.loadings[item]).reshape(3 * P, MODES)
    variance = (model.scale[item, frame] * EPS) ** 2
    prior = loading @ loading.T + variance * torch.eye(3 * P)
    index = torch.stack([3 * seen, 3 * seen + 1], 1).reshape(-1)
    rest = views.xy[item, frame, seen].reshape(-1) - mean
    expected = (model.mean[item] @ pose.T).reshape(-1) + prior[:, index] @ torch.linalg.solve(covariance, rest)
    torch.testing.assert_close(at.points[item, frame].reshape(-1), expected, rtol=1e-5, atol=1e-5)
    left = prior - prior[:, index] @ torch.linalg.solve(covariance, prior[index])
    spread = at.spread[item, frame].reshape(3 * P, -1)
    residual = (left - spread @ spread.T).view(P, 3, P, 3)
    blocks = residual[range(P), :, range(P), :]
    # What the weights do not explain is the residual: eps^2 in depth, less in the axes that were measured.
    torch.testing.assert_close(blocks[:, 2, 2], variance.expand(P), rtol=1e-5, atol=1e-5)
    assert bool((blocks[:, 0, 0] < variance + 1e-6).all())


def test_unseen_entries_and_neighbours_in_the_batch_change_nothing():
    views, model = _problem()
    wild = Views(torch.where(views.visible[..., None], views.xy, 1e3), views.visible, views.noise)
    whole = evaluate(views, model, EPS)
    other = evaluate(wild, model, EPS)
    single = Views(views.xy[1:], views.visible[1:], views.noise[1:])
    alone = evaluate(single, model.pick(1), EPS)
    for part in fields(whole):
        if part.name == "spread":
            continue
        torch.testing.assert_close(getattr(whole, part.name), getattr(other, part.name))
        torch.testing.assert_close(getattr(whole, part.name)[1:], getattr(alone, part.name))


def test_growth_raises_the_likelihood_and_descent_finds_the_shapes():
    g = torch.Generator().manual_seed(2)
    turn = rotation_from_vector(torch.linspace(0, 3, 40)[:, None] * torch.tensor([0.2, 1.0, 0.1]))
    mean = torch.randn(15, 3, generator=g)
    mean = mean - mean.mean(0)
    avoided = torch.linalg.qr(tangents(mean))[0]
    loading = torch.randn(45, 2, generator=g)
    loading = 0.3 * (loading - avoided @ (avoided.mT @ loading))
    shapes = mean + (torch.randn(40, 2, generator=g) @ loading.T).view(40, 15, 3)
    xy = (shapes @ turn.mT)[None, ..., :2]
    views = Views(xy, torch.ones(1, 40, 15, dtype=torch.bool), torch.zeros(1, 40, 15, 2, 2))
    model = ShapeModel(turn[None], torch.ones(1, 40), mean[None], torch.zeros(1, 15, 3, 0), avoided[None])
    eps = 0.02
    values = []
    for _ in range(10):
        model = grow_loadings(views, model, eps, 10)
        values.append(float(evaluate(views, model, eps).value))
    assert max(later - now for now, later in pairwise(values)) < 0
    for _ in range(4):
        model, value, _ = descend(views, grow_loadings(views, model, eps, 10), eps, 20, DescentParams())
    assert float(value) < values[-1]
    assert model.loadings.shape[-1] == 2  # as many as were put in
    points, truth = evaluate(views, model, eps).points[0], shapes @ turn.mT
    truth = truth - truth.mean(1, keepdim=True)
    assert float((points - points.mean(1, keepdim=True) - truth).norm() / truth.norm()) < 0.02


def test_noise_on_a_rigid_body_makes_no_modes():
    g = torch.Generator().manual_seed(3)
    turn = rotation_from_vector(torch.linspace(0, 3, 60)[:, None] * torch.tensor([0.2, 1.0, 0.1]))[None]
    mean = torch.randn(1, 20, 3, generator=g)
    mean = mean - mean.mean(-2, keepdim=True)
    sigma, eps = 0.1, 0.02
    xy = (mean @ turn.mT)[..., :2] + sigma * torch.randn(1, 60, 20, 2, generator=g)
    noise = (sigma**2 * torch.eye(2)).expand(1, 60, 20, 2, 2)
    views = Views(xy, torch.ones(1, 60, 20, dtype=torch.bool), noise)
    rigid = ShapeModel(turn, torch.ones(1, 60), mean, torch.zeros(1, 20, 3, 0), torch.linalg.qr(tangents(mean))[0])
    assert grow_loadings(views, rigid, eps, 10, sigma**2).loadings.shape[-1] == 0


@pytest.mark.parametrize("item", [0, 1])
def test_descent_of_a_batch_is_that_of_its_items(item):
    views, model = _problem()
    both, _, _ = descend(views, model, EPS, 6, DescentParams())
    single = Views(views.xy[item : item + 1], views.visible[item : item + 1], views.noise[item : item + 1])
    alone, _, _ = descend(single, model.pick(item), EPS, 6, DescentParams())
    torch.testing.assert_close(both.pick(item).rotations, alone.rotations, rtol=1e-5, atol=1e-6)
