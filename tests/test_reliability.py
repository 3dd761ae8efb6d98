"""The reliability job: its world, its grid, and a run of a few cells."""

from __future__ import annotations

import itertools
import json
import math

import pytest
import torch
import yaml
from scipy.stats import chi2

from eval.job import ROOT
from eval.reliability.__main__ import main, read_config
from eval.reliability.coverage import LEVELS
from eval.reliability.heldout import Clip2D, bootstrap_mean, run_clip, turned_view
from eval.reliability.motions import humaneva_joints, synthetic_joints
from eval.reliability.ranks import grid
from eval.reliability.world import low_rank_tracks
from torchrecon.errors import ReconError

CONFIG = ROOT / "configs" / "reliability.yaml"


def test_the_grid_is_whole_and_its_costly_part_is_a_stratified_twentieth():
    config = read_config(CONFIG, smoke=False)
    cells = grid(config, full=False)
    whole = [cell for cell in cells if cell.part == "grid"]
    costly = [cell for cell in cells if cell.part == "costly"]
    assert len(whole) == 480
    assert len(costly) == 24
    for field in ("bases", "snr"):
        counts = [getattr(cell, field) for cell in costly]
        assert len({counts.count(value) for value in counts}) == 1
    assert {cell.frames for cell in costly} == {cell.frames for cell in whole}
    assert {cell.points for cell in costly} == {cell.points for cell in whole}
    # the same tracks as the closed-form rules saw
    seeds = {(c.frames, c.points, c.bases, c.snr): c.seed for c in whole}
    assert all(seeds[c.frames, c.points, c.bases, c.snr] == c.seed for c in costly)
    assert len(grid(config, full=True)) - len(cells) == 480 - 24
    starts = sorted({cell.seed for cell in cells})
    assert min(b - a for a, b in itertools.pairwise(starts)) >= max(cell.trials for cell in cells)


def test_the_limit_of_detection_is_where_the_noise_ends():
    made = low_rank_tracks(300, 60, 3, 10.0, seed=0)
    # the same eigenvalue from the parts: the signal's weakest direction against sqrt(d / n)
    edge = math.sqrt(59 / 600)
    assert made.detectable == pytest.approx((1 + made.signal * edge) / (1 + edge))
    weaker = low_rank_tracks(300, 60, 3, 0.0, seed=0)
    assert weaker.signal == pytest.approx(made.signal / 10)  # 10 dB are a factor of ten in the noise variance
    assert low_rank_tracks(20, 15, 6, 20.0, seed=0).signal == 0.0  # 18 components do not fit into 14 columns
    missing = low_rank_tracks(100, 30, 2, 20.0, seed=0, missing=0.1).visible
    assert 0.1 <= float((~missing).double().mean()) < 0.12


def test_films_keep_the_body_in_front_of_the_camera_and_190_pixels_tall():
    for film in synthetic_joints(5):
        height = film.xy[..., 1].amax(1) - film.xy[..., 1].amin(1)
        assert float(height.median()) == pytest.approx(190, rel=1e-6)
        assert float(film.xy.diff(dim=0).norm(dim=-1).max()) < 60  # no joint jumps


def test_a_small_run_writes_what_it_prints(tmp_path, capsys):
    config = yaml.safe_load(CONFIG.read_text())
    config["grid"].update(frames=[50], points=[30], bases=[1, 2], snr=[20.0], trials=1)
    config["costly"].update(trials=1, cells=[[50, 30, 2, 20.0]])
    config["side"].update(frames=50, points=30, bases=[1], trials=1)
    config["rigid"].update(sizes=[[40, 30]], snr=[20.0], trials=2)
    config["gaps"].update(shares=[0.05], trials=1)
    config["paper"].update(cells=[[300, 30, 1]], trials=1)
    config["filling"].update(films=1, lengths=[1, 5])
    config["coverage"].update(sizes=[[30, 15, 1]], snr=[20.0], trials=1)
    small = tmp_path / "small.yaml"
    small.write_text(yaml.safe_dump(config))
    default = torch.get_default_dtype()
    try:
        assert main(["--config", str(small), "-o", str(tmp_path / "out"), "--workers", "1"]) == 0
    finally:
        torch.set_default_dtype(default)
    text = capsys.readouterr().out
    assert "auto auto" in text
    assert "RMSE px" in text
    result = json.loads((tmp_path / "out" / "reliability.json").read_text())
    auto = [r for r in result["rank"]["records"] if r["part"] == "grid" and r["rule"] == "auto"]
    assert [r["rank"] == r["bases"] for r in auto] == [True, True]
    assert {r["length"] for r in result["filling"]["records"]} == {1, 5}
    assert [r["held"]["0.95"] > 0.7 for r in result["coverage"]["records"]] == [True]
    assert "True points inside the ellipsoid" in text
    assert (tmp_path / "out" / "reliability.png").stat().st_size > 10_000


def test_levels_of_the_ellipsoids_are_quantiles():
    assert [chi2.ppf(level, 3) for level in LEVELS] == pytest.approx(list(LEVELS.values()), abs=1e-4)


def test_bad_input_is_named(tmp_path, capsys):
    assert main(["--config", str(tmp_path / "none.yaml")]) == 2
    assert "no such file" in capsys.readouterr().err
    (tmp_path / "thin.yaml").write_text("grid: {}")
    assert main(["--config", str(tmp_path / "thin.yaml")]) == 2
    assert "costly" in capsys.readouterr().err
    assert main(["--only", "filling", "--smoke", "--data", str(tmp_path), "-o", str(tmp_path / "o")]) == 2
    assert "dev.npz" in capsys.readouterr().err
    assert main(["--only", "heldout", "-o", str(tmp_path / "o")]) == 2
    assert "--data" in capsys.readouterr().err
    with pytest.raises(ReconError, match="no such file"):
        humaneva_joints(tmp_path / "humaneva15_train.npz")


def test_hidden_entries_tell_the_k_of_bodies_of_known_k():
    for bases in (1, 2, 3):
        made = low_rank_tracks(60, 30, bases, 20.0, seed=bases)
        record = run_clip(Clip2D("known", "walk", made.xy, 0.0, 0, hidden=True))
        assert record["rank"] == record["best"] == bases
        assert len(record["errors"]) == 9


def test_a_turning_view_shows_every_side_of_a_still_body():
    body = torch.randn(12, 3, generator=torch.Generator().manual_seed(0)).double().expand(40, 12, 3)
    seen = turned_view(body, math.pi, 0.3)
    height = seen[..., 1].amax(1) - seen[..., 1].amin(1)
    assert float((height - 190).abs().max()) < 1e-6  # a level camera: heights stay
    stack = (seen - seen.mean(1, keepdim=True)).mT.flatten(0, 1)
    assert int((torch.linalg.svdvals(stack) > 1e-6).sum()) == 3  # a rigid body that turns
    # half a turn is the mirror image from left to right
    torch.testing.assert_close(seen[-1] * torch.tensor([-1.0, 1.0]), seen[0])


def test_interval_of_a_mean_is_that_of_its_standard_error():
    values = torch.randn(200, generator=torch.Generator().manual_seed(0)).tolist()
    mean, low, high = bootstrap_mean(values)
    assert low < mean < high
    assert high - low == pytest.approx(2 * 1.96 / math.sqrt(200), rel=0.15)
