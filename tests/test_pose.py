"""``track --pose rtmlib``: an estimator that is not here is stood in for by one that plays recorded arrays."""

from __future__ import annotations

import json
import sys
import types
from typing import ClassVar

import numpy as np
import pytest

import torchrecon as tr
from tests.track_files import walk
from torchrecon.cli import main
from torchrecon.errors import ReconError
from torchrecon.io.readers import ReadOptions
from torchrecon.pipeline.pose import track_pose

FRAMES = 12
ALICE, BERT = walk(17), walk(17, start=(420.0, 180.0), speed=-3.0)
SCORES = np.random.default_rng(0).uniform(0.3, 1.2, (FRAMES, 17))
URL = "https://download.openmmlab.com/mmpose/v1/projects/rtmposev1/onnx_sdk/"


class Body:
    """What rtmlib's class of this name takes and gives; the frame's number stands in the blue of its first pixel."""

    MODE: ClassVar = {"balanced": {"det": f"{URL}yolox_m-c2c7a14a.zip", "pose": f"{URL}rtmpose-m-e48f03d0.zip"}}

    def __init__(self, mode, backend, device):
        assert (mode, backend, device) == ("balanced", "onnxruntime", "cpu")
        print("load rtmpose-m with onnxruntime backend")

    def __call__(self, image):
        assert image.shape == (240, 520, 3)
        assert image.dtype == np.uint8
        index = int(image[0, 0, 0])
        if index == 5:
            return np.zeros((0, 17, 2), np.float32), np.zeros((0, 17), np.float32)
        people = [(ALICE[index], SCORES[index]), (BERT[index], 0.5 * SCORES[index])]
        if index % 2:
            people.reverse()
        return tuple(np.stack(part).astype(np.float32) for part in zip(*people, strict=True))


@pytest.fixture
def rtmlib(monkeypatch, tmp_path):
    """An importable rtmlib with its weights in its cache, and a clip."""
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setitem(sys.modules, "rtmlib", types.SimpleNamespace(Body=Body))
    monkeypatch.delenv("TORCH_HOME", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = tmp_path / "rtmlib" / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    for name in ("yolox_m-c2c7a14a.onnx", "rtmpose-m-e48f03d0.onnx"):
        (folder / name).touch()
    (tmp_path / "frames").mkdir()
    for index in range(FRAMES):
        image = np.full((240, 520, 3), 90, np.uint8)
        image[0, 0] = (index, 200, 100)
        cv2.imwrite(str(tmp_path / "frames" / f"{index:03d}.png"), image)
    return folder


def test_joints_of_the_surest_person_with_names_and_confidence(rtmlib, tmp_path, capsys):
    command = ["track", str(tmp_path / "frames"), "-o", str(tmp_path / "t.npz"), "--pose", "rtmlib", "--json"]
    (tmp_path / "camera.json").write_text(json.dumps({"K": [[500, 0, 260], [0, 500, 120], [0, 0, 1]]}))
    assert main([*command, "--camera", str(tmp_path / "camera.json")]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out) == {"tracks": 17, "frames": FRAMES, "out": str(tmp_path / "t.npz")}
    assert "2 people are found" in said.err
    tracks = tr.load_tracks(tmp_path / "t.npz")
    there = np.arange(FRAMES) != 5
    np.testing.assert_allclose(tracks.xy[there], ALICE[there], atol=1e-3)
    assert (tracks.visible.numpy() == there[:, None]).all()
    assert tracks.names[5] == "left_shoulder"
    assert (5, 7) in {tuple(sorted(edge)) for edge in tracks.edges}
    assert tracks.intrinsics[0, 2] == 260
    # std(c) is std(1) / c, and c beyond 1 is 1: the ratio of two variances is known whatever the body's size.
    c = np.minimum(SCORES, 1.0)
    variance = tracks.covariance[..., 0, 0].numpy()
    np.testing.assert_allclose(variance[0, 3] / variance[8, 2], (c[8, 2] / c[0, 3]) ** 2, rtol=1e-5)


def test_the_other_person_is_as_if_read_from_a_file_of_the_same_keypoints(rtmlib, tmp_path):
    found = track_pose(tmp_path / "frames", options=ReadOptions(person=1))
    np.testing.assert_allclose(found.xy[:5], BERT[:5], atol=1e-3)
    scores = np.stack([SCORES, 0.5 * SCORES], 1).astype(np.float32)
    scores[5] = 0
    np.savez(tmp_path / "k.npz", keypoints=np.stack([ALICE, BERT], 1).astype(np.float32), scores=scores)
    read = tr.load_tracks(tmp_path / "k.npz", person=1)
    for name in ("xy", "visible", "covariance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(read, name))


def test_what_is_not_there_is_said_with_what_to_do(rtmlib, tmp_path, monkeypatch, capsys):
    def refuse(words, *more):
        clip = str(tmp_path / "frames")
        assert main(["track", clip, "-o", str(tmp_path / "t.npz"), *more]) == 2
        assert words in capsys.readouterr().err
        assert not (tmp_path / "t.npz").exists()

    refuse("--masks: is of no use", "--pose", "rtmlib", "--masks", str(tmp_path))
    refuse("needs --pose", "--person", "1")
    refuse("person 2 is not there: 2 people", "--pose", "rtmlib", "--person", "2")
    monkeypatch.setattr(Body, "__call__", lambda self, image: (np.zeros((0, 17, 2)), np.zeros((0, 17))))
    refuse("nobody is found", "--pose", "rtmlib")
    monkeypatch.setattr(Body, "__call__", lambda self, image: (np.zeros((2, 17, 2)), np.zeros((3, 17))))
    refuse("frame 0: keypoints (2, 17, 2) and scores (3, 17)", "--pose", "rtmlib")
    (rtmlib / "rtmpose-m-e48f03d0.onnx").unlink()
    refuse(f"rtmpose-m-e48f03d0.onnx are not in {rtmlib}; copy them there", "--pose", "rtmlib")
    monkeypatch.setitem(sys.modules, "rtmlib", None)
    refuse("pip install 'torchrecon[pose]'", "--pose", "rtmlib")
    with pytest.raises(ReconError, match="--pose magic: is not known; use rtmlib"):
        track_pose(tmp_path / "frames", "magic")
