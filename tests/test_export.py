"""Exports are read back by an independent reader, or by hand."""

from __future__ import annotations

import csv
import importlib.util

import numpy as np
import pytest
import torch

import torchrecon as tr
from torchrecon.io.export import export_reconstruction


@pytest.fixture
def rec() -> tr.Reconstruction:
    points = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(3))
    return tr.Reconstruction.from_points(points, torch.eye(3).expand(4, 3, 3), rank=2, status=tr.Status("ok", "made"))


def test_csv(rec, tmp_path):
    with export_reconstruction(rec, tmp_path / "a.csv", fps=50.0).open() as stream:
        rows = list(csv.DictReader(stream))
    values = np.array([[float(r[a]) for a in "xyz"] for r in rows]).reshape(4, 5, 3)
    np.testing.assert_allclose(values, rec.points3d, atol=1e-8)
    assert float(rows[5]["time"]) == 0.02


def test_trc_is_y_up_and_tab_separated(rec, tmp_path):
    lines = export_reconstruction(rec, tmp_path / "a.trc", fps=50.0).read_text().splitlines()
    assert lines[2].split("\t")[2:5] == ["4", "5", "m"]
    values = np.array([[float(x) for x in line.split("\t")[2:]] for line in lines[6:]]).reshape(4, 5, 3)
    np.testing.assert_allclose(values * [1, -1, -1], rec.points3d, atol=1e-8)


def test_ply(rec, tmp_path):
    lines = export_reconstruction(rec, tmp_path / "a.ply").read_text().splitlines()
    body = np.array([[float(x) for x in line.split()] for line in lines[lines.index("end_header") + 1 :]])
    np.testing.assert_allclose(body[:, :3].reshape(4, 5, 3), rec.points3d, atol=1e-8)
    assert body[:, 3].tolist() == sorted([0, 1, 2, 3] * 5)


@pytest.mark.skipif(importlib.util.find_spec("ezc3d") is None, reason="ezc3d is not installed")
def test_c3d(rec, tmp_path):
    import ezc3d

    read = ezc3d.c3d(str(export_reconstruction(rec, tmp_path / "a.c3d", fps=50.0)))
    np.testing.assert_allclose(read["data"]["points"][:3].transpose(2, 1, 0), rec.points3d, atol=1e-5)
    assert read["parameters"]["POINT"]["RATE"]["value"] == [50]


def test_unknown_suffix_names_the_known_ones(rec, tmp_path):
    with pytest.raises(tr.ReconError, match=r"\.csv"):
        export_reconstruction(rec, tmp_path / "a.xyz")
    with pytest.raises(tr.ReconError, match="does not exist"):
        export_reconstruction(rec, tmp_path / "none" / "a.csv")
