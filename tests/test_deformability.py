"""Deformation over time and per body part, and the scree figure."""

from __future__ import annotations

import pytest
import torch

from eval.reliability.world import low_rank_tracks
from torchrecon.cli import main
from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks
from torchrecon.rank import deformability_over_time, deformability_per_part, estimate_rank
from torchrecon.viz.scree import draw_scree


def test_windows_say_when_a_body_bends() -> None:
    still, bending = (low_rank_tracks(60, 40, bases, 20.0, seed=1) for bases in (1, 3))
    tracks = Tracks(torch.cat([still.xy, bending.xy]))
    found = deformability_over_time(tracks, length=60, step=20)
    assert found.start.tolist() == [0, 20, 40, 60]
    assert found.degree[0] == 1
    assert found.degree[-1] == 3
    # two bodies in one window need more bases than either
    assert bool((found.degree[1:3] > 1).all())
    assert bool((found.interval[:, 0] <= found.degree.round()).all())
    # a window that is the whole sequence is the plain estimate, and the last window ends with the sequence
    whole = deformability_over_time(tracks, length=500)
    assert whole.length == 120
    assert float(whole.degree[0]) == pytest.approx(float(estimate_rank(tracks).deformation_degree))
    assert deformability_over_time(tracks, length=50, step=40).start.tolist() == [0, 40, 70]


def test_a_rigid_part_of_a_bending_body_is_rigid() -> None:
    trunk, arm = (low_rank_tracks(150, 20, bases, 30.0, seed=2) for bases in (1, 2))
    tracks = Tracks(torch.cat([trunk.xy, arm.xy], 1))
    found = deformability_per_part(tracks, {"trunk": range(20), "arm": range(20, 40), "both": range(40)})
    assert [found[name].rank for name in ("trunk", "arm")] == [1, 2]
    assert found["both"].rank >= 2
    few = deformability_per_part(tracks, {"hand": range(20, 27)})["hand"]
    assert few.rank == 2
    assert any("at most 2" in text for text in few.warnings)
    batch = Tracks(torch.stack([tracks.xy, tracks.xy.flip(1)]))
    assert deformability_per_part(batch, {"first": range(20)})["first"].rank.tolist() == [1, 2]


def test_what_cannot_be_windows_or_parts_is_named() -> None:
    tracks = Tracks(torch.rand(30, 12, 2))
    with pytest.raises(ReconError, match="one sequence"):
        deformability_over_time(Tracks(torch.rand(2, 30, 12, 2)))
    with pytest.raises(ReconError, match="length 3"):
        deformability_over_time(tracks, length=3)
    for points in (range(4), range(8, 13)):
        with pytest.raises(ReconError, match="'leg'"):
            deformability_per_part(tracks, {"leg": points})


def test_scree_figure_from_the_command_line_and_what_it_refuses(tmp_path) -> None:
    file = Tracks(low_rank_tracks(60, 30, 2, 20.0, seed=0).xy).save(tmp_path / "tracks.npz")
    assert main(["rank", str(file), "--figure", str(tmp_path / "scree.svg")]) == 0
    text = (tmp_path / "scree.svg").read_text()
    assert "<svg" in text
    assert text.count("<path") > 10
    assert main(["rank", str(file), "--rule", "cross_validation", "--figure", str(tmp_path / "cv.png")]) == 0
    assert (tmp_path / "cv.png").stat().st_size > 5000
    with pytest.raises(ReconError, match="one estimate"):
        draw_scree(estimate_rank(Tracks(torch.rand(2, 30, 12, 2))), tmp_path / "no.png")
    with pytest.raises(ReconError, match="no eigenvalues"):
        draw_scree(estimate_rank(Tracks(torch.rand(5, 2, 2))), tmp_path / "no.png")
    assert not (tmp_path / "no.png").exists()
