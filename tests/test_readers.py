"""Every input format against files with known values, the confidence rule, 3D files by their views."""

from __future__ import annotations

import json
from itertools import pairwise

import h5py
import numpy as np
import pytest

import torchrecon as tr
from tests import track_files as files
from tests.reading import check, load
from tests.track_files import FRAMES, WRITERS, scores, walk
from torchrecon.cli import main
from torchrecon.data import read_c3d, read_trc
from torchrecon.io.readers import FORMATS, ConfidenceParams, Source, detect
from torchrecon.io.readers.base import ReadOptions
from torchrecon.io.readers.layouts import BODY_25, COCO_17, HUMANEVA_15, MEDIAPIPE_33, MPII_16, OPENPOSE_18, PENN_13
from torchrecon.io.readers.markers import project


def test_every_format_has_files_and_is_told_from_content_alone(tmp_path):
    assert [known.name for known in FORMATS] == list(WRITERS)
    for name, writers in WRITERS.items():
        for write in writers:
            path = write(tmp_path)
            path = path.rename(path.with_name(f"{write.__name__}.dat"))
            assert detect(Source(path)).name == name, write.__name__


@pytest.mark.parametrize(
    ("write", "points", "scored", "floor"),
    [
        (files.tracks_npz, 6, True, 0.1),
        (files.cotracker, 7, True, 0.5),
        (files.tapir, 8, True, 0.5),
        (files.tapnext, 8, True, 0.5),
        (files.bare_npy, 9, False, 0.0),
        (files.openpose_folder, 25, True, 0.1),
        (files.openpose_list, 18, True, 0.1),
        (files.coco_results, 17, True, 0.1),
        (files.mediapipe, 33, True, 0.1),
        (files.mmpose_json, 17, True, 0.1),
        (files.rtmlib_json, 17, True, 0.1),
        (files.rtmlib_npz, 17, True, 0.1),
        (files.penn_action, 13, True, 0.1),
        (files.sleap_h5, 5, True, 0.1),
        (files.sleap_csv, 5, True, 0.1),
        (files.long_csv, 6, True, 0.1),
        (files.wide_csv, 6, True, 0.1),
    ],
)
def test_known_values_come_back(tmp_path, write, points, scored, floor):
    tracks, _ = load(write(tmp_path))
    check(tracks, walk(points), scores(points) if scored else None, floor)


@pytest.mark.parametrize(
    "write", [files.deeplabcut_csv, files.deeplabcut_h5, files.deeplabcut_fixed, files.deeplabcut_csv2]
)
def test_deeplabcut_parts_and_individuals(tmp_path, write):
    path = write(tmp_path)
    several = write is files.deeplabcut_csv2
    tracks, said = load(path, person=1 if several else None)  # mouse1 has the higher likelihoods
    check(tracks, walk(4), np.maximum(scores(4), 0.125))
    assert tracks.names == ("nose", "ear", "paw", "tail")
    assert said == []
    if several:
        other, said = load(files.deeplabcut_h5_2(tmp_path))
        check(other, walk(4, (400.0, 200.0)))
        assert "2 individuals are found" in said[0]
        assert "mouse1" in said[0]


@pytest.mark.parametrize(
    ("write", "layout"),
    [
        (files.openpose_folder, BODY_25),
        (files.openpose_list, OPENPOSE_18),
        (files.coco_results, COCO_17),
        (files.rtmlib_npz, COCO_17),
        (files.mediapipe, MEDIAPIPE_33),
        (files.penn_action, PENN_13),
        (files.humaneva, HUMANEVA_15),
    ],
)
def test_known_layouts_give_names_and_bones(tmp_path, write, layout):
    tracks, _ = load(write(tmp_path))
    assert tracks.names == layout.names
    assert tracks.edges == layout.edges


@pytest.mark.parametrize("layout", [BODY_25, OPENPOSE_18, COCO_17, MEDIAPIPE_33, PENN_13, HUMANEVA_15, MPII_16])
def test_bones_join_each_side_to_itself_and_leave_no_joint_out(layout):
    """Elbows hang between shoulder and wrist of their own side, in every order that is published."""
    names = layout.names
    bones = {frozenset((names[a], names[b])) for a, b in layout.edges}
    assert len(bones) == len(layout.edges)
    for side in ("left", "right"):
        for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
            for a, b in pairwise(chain):
                assert frozenset((f"{side}_{a}", f"{side}_{b}")) in bones
    assert set(range(len(names))) == {end for edge in layout.edges for end in edge}


def test_coco_flags_halve_the_confidence_of_hidden_joints(tmp_path):
    path = files.coco_annotations(tmp_path)
    flags = np.array([a["keypoints"] for a in json.loads(path.read_text())["annotations"]]).reshape(FRAMES, 17, 3)[
        ..., 2
    ]
    tracks, said = load(path)
    assert said == []
    check(tracks, walk(17), flags)
    assert tracks.edges == ((0, 1), (1, 2))
    assert tracks.names[:2] == ("k0", "k1")
    std = tracks.covariance[..., 0, 0].sqrt().numpy()
    assert std[flags == 1] == pytest.approx(2 * std[flags == 2][0])


def test_confidence_rule(tmp_path):
    """std = share of the body's size / confidence: measured here from the file's own numbers."""
    tracks, _ = load(files.rtmlib_npz(tmp_path))
    c = scores(17)
    seen = c > 0.1
    boxes = [np.linalg.norm(np.ptp(xy[s], axis=0)) for xy, s in zip(walk(17), seen, strict=True)]
    expected = 0.01 * np.median(boxes) / c[seen]
    np.testing.assert_allclose(tracks.covariance[..., 0, 0].sqrt().numpy()[seen], expected, rtol=1e-12)
    assert (tracks.covariance[..., 0, 1] == 0).all()
    stricter, _ = load(files.rtmlib_npz(tmp_path), confidence=ConfidenceParams(floor=0.5, power=0.0))
    check(stricter, walk(17), c, 0.5)
    assert tracks.covariance.unique().numel() > 2
    one = stricter.covariance[..., 0, 0].unique()
    assert one.numel() == 1
    assert tr.load_tracks(files.cotracker(tmp_path)).covariance is None  # flags say nothing about the noise


def test_tapir_occlusion_logits_and_expected_distance(tmp_path):
    occlusion = np.array([[-9.0, 9.0, -9.0, -9.0]])
    far = np.array([[-9.0, -9.0, 9.0, -9.0]])
    xy = walk(1, frames=4).swapaxes(0, 1)
    np.savez(tmp_path / "t.npz", tracks=xy, occlusion=occlusion, expected_dist=far, query_points=np.zeros((1, 3)))
    tracks, _ = load(tmp_path / "t.npz")
    assert tracks.visible[:, 0].tolist() == [True, False, False, True]


@pytest.mark.parametrize("points", [8, FRAMES, 30])
def test_time_axis_is_found_from_query_points_or_from_smoothness(tmp_path, points):
    xy = walk(points)
    at = np.arange(points) % FRAMES
    first = xy[at, np.arange(points)]
    for tracks in (xy, xy.swapaxes(0, 1)):
        for extra in ({}, {"query_points": np.c_[at, first]}, {"query_points": np.c_[at, first[:, ::-1]]}):
            np.savez(tmp_path / "t.npz", tracks=tracks, **extra)
            check(load(tmp_path / "t.npz")[0], xy)


def test_an_unclear_time_axis_is_said(tmp_path):
    noise = np.random.default_rng(0).uniform(0, 500, (20, 20, 2))
    np.save(tmp_path / "t.npy", noise)
    tracks, said = load(tmp_path / "t.npy")
    assert "which axis is time is not clear" in said[0]
    check(tracks, noise)


def test_shares_of_the_image_need_its_size(tmp_path):
    path = files.mediapipe(tmp_path)
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content["frames"]))
    tracks, said = load(path, image_size=(480, 640))
    check(tracks, walk(33), scores(33))
    assert said == []
    tracks, said = load(path)
    check(tracks, walk(33) / [640, 480] * 1000, scores(33))
    assert "a square of 1000 pixels is assumed" in said[0]
    np.savez(tmp_path / "t.npz", tracks=walk(6) / [640, 480])
    check(load(tmp_path / "t.npz", image_size=(480, 640))[0], walk(6))


def test_a_folder_with_one_file_a_frame_counts_by_their_names(tmp_path):
    folder = tmp_path / "predictions"
    folder.mkdir()
    xy, sure = walk(17), scores(17)
    for t in (0, 1, 2, 10):
        instance = {"keypoints": xy[t].tolist(), "keypoint_scores": sure[t].tolist()}
        (folder / f"img_{t}.json").write_text(json.dumps([instance]))
    tracks, _ = load(folder)
    assert tracks.visible.any(-1).tolist() == [t in (0, 1, 2, 10) for t in range(11)]
    np.testing.assert_allclose(tracks.xy[10].numpy()[sure[10] > 0.1], xy[10][sure[10] > 0.1])


def test_sleap_in_either_axis_order(tmp_path):
    path = files.sleap_h5(tmp_path)
    with h5py.File(path, "r+") as file:
        for name in ("tracks", "point_scores"):
            value = file[name][()].T
            del file[name]
            file[name] = value
    tracks, _ = load(path)
    check(tracks, walk(5), scores(5))
    assert tracks.edges == ((0, 1), (1, 2))
    assert tracks.names == ("n0", "n1", "n2", "n3", "n4")


def test_frames_keep_their_gaps_and_their_rate(tmp_path):
    (tmp_path / "a.csv").write_text("frame,point,x,y\n10,a,1,2\n13,a,4,5\n11,b,7,\n")
    tracks, _ = load(tmp_path / "a.csv", fps=60.0)
    assert tracks.visible[:, 0].tolist() == [True, False, False, True]
    assert not tracks.visible[:, 1].any()
    assert tracks.times[-1].item() == pytest.approx(3 / 60)
    own, _ = load(files.tracks_npz(tmp_path), fps=10.0)
    assert own.times[1].item() == pytest.approx(0.1)
    scattered = [{"image_id": i, "keypoints": [1, 2, 1] * 17} for i in (139, 785, 581929, 40083)]
    (tmp_path / "stills.json").write_text(json.dumps(scattered))
    with pytest.raises(tr.ReconError, match="single images of a data set"):
        tr.load_tracks(tmp_path / "stills.json")


@pytest.mark.parametrize("write", [files.c3d, files.trc, files.bvh, files.free_throw])
def test_3d_files_say_what_they_are_and_wait_for_a_view(tmp_path, write):
    with pytest.raises(tr.ReconError, match=r"3D positions already .* view='front', 'side' or 'top'"):
        tr.load_tracks(write(tmp_path))


def test_views_of_z_up_and_y_up_files(tmp_path):
    """Front: x right and up up; side: from the end of the +x axis; top: from above, x right. One pixel a millimetre."""
    x, y, z = np.moveaxis(files.solid(), -1, 0)
    seen = np.isfinite(x)
    expected = {
        files.c3d: {"front": (x, -z), "side": (y, -z), "top": (x, -y)},
        files.trc: {"front": (x, -y), "side": (-z, -y), "top": (x, z)},
    }
    for write, views in expected.items():
        path = write(tmp_path)
        for view, image in views.items():
            tracks, _ = load(path, view=view)
            np.testing.assert_array_equal(tracks.visible.numpy(), seen)
            np.testing.assert_allclose(tracks.xy.numpy()[seen], np.stack(image, -1)[seen], atol=1e-3)
            assert tracks.fps == 50.0
            assert tracks.names == ("M0", "M1", "M2", "M3")


def test_side_view_is_a_turned_front_view(tmp_path):
    """Turning the body a quarter about the vertical shows from the front what was seen from the side."""
    xyz = files.solid()
    turns = {"y": [[0, 0, -1], [0, 1, 0], [1, 0, 0]], "z": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]}
    for up, turn in turns.items():
        assert np.linalg.det(turn) == pytest.approx(1.0)
        side = project(Source(tmp_path), ReadOptions(view="side"), xyz, up)
        front = project(Source(tmp_path), ReadOptions(view="front"), xyz @ np.transpose(turn), up)
        np.testing.assert_allclose(side.xy.numpy(), front.xy.numpy(), atol=1e-9)


def test_bvh_view_has_bones_and_millimetres(tmp_path):
    tracks, _ = load(files.bvh(tmp_path), view="front")
    assert tracks.names == ("Hips", "Knee", "Knee_end")
    assert tracks.edges == ((0, 1), (1, 2))
    # Frame 1: 90 degrees about z turn the thigh from down to the right; 40 cm are 400 px.
    np.testing.assert_allclose(tracks.xy[1].numpy(), [[100, -1000], [500, -1000], [800, -1000]], atol=1e-6)


def test_free_throw_feet_become_millimetres_at_the_recorded_rate(tmp_path):
    tracks, _ = load(files.free_throw(tmp_path), view="front")
    feet = np.round(np.random.default_rng(5).uniform(0, 6, (FRAMES, 3, 3)), 3)
    check(tracks, 304.8 * feet[..., [0, 2]] * [1, -1])
    assert tracks.names == ("NOSE", "L_HIP", "R_HIP")
    assert tracks.fps == pytest.approx(30.0, rel=2e-3)


def test_c3d_of_integers_and_of_other_processors(tmp_path):
    """A file put together by hand from the format's description: scaled int16, big-endian floats, VAX floats."""
    xyz = np.array([[[100.0, -200.0, 300.0], [4.0, 5.0, -6.0]], [[0.5, 0.25, 2.0], [8.0, 9.0, 10.0]]])
    for name, processor, order, scale in (("i", 84, "<", 0.25), ("be", 86, ">", -1.0), ("vax", 85, "<", -1.0)):

        def real(value, processor=processor, order=order):
            if processor != 85:
                return np.array(value, order + "f4").tobytes()
            return (4 * np.array(value, "<f4")).view("<u2").reshape(-1, 2)[:, ::-1].astype("<u2").tobytes()

        def word(value, order=order):
            return np.array(value, order + "i2").tobytes()

        units = b"\x05\x01UNITS" + word(2 + 5 + 2) + b"\xff\x02\x02\x01mm" + b"\x00"
        section = b"\x01\x50\x01" + bytes([processor]) + b"\x05\xffPOINT" + word(3) + b"\x00" + units
        header = b"\x02\x50" + word([2, 0, 1, 2, 0]) + real([scale]) + word([3, 0]) + real([50.0])
        words = np.concatenate([xyz / (scale if scale > 0 else 1.0), np.zeros((2, 2, 1))], -1)
        frames = word(np.round(words).astype(int)) if scale > 0 else real(words.reshape(-1))
        data = header.ljust(512, b"\0") + section.ljust(512, b"\0") + frames.ljust(512, b"\0")
        (tmp_path / f"{name}.c3d").write_bytes(data)
        markers = read_c3d(tmp_path / f"{name}.c3d")
        assert markers.fps == 50.0
        np.testing.assert_allclose(1000 * markers.positions.numpy(), xyz, atol=1e-4)


def test_c3d_agrees_with_ezc3d(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    path = files.c3d(tmp_path)
    theirs = ezc3d.c3d(str(path))
    ours = read_c3d(path)
    points = theirs["data"]["points"][:3].transpose(2, 1, 0)
    np.testing.assert_allclose(1000 * ours.positions.numpy(), points, atol=1e-3)
    assert list(ours.names) == theirs["parameters"]["POINT"]["LABELS"]["value"]


def test_trc_gaps_and_units(tmp_path):
    path = files.trc(tmp_path)
    markers = read_trc(path)
    np.testing.assert_allclose(1000 * markers.positions.numpy(), files.solid(), atol=1e-9)
    path.write_text(path.read_text().replace("mm", "cm"))
    np.testing.assert_allclose(100 * read_trc(path).positions.numpy(), files.solid(), atol=1e-9)
    path.write_text(path.read_text().replace("cm", "league"))
    with pytest.raises(tr.ReconError, match="Units is 'league'"):
        read_trc(path)


def test_command_line_reads_them_too(tmp_path, capsys):
    path = str(files.coco_results(tmp_path))
    assert main(["rank", path, "--json"]) == 0
    printed = capsys.readouterr()
    assert "warning" in printed.err
    assert "2 people are found" in printed.err
    first = json.loads(printed.out)
    assert main(["rank", path, "--person", "0", "--json"]) == 0
    printed = capsys.readouterr()
    assert "people" not in printed.err
    assert json.loads(printed.out) == first
    assert main(["rank", path, "--person", "7"]) == 2
    assert "2 people are found" in capsys.readouterr().err
    markers = str(files.c3d(tmp_path))
    assert main(["rank", markers]) == 2
    assert "--view" in capsys.readouterr().err
    assert main(["rank", markers, "--view", "side", "--fps", "50"]) == 0
    np.savez(tmp_path / "shares.npz", tracks=walk(6) / [640, 480])
    capsys.readouterr()
    assert main(["rank", str(tmp_path / "shares.npz"), "--image-size", "480", "640"]) == 0
    assert "square" not in capsys.readouterr().err


@pytest.mark.data
def test_real_files(data_dir):
    """Shapes and units of the real thing; a person is between half a metre and three metres in every view."""
    folder = data_dir / "keypoints"
    tracks, said = load(folder / "humaneva15_train.npz")
    assert "21 recordings" in said[0]
    with np.load(folder / "humaneva15_train.npz") as archive:
        np.testing.assert_allclose(tracks.xy.numpy(), archive["Train_S1_Walking1chunk0__xy"][0], rtol=1e-6)
    for path in sorted(folder.glob("BB_FT_*.json.gz")):
        tracks, _ = load(path, view="front")
        assert tracks.xy.shape == (240, 27, 2)
        assert tracks.fps == pytest.approx(30.0, rel=2e-3)
        up = -tracks.xy[..., 1]
        height = up[:, tracks.names.index("NOSE")] - up[:, tracks.names.index("R_CALC")]
        assert 1200 < height.median() < 2300
    for name in ("mpii_dataset.csv.gz", "test_mpii.json", "detections_our_format.mat"):
        with pytest.raises(tr.ReconError, match="single images"):
            tr.load_tracks(folder / name)
