"""The kernel dynamical model against closed forms, batch least squares and other predictors; repair of silhouettes."""

from __future__ import annotations

import math

import pytest
import torch

from torchrecon.contour import KernelDynamics, fill_outline, mask_outline, repair_silhouettes
from torchrecon.errors import ReconError
from torchrecon.statespace.linear_gaussian import LinearModel, smooth_states


def _limit_cycle(frames: int, generator: torch.Generator, noise: float) -> torch.Tensor:
    """A pendulum with large swings, angle and angular speed, sampled every 0.35 of its unit of time."""
    state = torch.tensor([2.6, 0.0])
    out = []
    for _ in range(frames):
        for _ in range(7):
            velocity = state[1] - 0.05 * torch.sin(state[0])
            state = torch.stack([state[0] + 0.05 * velocity, velocity])
        out.append(state)
    clean = torch.stack(out)
    return clean + noise * torch.randn(clean.shape, generator=generator)


def test_eq6_rbf_predicts_a_pendulum_better_than_a_linear_model(generator):
    x = _limit_cycle(300, generator, noise=0.02)
    train, test = x[:200], x[200:]

    def one_step_error(model: KernelDynamics) -> float:
        z = model.encode(test[:-1])
        return float((model.decode(z @ model.step.mT + model.offset) - test[1:]).square().mean().sqrt())

    rbf = one_step_error(KernelDynamics("rbf", n_components=12, ridge=1e-6).fit(train))
    linear = one_step_error(KernelDynamics("linear", n_components=2, ridge=1e-6).fit(train))
    now = torch.cat([train[:-1], torch.ones(199, 1)], 1)
    weights = torch.linalg.lstsq(now, train[1:]).solution
    plain = float((torch.cat([test[:-1], torch.ones(99, 1)], 1) @ weights - test[1:]).square().mean().sqrt())
    assert rbf < 0.5 * plain
    # the linear kernel is the linear model
    assert linear == pytest.approx(plain, rel=0.02)


def test_eq7_linear_kernel_has_the_eigenvalues_of_the_system(generator):
    a = torch.tensor([[0.95, -0.25, 0.0], [0.25, 0.95, 0.1], [0.0, 0.0, 0.8]])
    b = torch.tensor([0.3, -0.1, 0.2])
    x = [torch.tensor([1.0, 2.0, -1.0])]
    for _ in range(40):
        x.append(a @ x[-1] + b)
    lift, _ = torch.linalg.qr(torch.randn(10, 3, generator=generator))
    model = KernelDynamics("linear", n_components=3, ridge=1e-13).fit(torch.stack(x) @ lift.mT)

    def sort(values: torch.Tensor) -> torch.Tensor:
        return torch.view_as_real(values)[torch.view_as_real(values)[:, 1].argsort()]

    assert torch.allclose(sort(torch.linalg.eigvals(model.step)), sort(torch.linalg.eigvals(a)), atol=1e-6)


@pytest.mark.parametrize(("kernel", "components"), [("linear", 6), ("rbf", 39)])
def test_eq7_full_rank_reconstructs_what_was_learnt(kernel, components, generator):
    x = torch.randn(40, 6, generator=generator)
    model = KernelDynamics(kernel, components, pre_image_ridge=1e-10).fit(x)
    assert torch.allclose(model.decode(model.encode(x)), x, atol=1e-5)


def test_eq7_novelty_and_deviation_are_largest_at_the_corrupted_frame(generator):
    t = torch.arange(80.0)[:, None]
    x = torch.cat([torch.sin(0.2 * t + p) for p in (0.0, 1.0, 2.0, 4.0)], 1)
    x = x + 0.01 * torch.randn(x.shape, generator=generator)
    bad = x.clone()
    bad[37] += torch.tensor([0.5, -0.4, 0.3, 0.5])
    for kernel in ("rbf", "linear"):
        model = KernelDynamics(kernel, 2 if kernel == "linear" else 5, ridge=1e-6).fit(x)
        assert int(model.novelty(bad).argmax()) == 37
        # a frame judged by its neighbours does not make them look bad
        deviation = model.deviation(bad)
        assert int(deviation.argmax()) == 37
        seen = torch.ones(80, dtype=torch.bool)
        seen[37] = False
        assert int(model.deviation(bad, seen).argmax()) == 37


def test_smoothing_fills_what_was_not_seen_and_never_reads_it():
    angle = 0.25 * torch.arange(60.0)[:, None]
    x = torch.cat([angle.cos(), angle.sin(), (2 * angle).cos()], 1)
    seen = torch.ones(60, dtype=torch.bool)
    seen[[10, 25, 26, 27, 44]] = False
    model = KernelDynamics("rbf", 8, ridge=1e-4).fit(torch.where(seen[:, None], x, torch.nan), seen)
    smooth = model.smooth(torch.where(seen[:, None], x, torch.nan), seen)
    assert float((smooth - x).norm(dim=1).max()) < 0.1
    assert torch.equal(smooth, model.smooth(torch.where(seen[:, None], x, 9.0), seen))


def test_deviation_is_the_leave_one_out_error_of_the_smoother(generator):
    x = torch.randn(30, 2, generator=generator).cumsum(0)
    model = KernelDynamics("linear", 2, ridge=1e-3).fit(x)
    z = model.encode(x)
    deviation = model.deviation(x)
    for t in (0, 13, 29):
        seen = torch.arange(30) != t
        states, noise = model._smooth(z, seen)
        error = z[t] - states.mean[t]
        expected = error @ torch.linalg.solve(states.covariance[t] + noise, error)
        assert float(deviation[t]) == pytest.approx(float(expected), rel=1e-4, abs=1e-6)


def test_smoothed_states_are_the_solution_of_one_large_least_squares_problem(generator):
    def spd(size: int) -> torch.Tensor:
        root = torch.randn(size, size, generator=generator)
        return root @ root.mT + 0.1 * torch.eye(size)

    model = LinearModel(
        0.5 * torch.randn(2, 2, generator=generator), torch.tensor([0.3, -0.2]), spd(2), spd(2), torch.ones(2), spd(2)
    )
    frames = 6
    seen = torch.tensor([False, True, True, False, True, False])
    values = torch.randn(frames, 2, generator=generator)
    information, right = torch.zeros(12, 12), torch.zeros(12)

    def add(rows: torch.Tensor, target: torch.Tensor, covariance: torch.Tensor) -> None:
        weight = torch.linalg.inv(covariance)
        information.add_(rows.mT @ weight @ rows)
        right.add_(rows.mT @ weight @ target)

    pick = torch.eye(12).reshape(frames, 2, 12)
    add(pick[0], model.mean, model.spread)
    for t in range(1, frames):
        add(pick[t] - model.step @ pick[t - 1], model.offset, model.process)
    for t in seen.nonzero()[:, 0].tolist():
        add(pick[t], values[t], model.noise)
    out = smooth_states(values, seen, model)
    covariance = torch.linalg.inv(information)
    assert torch.allclose(out.mean.flatten(), covariance @ right)
    blocks = torch.stack([covariance[2 * t : 2 * t + 2, 2 * t : 2 * t + 2] for t in range(frames)])
    assert torch.allclose(out.covariance, blocks)


def test_fitted_model_survives_its_state_dict(generator):
    x = torch.randn(20, 4, generator=generator).cumsum(0)
    model = KernelDynamics("rbf", 4).fit(x)
    again = KernelDynamics("rbf", 4)
    again.load_state_dict(model.state_dict())
    assert torch.equal(again.predict(3), model.predict(3))


def test_what_cannot_be_learnt_is_named():
    with pytest.raises(ReconError, match="call fit first"):
        KernelDynamics().predict(1)
    with pytest.raises(ReconError, match="pairs"):
        KernelDynamics().fit(torch.randn(3, 2))
    with pytest.raises(ReconError, match="equal"):
        KernelDynamics().fit(torch.ones(9, 2))
    with pytest.raises(ReconError, match="frame 4"):
        KernelDynamics().fit(torch.cat([torch.randn(4, 2), torch.full((5, 2), torch.nan)]))
    with pytest.raises(ReconError, match="n_components"):
        KernelDynamics("rbf", 0)
    with pytest.raises(ReconError, match="8 are needed"):
        repair_silhouettes(torch.ones(5, 20, 20, dtype=torch.bool))


def _waving(frames: int) -> torch.Tensor:
    """A body with an arm that swings, drifting to the right: 90 x 110 pixels."""
    t = torch.arange(frames) / 6.0
    angle = 0.7 * torch.sin(t)
    centre = torch.stack([45 + 1.2 * torch.arange(frames), torch.full((frames,), 50.0)], -1)
    body = torch.tensor([[-8.0, -30.0], [8.0, -30.0], [10.0, 30.0], [-10.0, 30.0]])
    arm = torch.tensor([[0.0, -4.0], [26.0, -4.0], [26.0, 4.0], [0.0, 4.0]])
    turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).reshape(-1, 2, 2)
    swung = arm @ turn.mT + torch.tensor([6.0, -15.0])
    return fill_outline(body + centre[:, None], (90, 110)) | fill_outline(swung + centre[:, None], (90, 110))


def test_repair_lowers_the_contour_error_and_leaves_good_frames_alone():
    truth = _waving(36)
    bad = truth.clone()
    bad[[4, 11, 17, 18, 25, 31]] = False
    bad[7, 20:40, 40:62] = False
    bad[21, 66:90, 60:82] = False
    bad[14, 30:60, 80:95] = True
    bad[28, 5:25, 62:75] = True
    damaged = (bad ^ truth).flatten(1).any(1)
    out = repair_silhouettes(bad)

    def error(masks: torch.Tensor) -> torch.Tensor:
        distance = torch.cdist(mask_outline(masks, 120), mask_outline(truth, 120))
        return (distance.amin(1).mean(1) + distance.amin(2).mean(1)) / 2

    held = bad.clone()
    for t in range(36):
        if not held[t].any():
            held[t] = held[t - 1]
    assert float(error(out.masks).mean()) < 0.6 * float(error(held).mean())
    assert float(error(out.masks)[~damaged].mean()) < 0.1
    assert bool(out.replaced[[4, 17, 31]].all())
    assert torch.equal(out.novelty.isnan(), ~bad.flatten(1).any(1))
    judged = out.novelty.nan_to_num()
    assert float(judged[damaged].max()) > float(judged[~damaged].max())
    assert math.isfinite(float(judged.max()))
