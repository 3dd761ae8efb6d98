"""A view that turns a little: what bends may be deeper, what is rigid may not."""

from __future__ import annotations

import pytest
import torch

from eval.reliability.coverage import squared_distances
from eval.reliability.world import low_rank_tracks
from torchrecon.linalg import rotation_angle, rotation_from_vector
from torchrecon.measurement import Tracks
from torchrecon.metrics import error3d_camera
from torchrecon.nrsfm.marginal import marginal
from torchrecon.nrsfm.relief import made_deeper
from torchrecon.nrsfm.shape_likelihood import ShapeModel, tangents


@pytest.mark.parametrize("seed", [0, 1])
def test_a_bending_body_that_swings_is_not_called_determined(seed):
    made = low_rank_tracks(60, 30, 3, 20.0, seed, motion="swing")
    answer = marginal(Tracks(made.xy), 3)
    assert float(error3d_camera(answer.points3d, made.points3d)) > 0.1  # the depth is indeed wrong
    assert answer.status.code == "undetermined"
    assert "shapes of other depth" in answer.status.text
    # and the ellipsoids reach out for the truth
    assert answer.covariance3d is not None
    held = squared_distances(answer.points3d, answer.covariance3d, made.points3d) < 7.81
    assert float(held.double().mean()) > 0.5


def test_a_rigid_body_that_swings_is_determined():
    made = low_rank_tracks(60, 30, 1, 40.0, 0, motion="swing")
    answer = marginal(Tracks(made.xy), 1)
    assert answer.status.ok, answer.status.text
    assert float(error3d_camera(answer.points3d, made.points3d)) < 0.1


def test_deeper_and_less_turned_look_alike_from_the_middle(generator):
    mean = torch.randn(1, 9, 3, generator=generator, dtype=torch.float64)
    mean = mean - mean.mean(1, keepdim=True)
    angle = torch.linspace(-0.1, 0.1, 11, dtype=torch.float64)
    turn = rotation_from_vector(angle[:, None] * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    model = ShapeModel(
        turn[None],
        torch.ones(1, 11, dtype=torch.float64),
        mean,
        mean.new_zeros(1, 9, 3, 0),
        torch.linalg.qr(tangents(mean))[0],
    )
    deeper = made_deeper(model, 1.6)
    assert float(rotation_angle(deeper.rotations[0, -1])) == pytest.approx(0.1 / 1.6)
    seen = (model.mean @ model.rotations[0].mT)[..., :2]
    again = (deeper.mean @ deeper.rotations[0].mT)[..., :2]
    assert float((seen - again).abs().max()) < 0.01 * float(seen.abs().max())
