"""Covariances of 3D points: sized by refits."""

from __future__ import annotations

import math

import pytest
import torch

from eval.reliability.coverage import LEVELS, squared_distances
from eval.reliability.world import low_rank_tracks
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.nrsfm.marginal import MarginalParams, solve_marginal
from torchrecon.nrsfm.spread import SpreadParams, between, widened


def _errors(spread: torch.Tensor, draws: int, seed: int = 0) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    white = torch.randn(draws, *spread.shape[:-1], 1, generator=g)
    return (torch.linalg.cholesky(spread) @ white)[..., 0]


def test_widened_finds_the_covariance_that_the_errors_have() -> None:
    g = torch.Generator().manual_seed(0)
    stated = torch.randn(50, 20, 3, 3, generator=g)
    stated = stated @ stated.mT + torch.eye(3)
    mixed = torch.tensor([[2.0, 0.0, 0.0], [0.5, 1.5, 0.0], [0.3, -0.4, 3.0]])
    root = torch.linalg.cholesky(stated) @ mixed
    true = root @ root.mT
    found = widened(stated, _errors(true, 40), window=50)
    # in the metric of the truth, so that large and small axes count alike
    ratio = torch.linalg.solve(true, found).diagonal(dim1=-2, dim2=-1).mean()
    assert float(ratio) == pytest.approx(1, rel=0.05)
    # nothing is made smaller by errors that happen to be small
    calm = widened(stated, 0.1 * _errors(stated, 40), window=5)
    torch.testing.assert_close(calm, stated, rtol=1e-6, atol=1e-6)


def test_refits_make_the_closed_form_honest() -> None:
    levels = []
    for draws, halves in ((0, 0), (4, 2)):
        made = low_rank_tracks(40, 20, 1, 20.0, seed=3)
        params = MarginalParams(spread=SpreadParams(draws=draws, halves=halves))
        answer = solve_marginal(Tracks(made.xy), 1, torch.Generator().manual_seed(0), params)
        distances = squared_distances(answer.points3d, answer.covariance3d, made.points3d)
        levels.append(float(distances.mean()) / 3)
    assert levels[0] > 2.5  # what the closed form states is too small by that factor in variance
    assert 0.6 < levels[1] < 1.5


def test_halves_show_what_exact_tracks_leave_open() -> None:
    g = torch.Generator().manual_seed(1)
    time = torch.linspace(0, 1, 80, dtype=torch.float64)[:, None, None]
    shape = torch.randn(20, 3, generator=g, dtype=torch.float64)
    for k in range(1, 13):  # ever smaller deformations: no family of few modes holds them all
        wave = torch.sin(torch.pi * (k + 1) * time + 6 * torch.rand(1, generator=g, dtype=torch.float64))
        shape = shape + 0.3 / k**2 * wave * torch.randn(20, 3, generator=g, dtype=torch.float64)
    turn = rotation_from_vector(10 * time[:, 0] * torch.tensor([0.1, 1.0, 0.05], dtype=torch.float64))
    truth = shape @ turn.mT
    truth = truth - truth.mean(1, keepdim=True)
    held = []
    for halves in (0, 2):
        params = MarginalParams(spread=SpreadParams(halves=halves))
        answer = solve_marginal(Tracks(truth[..., :2]), 2, torch.Generator().manual_seed(0), params)
        depth = (answer.points3d - answer.points3d.mean(1, keepdim=True))[..., 2]
        error = depth - truth[..., 2] * (depth * truth[..., 2]).sum().sign()  # the mirror is free
        assert float(error.norm() / truth.norm()) < 0.02
        held.append(float((error.abs() < 1.96 * answer.covariance3d[..., 2, 2].sqrt()).double().mean()))
    assert held[0] < 0.5
    assert held[1] > held[0] + 0.25


def test_deformation_too_weak_for_a_mode_is_in_the_covariance() -> None:
    g = torch.Generator().manual_seed(1)
    time = torch.linspace(0, 1, 150, dtype=torch.float64)[:, None, None]
    truth = torch.randn(40, 3, generator=g, dtype=torch.float64)
    for k in range(40):
        wave = torch.sin(torch.pi * (8 + k) * time + 6 * torch.rand(1, generator=g, dtype=torch.float64))
        truth = truth + 0.03 * wave * torch.randn(40, 3, generator=g, dtype=torch.float64)
    truth = truth @ rotation_from_vector(10 * time[:, 0] * torch.tensor([0.1, 1.0, 0.05], dtype=torch.float64)).mT
    truth = truth - truth.mean(1, keepdim=True)
    noisy = truth[..., :2] + 0.2 * torch.randn(150, 40, 2, generator=g, dtype=torch.float64)
    answer = solve_marginal(Tracks(noisy), 2, torch.Generator().manual_seed(0))
    distances = squared_distances(answer.points3d, answer.covariance3d, truth)
    # without what lasts of the residual it is 0.19
    assert 0.93 < float((distances < LEVELS[0.95]).double().mean()) < 0.99


def test_other_answers_spread_as_far_as_they_are_off_and_cheap() -> None:
    g = torch.Generator().manual_seed(0)
    turns = torch.linspace(0, 3, 60)[:, None] * torch.tensor([0.1, 1.0, 0.0])
    rotations = rotation_from_vector(turns)
    body, wrong = torch.randn(12, 3, generator=g), 0.1 * torch.randn(12, 3, generator=g)
    body, wrong = body - body.mean(0), wrong - wrong.mean(0)
    points, other = body @ rotations.mT, (body + wrong) @ rotations.mT
    every, some = torch.arange(60), torch.arange(0, 60, 6)
    mirrored = points * torch.tensor([1.0, 1.0, -1.0])  # the depth sign is free: that is the same answer
    assert float(between(points, rotations, [(mirrored, every, 0.0)], 1.0).abs().max()) < 1e-12
    whole = between(points, rotations, [(other, every, 0.0)], 1.0)
    away = wrong @ rotations.mT
    torch.testing.assert_close(whole, 0.5 * away[..., :, None] * away[..., None, :])
    # what is constant in the body is known between the frames of a part, from the first to the last of them
    part = between(points, rotations, [(other[some], some, 0.0)], 1.0)
    torch.testing.assert_close(part[:55], whole[:55])
    dear = between(points, rotations, [(other, every, 1.0)], 1.0)
    torch.testing.assert_close(dear, whole * 2 / (1 + math.e))
