"""The part model: its sums, its exact maximum against all readings, and what it tells parts from clutter by."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from scipy import stats

from torchrecon.contour.part_model import Detections, PartModel, PartTemplates, motion_labels
from torchrecon.errors import ReconError

MODEL = PartModel(appearance_volume=12.0**2, motion_volume=2 * math.pi * 100.0, labels=8)


def _scene(seed: int, parts: int = 3, clutter: int = 1, apart: float = 3.0) -> tuple[Detections, PartTemplates]:
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g)

    mean = apart * torch.randn(parts, 2, generator=g)
    root = torch.eye(2) + 0.3 * torch.randn(parts, 2, 2, generator=g)
    templates = PartTemplates(
        0.2 + 0.6 * rand(parts), mean, root @ root.mT, 2 * math.pi * rand(parts), 4 * rand(parts),
        100 * rand(parts), 5 + 20 * rand(parts),
    )  # fmt: skip
    seen = mean + torch.randn(parts, 2, generator=g)
    found = Detections(
        torch.cat([seen, 12 * rand(clutter, 2) - 6]),
        torch.cat([templates.orientation + 0.5 * torch.randn(parts, generator=g), 2 * math.pi * rand(clutter)]),
        torch.cat([templates.speed + 10 * torch.randn(parts, generator=g), 100 * rand(clutter)]),
    )
    order = torch.randperm(parts + clutter, generator=g)
    return Detections(found.appearance[order], found.orientation[order], found.speed[order]), templates


def _readings(parts: int, detections: int):
    for s in itertools.product([False, True], repeat=parts):
        present = [i for i in range(parts) if s[i]]
        for chosen in itertools.permutations(range(detections), len(present)):
            D = [-1] * parts
            for part, detection in zip(present, chosen, strict=True):
                D[part] = detection
            yield torch.tensor(s), torch.tensor(D)


@pytest.mark.parametrize("seed", range(8))
def test_eq8_assignment_is_the_best_of_all_readings(seed):
    found, templates = _scene(seed)
    joint = {
        (tuple(s.tolist()), tuple(D.tolist())): MODEL.log_joint(found, templates, s, D) for s, D in _readings(3, 4)
    }
    best = MODEL.match(found, templates)
    assert (tuple(best.present.tolist()), tuple(best.detection.tolist())) == max(joint, key=joint.__getitem__)
    assert best.log_joint == pytest.approx(max(joint.values()))


def test_eq8_posterior_is_the_share_of_all_readings():
    found, templates = _scene(3, apart=1.0)
    weight = torch.zeros(3, 4)
    total = 0.0
    for s, D in _readings(3, 4):
        value = math.exp(MODEL.log_joint(found, templates, s, D))
        total += value
        weight[s, D[s]] += value
    assert torch.allclose(MODEL.posterior(found, templates), weight / total)
    assert float((weight / total).sum(1).max()) <= 1.0


def test_eq8_log_joint_is_its_factors_by_scipy():
    found, templates = _scene(1)
    s, D = torch.tensor([True, False, True]), torch.tensor([2, -1, 0])
    expected = math.log(templates.presence[0]) + math.log(1 - templates.presence[1]) + math.log(templates.presence[2])
    expected += 3 * math.log(1 / 8) + 2 * (math.log(1 / 12.0**2) + math.log(1 / (2 * math.pi * 100.0)))
    for part, detection in ((0, 2), (2, 0)):
        expected += stats.multivariate_normal(
            templates.appearance[part].numpy(), templates.covariance[part].numpy()
        ).logpdf(found.appearance[detection].numpy())
        angle = float(found.orientation[detection] - templates.orientation[part])
        expected += stats.vonmises(float(templates.concentration[part])).logpdf(angle)
        expected += stats.norm(float(templates.speed[part]), float(templates.speed_deviation[part])).logpdf(
            float(found.speed[detection])
        )
    assert MODEL.log_joint(found, templates, s, D) == pytest.approx(expected)


def test_eq9_presence_sums_to_one():
    _, templates = _scene(0, parts=5)
    every = torch.tensor(list(itertools.product([False, True], repeat=5)))
    assert float(MODEL.log_presence(every, templates).exp().sum()) == pytest.approx(1.0)
    everything = float(MODEL.log_presence(torch.ones(5, dtype=torch.bool), templates).exp())
    assert everything == pytest.approx(float(templates.presence.prod()))


def test_eq10_number_of_labels_shifts_the_density_and_nothing_else():
    found, templates = _scene(2)
    more = replace(MODEL, labels=80)
    first, second = MODEL.match(found, templates), more.match(found, templates)
    assert torch.equal(first.detection, second.detection)
    assert first.log_joint - second.log_joint == pytest.approx(3 * math.log(10))


def test_eq11_doubled_volume_with_no_match_leaves_the_answer():
    found, templates = _scene(4)
    far = replace(found, appearance=found.appearance + 200.0)
    doubled = replace(MODEL, appearance_volume=2 * MODEL.appearance_volume)
    for model in (MODEL, doubled):
        assert not model.match(far, templates).present.any()
    change = MODEL.match(far, templates).log_joint - doubled.match(far, templates).log_joint
    assert change == pytest.approx(4 * math.log(2))


def test_eq11_roc_rises_with_the_distance_between_parts_and_clutter():
    """Area under the curve of posterior presence, part there against part away, clutter in both."""
    areas = []
    for d in (0.5, 1.5, 4.0):
        there, away = [], []
        for seed in range(60):
            g = torch.Generator().manual_seed(seed)
            one = torch.ones(1)
            templates = PartTemplates(
                0.5 * one, torch.zeros(1, 1), torch.ones(1, 1, 1), 0 * one, 0 * one, 0 * one, 10 * one
            )
            clutter = d + torch.randn(3, 1, generator=g)
            seen = torch.cat([torch.randn(1, 1, generator=g), clutter[1:]])
            model = PartModel(2 * d + 6, 2 * math.pi * 25)
            for values, scores in ((seen, there), (clutter, away)):
                found = Detections(values, torch.zeros(3), torch.zeros(3))
                scores.append(float(model.posterior(found, templates).sum()))
        areas.append(stats.mannwhitneyu(there, away).statistic / 3600)
    assert areas[0] < areas[1] < areas[2]
    assert areas[2] > 0.9


def test_order_of_detections_and_parts_does_not_matter():
    found, templates = _scene(5, parts=4, clutter=3)
    best = MODEL.match(found, templates)
    order = torch.tensor([3, 6, 0, 5, 1, 4, 2])
    mixed = Detections(found.appearance[order], found.orientation[order], found.speed[order])
    again = MODEL.match(mixed, templates)
    matched = best.present
    assert torch.equal(order[again.detection[matched]], best.detection[matched])
    swap = torch.tensor([2, 0, 3, 1])
    fields = {name: value[swap] for name, value in vars(templates).items()}
    swapped = MODEL.match(found, PartTemplates(**fields))
    assert torch.equal(swapped.detection, best.detection[swap])
    assert torch.equal(swapped.speed.isnan(), ~swapped.present)


def test_orientation_wraps():
    found, templates = _scene(6)
    turned = replace(found, orientation=found.orientation + 2 * math.pi)
    s, D = torch.tensor([True, True, False]), torch.tensor([0, 3, -1])
    assert MODEL.log_joint(turned, templates, s, D) == pytest.approx(MODEL.log_joint(found, templates, s, D))
    sharp = replace(templates, concentration=torch.full((3,), 1e6))
    assert torch.isfinite(MODEL.log_motion(found, sharp)).all()
    orientation, speed = motion_labels(torch.tensor([[1.0, 1.0]]), torch.tensor([[1.0, -1.0]]), 0.5)
    assert (float(orientation), float(speed)) == (pytest.approx(-math.pi / 2), 4.0)


def test_nothing_found_and_bad_input():
    found, templates = _scene(7)
    none = Detections(torch.zeros(0, 2), torch.zeros(0), torch.zeros(0))
    assert not MODEL.match(none, templates).present.any()
    with pytest.raises(ReconError, match="different detections"):
        MODEL.log_joint(found, templates, torch.tensor([True, True, False]), torch.tensor([1, 1, -1]))
    with pytest.raises(ReconError, match=r"inside \(0, 1\)"):
        MODEL.match(found, replace(templates, presence=torch.tensor([0.5, 1.0, 0.5])))
    with pytest.raises(ReconError, match="speed holds NaN"):
        MODEL.match(replace(found, speed=found.speed * torch.nan), templates)
    with pytest.raises(ReconError, match="features"):
        MODEL.match(replace(found, appearance=found.appearance[:, :1]), templates)
    with pytest.raises(ReconError, match="positive"):
        PartModel(0.0, 1.0)
