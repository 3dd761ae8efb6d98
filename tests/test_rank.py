"""Eqs. 18-20 and 25-27: the number of shape bases."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from eval.reliability.ranks import mass_above
from eval.reliability.world import low_rank_tracks
from torchrecon.errors import ReconError
from torchrecon.linalg.noise_edge import Complement, count_signals, spectrum, tracy_widom_edge
from torchrecon.measurement import Tracks, stack_matrix, vector_matrix
from torchrecon.rank import RULES, cross_validate, estimate_rank
from torchrecon.rank.band_limited import motion_band


def _scene(*arguments: Any, **options: Any) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Tracks of a body of known K: xy, visible, noise standard deviation."""
    made = low_rank_tracks(*arguments, **options)
    return made.xy, made.visible, made.sigma


def _isotropic(xy: torch.Tensor, sigma: float) -> torch.Tensor:
    return sigma**2 * torch.eye(2).expand(*xy.shape, 2)


def test_eq18_19_vectors_have_rank_6k_and_the_stack_3k() -> None:
    for bases in (1, 2, 4):
        xy, _, _ = _scene(200, 40, bases, 400.0, 0)
        centred = xy - xy.mean(1, keepdim=True)
        for matrix, per_basis in ((vector_matrix(centred), 6), (stack_matrix(centred), 3)):
            values = torch.linalg.svdvals(matrix)
            assert int((values > 1e-9 * values[0]).sum()) == per_basis * bases
    xy, _, _ = _scene(200, 40, 2, 400.0, 0, motion="yaw")
    values = torch.linalg.svdvals(vector_matrix(xy - xy.mean(1, keepdim=True)))
    assert int((values > 1e-9 * values[0]).sum()) == 6  # 3K, not 6K: why the paper's division by 6 is conditional


def test_eq20_second_moments_are_signal_plus_noise_covariance() -> None:
    clean = 0.05 * _scene(20, 10, 2, 400.0, 0)[0]
    g = torch.Generator().manual_seed(1)
    factor = torch.randn(10, 2, 2, generator=g)
    noise = torch.einsum("pab,nfpb->nfpa", factor, torch.randn(4000, 20, 10, 2, generator=g))
    noisy = vector_matrix((clean - clean.mean((0, 1))) + noise)
    measured = noisy.transpose(-1, -2) @ noisy / 20
    c = factor @ factor.transpose(-1, -2)
    dense = torch.cat(
        [torch.cat([torch.diag(c[:, a, b]) for b in (0, 1)], 1) for a in (0, 1)],
        0,
    )
    signal = vector_matrix(clean - clean.mean((0, 1)))
    expected = signal.T @ signal / 20 + dense
    assert float((measured.mean(0) - expected).norm() / dense.norm()) < 0.05


def test_eq25_26_whitened_eigenvalues_do_not_depend_on_how_the_points_are_scaled() -> None:
    xy, _, sigma = _scene(150, 20, 2, 20.0, 0)
    g = torch.Generator().manual_seed(0)
    mixed = torch.randn(20, 2, 2, generator=g) + 2 * torch.eye(2)
    covariance = sigma**2 * mixed @ mixed.transpose(-1, -2)
    tracks = Tracks(xy, covariance=covariance.expand(150, 20, 2, 2))
    estimate = estimate_rank(tracks, "tracy_widom", layout="vector", noise_scale="given")
    # the printed order: centre with Helmert rows, then C -> T C T^T, then the eigenvalues of R C^-1
    t = Complement(torch.ones(20)).up(torch.eye(19))
    helmert = torch.block_diag(t, t)
    c = torch.cat([torch.cat([torch.diag(covariance[:, a, b]) for b in (0, 1)], 1) for a in (0, 1)], 0)
    x = vector_matrix(xy) @ helmert.T
    h = (x.T @ x / 150) @ torch.linalg.inv(helmert @ c @ helmert.T)
    values = torch.linalg.eigvals(h)
    assert float(values.imag.abs().max()) < 1e-6
    torch.testing.assert_close(estimate.eigenvalues, values.real.sort(descending=True).values)


@pytest.mark.parametrize(("frames", "points", "bases"), [(1000, 60, 2), (300, 30, 3), (1000, 100, 1), (300, 60, 2)])
def test_eq27_paper_rule_follows_its_closed_form(frames: int, points: int, bases: int) -> None:
    counts = []
    for seed in range(8):
        xy, _, sigma = _scene(frames, points, bases, 30.0, seed)
        estimate = estimate_rank(Tracks(xy, covariance=_isotropic(xy, sigma)), "paper")
        assert (estimate.rule, estimate.layout) == ("paper", "vector")
        counts.append(6 * float(estimate.deformation_degree))
        assert (estimate.threshold == 1).all()
        assert estimate.rank == int(float(estimate.deformation_degree) + 0.5)
    measured = sum(counts) / len(counts)
    free, left = 2 * points - 2 - 6 * bases, frames - 6 * bases
    # the signals take 6K samples with them, but the paper divides by all F: the level 1 lies F / (F - 6K) higher
    assert measured == pytest.approx(6 * bases + free * mass_above(frames / left, free / left), rel=0.03)
    if frames == 1000:
        plain = 6 * bases + free * mass_above(1.0, (2 * points - 2) / frames)
        assert measured == pytest.approx(plain, rel=0.03)
    assert measured > 1.5 * 6 * bases


def test_eq27_paper_needs_a_covariance() -> None:
    xy, _, _ = _scene(30, 20, 1, 30.0, 0)
    with pytest.raises(ReconError, match="covariance"):
        estimate_rank(Tracks(xy), "paper")
    with pytest.raises(ReconError, match="covariance"):
        estimate_rank(Tracks(xy), noise_scale="given")


def test_eq27_exact_k_at_20_db() -> None:
    cells = [(f, p, k, s) for f in (100, 200) for p in (60, 80) for k in (1, 2, 3, 4) for s in (0, 1)]
    exact = [estimate_rank(Tracks(_scene(f, p, k, 20.0, s)[0])).rank == k for f, p, k, s in cells]
    assert sum(exact) >= 0.95 * len(cells)


def test_eq27_noise_that_varies_per_frame() -> None:
    exact = [
        estimate_rank(Tracks(_scene(100, 60, k, 20.0, s, frame_spread=0.7)[0])).rank == k
        for k in (1, 2, 3, 4)
        for s in range(4)
    ]
    assert sum(exact) >= 15


@pytest.mark.parametrize("missing", [0.05, 0.1])
def test_eq27_exact_k_with_gaps(missing: float) -> None:
    exact = []
    for bases in (1, 2, 3, 4):
        for seed in range(3):
            xy, visible, _ = _scene(100, 60, bases, 20.0, seed, missing=missing)
            estimate = estimate_rank(Tracks(xy, visible))
            exact.append(estimate.rank == bases)
            assert estimate.interval[0] <= estimate.rank <= estimate.interval[1]
    assert sum(exact) >= 11


def test_band_shaped_visibility_where_no_point_is_complete() -> None:
    xy, visible, _ = _scene(60, 300, 3, 30.0, 0)
    g = torch.Generator().manual_seed(0)
    start = torch.randint(-10, 50, (300,), generator=g)
    length = torch.randint(15, 40, (300,), generator=g)
    frame = torch.arange(60)[:, None]
    visible = (frame >= start) & (frame < start + length)
    seen = visible.sum(0) > 8
    estimate = estimate_rank(Tracks(xy[:, seen], visible[:, seen]))
    assert not visible.all(0).any()
    assert (estimate.rule, estimate.rank) == ("cross_validation", 3)


def test_pure_noise_on_a_rigid_body_is_k_1() -> None:
    ranks = [estimate_rank(Tracks(_scene(80, 40, 1, 10.0, s)[0])).rank for s in range(40)]
    assert sum(rank == 1 for rank in ranks) >= 39


def test_noise_alone_has_no_signal() -> None:
    g = torch.Generator().manual_seed(0)
    counts = []
    for _ in range(200):
        values, samples, _ = spectrum(torch.randn(90, 25, generator=g))
        counts.append(count_signals(values, samples, 1.0)[0])
    assert 0.90 <= sum(c == 0 for c in counts) / 200 <= 0.99
    assert tracy_widom_edge(90, 25) > (90**0.5 + 25**0.5) ** 2 / 90


def test_yaw_only_swing_and_static_views() -> None:
    for bases in (1, 3):
        estimate = estimate_rank(Tracks(_scene(150, 40, bases, 20.0, 0, motion="yaw")[0]))
        assert estimate.rank == bases
        assert estimate.warnings == ()
        still = estimate_rank(Tracks(_scene(150, 40, bases, 20.0, 0, motion="static")[0]))
        assert any("depth" in text for text in still.warnings)
    assert estimate_rank(Tracks(_scene(150, 40, 3, 30.0, 0)[0])).warnings == ()


def test_fewer_frames_than_coordinates() -> None:
    for bases in (1, 2, 3):
        assert estimate_rank(Tracks(_scene(30, 60, bases, 30.0, 1)[0])).rank == bases


def test_scale_rotation_and_precision_do_not_matter() -> None:
    xy, _, _ = _scene(100, 60, 3, 20.0, 5)
    reference = estimate_rank(Tracks(xy))
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
    for other in (7.5 * xy, xy @ turn.T, xy.float(), xy[:, torch.randperm(60)]):
        estimate = estimate_rank(Tracks(other))
        assert estimate.rank == reference.rank
        torch.testing.assert_close(
            (estimate.eigenvalues / estimate.threshold).double(),
            reference.eigenvalues / reference.threshold,
            rtol=1e-3,
            atol=1e-3,
        )


@pytest.mark.parametrize("rule", [rule for rule in RULES if rule not in ("auto", "paper")])
def test_every_rule_finds_a_clear_answer_and_keeps_the_contract(rule: str) -> None:
    xy, _, sigma = _scene(200, 60, 3, 30.0, 0)
    tracks = Tracks(xy, covariance=_isotropic(xy, sigma))
    estimate = estimate_rank(tracks, rule)
    assert (estimate.rank, estimate.rule, estimate.layout) == (3, rule, "stack")
    assert estimate.eigenvalues.shape == estimate.threshold.shape
    assert (estimate.eigenvalues.diff() <= 0).all()
    assert estimate_rank(tracks, rule, max_rank=2).rank <= 2
    if rule in ("mp", "tracy_widom"):
        assert estimate_rank(tracks, rule, noise_scale="given").rank == 3


def test_bootstrap_interval_holds_k_and_its_edge_is_that_of_the_noise() -> None:
    inside, exact = [], []
    for seed in range(10):
        xy, _, _ = _scene(60, 30, 3, 10.0, seed)
        estimate = estimate_rank(Tracks(xy), "bootstrap")
        low, high = estimate.interval
        inside.append(low <= 3 <= high)
        assert low <= estimate.rank <= high
        _, _, sigma = _scene(60, 30, 1, 10.0, seed)
        noise = sigma * torch.randn(60, 30, 2, generator=torch.Generator().manual_seed(seed))
        exact.append(6 * float(estimate_rank(Tracks(noise), "bootstrap", "vector").deformation_degree))
    assert sum(inside) >= 9
    assert sum(count > 0 for count in exact) <= 3  # one in twenty is expected


def test_bootstrap_knows_correlated_noise_that_the_closed_form_takes_for_signal() -> None:
    xy, _, sigma = _scene(150, 40, 2, 20.0, 0)
    g = torch.Generator().manual_seed(1)
    level = torch.exp(0.7 * torch.randn(150, 40, generator=g))
    slant = torch.tensor([[1.0, 0.0], [0.9, 0.44]])
    factor = sigma * level[..., None, None] * slant
    noisy = xy + (factor @ torch.randn(150, 40, 2, 1, generator=g))[..., 0]
    tracks = Tracks(noisy, covariance=factor @ factor.mT + sigma**2 * torch.eye(2))
    assert estimate_rank(tracks, "bootstrap", noise_scale="given").rank == 2
    assert estimate_rank(tracks, "tracy_widom", noise_scale="given").rank == 3


def test_unequal_points_need_the_covariance() -> None:
    xy, _, sigma = _scene(200, 60, 2, 20.0, 0)
    g = torch.Generator().manual_seed(0)
    level = torch.exp(0.8 * torch.randn(60, generator=g))
    noisy = xy + sigma * level[:, None] * torch.randn(200, 60, 2, generator=g)
    covariance = (sigma**2 * (1 + level**2))[:, None, None] * torch.eye(2)
    told = estimate_rank(Tracks(noisy, covariance=covariance.expand(200, 60, 2, 2)), "tracy_widom", noise_scale="given")
    blind = estimate_rank(Tracks(noisy), "tracy_widom")
    assert told.rank == 2
    assert blind.rank > 2
    assert estimate_rank(Tracks(noisy)).rank == 2  # the residuals tell what the covariance would have told


def test_batches_incomplete_points_and_bad_arguments() -> None:
    scenes = [_scene(80, 40, k, 30.0, k)[0] for k in (1, 3)]
    batch = estimate_rank(Tracks(torch.stack(scenes)))
    assert batch.rank.tolist() == [1, 3]
    assert batch.rank.dtype == torch.int64
    assert batch.interval.shape == (2, 2)
    xy, visible, _ = _scene(80, 40, 2, 30.0, 0)
    visible[5, :4] = False
    some = estimate_rank(Tracks(xy, visible), "kritchman_nadler")
    assert some.rank == 2
    assert any("4 of 40" in text for text in some.warnings)
    tiny = estimate_rank(Tracks(torch.rand(5, 2, 2)))
    assert tiny.rank == 1
    assert tiny.warnings
    for bad in ({"rule": "best"}, {"layout": "rows"}, {"noise_scale": "guess"}, {"max_rank": 0}):
        with pytest.raises(ReconError, match=next(iter(bad))):
            estimate_rank(Tracks(xy), **bad)


def test_unseen_entries_are_never_read_and_seeds_decide() -> None:
    xy, visible, _ = _scene(60, 40, 2, 20.0, 0, missing=0.1)
    results = []
    for fill in (0.0, 1e6, float("nan")):
        poisoned = torch.where(visible[..., None], xy, torch.tensor(fill))
        results.append(cross_validate(poisoned, visible, 4, torch.Generator().manual_seed(3)).errors)
    assert results[0] == results[1] == results[2]
    assert cross_validate(xy, visible, 4, torch.Generator().manual_seed(4)).errors != results[0]


def test_a_basis_below_the_edge_of_all_frames_stands_above_that_of_the_band_it_moves_in() -> None:
    weak = [_scene(300, 30, 2, -5.0, seed) for seed in range(8)]
    counts = {
        rule: [estimate_rank(Tracks(xy), rule).rank for xy, _, _ in weak]
        for rule in ("kritchman_nadler", "band_limited")
    }
    assert counts["band_limited"].count(2) > counts["kritchman_nadler"].count(2)
    assert max(counts["band_limited"]) == 2
    noise = torch.randn(300, 30, 2, generator=torch.Generator().manual_seed(0))
    band = motion_band((noise - noise.mean(1, keepdim=True)).mT[..., 1:])
    assert len(band.kept) < 60  # what does not move at all leaves nothing but noise above the band
    assert band.noise == pytest.approx(float(noise.square().mean()), rel=0.05)


def test_without_smoothness_the_band_is_all_frames_and_the_rule_that_of_kritchman_and_nadler() -> None:
    g = torch.Generator().manual_seed(0)
    a, b = torch.randn(60, 2, 6, generator=g), torch.randn(40, 6, generator=g)
    xy = torch.einsum("fck,pk->fpc", a, b) + 0.3 * torch.randn(60, 40, 2, generator=g)
    ours, reference = (estimate_rank(Tracks(xy), rule) for rule in ("band_limited", "kritchman_nadler"))
    assert ours.rank == reference.rank == 2
    torch.testing.assert_close(ours.eigenvalues, reference.eigenvalues)
    torch.testing.assert_close(ours.threshold, reference.threshold)
