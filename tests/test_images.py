"""MSE, PSNR and SSIM against scipy and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from torchrecon.errors import ReconError
from torchrecon.metrics import mse, psnr, ssim


def _reference_ssim(x: np.ndarray, y: np.ndarray, peak: float) -> float:
    """Wang et al. 2004 by separable correlation with a Gaussian cut at 5 pixels, windows inside the picture only."""

    def mean(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, 1.5, truncate=3.5)[5:-5, 5:-5]

    c1, c2 = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    return float(np.mean((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))))


@pytest.fixture
def pair(generator):
    truth = torch.rand(2, 3, 24, 31, generator=generator)
    return (truth + 0.1 * torch.randn(truth.shape, generator=generator)).clamp(0, 1), truth


def test_eq34_mse_is_the_mean_of_squares(pair):
    picture, truth = pair
    expected = np.mean((picture.numpy() - truth.numpy()) ** 2, axis=(-1, -2))
    np.testing.assert_allclose(mse(picture, truth).numpy(), expected, rtol=1e-12)
    noise = 0.05 * torch.ones(8, 8) * torch.tensor([1.0, -1.0]).repeat(4)
    assert math.isclose(float(mse(0.5 + noise, torch.full((8, 8), 0.5))), 0.0025)


@pytest.mark.parametrize("peak", [1.0, 255.0])
def test_eq32_psnr_is_minus_ten_log_mse_of_the_unit_range(pair, peak):
    picture, truth = pair
    torch.testing.assert_close(psnr(picture, truth), -10 * torch.log10(mse(picture, truth)))
    # The unit of intensity does not matter as long as the peak goes with it.
    torch.testing.assert_close(psnr(peak * picture, peak * truth, peak), psnr(picture, truth))
    assert math.isinf(float(psnr(truth[0, 0], truth[0, 0])))


def test_eq32_eq34_the_papers_two_tables_contradict_each_other():
    # Tables 3 and 5, first and last row of frame 50: what peak would make MSE .93 and PSNR 70.56 one picture?
    implied = [math.sqrt(error * 10 ** (ratio / 10)) for ratio, error in ((70.56, 0.93), (93.55, 0.09))]
    assert 3.2e3 < implied[0] < 3.3e3
    assert implied[1] > 4 * implied[0]


@pytest.mark.parametrize("peak", [1.0, 255.0])
def test_eq33_ssim_agrees_with_an_independent_filter(pair, peak):
    picture, truth = (peak * value for value in pair)
    found = ssim(picture, truth, peak)
    assert found.shape == (2, 3)
    for index in np.ndindex(2, 3):
        expected = _reference_ssim(picture[index].numpy(), truth[index].numpy(), peak)
        assert math.isclose(float(found[index]), expected, abs_tol=1e-9)


def test_eq33_ssim_is_symmetric_one_for_equals_and_falls_with_noise(pair, generator):
    picture, truth = pair
    torch.testing.assert_close(ssim(picture, truth), ssim(truth, picture))
    torch.testing.assert_close(ssim(truth, truth), torch.ones(2, 3))
    noise = torch.randn(truth.shape, generator=generator)
    worse = torch.stack([ssim(truth + s * noise, truth) for s in (0.02, 0.1, 0.5)])
    assert (worse.diff(dim=0) < 0).all()
    assert ssim(truth.float(), truth.float()).dtype == torch.float32


def test_unusable_pictures_are_refused(pair):
    picture, truth = pair
    holed = picture.clone()
    holed[1, 2, 3, 4] = torch.nan
    for metric in (mse, psnr, ssim):
        with pytest.raises(ReconError, match=r"\(1, 2, 3, 4\)"):
            metric(holed, truth)
    with pytest.raises(ReconError, match="window"):
        ssim(truth[..., :10], truth[..., :10])
    with pytest.raises(ReconError, match="peak"):
        psnr(picture, truth, peak=0.0)
