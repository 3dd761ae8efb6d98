"""The trajectory likelihood against a dense Gaussian, finite differences and the promise of EM."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.nrsfm import likelihood
from torchrecon.nrsfm.likelihood import (
    CameraPath,
    MotionPrior,
    learn_kernels,
    matern32,
    negative_log_likelihood,
    pack,
    posterior_points,
)
from torchrecon.nrsfm.observations import observe

F, P = 7, 4


def _problem(perspective: bool, classes: int = 2):
    g = torch.Generator().manual_seed(0)
    visible = torch.rand(F, P, generator=g) < 0.7
    k = torch.tensor([[900.0, 0, 300], [0, 900, 200], [0, 0, 1]]) if perspective else None
    xy = 250 + 60 * torch.randn(F, P, 2, generator=g)
    data = observe(Tracks(xy, visible, intrinsics=k))
    turn = rotation_from_vector(torch.linspace(0, 1, F)[:, None] * torch.tensor([0.1, 1.0, 0.2]))
    path = CameraPath(turn, 0.1 * torch.randn(F, 2, generator=g), 0.05 * torch.randn(F, generator=g))
    times = torch.arange(F) / 25.0
    kernels = torch.stack([v * matern32(times, 0.2) + 1e-3 * torch.eye(F) for v in (0.05, 0.5)[:classes]])
    rest = torch.diag(torch.tensor([0.3, 1.5, 0.3]))
    prior = MotionPrior(rest, kernels, torch.full((classes,), -math.log(classes)))
    return data, path, prior


def _reference_nll(data, path, prior, noise):
    """Dense Gaussian of the visible orthographic coordinates, point by point, without shared code."""
    total = torch.zeros(())
    for p in range(P):
        seen = data.visible[:, p].nonzero()[:, 0].tolist()
        if not seen:
            continue
        rows = torch.cat([path.rotations[f, :2] * path.log_scale[f].exp() for f in seen])
        mean = torch.cat([path.translation[f] for f in seen])
        value = torch.cat([data.xy[f, p] for f in seen])
        where = [f for f in seen for _ in range(2)]
        terms = []
        for kernel, share in zip(prior.kernels, prior.log_share, strict=True):
            cov = torch.stack(
                [
                    torch.stack(
                        [a @ (prior.rest + kernel[f, h] * torch.eye(3)) @ b for b, h in zip(rows, where, strict=True)]
                    )
                    for a, f in zip(rows, where, strict=True)
                ]
            )
            cov = cov + noise**2 * torch.eye(len(cov))
            normal = torch.distributions.MultivariateNormal(mean, cov)
            terms.append(normal.log_prob(value) + 0.5 * len(cov) * math.log(2 * math.pi) + share)
        total = total - torch.logsumexp(torch.stack(terms), 0)
    return total


def test_likelihood_is_that_of_a_dense_gaussian():
    data, path, prior = _problem(perspective=False)
    found = negative_log_likelihood(pack(data), path, prior, 0.2)
    torch.testing.assert_close(found, _reference_nll(data, path, prior, 0.2))


@pytest.mark.parametrize("perspective", [False, True])
def test_gradient_is_that_of_finite_differences(perspective):
    data, path, prior = _problem(perspective)

    def cost(vector, shift, log_scale):
        moved = CameraPath(rotation_from_vector(vector) @ path.rotations, path.translation + shift, log_scale)
        return negative_log_likelihood(pack(data), moved, prior, 0.2)

    start = (0.1 * torch.ones(F, 3), torch.zeros(F, 2), path.log_scale.clone())
    assert torch.autograd.gradcheck(cost, tuple(s.requires_grad_() for s in start))


def test_thinned_tracks_use_every_nth_frame_only():
    data, _, _ = _problem(perspective=False)
    packed = pack(data, 3)
    assert bool((packed.frame[packed.seen] % 3 == 0).all())
    assert int(packed.seen.sum()) == int(data.visible[::3].sum())


def test_batches_hold_every_entry_of_every_point_once(monkeypatch):
    data, path, prior = _problem(perspective=False)
    visible = data.visible.clone()
    visible[3:, ::2] = False  # short and long tracks
    packed = pack(replace(data, visible=visible))
    assert sorted(torch.cat([points for points, _ in packed.batches]).tolist()) == list(range(visible.shape[1]))
    assert sum(int(batch.seen.sum()) for _, batch in packed.batches) == int(visible.sum())
    assert len({batch.seen.shape[1] for _, batch in packed.batches}) > 1
    one = posterior_points(packed, path, prior, 0.2)
    monkeypatch.setattr(likelihood, "_BATCH", 1)
    single = pack(replace(data, visible=visible))
    assert len(single.batches) == visible.shape[1]
    for a, b in zip(one, posterior_points(single, path, prior, 0.2), strict=True):
        torch.testing.assert_close(a, b)


def test_learning_kernels_never_lowers_the_likelihood():
    data, path, prior = _problem(perspective=True)
    packed = pack(data)
    before = negative_log_likelihood(packed, path, prior, 0.2)
    for _ in range(4):
        prior = learn_kernels(packed, path, prior, 0.2, weight=0.0, iterations=1)
        after = negative_log_likelihood(packed, path, prior, 0.2)
        assert after < before + 1e-2  # shares are kept off zero, which costs a little
        before = after


def test_posterior_goes_through_precise_observations():
    data, path, prior = _problem(perspective=False)
    canonical, spread, share = posterior_points(pack(data), path, prior, 1e-3)
    placed = canonical @ path.rotations.mT
    image = placed[..., :2] * path.log_scale.exp()[:, None, None] + path.translation[:, None]
    torch.testing.assert_close(image[data.visible], data.xy[data.visible], atol=5e-3, rtol=0)
    torch.testing.assert_close(share.sum(0), torch.ones(P))
    assert bool((torch.linalg.eigvalsh(spread) > 0).all())
