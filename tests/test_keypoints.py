"""PCK in 3D and PCKh, matching of left-out points, and the MPII readers."""

from __future__ import annotations

import gzip
import json
import math

import pytest
import torch

from torchrecon.data.mpii import MPII_JOINTS, load_mpii, load_mpii_predictions
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement.camera import project_points
from torchrecon.metrics import matching_degree, pck3d, pckh, place_in_view, similarity_align


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_similarity_of_a_sequence_is_undone_and_a_mirror_is_not(generator, batch):
    truth = torch.randn(*batch, 5, 9, 3, generator=generator)
    turn = rotation_from_vector(torch.randn(*batch, 3, generator=generator))
    shift = torch.randn(*batch, 5, 1, 3, generator=generator)
    aligned, target = similarity_align(0.3 * truth @ turn[..., None, :, :].mT + shift, truth)
    torch.testing.assert_close(aligned, target)
    assert pck3d(0.3 * truth + shift, truth).shape == batch
    mirrored, target = similarity_align(truth * torch.tensor([1.0, 1.0, -1.0]), truth)
    assert (mirrored - target).norm() > 0.3 * target.norm()


def test_one_similarity_for_the_sequence_is_not_one_for_each_frame(generator):
    truth = torch.randn(2, 9, 3, generator=generator)
    estimate = truth.clone()
    estimate[1] = truth[1] @ rotation_from_vector(torch.tensor([0.0, 2.5, 0.0])).mT
    assert pck3d(estimate[1:], truth[1:]) == 100
    assert pck3d(estimate, truth) < 50


def test_pck3d_counts_points_within_the_threshold_of_this_person():
    truth = torch.zeros(1, 4, 3)
    truth[0, :, 0] = torch.tensor([-3.0, -1.0, 1.0, 3.0])
    off = torch.zeros(1, 4, 3)
    # Two errors that leave the centroid where it is: 0.14 m and 0.16 m.
    off[0, :, 1] = torch.tensor([0.14, -0.14, 0.16, -0.16])
    assert pck3d(truth + off, truth, align="translation") == 50
    assert pck3d(truth + off, truth, align="translation", stature=1.80 * 0.13 / 0.15) == 0
    assert pck3d(truth + off, truth, align="translation", stature=2.0) == 100
    seen = torch.tensor([[True, True, False, False]])
    assert pck3d(torch.where(seen[..., None], truth + off, torch.nan), truth, seen, align="translation") == 100
    with pytest.raises(ReconError, match="stature"):
        pck3d(truth, truth, stature=0.0)


def test_pck3d_refuses_nan(generator):
    truth = torch.randn(2, 5, 3, generator=generator)
    with pytest.raises(ReconError, match="not finite"):
        pck3d(truth * torch.nan, truth, align="translation")


def test_pckh_reads_annotated_joints_only(generator):
    truth = 100 * torch.rand(20, 16, 2, generator=generator)
    head = 5 + 10 * torch.rand(20, generator=generator)
    angle = 6.28 * torch.rand(20, 16, generator=generator)
    way = torch.stack([angle.cos(), angle.sin()], -1)
    reach = torch.linspace(0.025, 0.975, 20)[:, None, None] * head[:, None, None]
    assert pckh(truth + reach * way, truth, head).tolist() == [50.0] * 16
    present = torch.ones(20, 16, dtype=torch.bool)
    present[10:, 3], present[:, 5] = False, False
    found = pckh(torch.where(present[..., None], truth + reach * way, torch.nan), truth, head, present)
    assert found[3] == 100
    assert found[5].isnan()
    with pytest.raises(ReconError, match="head"):
        pckh(truth, truth, head * 0)


def test_csv_and_json_forms_say_the_same(tmp_path):
    joints = [[float(10 * i), float(i) - 1.0] for i in range(16)]
    joints[9] = [677.0, -7.4]  # outside the image, yet annotated
    shown = [1] * 16
    shown[2], joints[2] = 0, [-1.0, -1.0]
    person = {"image": "a.jpg", "scale": 3.25, "center": [1.0, 2.0], "joints": joints, "joints_vis": shown}
    (tmp_path / "a.json").write_text(json.dumps([person]))
    head = ["", "NAME", *(f"{j}_{a}" for j in MPII_JOINTS for a in "XY"), "Scale", "Activity", "Category"]
    row = ["0", "a.jpg", *(str(v) for xy in joints for v in xy), "3.25", "curling", "sports"]
    text = ",".join(head) + "\n" + ",".join(row) + "\n"
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(text.encode()))
    first = load_mpii(tmp_path / "a.json")
    for name in ("a.csv", "a.csv.gz"):
        second = load_mpii(tmp_path / name)
        torch.testing.assert_close(first.xy, second.xy, equal_nan=True)
        assert first.names == second.names == ("a.jpg",)
        assert second.activity == ("curling",)
        assert float(second.scale) == 3.25
    assert first.xy[0, 2].isnan().all()
    assert first.xy[0, 9].tolist() == [677.0, -7.4]


def test_unusable_annotations_name_file_row_and_key(tmp_path):
    with pytest.raises(ReconError, match="no such file"):
        load_mpii(tmp_path / "none.csv")
    (tmp_path / "b.csv").write_text("NAME,Scale,Activity\n")
    with pytest.raises(ReconError, match=r"b\.csv: has no column 'r ankle_X'"):
        load_mpii(tmp_path / "b.csv")
    (tmp_path / "c.json").write_text('[{"image": "a.jpg", "scale": 1}]')
    with pytest.raises(ReconError, match="person 0: has no key 'joints'"):
        load_mpii(tmp_path / "c.json")
    person = {"image": "a.jpg", "scale": 1, "joints": [[0.0, 0.0]] * 15, "joints_vis": [1] * 16}
    (tmp_path / "c.json").write_text(json.dumps([person]))
    with pytest.raises(ReconError, match="person 0: joints"):
        load_mpii(tmp_path / "c.json")
    (tmp_path / "d.json").write_text("{")
    with pytest.raises(ReconError, match="not readable"):
        load_mpii(tmp_path / "d.json")


@pytest.mark.data
def test_stored_mpii_predictions_score_what_is_published(data_dir):
    published = {
        "head": 95.60, "shoulder": 92.71, "elbow": 83.36, "wrist": 76.74, "hip": 81.93, "knee": 73.36,
        "ankle": 65.45, "mean": 82.34,
    }  # fmt: skip
    scores = load_mpii_predictions(data_dir / "keypoints" / "detections_our_format.mat").scores()
    assert scores.keys() == published.keys()
    for part, value in published.items():
        assert math.isclose(scores[part], value, abs_tol=0.006), part


@pytest.mark.data
def test_mpii_files_are_read_whole(data_dir):
    table = load_mpii(data_dir / "keypoints" / "mpii_dataset.csv.gz")
    assert len(table) == 17_372
    assert sum("basketball" in activity for activity in table.activity) == 170
    people = load_mpii(data_dir / "keypoints" / "test_mpii.json")
    assert len(people) == 5
    assert float(people.xy.isnan().all(-1).double().mean()) == pytest.approx(0.05)


@pytest.mark.parametrize("batch", [(), (2,), (2, 3)])
def test_a_shape_is_placed_where_it_was_seen(generator, batch):
    shape = torch.randn(*batch, 4, 12, 3, generator=generator)
    shift = torch.randn(*batch, 4, 3, generator=generator) + torch.tensor([0.0, 0.0, 9.0])
    k = torch.tensor([[500.0, 0, 320], [0, 480.0, 240], [0, 0, 1]]).expand(*batch, 3, 3)
    xy = project_points(shape + shift[..., None, :], k[..., None, None, :, :])
    seen = torch.rand(*batch, 4, 12, generator=generator) < 0.7
    hidden = torch.where(seen[..., None], shape, torch.nan)
    torch.testing.assert_close(place_in_view(hidden, xy, seen, k), shift)
    # Twice as large is twice as far: the same picture.
    again = place_in_view(2 * shape, xy, seen, k)
    torch.testing.assert_close(project_points(2 * shape + again[..., None, :], k[..., None, None, :, :]), xy)
    with pytest.raises(ReconError, match="fewer than two"):
        place_in_view(shape, xy, torch.zeros_like(seen), k)


def test_placing_is_the_least_squares_solution(generator):
    shape = torch.randn(1, 9, 3, generator=generator)
    k = torch.tensor([[500.0, 0, 320], [0, 480.0, 240], [0, 0, 1]])
    xy = project_points(shape + torch.tensor([0.2, 0.1, 8.0]), k) + torch.randn(1, 9, 2, generator=generator)
    n = (xy[0] - torch.tensor([320.0, 240.0])) / torch.tensor([500.0, 480.0])
    one, zero = torch.ones(9), torch.zeros(9)
    design = torch.cat([torch.stack([one, zero, -n[:, 0]], -1), torch.stack([zero, one, -n[:, 1]], -1)])
    right = torch.cat([n[:, 0] * shape[0, :, 2] - shape[0, :, 0], n[:, 1] * shape[0, :, 2] - shape[0, :, 1]])
    expected = torch.linalg.lstsq(design, right[:, None]).solution[:, 0]
    found = place_in_view(shape, xy, torch.ones(1, 9, dtype=torch.bool), k)
    torch.testing.assert_close(found[0], expected)


def test_a_point_without_a_position_is_a_miss():
    truth = torch.zeros(2, 4, 2)
    off = torch.tensor([0.0, 2.0, 4.0, torch.nan])[:, None].expand(4, 2) / 2**0.5
    chosen = torch.tensor([[True] * 4, [True, False, False, True]])
    assert matching_degree(off.expand(2, 4, 2), truth, chosen).tolist() == [50.0, 50.0]
    assert matching_degree(off.expand(2, 4, 2), truth, ~chosen).isnan().tolist() == [True, False]
