"""Reading frames, masks, depth and cameras: what is read, and what a stranger is told when it cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.io.frames import load_camera, open_depths, open_frames, open_masks


def _images(folder: Path, count: int = 3, size: tuple[int, int] = (12, 16), dtype=np.uint8, channels: int = 3) -> Path:
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(count):
        shape = size if channels == 1 else (*size, channels)
        image = rng.integers(0, np.iinfo(dtype).max, shape).astype(dtype)
        cv2.imwrite(str(folder / f"f{index}.png"), image)
    return folder


def _video(path: Path, count: int = 20, size: tuple[int, int] = (48, 64), fps: float = 29.97) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, (size[1], size[0]))
    for index in range(count):
        writer.write(np.full((*size, 3), (0, 0, 10 * index), np.uint8))
    writer.release()
    return path


def test_folder_is_rgb_in_numeric_order(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for number in (10, 9, 1):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((4, 6, 3), (0, 0, number), np.uint8))
    (folder / "notes.txt").write_text("not a frame")
    source = open_frames(folder)
    assert (len(source), source.size, source.fps) == (3, (4, 6), 25.0)
    assert [round(float(frame[0, 0, 0]) * 255) for frame in source] == [1, 9, 10]  # red is channel 0
    assert all(float(frame[1:].abs().max()) == 0 for frame in source)
    assert next(iter(source)).dtype == torch.float32


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_grey_alpha_and_16_bit_images_become_rgb_in_unit_range(tmp_path, dtype, channels):
    folder = _images(tmp_path / "frames", dtype=dtype, channels=channels)
    stored = cv2.imread(str(folder / "f1.png"), cv2.IMREAD_UNCHANGED).astype(np.float64) / np.iinfo(dtype).max
    frame = list(open_frames(folder, fps=30.0))[1]
    assert frame.shape == (3, 12, 16)
    expected = np.stack([stored] * 3) if channels == 1 else stored[..., 2::-1].transpose(2, 0, 1)
    np.testing.assert_allclose(frame.numpy(), expected, atol=1e-6)


def test_video_can_be_read_twice(tmp_path):
    source = open_frames(_video(tmp_path / "clip.avi"))
    assert (len(source), source.size) == (20, (48, 64))
    assert source.fps == pytest.approx(29.97, abs=0.01)
    first, second = list(source), list(source)
    assert len(first) == 20
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert float(first[15][0].mean()) > float(first[2][0].mean())


@pytest.mark.parametrize("keep", [0.0, 0.02, 0.6])
def test_truncated_video_gives_its_frames_or_a_clear_error(tmp_path, keep):
    whole = _video(tmp_path / "clip.avi", count=60)
    data = whole.read_bytes()
    whole.write_bytes(data[: int(len(data) * keep)])
    if keep < 0.5:
        with pytest.raises(ReconError, match=r"clip\.avi"):
            open_frames(whole)
    else:
        with pytest.warns(UserWarning, match="of 60 frames"):
            source = open_frames(whole)
        assert 10 < len(source) < 60
        assert len(list(source)) == len(source)


def test_missing_empty_and_unreadable_input_is_named(tmp_path):
    with pytest.raises(ReconError, match="no such file"):
        open_frames(tmp_path / "nothing.mp4")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ReconError, match="holds no image"):
        open_frames(tmp_path / "empty")
    (tmp_path / "text.mp4").write_text("this is no video")
    with pytest.raises(ReconError, match=r"text\.mp4"):
        open_frames(tmp_path / "text.mp4")
    folder = _images(tmp_path / "frames")
    (folder / "f1.png").write_bytes((folder / "f1.png").read_bytes()[:40])
    with pytest.raises(ReconError, match=r"f1\.png: is not a readable image"):
        list(open_frames(folder))
    with pytest.raises(ReconError, match="fps"):
        open_frames(folder, fps=0.0)


def test_images_of_two_sizes_are_refused(tmp_path):
    folder = _images(tmp_path / "frames")
    cv2.imwrite(str(folder / "f2.png"), np.zeros((12, 17, 3), np.uint8))
    with pytest.raises(ReconError, match=r"f2\.png.*one size"):
        list(open_frames(folder))


def test_masks_and_depth(tmp_path):
    for name in ("masks", "depth"):
        (tmp_path / name).mkdir()
    mask = np.zeros((5, 7), np.uint8)
    mask[2, 3], mask[1, 1] = 1, 255
    cv2.imwrite(str(tmp_path / "masks" / "0.png"), mask)
    depth = np.full((5, 7), 2345, np.uint16)
    depth[0, 0] = 0
    cv2.imwrite(str(tmp_path / "depth" / "0.png"), depth)
    (read,) = open_masks(tmp_path / "masks")
    assert read.dtype == torch.bool
    assert np.array_equal(read.numpy(), mask > 0)
    (metres,) = open_depths(tmp_path / "depth")
    assert torch.isnan(metres[0, 0])
    assert float(metres[1, 1]) == pytest.approx(2.345)
    with pytest.raises(ReconError, match="16-bit millimetres"):
        list(open_depths(tmp_path / "masks"))


def test_camera_file_forms_and_errors(tmp_path):
    k = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
    eye = np.eye(3).tolist()
    path = tmp_path / "camera.json"

    def load(content: object):
        path.write_text(json.dumps(content))
        return load_camera(path)

    assert load({"K": k}).intrinsics.tolist() == k
    full = load({"cameras": [{"intrinsic": k, "R": eye, "t": [[1.0], [2], [3]]}] * 4})
    assert full.rotations.shape == (4, 3, 3)
    assert full.translations[0].tolist() == [1, 2, 3]
    assert load({"cameras": [{"intrinsic": k}]}).rotations is None
    for wrong, text in [
        ({}, "neither"),
        ({"K": [[1, 2], [3, 4]]}, "shape"),
        ({"K": np.zeros((3, 3)).tolist()}, "pinhole"),
        ({"cameras": [{}]}, "camera 0"),
        ({"cameras": [{"intrinsic": k}, {"intrinsic": (2 * np.array(k) - np.diag([0, 0, 1])).tolist()}]}, "change"),
    ]:
        with pytest.raises(ReconError, match=text):
            load(wrong)
    path.write_text("{")
    with pytest.raises(ReconError, match="not JSON"):
        load_camera(path)


def test_real_video_folder_and_camera_are_read(data_dir):
    source = open_frames(data_dir / "video" / "PS7A2P1T1.avi")
    assert (len(source), source.size) == (72, (480, 640))
    folder = data_dir / "video" / "kinect_turn"
    frames, masks, depths = open_frames(folder / "frames"), open_masks(folder / "masks"), open_depths(folder / "depth")
    assert len(frames) == len(masks) == len(depths) == 60
    assert frames.size == masks.size == depths.size
    camera = load_camera(folder / "cameras.json")
    eye = torch.eye(3, dtype=torch.float64).expand(60, 3, 3)
    torch.testing.assert_close(camera.rotations @ camera.rotations.mT, eye, atol=1e-5, rtol=0)
