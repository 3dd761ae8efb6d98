"""Metrics against closed forms, scipy and the figures stored with the public sequences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.metrics import (
    action_error,
    error3d_akhter,
    error3d_camera,
    error3d_camera_frameflip,
    mpjpe,
    nrmse,
    pa_mpjpe,
    procrustes_disparity,
)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_error3d_camera_is_relative_with_one_flip(batch, generator):
    truth = torch.randn(*batch, 6, 9, 3, generator=generator)
    truth = truth - truth.mean(-2, keepdim=True)
    flip = torch.tensor([1.0, 1.0, -1.0])
    assert error3d_camera(truth, truth).shape == batch
    torch.testing.assert_close(error3d_camera(1.1 * truth * flip + 4, truth), torch.full(batch, 0.1))
    scaled = error3d_camera(1.1 * truth, truth, align_scale="sequence")
    torch.testing.assert_close(scaled, torch.zeros(batch), atol=1e-12, rtol=0)


def test_one_flip_per_sequence_is_not_one_per_frame(generator):
    truth = torch.randn(4, 9, 3, generator=generator)
    estimate = truth.clone()
    estimate[:2, :, 2] *= -1
    assert error3d_camera(estimate, truth) > 0.3
    assert error3d_camera_frameflip(estimate, truth) < 1e-12


def test_unseen_entries_do_not_count(generator):
    truth = torch.randn(5, 8, 3, generator=generator)
    visible = torch.rand(5, 8, generator=generator) < 0.7
    estimate = torch.where(visible[..., None], truth + 7.0, torch.nan)
    for metric in (error3d_camera, error3d_akhter, mpjpe, nrmse, pa_mpjpe, procrustes_disparity):
        assert metric(estimate, torch.where(visible[..., None], truth, torch.nan), visible) < 1e-10


def test_nan_is_an_error_not_a_perfect_score(generator):
    truth = torch.randn(3, 5, 3, generator=generator)
    estimate = truth.clone()
    estimate[1, 2, 0] = torch.nan
    with pytest.raises(ReconError, match=r"\(1, 2\)"):
        procrustes_disparity(estimate, truth)


def test_eq31_nrmse_closed_form(generator):
    truth = torch.randn(7, 11, 3, generator=generator)
    truth = truth - truth.mean(-2, keepdim=True)
    noise = torch.randn(7, 11, 3, generator=generator)
    noise = noise - noise.mean(-2, keepdim=True)
    expected = 100 * (noise.square().sum(-1).mean() / truth.square().sum(-1).mean()).sqrt()
    torch.testing.assert_close(nrmse(truth + 0.01 * noise, truth), 0.01 * expected)


def test_action_error_counts():
    assert action_error(torch.tensor([[0, 1], [2, 2]]), torch.tensor([[0, 0], [1, 1]])).tolist() == [50.0, 100.0]
    with pytest.raises(ReconError, match="window"):
        action_error(torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long))


def test_procrustes_disparity_is_scipys_without_reflection(generator):
    from scipy.spatial import procrustes

    truth = torch.randn(1, 9, 3, generator=generator)
    estimate = truth @ rotation_from_vector(torch.tensor([0.3, -0.4, 0.9])).mT
    estimate = 2 * estimate + 0.3 * torch.randn(1, 9, 3, generator=generator)
    _, _, expected = procrustes(truth[0].numpy(), estimate[0].numpy())
    np.testing.assert_allclose(procrustes_disparity(estimate, truth).item(), expected, rtol=1e-9)
    mirrored = truth * torch.tensor([1.0, 1.0, -1.0])
    assert procrustes(truth[0].numpy(), mirrored[0].numpy())[2] < 1e-12
    assert procrustes_disparity(mirrored, truth) > 0.05


def test_pa_mpjpe_removes_a_similarity_and_mpjpe_does_not(generator):
    truth = torch.randn(3, 6, 3, generator=generator)
    moved = 1.7 * truth @ rotation_from_vector(torch.tensor([0.1, 0.8, 0.2])).mT + 5
    assert pa_mpjpe(moved, truth) < 1e-12
    assert mpjpe(moved, truth) > 0.3


@pytest.mark.data
def test_akhter_metric_reproduces_the_stored_pta_results(data_dir):
    from scipy.io import loadmat

    expected = {"drink": 0.0250, "pickup": 0.2369, "yoga": 0.1625, "stretch": 0.1088, "dance": 0.2956}
    for name, figure in expected.items():
        content = loadmat(data_dir / "nrsfm" / "akhter" / f"{name}.mat")
        truth, stored = (
            torch.from_numpy(np.asarray(content[key], np.float64)).unflatten(0, (-1, 3)).mT for key in ("S", "Shat")
        )
        centred = truth - truth.mean(-2, keepdim=True)
        sigma = centred.std(-2, correction=0).mean()
        assert abs(float(error3d_akhter(stored * sigma, truth)) - figure) < 1e-4, name
