"""The Table 1 job: cache, scoring and errors; its films and methods are tested where they live."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from eval import recognisers, table1
from eval.job import Cache, Profile, digest, plain, read_json, run_parallel, source_digest, write_arrays, write_json
from eval.predict import load_row, row_path, tracks_path
from eval.recognisers import Reader
from eval.rows import FLAT, ROWS, TRUE_3D, VIEWS_2D, rows_of
from eval.rows.template import load_prior, place_template, save_prior, template_layout, train_prior
from eval.scoring import PAPER, bootstrap_cells, draw, table_text
from eval.sequences import (
    ACTIONS,
    TEST_SEED,
    Filmed,
    Filming,
    film,
    mocap_sequences,
    subject_folds,
    synthetic_sequences,
)
from torchrecon.data.synthetic import sample_body, sample_motion
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.measurement.camera import project_points
from torchrecon.models.recogniser import ReadOut, Recogniser, save_recogniser, weights_hash
from torchrecon.nrsfm.turning import TurnParams, turning_rigid


def test_cache_of_another_configuration_is_refused(tmp_path):
    cache = Cache(tmp_path / "cache", {"seed": 0, "filming": {"turn": 300.0}})
    cache.path("rows", "flat.npz").write_bytes(b"x")
    assert Cache(tmp_path / "cache", {"filming": {"turn": 300.0}, "seed": 0}).path("rows", "flat.npz").is_file()
    with pytest.raises(ReconError, match=r"filming\.turn: 300\.0 there, 120\.0 now"):
        Cache(tmp_path / "cache", {"seed": 0, "filming": {"turn": 120.0}})
    assert cache.path("rows", "flat.npz").is_file()
    fresh = Cache(tmp_path / "cache", {"seed": 1}, fresh=True)
    assert not fresh.path("rows", "flat.npz").is_file()


def test_a_folder_that_is_no_cache_is_never_emptied(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    for fresh in (False, True):
        with pytest.raises(ReconError, match="choose another --out"):
            Cache(tmp_path, {"seed": 0}, fresh=fresh)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_results_are_written_whole_and_unrounded(tmp_path):
    path = write_json(tmp_path / "new" / "r.json", {"a": torch.tensor(1 / 3), "b": math.nan, "c": (np.int64(2),)})
    assert json.loads(path.read_text()) == {"a": 1 / 3, "b": None, "c": [2]}
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert read_json(path)["a"] == 1 / 3
    assert [item.name for item in path.parent.iterdir()] == ["r.json"]


def test_digest_reads_values_not_order():
    assert digest({"a": 1, "b": (1, 2)}) == digest({"b": [1, 2], "a": 1})
    assert digest({"a": 1}) != digest({"a": 2})
    assert source_digest("eval/job.py") != source_digest("eval/scoring.py")
    assert plain({1: Path("x")}) == {"1": "x"}


def test_profile_adds_up():
    profile, other = Profile(), Profile()
    profile.add("render", 1.0, 2.0)
    other.add("render", 2.0, 3.0, calls=4)
    profile.merge(other)
    assert profile.stages["render"] == {"cpu_s": 3.0, "wall_s": 5.0, "calls": 5}
    assert "0.05" in profile.text()


def test_parallel_names_the_item_that_failed():
    # A task of the standard library, so that the workers need not import this file.
    assert sorted(run_parallel(math.factorial, [1, 2, 4], workers=2, label="factorials")) == [(1, 1), (2, 2), (4, 24)]
    with pytest.raises(ReconError, match=r"(?s)factorials: -3 failed: .*ValueError"):
        list(run_parallel(math.factorial, [-3], workers=1, label="factorials"))


def test_test_films_share_no_seed_with_training_and_no_body_with_each_other():
    sequences = synthetic_sequences(10, 60)
    assert len({item.seed for item in sequences}) == 40
    assert all(item.seed >= TEST_SEED for item in sequences)
    assert [sum(item.action == action for item in sequences) for action in ACTIONS] == [10, 10, 10, 10]
    assert not {item.seed for item in sequences} & {item.seed for item in synthetic_sequences(10, 60, seed=1)}


def test_folds_leave_whole_subjects_out():
    subjects = ["a"] * 7 + ["b"] * 3 + ["c"] * 3 + ["d"] * 1 + ["e", "f"]
    fold = subject_folds(subjects, 3)
    assert set(fold) == set(subjects)
    load = [sum(fold[name] == k for name in subjects) for k in range(3)]
    assert max(load) - min(load) <= 3
    assert fold == subject_folds(subjects[::-1], 3)


def test_mocap_sequences_take_the_four_actions_of_a_second_or_more(data_dir):
    sequences = mocap_sequences(str(data_dir / "mocap" / "dev.npz"))
    assert {item.action for item in sequences} == set(ACTIONS)
    assert all(item.frames >= item.fps for item in sequences)
    folds = {item.subject: {other.fold for other in sequences if other.subject == item.subject} for item in sequences}
    assert all(len(value) == 1 for value in folds.values())
    assert {item.fold for item in sequences} == set(range(5))
    with pytest.raises(ReconError, match="no such file"):
        mocap_sequences(str(data_dir / "missing.npz"))


def test_bootstrap_draws_sequences_not_windows():
    same = bootstrap_cells({"run": [(1, 8)] * 10})["run"]
    assert same.error == same.low == same.high == 12.5
    mixed = bootstrap_cells({"run": [(8, 8)] * 5 + [(0, 8)] * 5})["run"]
    assert mixed.error == 50.0
    assert mixed.low <= 20.0  # windows taken as independent would give 39
    assert mixed.high >= 80.0
    uneven = bootstrap_cells({"run": [(1, 1), (0, 9)], "jump": [(0, 5)]})
    assert uneven["run"].error == 10.0
    assert uneven["mean"].error == 5.0


def test_the_papers_numbers_are_those_of_its_table():
    assert PAPER["default"] == (21.22, 20.51, 20.97, 21.08)
    assert set(PAPER) <= {row.key for row in ROWS}
    assert all(len(numbers) == len(ACTIONS) for numbers in PAPER.values())


def test_rows_are_marked():
    by_key = {row.key: row for row in rows_of("depth")}
    assert by_key["ref4"].supervised
    assert by_key["paper"].filled
    assert "sensor" in by_key
    assert "sensor" not in {row.key for row in rows_of("turning")}
    assert TRUE_3D.solve is None
    assert VIEWS_2D.solve is None


def test_template_points_lie_on_every_body_and_prior_round_trips(tmp_path):
    part, _ = template_layout()
    for seed in (1, 2):
        generator = torch.Generator().manual_seed(seed)
        body = sample_body(generator)
        motion = sample_motion("jump", body, frames=4, generator=generator)
        points = place_template(body, motion)
        assert points.shape == (4, len(part), 3)
        height = points[..., 1].amax(1) - points[..., 1].amin(1)
        assert float(height.max()) > 0.7 * body.stature
    prior = train_prior(("jump",), bodies=2, frames=8)
    assert abs(float(prior["jump"].mean.square().sum(-1).mean().sqrt()) - 1) < 0.1
    assert torch.allclose(prior["jump"].modes.flatten(1) @ prior["jump"].modes.flatten(1).T, torch.eye(8), atol=1e-9)
    save_prior(tmp_path / "prior.npz", prior)
    assert torch.equal(load_prior(tmp_path / "prior.npz")["jump"].mean, prior["jump"].mean)
    with pytest.raises(ReconError, match="no such file"):
        load_prior(tmp_path / "none.npz")


@pytest.mark.parametrize("rate", [-5.0, 4.0])
def test_shared_rotations_find_turn_and_mirror_of_short_tracks(generator, rate):
    frames, points = 40, 300
    angle = torch.deg2rad(rate * torch.arange(frames) + 8 * torch.sin(torch.linspace(0, 3, frames)))
    rotations = rotation_from_vector(torch.stack([0 * angle, angle, 0 * angle], -1))
    place = 2 * math.pi * torch.rand(points, generator=generator)
    shape = torch.stack(
        [0.3 * place.cos(), 1.7 * torch.rand(points, generator=generator) - 0.85, 0.2 * place.sin()], -1
    )
    truth = shape @ rotations.mT
    visible = (torch.stack([place.cos(), 0 * place, place.sin()], -1) @ rotations.mT)[..., 2] < -0.3
    k = torch.tensor([[1150.0, 0, 384], [0, 1150.0, 288], [0, 0, 1]])
    xy = project_points(truth + torch.tensor([0.0, 0.0, 7.0]), k)
    xy = xy + 0.5 * torch.randn(xy.shape, generator=generator)
    tracks = Tracks(torch.where(visible[..., None], xy, torch.tensor(float("nan"))), intrinsics=k)
    answer = turning_rigid(tracks, TurnParams(refinements=15, search_points=200))
    step = rotations[1:] @ rotations[:-1].mT
    found = answer.rotations[1:] @ answer.rotations[:-1].mT
    assert float(torch.rad2deg((step - found).norm(dim=(-1, -2)) / 2**0.5).mean()) < 0.7
    depth = answer.points3d[..., 2][visible]
    assert float(torch.corrcoef(torch.stack([depth, truth[..., 2][visible]]))[0, 1]) > 0.97


def fake_run(folder: Path) -> tuple[list, dict]:
    """A cache with two short films, as the first pass leaves it, and an untrained recogniser."""
    sequences = [replace(item, frames=36) for item in synthetic_sequences(1, 36)[:2]]
    generator = torch.Generator().manual_seed(0)
    k = torch.tensor([[500.0, 0, 100], [0, 500.0, 100], [0, 0, 1]])
    for item in sequences:
        truth = torch.randn(36, 30, 3, generator=generator) * 0.3 + torch.tensor([0.0, 0.0, 6.0])
        tracks = Tracks(project_points(truth, k), intrinsics=k)
        known = torch.ones(30, dtype=torch.bool)
        known[3] = False
        truth[:, 3] = math.nan
        eye = torch.eye(3).expand(36, 3, 3)
        Filmed(tracks, torch.eye(2).expand(36, 30, 2, 2), truth, known, eye).save(tracks_path(folder, item.name))
        flat = torch.nan_to_num(truth) * torch.tensor([1.0, 1.0, 0.0])
        for key in ("default", "ref5", FLAT.key):
            arrays = {"points3d": flat.float(), "visible": torch.ones(36, 30, dtype=torch.bool), "note": np.asarray("")}
            write_arrays(row_path(folder, key, item.name), arrays)
    refused = row_path(folder, "ref5", sequences[1].name)
    write_arrays(refused, {"note": np.asarray("too few tracks")})
    recogniser = Recogniser(("shoot", "run", "jump", "pass"), ReadOut(views=("top",)))
    file = save_recogniser(recogniser, folder / "recogniser.safetensors")
    reader = Reader(str(file), weights_hash(recogniser))
    return sequences, {("3d", 0, 0): reader, ("2d", 0, 0): reader}


def test_scoring_reads_the_cache_and_counts_a_refusal_as_wrong(tmp_path):
    sequences, readers = fake_run(tmp_path)
    rows = tuple(row for row in ROWS if row.key in ("default", "ref5", FLAT.key, VIEWS_2D.key, TRUE_3D.key))
    table, remarks = table1.score(tmp_path, tmp_path, sequences, rows, readers, seed=0)
    by_key = {row["key"]: row for row in table}
    assert load_row(tmp_path, "ref5", sequences[1].name) == "too few tracks"
    assert by_key["ref5"]["cells"]["run"]["error"] == 100.0
    assert by_key["ref5"]["cells"]["run"]["windows"] == 2
    assert any("too few tracks" in line for line in remarks)
    # Equal points, equal verdict: nothing but the points decides.
    assert by_key["default"]["cells"] == by_key[FLAT.key]["cells"]
    assert by_key["default"]["errors"]["mean"]["nrmse"] > 30
    assert by_key[TRUE_3D.key]["errors"] == {}
    result = {"title": "t", "actions": ["shoot", "run"], "rows": table, "remarks": remarks}
    text = table_text(result)
    assert "torchrecon default" in text
    assert "(21.22)" in text
    assert draw(result, tmp_path / "table1.png").stat().st_size > 1000


def test_unusable_input_is_one_sentence_and_exit_code_2(tmp_path, capsys):
    assert table1.main(["--data", str(tmp_path / "none.npz"), "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert "no such file" in message
    assert "Traceback" not in message


def test_film_gives_tracks_with_their_truth():
    sequence = replace(synthetic_sequences(1, 8)[0], frames=8)
    profile = Profile()
    filmed = film(sequence, Filming(turn=40.0, size=(288, 384)), profile)
    tracks, seen = filmed.tracks, filmed.tracks.visible & filmed.known
    assert {"render", "tracking"} <= set(profile.stages)
    assert profile.stages["render"]["calls"] == 8
    assert float(filmed.known.double().mean()) > 0.9
    again = project_points(filmed.truth.double(), tracks.intrinsics.double())
    miss = (again - tracks.xy).norm(dim=-1)[seen]
    assert float(miss.median()) < 1.0  # truth and track are the same point of the body
    assert bool(torch.isfinite(filmed.hessian[tracks.visible]).all())


def test_every_recogniser_reads_and_a_cell_is_their_mean(tmp_path):
    sequences, readers = fake_run(tmp_path)
    # Recognisers that always say the same: the first is wrong about the run, the second about the shot.
    for seed, name in enumerate(("shoot", "run")):
        recogniser = Recogniser(("shoot", "run", "jump", "pass"), ReadOut(views=("top",)))
        with torch.no_grad():
            recogniser.to_classes.bias[recogniser.classes.index(name)] = 1e3
        file = save_recogniser(recogniser, tmp_path / f"recogniser_seed{seed}.safetensors")
        for views in ("3d", "2d"):
            readers[views, 0, seed] = Reader(str(file), weights_hash(recogniser))
    rows = tuple(row for row in ROWS if row.key in ("default", "ref5", FLAT.key, TRUE_3D.key))
    table, _ = table1.score(tmp_path, tmp_path, sequences, rows, readers, seed=0)
    by_key = {row["key"]: row for row in table}
    true = by_key[TRUE_3D.key]
    assert {item.action for item in sequences} == {"shoot", "run"}
    assert [true["cells"][name]["error"] for name in ("shoot", "run", "mean")] == [50.0, 50.0, 50.0]
    assert true["by_seed"] == [{"shoot": 0.0, "run": 100.0, "mean": 50.0}, {"shoot": 100.0, "run": 0.0, "mean": 50.0}]
    assert true["cells"]["run"]["windows"] == 2  # of one recogniser, not of both
    assert by_key["ref5"]["cells"]["run"]["error"] == 100.0  # refused there, whoever reads
    assert sum(value["wrong"] for value in true["by_source"].values()) == 2.0


def test_recognisers_of_all_folds_and_seeds_are_asked_for(tmp_path, monkeypatch):
    asked = []

    def train(path, arguments):
        asked.append(arguments)
        save_recogniser(Recogniser(("run",)), path)

    monkeypatch.setattr(recognisers, "_train", train)
    first, second = synthetic_sequences(1, 60)[:2]
    sequences = [replace(first, subject="a"), replace(second, subject="b", fold=1)]
    readers = recognisers.readers_of(sequences, "clips.npz", False, tmp_path, seeds=2)
    assert set(readers) == {(views, fold, seed) for views in ("3d", "2d") for fold in (0, 1) for seed in (0, 1)}
    assert len({reader.path for reader in readers.values()}) == 8
    assert len(asked) == 8
    for arguments in asked:
        fold = 1 if "fold1" in arguments[arguments.index("--out") + 1] else 0
        assert arguments[arguments.index("--exclude") + 1] == "ab"[fold]
        assert ("--seed" in arguments) == ("seed1" in arguments[arguments.index("--out") + 1])


def test_named_rows_come_with_what_they_are_held_against():
    keys = [row.key for row in table1.chosen_rows("turning", ["pnd2"])]
    assert keys == ["pnd2", "default", "flat", "views2d", "true3d"]
    everything = {row.key for row in table1.chosen_rows("turning", None)}
    assert everything >= {row.key for row in ROWS} | {"true-rotations"}
    assert "pnd2" not in everything
    with pytest.raises(ReconError, match="--rows true-rotations: is not one of"):
        table1.chosen_rows("depth", ["true-rotations"])
    with pytest.raises(ReconError, match="--rows nobody"):
        table1.chosen_rows("turning", ["nobody"])
