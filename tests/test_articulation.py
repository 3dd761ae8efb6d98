"""Pairs of points that keep their distance: the term, its gradient, and what it does for an articulated body."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchrecon.data.synthetic import sample_body, sample_motion
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.metrics import error3d_camera
from torchrecon.nrsfm.articulation import Articulation, ArticulationParams, evaluate_with, find_partners
from torchrecon.nrsfm.marginal import MarginalParams, _found, solve_marginal
from torchrecon.nrsfm.shape_likelihood import ShapeModel, Views, evaluate, moved, tangents


def _limbs(frames: int) -> torch.Tensor:
    """Three rigid segments of eight points on hinges, seen by a camera that turns twice; (frames, 24, 3)."""
    g = torch.Generator().manual_seed(2)
    along = torch.linspace(0, 1, 8)
    around = 0.15 * torch.randn(3, 8, 3, generator=g)
    down = torch.stack([0 * along, -along, 0 * along], -1) + around[0]
    shapes = []
    for phase in torch.linspace(0, 4 * math.pi, frames).tolist():
        first = rotation_from_vector(torch.tensor([0.5 * math.sin(1.3 * phase), 0.0, 0.7 * math.sin(phase)]))
        second = first @ rotation_from_vector(torch.tensor([0.0, 0.0, 0.6 + 0.6 * math.sin(0.7 * phase + 1)]))
        up = torch.tensor([0.0, 1.0, 0.0])
        shapes.append(
            torch.cat(
                [
                    down,
                    (around[1] - down + around[0]) @ first.T,
                    first @ up + (along[:, None] * up + around[2]) @ second.T,
                ]
            )
        )
    turn = rotation_from_vector(torch.linspace(0, 4 * math.pi, frames)[:, None] * torch.tensor([0.05, 1.0, 0.02]))
    shape = torch.stack(shapes)
    return (shape - shape.mean(1, keepdim=True)) @ turn.mT


def _model(frames: int, points: int, modes: int, g: torch.Generator) -> tuple[Views, ShapeModel]:
    mean = torch.randn(1, points, 3, generator=g)
    mean = mean - mean.mean(1, keepdim=True)
    avoided = torch.linalg.qr(tangents(mean))[0]
    flat = 0.2 * torch.randn(1, 3 * points, modes, generator=g)
    loadings = (flat - avoided @ (avoided.mT @ flat)).unflatten(1, (points, 3))
    turns = rotation_from_vector(torch.randn(1, frames, 3, generator=g))
    xy = torch.randn(1, frames, points, 2, generator=g)
    views = Views(
        xy, torch.rand(1, frames, points, generator=g) > 0.2, 0.01 * torch.eye(2).expand(1, frames, points, 2, 2)
    )
    return views, ShapeModel(turns, torch.ones(1, frames), mean, loadings, avoided)


def test_partners_are_points_of_the_same_segment():
    found = find_partners(_limbs(60), 0.0, ArticulationParams(partners=3))
    assert found is not None
    segments = found.pairs // 8
    assert bool((segments[:, 0] == segments[:, 1]).all())
    assert found.pairs.shape[0] >= 24 * 3 / 2
    assert find_partners(_limbs(60)[:, :3], 0.0, ArticulationParams(partners=3)) is None
    assert find_partners(_limbs(60), 0.0, ArticulationParams(partners=0)) is None


def test_cost_is_nothing_for_rigid_pairs_and_bounded_for_others():
    shape = _limbs(50)
    zoom = torch.linspace(1.0, 1.5, 50)[:, None, None]
    rigid = Articulation(torch.tensor([[0, 5], [9, 13], [17, 22]]), 0.01, 0.0, 2.0, 1.0)
    assert float(rigid.cost(zoom * shape)) < 1e-6
    across = Articulation(torch.tensor([[0, 13], [5, 22]]), 0.01, 0.0, 2.0, 1.0)
    assert 0.5 * 50 < float(across.cost(shape)) <= 0.5 * 50 * 4 * 2


def test_gradient_with_the_term_is_that_of_differences():
    g = torch.Generator().manual_seed(0)
    views, model = _model(7, 9, 2, g)
    term = Articulation(torch.tensor([[0, 1], [2, 5], [3, 8], [4, 6]]), 0.7, 0.005, 2.0, 3.0)
    found = evaluate_with(term, views, model, 0.1)
    plain = evaluate(views, model, 0.1)
    torch.testing.assert_close(found.value, plain.value + term.cost(plain.points))
    pose = torch.randn(1, 7, 4, generator=g)
    mean = torch.randn(1, 9, 3, generator=g)
    mean = mean - mean.mean(1, keepdim=True)
    flat = torch.randn(1, 27, 2, generator=g)
    loadings = (flat - model.avoided @ (model.avoided.mT @ flat)).unflatten(1, (9, 3))
    h = 1e-6

    def value(step: float) -> float:
        there = moved(model, step * pose, step * mean, step * loadings)
        return float(evaluate_with(term, views, there, 0.1).value)

    slope = (found.pose * pose).sum() + (found.mean * mean).sum() + (found.loadings * loadings).sum()
    assert float(slope) == pytest.approx((value(h) - value(-h)) / (2 * h), rel=1e-5)


def test_articulated_body_is_found_better_with_the_term():
    truth = _limbs(60)
    tracks = Tracks(truth[..., :2])

    def error(params: MarginalParams) -> float:
        answer = solve_marginal(tracks, 4, torch.Generator().manual_seed(0), params)
        return float(error3d_camera(answer.points3d, truth))

    default = MarginalParams()
    without = replace(default, articulation=replace(default.articulation, partners=0))
    assert error(default) < 0.5 * error(without)


@pytest.mark.parametrize(("action", "searches", "gain"), [("jump", 2, 0.5), ("idle", 1, 1.0)])
def test_a_coarser_search_follows_where_the_first_answer_breaks_its_pairs(action, searches, gain):
    g = torch.Generator().manual_seed(1)
    joints = sample_motion(action, sample_body(g), frames=90, fps=25.0, generator=g).joints.double()
    yaw = torch.arange(90, dtype=torch.float64)[:, None] * torch.tensor([0.0, math.radians(5), 0.0])
    tilt = rotation_from_vector(torch.tensor([0.17, 0.0, 0.0], dtype=torch.float64))
    truth = (joints - joints.mean(1, keepdim=True)) @ (tilt @ rotation_from_vector(yaw)).mT
    truth = truth / truth[..., :2].square().mean().sqrt()
    xy = truth[..., :2]
    views = Views(xy, torch.ones(90, xy.shape[1], dtype=torch.bool), torch.zeros(*xy.shape, 2, dtype=xy.dtype))
    default = MarginalParams()

    def found(params: MarginalParams) -> tuple[float, int]:
        answers, starts = _found(views, 1.0, xy, torch.Generator().manual_seed(0), params)
        model, eps, _ = answers[0]
        return float(error3d_camera(evaluate(views, model, eps).points[0], truth)), starts

    once, starts = found(replace(default, coarse=default.coarse[:1]))
    error, all_starts = found(default)
    assert all_starts == searches * starts
    assert error <= gain * once
