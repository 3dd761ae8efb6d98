"""Agreement of overlapping groups on signs and depths."""

from __future__ import annotations

import pytest
import torch
from scipy.optimize import minimize

from torchrecon.nrsfm.consensus import agree_on_depth, agree_on_sign, draw_groups


def _groups(frames: int = 8, points: int = 15, size: int = 6, uses: int = 9):
    g = torch.Generator().manual_seed(0)
    truth = torch.randn(frames, points, generator=g)
    truth = truth - truth.mean(1, keepdim=True)
    index = draw_groups(torch.randn(frames, points, 2, generator=g), size, uses, g)
    return truth, index, truth[:, index].transpose(0, 1).contiguous(), g


def test_every_point_is_in_several_groups_and_no_group_repeats_one():
    _, index, _, _ = _groups()
    assert torch.bincount(index.flatten(), minlength=15).min() >= 3
    assert all(len(group.unique()) == len(group) for group in index)
    whole = draw_groups(torch.randn(3, 5, 2), 8, 4, torch.Generator().manual_seed(0))
    assert whole.tolist() == [[0, 1, 2, 3, 4]]


def test_signs_are_found_up_to_one_for_all():
    _, index, depth, g = _groups()
    sign = torch.where(torch.rand(len(index), generator=g) < 0.5, -1.0, 1.0)
    offset = torch.randn(len(index), 8, 1, generator=g)
    noise = 0.3 * torch.randn(depth.shape, generator=g)
    found = agree_on_sign(sign[:, None, None] * (depth + noise) + offset, index)
    assert torch.equal(found * found[0], sign * sign[0])


def test_wrong_groups_are_outvoted():
    truth, index, depth, g = _groups()
    depth = depth + torch.randn(len(index), 8, 1, generator=g)
    depth[::5] = torch.randn(depth[::5].shape, generator=g)
    robust = (agree_on_depth(depth, index, 15, 30)[0] - truth).abs().max()
    squares = (agree_on_depth(depth, index, 15, 1)[0] - truth).abs().max()
    assert robust < 0.02 < 0.3 < squares


@pytest.mark.parametrize("frame", [0, 3])
def test_agreement_is_the_minimum_of_the_sum_of_distances(frame):
    _, index, depth, g = _groups()
    depth = depth + 0.5 * torch.randn(depth.shape, generator=g)

    def total(z):
        residual = torch.as_tensor(z)[index] - depth[:, frame]
        return float((residual - residual.mean(1, keepdim=True)).norm(dim=1).sum())

    found = agree_on_depth(depth, index, 15, 60)[0][frame]
    best = minimize(total, found.numpy() + 0.01, method="Powell", options={"xtol": 1e-8, "ftol": 1e-12}).fun
    assert total(found) < best * (1 + 1e-4)
