"""Cameras that film known motion again, noise and gaps."""

from __future__ import annotations

import math

import pytest
import torch

from torchrecon.data.views import CAMERAS, degrade_tracks, film_again
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_rotation, rotation_angle, rotation_from_vector

F = 80


def _orbit() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A bending body, seen by a camera that turns about a tilted vertical."""
    g = torch.Generator().manual_seed(0)
    world = torch.randn(12, 3, generator=g) + 0.1 * torch.randn(F, 12, 3, generator=g)
    vertical = torch.tensor([0.2, 0.95, 0.1])
    vertical = vertical / vertical.norm()
    tilt = rotation_from_vector(torch.tensor([0.3, 0.0, 0.1]))
    turn = tilt @ rotation_from_vector(0.087 * torch.arange(F)[:, None] * vertical)
    return world, world @ turn.mT, tilt @ vertical


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_new_camera_shows_the_same_body(camera):
    world, first, vertical = _orbit()
    seen = film_again(world, first, camera)
    centred = world - world.mean(1, keepdim=True)
    rotations = nearest_rotation(seen.mT @ centred)
    torch.testing.assert_close(centred @ rotations.mT, seen)
    turns = rotations @ rotations[0].mT
    angle = math.degrees(float(rotation_angle(turns[-1])))
    if camera.startswith("turn"):
        assert angle == pytest.approx(float(camera[4:]), abs=1e-6)
        assert float(rotation_angle(turns[3 * F // 8])) < 1e-6
        torch.testing.assert_close(turns[-1] @ vertical, vertical)  # a yaw
    if camera == "pan":
        assert angle == pytest.approx(60, abs=1e-6)
    if camera == "sway":
        assert 1 < math.degrees(float(rotation_angle(turns).amax())) < 30


def test_without_a_turning_first_camera_there_is_no_vertical():
    world, _, _ = _orbit()
    with pytest.raises(ReconError, match="does not turn"):
        film_again(world, world, "pan")
    with pytest.raises(ReconError, match="turn60"):
        film_again(world, world, "spin")


def test_noise_and_gaps_are_as_asked():
    xy = 50 * torch.randn(200, 30, 2, generator=torch.Generator().manual_seed(1))
    sigma = 0.02 * float((xy - xy.mean(1, keepdim=True)).abs().max())
    tracks = degrade_tracks(xy, 0.02, 0.3, (10, 40), generator=torch.Generator().manual_seed(2))
    assert float((tracks.xy - xy)[tracks.visible].std()) == pytest.approx(sigma, rel=0.03)
    assert float((~tracks.visible).double().mean()) == pytest.approx(0.3, abs=0.01)
    edges = torch.nn.functional.pad((~tracks.visible).T.to(torch.int8), (1, 1)).diff(dim=1)
    lengths = (edges == -1).nonzero()[:, 1] - (edges == 1).nonzero()[:, 1]
    assert int(lengths.min()) >= 10
    with pytest.raises(ReconError, match="gaps"):
        degrade_tracks(xy, 0.0, 0.3, (9, 3), generator=torch.Generator())
    with pytest.raises(ReconError, match="missing"):
        degrade_tracks(xy, 0.0, 1.0, generator=torch.Generator())
