"""Rotations against scipy and against their defining properties."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrecon.linalg import (
    nearest_orthogonal,
    nearest_rotation,
    rotation_angle,
    rotation_from_rows,
    rotation_from_vector,
    skew,
)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_rotation_from_vector_is_scipys(batch, generator):
    from scipy.spatial.transform import Rotation

    vector = torch.randn(*batch, 3, generator=generator)
    expected = Rotation.from_rotvec(vector.reshape(-1, 3).numpy()).as_matrix().reshape(*batch, 3, 3)
    np.testing.assert_allclose(rotation_from_vector(vector).numpy(), expected, atol=1e-12)


def test_rotation_from_vector_is_smooth_at_zero():
    vector = torch.zeros(3, requires_grad=True)
    assert torch.autograd.gradcheck(rotation_from_vector, vector)
    assert torch.autograd.gradcheck(rotation_from_vector, torch.full((3,), 1e-5, requires_grad=True))


def test_rotation_angle_is_accurate_at_both_ends():
    for angle in (1e-9, 1e-3, 1.0, torch.pi - 1e-6):
        found = rotation_angle(rotation_from_vector(torch.tensor([0.0, angle, 0.0])))
        assert abs(float(found) - angle) < 1e-9 * max(1.0, 1 / angle * 1e-9)


def test_nearest_rotation_beats_any_other_rotation(generator):
    matrix = torch.randn(5, 3, 3, generator=generator)
    nearest = nearest_rotation(matrix)
    torch.testing.assert_close(torch.linalg.det(nearest), torch.ones(5))
    others = rotation_from_vector(torch.randn(200, 1, 3, generator=generator))
    distance = (others - matrix).square().sum((-1, -2)).amin(0)
    assert bool(((nearest - matrix).square().sum((-1, -2)) <= distance).all())
    orthogonal = nearest_orthogonal(matrix)
    assert bool(
        ((orthogonal - matrix).square().sum((-1, -2)) <= (nearest - matrix).square().sum((-1, -2)) + 1e-12).all()
    )


def test_rotation_from_rows_keeps_exact_rows(generator):
    rotation = rotation_from_vector(torch.randn(4, 3, generator=generator))
    torch.testing.assert_close(rotation_from_rows(3.0 * rotation[:, :2]), rotation)


def test_skew_is_the_cross_product(generator):
    a, b = torch.randn(2, 6, 3, generator=generator)
    torch.testing.assert_close((skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))
