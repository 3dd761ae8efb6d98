"""Smoothing of noisy tracks over time."""

from __future__ import annotations

import pytest
import torch

from torchrecon.linalg.noise_edge import difference_noise
from torchrecon.nrsfm.shape_likelihood import Views
from torchrecon.nrsfm.smoothing import smoothed


def waves(frames: int, points: int, generator: torch.Generator) -> torch.Tensor:
    """Slow paths of rms size one (frames, points, 2)."""
    time = torch.linspace(0, 1, frames, dtype=torch.float64)[:, None, None]
    phase = 6 * torch.rand(4, points, 2, generator=generator, dtype=torch.float64)
    return sum((2 * torch.pi * (k + 1) * time + phase[k]).sin() for k in range(4)) / 2**0.5


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_what_is_left_of_the_noise_is_what_is_said(generator, share):
    exact = waves(240, 60, generator)
    noise = 0.05
    xy = exact + noise * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    visible = torch.rand(240, 60, generator=generator) < share
    covariance = noise**2 * torch.eye(2, dtype=torch.float64).expand(240, 60, 2, 2)
    complete = torch.where(visible[..., None], xy, exact)
    calm = smoothed(Views(xy, visible, covariance), complete)
    left = (calm.xy - exact)[visible].square().mean()
    assert float(left) < 0.35 * noise**2
    said = calm.noise.diagonal(dim1=-2, dim2=-1).mean(-1)[visible].mean()
    assert float(said) == pytest.approx(float(left), rel=0.3)
    assert torch.equal(calm.visible, visible)


def test_exact_tracks_pass_as_they_are(generator):
    exact = waves(100, 20, generator)
    views = Views(exact, torch.ones(100, 20, dtype=torch.bool), torch.zeros(100, 20, 2, 2, dtype=torch.float64))
    assert smoothed(views, exact) is views


def test_shuffled_frames_pass_as_they_are(generator):
    exact = waves(200, 30, generator)[torch.randperm(200, generator=generator)]
    noise = 0.02**2 * torch.eye(2, dtype=torch.float64).expand(200, 30, 2, 2)
    xy = exact + 0.02 * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    views = Views(xy, torch.ones(200, 30, dtype=torch.bool), noise)
    assert smoothed(views, xy) is views


def test_a_body_that_stands_still_under_noise_passes_as_it_is(generator):
    xy = torch.randn(1, 1000, 2, generator=generator, dtype=torch.float64)
    xy = xy + 0.05 * torch.randn(40, 1000, 2, generator=generator, dtype=torch.float64)
    noise = 0.05**2 * torch.eye(2, dtype=torch.float64).expand(40, 1000, 2, 2)
    views = Views(xy, torch.ones(40, 1000, dtype=torch.bool), noise)
    assert smoothed(views, xy) is views


def test_third_differences_read_the_noise_through_gaps(generator):
    exact = waves(300, 40, generator)
    xy = exact + 0.03 * torch.randn(exact.shape, generator=generator, dtype=torch.float64)
    visible = torch.rand(300, 40, generator=generator) < 0.7
    xy[~visible] = torch.nan
    assert float(difference_noise(xy, visible).sqrt()) == pytest.approx(0.03, rel=0.03)
    assert difference_noise(xy[:3], visible[:3]) == torch.inf
