"""Basin hopping: when it is believed, what it leaves alone, and that a family that runs away ends nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from torchrecon.linalg import rotation_angle, rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.nrsfm.articulation import ArticulationParams
from torchrecon.nrsfm.hopping import HoppingParams, _survey_frames, _whole, better_basin, part_of
from torchrecon.nrsfm.marginal import MarginalParams, solve_marginal
from torchrecon.nrsfm.quasi_newton import DescentParams, Growth, descend
from torchrecon.nrsfm.shape_likelihood import ShapeModel, Views, evaluate, tangents


def _model(rotations: torch.Tensor, loading: float) -> tuple[Views, ShapeModel]:
    g = torch.Generator().manual_seed(3)
    frames = len(rotations)
    mean = torch.randn(1, 15, 3, generator=g)
    mean = mean - mean.mean(1, keepdim=True)
    loadings = loading * torch.randn(1, 15, 3, 2, generator=g)
    model = ShapeModel(rotations[None], torch.ones(1, frames), mean, loadings, torch.linalg.qr(tangents(mean))[0])
    xy = (mean @ rotations.mT)[..., :2]
    return Views(xy, torch.ones(frames, 15, dtype=torch.bool), torch.zeros(frames, 15, 2, 2)), model


def test_survey_takes_frames_that_are_close_in_view_and_brings_the_model_back():
    angle = torch.linspace(0, 20, 400)[:, None]
    rotations = rotation_from_vector(angle * torch.tensor([0.1, 1.0, 0.0]))
    views, model = _model(rotations, 0.1)
    index = _survey_frames(model, HoppingParams())
    assert 60 <= len(index) < 400
    chosen = rotations[index]
    assert float(rotation_angle(chosen[1:] @ chosen[:-1].mT).max()) <= math.radians(30)
    some, part = part_of(views, model, index)
    assert some.xy.shape[0] == part.scale.shape[1] == len(index)
    whole = _whole(part, index, 400)
    torch.testing.assert_close(
        whole.rotations[0, : int(index[-1]) + 1], rotations[: int(index[-1]) + 1], atol=0.02, rtol=0
    )


def test_loadings_beyond_all_reason_cost_without_limit_and_the_descent_turns_back():
    rotations = rotation_from_vector(torch.linspace(0, 1, 12)[:, None] * torch.tensor([0.1, 1.0, 0.0]))
    views, model = _model(rotations, 0.1)
    runaway = replace(model, loadings=1e12 * model.loadings[..., :1].expand(-1, -1, -1, 6))  # and all alike
    assert torch.isinf(evaluate(views, runaway, 0.003).value).all()
    found, value, _ = descend(views, model, 0.003, 5, DescentParams())
    assert bool(value.isfinite().all() and found.loadings.isfinite().all())
    growth = Growth(10, 0.0, 1.0, 2, 5)
    deep = replace(model, mean=model.mean * torch.tensor([1.0, 1.0, 1e3]))
    kept, _ = better_basin(
        views, deep, 0.003, growth, torch.Generator(), HoppingParams(), ArticulationParams(), DescentParams()
    )
    assert kept is deep


def test_body_without_parts_keeps_the_answer_of_low_rank():
    g = torch.Generator().manual_seed(2)
    time = torch.linspace(0, 1, 50)[:, None, None]
    shape = torch.randn(20, 3, generator=g)
    for k in range(1, 13):
        wave = torch.sin(torch.pi * (k + 1) * time + 6 * torch.rand(1, generator=g))
        shape = shape + 0.3 / k**2 * wave * torch.randn(20, 3, generator=g)
    turn = rotation_from_vector(10 * time[:, 0] * torch.tensor([0.1, 1.0, 0.05]))
    tracks = Tracks((shape @ turn.mT)[..., :2])
    default = MarginalParams()
    without = replace(default, articulation=replace(default.articulation, partners=0))
    answers = [solve_marginal(tracks, 2, torch.Generator().manual_seed(0), p).points3d for p in (default, without)]
    torch.testing.assert_close(answers[0], answers[1], rtol=0, atol=0)
