"""The floor of one who knows views and family: exact without noise, in step with it, and below what is solved."""

from __future__ import annotations

import math

import torch

import torchrecon as tr
from eval.floor import known_subspace_floor
from torchrecon.data.views import degrade_tracks
from torchrecon.linalg import rotation_from_vector
from torchrecon.metrics import error3d_camera


def test_floor_is_nothing_without_noise_and_grows_in_step_with_it():
    g = torch.Generator().manual_seed(0)
    time = torch.linspace(0, 1, 60)[:, None, None]
    shape = torch.randn(20, 3, generator=g) + sum(
        0.2 * torch.sin(k * 5 * time) * torch.randn(20, 3, generator=g) for k in (1, 2)
    )
    truth = shape @ rotation_from_vector(6 * time[:, 0] * torch.tensor([0.1, 1.0, 0.0])).mT
    truth = truth - truth.mean(1, keepdim=True)
    size = float(truth[..., :2].abs().max())

    def floor(noise: float, missing: float) -> tuple[float, tr.Tracks]:
        tracks = degrade_tracks(truth[..., :2], noise, missing, generator=torch.Generator().manual_seed(1))
        return known_subspace_floor(tracks, truth, noise * size), tracks

    assert floor(0.0, 0.0)[0] < 1e-4
    levels = [floor(noise, 0.0)[0] for noise in (0.001, 0.01)]
    assert 0.8 < math.log10(levels[1] / levels[0]) < 1.1
    gaps, tracks = floor(0.01, 0.5)
    assert gaps > 1.2 * levels[1]
    blind = tr.reconstruct(tracks, 1, solver="rigid").points3d
    assert gaps < float(error3d_camera(blind, truth))
