"""The command line: what it writes, what it prints, what it refuses."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

import torchrecon as tr
from torchrecon.cli import main


@pytest.fixture
def tracks_file(tmp_path):
    g = torch.Generator().manual_seed(0)
    shape = torch.randn(14, 3, generator=g)
    angle = torch.linspace(0, 3, 24)
    c, s, o = angle.cos(), angle.sin(), torch.zeros(24)
    turn = torch.stack([c, o, s, o, o + 1, o, -s, o, c], -1).reshape(24, 3, 3)
    xy = 50 * (shape @ turn.mT)[..., :2] + 0.01 * torch.randn(24, 14, 2, generator=g)
    return tr.Tracks(xy).save(tmp_path / "tracks.npz")


def test_solve_writes_a_reconstruction(tracks_file, tmp_path, capsys):
    out = tmp_path / "r.npz"
    assert main(["solve", str(tracks_file), "-o", str(out), "--rank", "1", "--solver", "rigid", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rank"] == 1
    assert tr.Reconstruction.load(out).points3d.shape == (24, 14, 3)


def test_export_takes_rate_and_names_from_the_tracks_of_the_run(tracks_file, tmp_path, capsys):
    out = tmp_path / "reconstruction.npz"
    tracks = tr.load_tracks(tracks_file)
    dataclasses.replace(tracks, fps=50.0, names=[f"joint {i}" for i in range(14)]).save(tracks_file)
    assert main(["solve", str(tracks_file), "-o", str(out), "--rank", "1", "--solver", "rigid"]) == 0
    assert main(["export", str(out), "-o", str(tmp_path / "r.trc")]) == 0
    assert "p13" in (tmp_path / "r.trc").read_text()
    capsys.readouterr()
    (tmp_path / "run.json").write_text("{}")  # now the tracks beside it are known to be of the same run
    assert main(["export", str(out), "-o", str(tmp_path / "r.trc"), "--height", "1.8", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "out": str(tmp_path / "r.trc"),
        "unit": "m",
        "tracks": str(tracks_file),
    }
    lines = (tmp_path / "r.trc").read_text().splitlines()
    assert lines[2].split("\t")[:5] == ["50", "50", "24", "14", "m"]
    assert lines[3].split("\t")[2] == "joint_0"
    before = out.read_bytes()
    assert main(["export", str(out), "-o", str(out)]) == 2
    assert "itself" in capsys.readouterr().err
    assert out.read_bytes() == before


def test_rank_prints_exactly_the_fields(tracks_file, tmp_path, capsys):
    assert main(["rank", str(tracks_file), "--json", "-o", str(tmp_path / "k.json")]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert set(printed) == set(tr.RankEstimate.__dataclass_fields__)
    assert printed == json.loads((tmp_path / "k.json").read_text())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["solve", "none.npz", "-o", "r.npz"], "no such file"),
        (["solve", "T", "-o", "none/r.npz", "--rank", "1", "--solver", "rigid"], "does not exist"),
        (["solve", "T", "-o", "r.npz", "--rank", "zero"], "positive integer"),
        (["solve", "T", "-o", "r.npz", "--solver", "magic"], "magic"),
        (["solve", "T", "-o", "r.npz", "--camera", "none.json"], "no such file"),
        (["solve", "T", "-o", "r.npz", "--device", "cuda:99"], "not available"),
        (["rank", "T", "--rule", "magic"], "magic"),
        (["rank", "T", "--rule", "paper"], "covariance"),
        (["track", "none.mp4", "-o", "t.npz"], "none.mp4"),
        (["reconstruct", "none.mp4", "-o", "out", "--config", "none.yaml"], "no such file"),
        (["export", "none.npz", "-o", "r.csv"], "no such file"),
    ],
)
def test_bad_input_is_one_sentence_and_code_2(arguments, words, tracks_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([str(tracks_file) if a == "T" else a for a in arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error


def test_a_folder_of_another_run_needs_force(tmp_path, capsys):
    frames = tmp_path / "frames"
    frames.mkdir()
    out = tmp_path / "out"
    out.mkdir()
    (out / "holiday.txt").write_text("mine")
    cv2 = pytest.importorskip("cv2")
    for i in range(10):
        cv2.imwrite(str(frames / f"{i:03d}.png"), np.full((48, 64, 3), 90, np.uint8))
    assert main(["reconstruct", str(frames), "-o", str(out)]) == 2
    assert "--force" in capsys.readouterr().err
    assert (out / "holiday.txt").read_text() == "mine"


def test_a_clip_without_texture_is_refused_with_numbers(tmp_path, capsys):
    cv2 = pytest.importorskip("cv2")
    frames = tmp_path / "frames"
    frames.mkdir()
    for i in range(12):
        image = np.full((96, 128, 3), 90, np.uint8)
        image[30:70, 20 + 4 * i : 50 + 4 * i] = 200
        cv2.imwrite(str(frames / f"{i:03d}.png"), image)
    assert main(["reconstruct", str(frames), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "needed" in error
    # The refused run left no result, so another attempt at the same folder is not told to use --force.
    assert main(["reconstruct", str(frames), "-o", str(tmp_path / "out"), "--rank", "2"]) == 2
    assert "--force" not in capsys.readouterr().err
