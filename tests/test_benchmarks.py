"""Readers of the public sequences, and the metric that a stored result pins down."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from eval.recordings import CAMERAS, at_image_scale, recording, recordings
from eval.trials import sample, trial, trials
from torchrecon.data.benchmarks import SEQUENCES, load_benchmark
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_rotation, rotation_angle
from torchrecon.metrics import error3d_akhter

SHAPES = {
    "drink": (1102, 41),
    "pickup": (357, 41),
    "yoga": (307, 41),
    "stretch": (370, 41),
    "dance": (264, 75),
    "walking": (260, 55),
    "face": (316, 40),
    "shark": (240, 91),
}


def test_all_eight_have_their_published_size(data_dir):
    for name in SEQUENCES:
        assert load_benchmark(name, data_dir / "nrsfm").points3d.shape == (*SHAPES[name], 3)


@pytest.mark.parametrize(
    ("name", "published"),
    [("drink", 0.0250), ("pickup", 0.2369), ("yoga", 0.1625), ("stretch", 0.1088), ("dance", 0.2956)],
)
def test_stored_pta_result_scores_as_published(name, published, data_dir):
    sequence = load_benchmark(name, data_dir / "nrsfm")
    assert abs(float(error3d_akhter(sequence.stored_pta, sequence.canonical)) - published) < 1e-4


def test_camera_frame_is_a_rotated_world_frame(data_dir):
    sequence = load_benchmark("pickup", data_dir / "nrsfm")
    centred = [x - x.mean(-2, keepdim=True) for x in (sequence.points3d, sequence.canonical)]
    torch.testing.assert_close(
        torch.cdist(centred[0], centred[0]), torch.cdist(centred[1], centred[1]), rtol=1e-6, atol=1e-6
    )


def test_missing_data_is_named(tmp_path):
    with pytest.raises(ReconError, match="camera_frame"):
        load_benchmark("yoga", tmp_path)
    with pytest.raises(ReconError, match="not one of"):
        load_benchmark("jog", tmp_path)


def test_humaneva_is_seen_by_the_camera_that_its_pixels_tell_of(data_dir):
    folder = data_dir / "keypoints"
    for name in recordings(folder)[:2]:
        for camera in range(CAMERAS):
            xy, metres = recording(name, camera, folder)
            seen = at_image_scale(metres, xy)[..., :2]
            seen, flat = (part - part.mean(1, keepdim=True) for part in (seen, xy))
            # what is left is perspective within the body
            assert float((seen - flat).norm() / flat.norm()) < 0.08
            assert float((metres - metres.mean(1, keepdim=True)).norm(dim=-1).max()) < 2.0  # a person, in metres


def test_trials_of_the_motion_capture_turn_before_the_camera(tmp_path):
    names, lengths = ("pelvis", "neck", "hand"), (100, 89, 300)
    g = torch.Generator().manual_seed(0)
    arrays = {f"clip_{i:04d}": torch.randn(n, 3, 3, generator=g).numpy() for i, n in enumerate(lengths)}
    fields = {k: np.array(["walk"] * 3) for k in ("label", "subject", "trial", "source", "quality", "license")}
    np.savez(
        tmp_path / "general.npz",
        joints=np.array(names),
        parents=np.array([-1, 0, 1]),
        n_clips=3,
        fps=np.array([30.0] * 3),
        **fields,
        **arrays,
    )
    assert trials(tmp_path) == ["0000-walk", "0002-walk"]
    assert sample(tmp_path) == ["0000-walk"]
    found = trial("0002-walk", tmp_path)
    assert found.points3d.shape == (240, 3, 3)
    step = nearest_rotation(found.points3d.mT @ found.canonical)
    torch.testing.assert_close(rotation_angle(step[1:] @ step[:-1].mT), torch.full((239,), math.radians(5)).double())
    with pytest.raises(ReconError, match="0001-walk"):
        trial("0001-walk", tmp_path)
