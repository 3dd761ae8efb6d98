"""The figures job: its world, the floor of Figure 9, the graph, and a run of the cheap ones."""

from __future__ import annotations

import json
import math

import pytest
import torch

from eval.figures import curves, pictures, scatter
from eval.figures.__main__ import main
from eval.figures.scatter import Cell, deflection_cells, grid_cells, known_rotation_shape, noisy_views, turned_body
from torchrecon.linalg import rotation_angle
from torchrecon.metrics import procrustes_disparity


def test_the_body_turns_by_what_the_cell_says_and_a_rigid_one_keeps_its_shape():
    points, rotations = turned_body(Cell("rigid", 21, 60.0, 20.0, "rigid"))
    assert math.degrees(float(rotation_angle(rotations[-1] @ rotations[0].T))) == pytest.approx(60, abs=1e-6)
    torch.testing.assert_close(points @ rotations, (points[:1] @ rotations[:1]).expand_as(points))
    bent, turn = turned_body(Cell("non-rigid", 21, 60.0, 20.0, "auto"))
    assert float((bent @ turn).std(0).norm()) > 1.0
    assert float(points.mean(1).abs().max()) < 1e-9


def test_noise_has_the_ratio_that_the_cell_says():
    points, _ = turned_body(Cell("rigid", 200, 180.0, 10.0, "rigid"))
    xy, sigma = noisy_views(points, Cell("rigid", 200, 180.0, 10.0, "rigid"))
    noise = xy - points[..., :2]
    assert float(points[..., :2].square().mean() / noise.square().mean()) == pytest.approx(10.0, rel=0.03)
    assert float(noise.std()) == pytest.approx(sigma, rel=0.03)


def test_the_floor_is_the_analytic_one():
    # E|error|^2 = sigma^2 P trace((A^T A)^-1) of the least squares; a similarity takes a few of the 3 P numbers out.
    ratios = []
    for seed in range(8):
        cell = Cell("rigid", 100, 180.0, 20.0, "rigid", seed)
        truth, rotations = turned_body(cell)
        xy, sigma = noisy_views(truth, cell)
        found = known_rotation_shape(xy, rotations) @ rotations.mT
        cameras = rotations[:, :2].flatten(0, 1)
        expected = sigma**2 * scatter.POINTS * float(torch.linalg.inv(cameras.T @ cameras).trace())
        ratios.append(float(procrustes_disparity(found, truth)) / (expected / float(truth[0].square().sum())))
    assert 0.75 < sum(ratios) / len(ratios) < 1.05


def test_grids_leave_out_what_cannot_be_solved():
    assert all(cell.frames > 3 for cell in deflection_cells(scatter.DEFLECTIONS, scatter.STEPS, 20.0))
    assert {cell.turn for cell in deflection_cells((3.0, 180.0), (1.0, 8.0), 20.0)} == {3.0, 180.0}
    cells = grid_cells((20,), (60.0,), (0.0, 10.0), ("rigid", "auto"), 2)
    assert len(cells) == len(set(cells)) == 3 * 2 * 2
    assert not [cell for cell in cells if cell.body == "non-rigid" and cell.solver == "rigid"]


def test_the_target_is_judged_where_the_depth_is_determined():
    cell = {"body": "rigid", "frames": 50, "turn": 60.0, "snr": 10.0, "solver": "auto", "note": "ok"}
    records = [
        {**cell, "disparity": 1.2e-3, "floor": 1e-3},
        {**cell, "snr": 30.0, "disparity": None, "floor": 1e-3},
        {**cell, "snr": 0.0, "disparity": 9.0, "floor": 1e-3},
        {**cell, "frames": 20, "disparity": 9.0, "floor": 1e-3},
        {**cell, "body": "non-rigid", "disparity": 9.0, "floor": 1e-3},
    ]
    (line,) = scatter.target_lines(records)
    assert "in 1 of 2 cells" in line
    assert "inf x" in line


def test_the_graph_is_the_factorisation():
    assert pictures.edges_of(pictures.JOINT) == [("x", "y"), ("B", "y"), ("A", "B"), ("P", "x")]
    assert {name for edge in pictures.edges_of(pictures.JOINT) for name in edge} == set(pictures.NODES)


def test_filter_and_contour_clean_a_squat(tmp_path):
    figures = pictures.draw_depth(tmp_path / "figure3.png", (144, 192))
    assert figures["psnr_after"] > figures["psnr_before"] + 2
    assert figures["iou"] > 0.6
    assert (tmp_path / "figure3.png").stat().st_size > 1000


def test_a_run_writes_numbers_and_pictures(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scatter, "run_parallel", lambda task, items, *_, **__: [(item, task(item)) for item in items])
    cells = [Cell("rigid", f, 120.0, 30.0, "rigid") for f in (12, 24)]
    monkeypatch.setattr(scatter, "grid_cells", lambda *_: cells)
    monkeypatch.setattr(scatter, "deflection_cells", lambda *_, **__: cells)
    assert main(["--figure", "1", "8", "9", "--smoke", "-o", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "figures.json").read_text())["figures"]
    records = written["9"]["records"]
    assert [record["frames"] for record in records] == [12, 24]
    # One similarity for all frames cannot do better than one for each.
    assert all(record["disparity"] <= record["disparity_sequence"] * (1 + 1e-9) for record in records)
    assert all(0 < record["floor"] < record["disparity"] * 1.5 < 0.1 for record in records)
    for figure in (1, 8, 9):
        assert (tmp_path / f"figure{figure}.png").stat().st_size > 1000
    assert "Pro-D" in capsys.readouterr().out
    # The second run reads the cache.
    monkeypatch.setattr(scatter, "_solve", None)
    assert main(["--figure", "9", "--smoke", "-o", str(tmp_path)]) == 0
    assert curves.curve_lines([{**record, "disparity": None} for record in records])[1].count("nan") == 2
