"""Long sequences in windows, dense ones through a sample: the same answer as in one piece."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable

import pytest
import torch

import torchrecon as tr
from torchrecon.linalg import nearest_rotation, rotation_from_vector
from torchrecon.metrics import error3d_camera
from torchrecon.nrsfm.dense import DenseParams, solve_dense
from torchrecon.nrsfm.rigid import rigid
from torchrecon.nrsfm.windows import WindowParams, solve_windows, window_starts


def solve_rigid(item: tr.Tracks, rank: int, generator: torch.Generator) -> tr.Reconstruction:
    return rigid(item, rank, generator=generator)


def turning(frames: int, points: int, generator: torch.Generator, bend: float = 0.0) -> torch.Tensor:
    """A body of one or two shape bases that turns about changing axes (frames, points, 3), of size 100."""
    time = torch.linspace(0, 9, frames, dtype=torch.float64)
    rest, mode = torch.randn(2, points, 3, generator=generator, dtype=torch.float64)
    shape = rest + bend * torch.sin(4.3 * time)[:, None, None] * mode
    axis = torch.stack([0.6 * torch.sin(0.7 * time), time, 0.4 * torch.cos(1.1 * time)], 1)
    return 100 * (shape - shape.mean(1, keepdim=True)) @ rotation_from_vector(axis).mT


def test_windows_cover_every_frame_and_overlap():
    params = WindowParams(length=50, overlap=10)
    for frames in (20, 50, 51, 90, 333):
        starts = window_starts(frames, params)
        assert starts[0] == 0
        assert starts[-1] == max(0, frames - 50)
        assert all(0 < b - a <= 40 for a, b in itertools.pairwise(starts))


def test_windows_of_a_rigid_body_are_one_body(generator):
    truth = turning(200, 12, generator)
    shift = torch.linspace(0, 500, 200, dtype=torch.float64)[:, None, None]
    answer = solve_windows(tr.Tracks(truth[..., :2] + shift), 1, generator, solve_rigid, WindowParams(0, 50, 10))
    assert answer.status.ok
    assert float(error3d_camera(answer.points3d, truth)) < 1e-6
    assert float((answer.reproject() - truth[..., :2] - shift).abs().max()) < 1e-6
    # One set of canonical axes: the body is the same in every frame.
    assert float((answer.canonical - answer.canonical[:1]).abs().max()) < 1e-5


def test_a_window_that_says_too_little_is_named(generator):
    truth = turning(120, 12, generator)
    still = truth[:1].expand(60, -1, -1)
    answer = solve_windows(
        tr.Tracks(torch.cat([truth, still])[..., :2]), 1, generator, solve_rigid, WindowParams(0, 50, 10, turn=0.0)
    )
    assert answer.status.code == "undetermined"
    assert answer.status.text.startswith("window 5 of 5, frames 130 to 179: the view turns")


def test_windows_grow_where_the_view_stands_still(generator):
    truth = turning(120, 12, generator)
    seen = torch.cat([truth, truth[-1:].expand(60, -1, -1)])
    answer = solve_windows(tr.Tracks(seen[..., :2]), 1, generator, solve_rigid, WindowParams(0, 50, 10))
    assert answer.status.ok
    assert answer.status.text == "2 windows of 100 frames"
    assert float(error3d_camera(answer.points3d, seen)) < 1e-6


def test_a_long_sequence_of_one_view_is_solved_in_one_piece(generator):
    still = turning(120, 12, generator)[:1].expand(90, -1, -1)
    answer = solve_windows(tr.Tracks(still[..., :2].clone()), 1, generator, solve_rigid, WindowParams(0, 50, 10))
    assert answer.status.code == "undetermined"
    assert not answer.status.text.startswith("window")


def told(truth: torch.Tensor) -> Callable[[tr.Tracks, int, torch.Generator], tr.Reconstruction]:
    """A solver that knows the answer; its tracks carry the index of each point."""

    def solve(item: tr.Tracks, rank: int, generator: torch.Generator) -> tr.Reconstruction:
        assert item.extras is not None
        points = truth[:, item.extras["index"]]
        view = points[0].T @ torch.linalg.pinv(points.mT)
        return tr.Reconstruction.from_points(
            points,
            nearest_rotation(torch.linalg.inv(view)),
            rank=rank,
            status=tr.Status("ok", "told"),
            translation=points.mean(1)[:, :2] + 7,
        )

    return solve


@pytest.mark.parametrize("share", [1.0, 0.8])
def test_dense_points_follow_their_sample(generator, share):
    truth = turning(60, 150, generator)
    visible = torch.rand(60, 150, generator=generator) < share
    tracks = tr.Tracks(truth[..., :2] + 7, visible, extras={"index": torch.arange(150)})
    answer = solve_dense(tracks, 1, generator, told(truth), DenseParams(sample=40, chunk=64))
    assert float(error3d_camera(answer.points3d, truth)) < 1e-5
    assert float((answer.reproject() - truth[..., :2] - 7)[visible].abs().max()) < 0.01
    assert answer.status.text == "told; 40 of 150 points give the cameras"


def test_dense_covariance_is_that_of_the_regression(generator):
    truth = turning(80, 400, generator)
    noise = 2.0
    xy = truth[..., :2] + 7 + noise * torch.randn(80, 400, 2, generator=generator, dtype=torch.float64)
    covariance = noise**2 * torch.eye(2, dtype=torch.float64).expand(80, 400, 2, 2)
    tracks = tr.Tracks(xy, covariance=covariance, extras={"index": torch.arange(400)})
    answer = solve_dense(tracks, 1, generator, told(truth), DenseParams(sample=200))
    miss = min(
        (answer.points3d - truth, answer.mirrored().points3d - truth), key=lambda error: float(error.square().sum())
    )
    assert answer.covariance3d is not None
    squared = (torch.linalg.solve(answer.covariance3d, miss[..., None])[..., 0] * miss).sum(-1)
    assert 0.9 < float((squared < 7.815).double().mean()) < 0.99


def test_auto_takes_windows_and_samples(generator, monkeypatch):
    auto = importlib.import_module("torchrecon.nrsfm.auto")
    monkeypatch.setattr(auto, "solve_marginal", solve_rigid)
    long = tr.reconstruct(tr.Tracks(turning(1030, 8, generator)[..., :2]), 1)
    assert long.status.text == "3 windows of 500 frames"
    many = tr.reconstruct(tr.Tracks(turning(20, 700, generator)[..., :2]), 1)
    assert many.status.text.endswith("300 of 700 points give the cameras")
