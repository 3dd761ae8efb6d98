"""Eqs. 28-29 against hand-written recursions and the Riccati equation solved by scipy."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import torch

from torchrecon.errors import ReconError
from torchrecon.statespace import (
    abg_alpha,
    abg_covariance,
    abg_gains,
    abg_innovation_variance,
    abg_predict,
    abg_tracking_index,
    abg_update,
)


def _reference_kalman(index: float, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Steady-state gain and updated covariance of the discrete Wiener-acceleration model, measurement variance 1."""
    f = np.array([[1, dt, dt * dt / 2], [0, 1, dt], [0, 0, 1]])
    g = np.array([[dt * dt / 2], [dt], [1]])
    h = np.array([[1.0, 0, 0]])
    sigma_w = index / dt**2
    # scaled to per-frame units: the raw equation at dt = .04 is too badly conditioned for the solver
    scale = np.diag([1, 1 / dt, 1 / dt**2])
    inverse = np.diag([1, dt, dt**2])
    fs, gs = inverse @ f @ scale, inverse @ g
    predicted = scipy.linalg.solve_discrete_are(fs.T, h.T, sigma_w**2 * gs @ gs.T, np.eye(1))
    gain = predicted @ h.T / (h @ predicted @ h.T + 1)
    updated = (np.eye(3) - gain @ h) @ predicted
    return (scale @ gain)[:, 0], scale @ updated @ scale


@pytest.mark.parametrize("dt", [1.0, 0.04])
@pytest.mark.parametrize("index", [0.01, 0.1, 1.0, 5.0])
def test_eq29_gains_are_the_steady_state_kalman_gain(index: float, dt: float) -> None:
    gain, covariance = _reference_kalman(index, dt)
    alpha = abg_alpha(index)
    a, b, g = (float(x) for x in abg_gains(alpha))
    np.testing.assert_allclose([a, b / dt, g / (2 * dt**2)], gain, rtol=1e-6)
    np.testing.assert_allclose(abg_covariance(alpha, dt).numpy(), covariance, rtol=1e-5)
    assert float(abg_tracking_index(alpha)) == pytest.approx(index, rel=1e-9)


def test_eq29_halved_gamma_is_not_the_kalman_gain() -> None:
    gain, _ = _reference_kalman(1.0, 1.0)
    a, b, _ = (float(x) for x in abg_gains(abg_alpha(1.0)))
    assert abs(b * b / (2 * a) / 2 - gain[2]) > 0.1 * gain[2]


def test_eq29_printed_form_and_batch() -> None:
    alpha = torch.rand(3, 4) * 0.9 + 0.05
    a, b, g = abg_gains(alpha)
    torch.testing.assert_close(b, 2 * (2 - a) - 4 * torch.sqrt(1 - a))
    torch.testing.assert_close(g, b * b / a)


def test_eq28_predict_and_update_by_hand(generator: torch.Generator) -> None:
    dt, alpha = 0.04, 0.6
    beta = 2 * (2 - alpha) - 4 * (1 - alpha) ** 0.5
    gamma = beta**2 / alpha
    z = torch.randn(5, 2, 7, generator=generator)
    state = torch.zeros(2, 7, 3)
    x, v, a = np.zeros((2, 7)), np.zeros((2, 7)), np.zeros((2, 7))
    for frame in z:
        state = abg_update(abg_predict(state, dt), frame, abg_gains(alpha), dt)
        xp, vp = x + dt * v + dt**2 / 2 * a, v + dt * a
        r = frame.numpy() - xp
        x, v, a = xp + alpha * r, vp + beta / dt * r, a + gamma / (2 * dt**2) * r
    np.testing.assert_allclose(state.numpy(), np.stack([x, v, a], -1), rtol=1e-10)


def test_eq28_follows_a_parabola_exactly_and_coasts() -> None:
    dt = 0.04
    t = torch.arange(200) * dt
    truth = 3 + 20 * t - 4 * t * t
    gains = abg_gains(0.7)
    state = torch.tensor([truth[0].item(), 0.0, 0.0])
    for k in range(1, 150):
        state = abg_update(abg_predict(state, dt), truth[k], gains, dt)
    for _ in range(50):
        state = abg_update(abg_predict(state, dt), torch.tensor(float("nan")), gains, dt)
    assert abs(state[0] - truth[-1]) < 1e-6


def test_innovation_variance_is_what_the_filter_sees(generator: torch.Generator) -> None:
    index, dt = 0.5, 1.0
    alpha = abg_alpha(index)
    gains = abg_gains(alpha)
    true, state = torch.zeros(4000, 3), torch.zeros(4000, 3)
    kick = torch.tensor([dt * dt / 2, dt, 1.0])
    for _ in range(60):
        true = abg_predict(true, dt) + kick * index * torch.randn(4000, 1, generator=generator)
        predicted = abg_predict(state, dt)
        z = true[:, 0] + torch.randn(4000, generator=generator)
        innovation = z - predicted[:, 0]
        state = abg_update(predicted, z, gains, dt)
    expected = float(abg_innovation_variance(alpha, 1.0))
    assert float(innovation.var()) == pytest.approx(expected, rel=0.08)


def test_bad_alpha_is_refused() -> None:
    for alpha in (0.0, 1.0, -2.0, float("nan")):
        with pytest.raises(ReconError, match="alpha"):
            abg_gains(alpha)
    with pytest.raises(ReconError, match="tracking_index"):
        abg_alpha(0.0)
