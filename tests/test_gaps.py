"""Eqs. 28-30 and the fillers that replace them."""

from __future__ import annotations

import math

import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.gaps import METHODS, GapParams, fill_gaps, neighbour_covariance
from torchrecon.gaps.base import gap_lengths, open_gaps
from torchrecon.measurement import Tracks
from torchrecon.statespace import abg_gains, abg_predict, abg_update, rts_smooth


def _joints(frames: int = 80, points: int = 14, seed: int = 0, noise: float = 0.5) -> tuple[torch.Tensor, torch.Tensor]:
    """Smooth joint-like motion of low rank about a moving body: truth and noisy measurement, pixels."""
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(frames) / 25
    rates = 0.4 + 1.2 * torch.rand(4, generator=g)
    modes = torch.stack([torch.sin(2 * math.pi * r * t + 6.28 * torch.rand(1, generator=g)) for r in rates])
    shape = 80 * torch.randn(points, 2, generator=g)
    swing = 25 * torch.randn(4, points, 2, generator=g)
    path = torch.stack([60 * t, 20 * torch.sin(2 * t)], -1) + 300
    truth = path[:, None] + shape + torch.einsum("kf,kpc->fpc", modes, swing)
    return truth, truth + noise * torch.randn(truth.shape, generator=g)


def _hide(frames: int, points: int, start: int, length: int, lost: int = 1) -> torch.Tensor:
    visible = torch.ones(frames, points, dtype=torch.bool)
    visible[start : start + length, :lost] = False
    return visible


def _rms(filled: torch.Tensor, truth: torch.Tensor, visible: torch.Tensor) -> float:
    return float(((filled - truth)[~visible] ** 2).mean().sqrt())


def test_eq28_abg_fill_is_the_coasting_filter_of_one_point() -> None:
    _, xy = _joints()
    visible = _hide(80, 14, 40, 6)
    filled = fill_gaps(Tracks(xy, visible), "abg")
    coast = filled.xy[40:46, 0]
    # constant acceleration while coasting: the third difference is zero
    torch.testing.assert_close(coast.diff(dim=0).diff(dim=0).diff(dim=0), torch.zeros(3, 2), atol=1e-8, rtol=0)
    errors = []
    for alpha in (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95):
        state = torch.cat([xy[1, 0, :, None], (xy[1, 0] - xy[0, 0])[:, None], torch.zeros(2, 1)], -1)
        for frame in range(2, 40):
            state = abg_update(abg_predict(state, 1.0), xy[frame, 0], abg_gains(alpha), 1.0)
        errors.append(float((abg_predict(state, 1.0)[:, 0] - coast[0]).abs().max()))
    assert min(errors) < 1e-9


def test_eq28_abg_is_causal_and_runs_backward_only_before_the_start() -> None:
    _, xy = _joints()
    visible = _hide(80, 14, 40, 5)
    future = xy.clone()
    future[60:] += 100.0
    params_free = [fill_gaps(Tracks(x, visible), "rts").xy[40:45, 0] for x in (xy, future)]
    assert not torch.equal(*params_free)  # the smoother does look ahead
    params = GapParams(alpha=0.7)
    past = [fill_gaps(Tracks(x, visible), "abg", params).xy[40:45, 0] for x in (xy, future)]
    assert torch.equal(*past)
    late = _hide(80, 14, 0, 8)
    mirrored = fill_gaps(Tracks(xy.flip(0), late.flip(0)), "abg", params).xy.flip(0)
    torch.testing.assert_close(fill_gaps(Tracks(xy, late), "abg", params).xy[:8, 0], mirrored[:8, 0])


def test_eq30_one_frame_gap_is_the_mean_of_the_neighbours_in_time() -> None:
    g = torch.Generator().manual_seed(0)
    a = torch.randn(9, 3, 2, 2, generator=g)
    q = a @ a.transpose(-1, -2) + 0.2 * torch.eye(2)
    visible = torch.ones(9, 3, dtype=torch.bool)
    visible[4, 1] = False
    visible[6:, 2] = False
    out = neighbour_covariance(q, visible, torch.arange(9.0))
    torch.testing.assert_close(out[4, 1], (q[3, 1] + q[5, 1]) / 2)
    torch.testing.assert_close(out[7, 2], q[5, 2])
    torch.testing.assert_close(out[visible], q[visible])
    printed = q[3, 1] @ q[5, 1] / 2
    assert float((printed - printed.T).abs().max()) > 0.01  # what the paper prints is no covariance


@pytest.mark.parametrize("method", METHODS)
def test_eq30_covariance_is_spd_and_grows_into_the_gap(method: str) -> None:
    _, xy = _joints()
    visible = _hide(80, 14, 30, 9)
    covariance = (0.25 * torch.eye(2)).expand(80, 14, 2, 2)
    filled = fill_gaps(Tracks(xy, visible, covariance=covariance), method)
    assert (torch.linalg.eigvalsh(filled.covariance) > 0).all()
    size = filled.covariance[30:39, 0].diagonal(dim1=-2, dim2=-1).sum(-1)
    assert (size > 0.5).all()
    rising = size if method == "abg" else size[:5]
    assert (rising.diff() >= 0).all()
    if method == "rts":
        torch.testing.assert_close(size, size.flip(0), rtol=0.2, atol=0)
    torch.testing.assert_close(filled.covariance[visible], covariance[visible])


@pytest.mark.parametrize("method", METHODS)
def test_contract_of_every_filler(method: str) -> None:
    _, xy = _joints()
    visible = _hide(80, 14, 30, 4) & _hide(80, 14, 0, 6, 3) & _hide(80, 14, 70, 10, 2)
    poisoned = torch.where(visible[..., None], xy, torch.tensor(1e5))
    filled = fill_gaps(Tracks(poisoned, visible), method)
    assert torch.equal(filled.xy[visible], xy[visible])
    assert torch.equal(filled.filled, ~visible)
    assert torch.isfinite(filled.xy).all()
    assert torch.isfinite(filled.covariance).all()
    assert torch.equal(filled.xy, fill_gaps(Tracks(xy, visible), method).xy)
    assert not filled.low_confidence[visible].any()
    ends = ~visible
    ends[30:34] = False
    assert filled.low_confidence[ends].all()
    batch = fill_gaps(Tracks(torch.stack([xy, xy + 5]), torch.stack([visible, visible])), method)
    torch.testing.assert_close(batch.xy[1], batch.xy[0] + 5, atol=0.2, rtol=0)
    assert batch.covariance.shape == (2, 80, 14, 2, 2)
    assert fill_gaps(Tracks(xy.float(), visible), method).xy.dtype == torch.float32


def test_nothing_to_fill_changes_nothing() -> None:
    _, xy = _joints()
    for method in METHODS:
        filled = fill_gaps(Tracks(xy), method)
        assert torch.equal(filled.xy, xy)
        assert not filled.filled.any()


def test_smoother_beats_coasting_and_low_rank_beats_both_in_long_gaps() -> None:
    errors: dict[tuple[str, int], float] = {}
    for length in (1, 8):
        for method in ("abg", "rts", "auto"):
            squares = []
            for seed in range(4):
                truth, xy = _joints(seed=seed)
                visible = _hide(80, 14, 20 + 5 * seed, length, lost=2)
                squares.append(_rms(fill_gaps(Tracks(xy, visible), method).xy, truth, visible) ** 2)
            errors[method, length] = (sum(squares) / len(squares)) ** 0.5
        assert errors["rts", length] < errors["abg", length]
    assert errors["auto", 1] < 1.05 * errors["rts", 1] < 1.0
    assert errors["auto", 8] < min(2.0, errors["rts", 8])


def test_filled_values_are_about_as_far_off_as_they_say() -> None:
    ratios = []
    for seed in range(12):
        _, xy = _joints(seed=seed)
        visible = _hide(80, 14, 15 + seed, 2, lost=3)
        filled = fill_gaps(Tracks(xy, visible), "rts")
        # the covariance holds the neighbours' measurement noise as well, so compare with a measurement, not the truth
        error2 = ((filled.xy - xy)[~visible] ** 2).sum(-1)
        ratios.append(error2 / filled.covariance[~visible].diagonal(dim1=-2, dim2=-1).sum(-1))
    assert 0.5 < float(torch.cat(ratios).mean()) < 2.0


def test_values_that_cannot_be_known_are_flagged() -> None:
    # independent noise: nothing is shared between points or frames
    xy = 60 * torch.randn(80, 14, 2, generator=torch.Generator().manual_seed(0))
    visible = _hide(80, 14, 30, 8, lost=2)
    filled = fill_gaps(Tracks(xy, visible), "auto")
    assert filled.low_confidence[~visible].all()
    wide = filled.covariance[~visible].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    assert float(wide.mean()) > 40


def test_band_shaped_visibility_is_completed_from_the_shared_motion() -> None:
    truth, xy = _joints(60, 200)
    g = torch.Generator().manual_seed(1)
    start = torch.randint(-10, 50, (200,), generator=g)
    frame = torch.arange(60)[:, None]
    visible = (frame >= start) & (frame < start + torch.randint(15, 40, (200,), generator=g))
    keep = visible.sum(0) > 4
    truth, xy, visible = truth[:, keep], xy[:, keep], visible[:, keep]
    tracks = Tracks(xy, visible)
    low_rank = _rms(fill_gaps(tracks, "auto").xy, truth, visible)
    assert low_rank < 0.5 * _rms(fill_gaps(tracks, "rts").xy, truth, visible)
    assert low_rank < 0.1 * _rms(fill_gaps(tracks, "abg").xy, truth, visible)


def test_rts_smoother_equals_the_dense_least_squares_solution() -> None:
    g = torch.Generator().manual_seed(0)
    frames, index, sigma = 12, 0.3, 0.7
    z = torch.randn(frames, generator=g).cumsum(0)
    seen = torch.ones(frames, dtype=torch.bool)
    seen[[4, 5, 6]] = False
    step = torch.tensor([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    kick = torch.tensor([0.5, 1.0, 1.0])
    # unknowns: the start state and one kick per frame; the state is linear in them
    maps = [torch.cat([torch.eye(3), torch.zeros(3, frames - 1)], 1)]
    for f in range(frames - 1):
        following = step @ maps[-1]
        following[:, 3 + f] += kick
        maps.append(following)
    design = torch.stack([m[0] for m in maps])
    prior = torch.diag(torch.tensor([0.0, 1e-6, 1e-4] + [1 / index**2] * (frames - 1))) / sigma**2
    normal = design[seen].T @ design[seen] / sigma**2 + prior
    solution = design @ torch.linalg.solve(normal, design[seen].T @ z[seen] / sigma**2)
    spread = (design @ torch.linalg.inv(normal) @ design.T).diagonal()
    out = rts_smooth(z[:, None, None], seen[:, None], torch.full((frames, 1), sigma**2), torch.tensor([index]))
    torch.testing.assert_close(out.position[:, 0, 0], solution, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(out.variance[:, 0], spread, atol=1e-5, rtol=1e-4)


def test_gap_bookkeeping_and_errors() -> None:
    visible = torch.tensor([[True, False], [False, True], [False, False], [True, True]])
    assert gap_lengths(visible).T.tolist() == [[0, 2, 2, 0], [1, 0, 1, 0]]
    xy = torch.rand(4, 2, 2)
    gaps = open_gaps(Tracks(xy, visible))
    assert gaps.inside.T.tolist() == [[False, True, True, False], [False, False, True, False]]
    with pytest.raises(ReconError, match="point 1"):
        fill_gaps(Tracks(xy, visible & torch.tensor([True, False])))
    with pytest.raises(ReconError, match="method"):
        fill_gaps(Tracks(xy, visible), "magic")
    one = fill_gaps(Tracks(torch.rand(1, 3, 2)))
    assert one.xy.shape == (1, 3, 2)


def test_a_gap_in_which_nothing_went_on_as_before_is_doubtful_as_a_whole_and_an_easy_one_is_not() -> None:
    swing = 60 * torch.exp(-(((torch.arange(80.0) - 37) / 3) ** 2))
    doubted, easy = 0, 0
    for seed in range(6):
        truth, xy = _joints(seed=seed)
        visible = _hide(80, 14, 60, 2)
        easy += int(fill_gaps(Tracks(xy, visible), "auto").low_confidence.any())
        truth[:, 0, 0] += swing  # out and back while the point is hidden
        xy[:, 0, 0] += swing
        visible = _hide(80, 14, 30, 14)
        filled = fill_gaps(Tracks(xy, visible), "auto")
        assert float((filled.xy - truth)[30:44, 0].norm(dim=-1).max()) > 10
        assert not filled.low_confidence[visible].any()
        flags = filled.low_confidence[30:44, 0]
        assert flags.all() or not flags.any()
        doubted += int(flags.any())
    assert doubted >= 5
    assert easy <= 1
