"""The scripts in ``examples/``: each runs, and says what is so."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import torchrecon as tr

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(autouse=True)
def _as_a_user():
    torch.set_default_dtype(torch.float32)


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"examples_{name}", EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_quickstart_writes_a_shape_near_the_truth_and_its_files(tmp_path, capsys):
    rec = load("quickstart").main(tmp_path, frames=40, points=16)
    said = capsys.readouterr().out
    # A flat shape, depth zero, scores 0.5 here and more.
    assert float(said.split("truth: ")[1].split()[0]) < 0.15
    assert said.startswith("ok: ")
    assert {path.name for path in tmp_path.iterdir()} == {"tracks.npz", "shape.npz", "shape.glb", "shape.csv"}
    rows = np.loadtxt(tmp_path / "shape.csv", delimiter=",", skiprows=1, usecols=(3, 4, 5))
    np.testing.assert_allclose(rows.reshape(40, 16, 3), rec.points3d, rtol=1e-5, atol=1e-5)


def test_own_video_makes_a_page_and_explains_the_tracks(tmp_path, capsys):
    rec = load("own_video").main(None, tmp_path / "out", frames=13, size=(300, 400), solver="rigid")
    assert float(capsys.readouterr().out.split("error ")[1].split()[0]) < 1.0  # pixels
    assert rec.points3d.shape[0] == 13
    assert (tmp_path / "out" / "report.html").read_text().rstrip().endswith("</html>")
    assert tr.load_tracks(tmp_path / "out" / "tracks.npz").points == rec.points3d.shape[1]


def test_recogniser_head_learns_its_films(capsys):
    found = load("recogniser_head").main(films=2, frames=20, points=20, solver="rigid")
    assert found["last"] < 0.1 * found["first"]
    assert found["right"] == 1.0


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_every_example_says_what_it_shows_and_is_run_by_a_test(path):
    assert load(path.stem).__doc__
    tests = "".join(file.read_text() for file in Path(__file__).parent.glob("test_*.py"))
    assert f'"{path.stem}"' in tests


def test_keypoint_refiner_learns_through_the_reconstruction(capsys):
    errors = load("keypoint_refiner").main(films=1, rounds=4)
    assert errors[-1] < 0.7 * errors[0]
    assert "before" in capsys.readouterr().out
