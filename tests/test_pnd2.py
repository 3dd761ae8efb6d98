"""The Procrustean normal distribution against dense Gaussian algebra."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import multivariate_normal

from torchrecon.linalg import rotation_from_vector
from torchrecon.nrsfm.pnd2 import Pnd2Params, ProcrusteanNormal, fit_procrustean, similarity_tangents


def _model(frames: int = 4, points: int = 6, rank: int = 3) -> tuple[ProcrusteanNormal, torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    mean = torch.randn(points, 3, generator=g)
    mean = mean - mean.mean(0)
    loads = 0.3 * torch.randn(points * 3, rank, generator=g)
    tangents = similarity_tangents(mean)
    loads = loads - tangents @ (tangents.mT @ loads)
    model = ProcrusteanNormal(
        rotation_from_vector(torch.randn(frames, 3, generator=g)),
        1 + 0.2 * torch.rand(frames, generator=g),
        0.1 * torch.randn(frames, 2, generator=g),
        mean,
        loads.view(points, 3, rank),
    )
    return model, torch.randn(frames, points, 2, generator=g), torch.rand(frames, points, generator=g) < 0.7


def _reference(model: ProcrusteanNormal, xy, seen, eps: float, frame: int):
    """Dense mean and covariance of the camera-frame shape, conditioned on what is seen (plus the log density)."""
    points = xy.shape[1]
    turn = torch.kron(torch.eye(points), model.rotations[frame]) * model.scale[frame]
    flat = model.loadings.flatten(0, 1)
    centre = turn @ model.mean.flatten()
    covariance = turn @ (flat @ flat.mT + eps**2 * torch.eye(3 * points)) @ turn.mT
    rows = [3 * p + a for p in range(points) for a in (0, 1) if seen[frame, p]]
    value = torch.stack([(xy[frame, r // 3] - model.translation[frame])[r % 3] for r in rows])
    inner = covariance[rows][:, rows]
    gain = covariance[:, rows] @ torch.linalg.inv(inner)
    density = multivariate_normal(centre[rows].numpy(), inner.numpy()).logpdf(value.numpy())
    return (centre + gain @ (value - centre[rows])).view(points, 3), density


@pytest.mark.parametrize("complete", [True, False])
def test_likelihood_and_expected_shapes_are_those_of_the_dense_gaussian(complete):
    model, xy, seen = _model()
    seen = torch.ones_like(seen) if complete else seen
    _, expected, cost, converged = fit_procrustean(xy, seen, model, 0, Pnd2Params(eps_fine=0.1), anneal=False)
    density = 0.0
    for frame in range(len(xy)):
        shape, log_density = _reference(model, xy, seen, 0.1, frame)
        torch.testing.assert_close(expected[frame], shape)
        density += float(log_density)
    constant = 2 * float(seen.sum()) * torch.log(torch.tensor(2 * torch.pi))
    torch.testing.assert_close(cost * len(xy) + constant, torch.tensor(-2 * density))
    assert not converged


def test_a_step_raises_the_likelihood_and_keeps_off_the_tangents():
    model, xy, seen = _model(frames=30)
    params = Pnd2Params(eps_fine=0.3)
    costs = []
    for _ in range(6):
        model, _, cost, _ = fit_procrustean(xy, seen, model, 5, params, anneal=False)
        costs.append(float(cost))
    assert costs[-1] < costs[0] - 0.1
    deformation = model.loadings.flatten(0, 1)
    assert (similarity_tangents(model.mean).mT @ deformation).abs().max() < 1e-10
    torch.testing.assert_close(model.scale.log().mean(), torch.zeros(()))


def test_gaps_and_batches_follow_the_same_path():
    model, xy, _ = _model(frames=10)
    full = torch.ones(10, 6, dtype=torch.bool)
    hole = full.clone()
    hole[3, 2] = False
    params = Pnd2Params(eps_fine=0.2)
    one, _, _, _ = fit_procrustean(xy, full, model, 3, params, anneal=False)
    other, _, _, _ = fit_procrustean(xy, hole, model, 3, params, anneal=False)
    pair = ProcrusteanNormal(*(torch.stack([value, value]) for value in (vars(model)[name] for name in vars(model))))
    both, _, _, _ = fit_procrustean(torch.stack([xy, xy]), torch.stack([full, hole]), pair, 3, params, anneal=False)
    torch.testing.assert_close(both.mean, torch.stack([one.mean, other.mean]), atol=1e-6, rtol=0)
    torch.testing.assert_close(both.rotations, torch.stack([one.rotations, other.rotations]), atol=1e-6, rtol=0)
