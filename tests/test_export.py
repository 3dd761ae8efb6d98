"""Exports are read back by readers that share nothing with the writers: written from the formats' own texts, or ezc3d.

Target: positions within 1e-4 of a unit of the data; BVH within 5 mm of the fitted skeleton.
"""

from __future__ import annotations

import csv
import importlib.util
import json
import struct

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchrecon as tr
from torchrecon.data.mocap import read_bvh
from torchrecon.io.export import FORMATS, export_reconstruction, to_motion
from torchrecon.io.writers import mp4
from torchrecon.io.writers.motion import Motion
from torchrecon.io.writers.skeleton import fit_skeleton, rigid_tree, root_tree

UP = np.array([1.0, -1.0, -1.0])
# A body of 12 joints: parent and bone length in metres.
PARENTS = [-1, 0, 1, 2, 1, 4, 5, 1, 0, 8, 0, 10]
LENGTHS = [0.0, 0.5, 0.2, 0.25, 0.2, 0.3, 0.25, 0.25, 0.45, 0.4, 0.45, 0.4]
EDGES = tuple((parent, joint) for joint, parent in enumerate(PARENTS) if parent >= 0)


def walker(frames: int = 30, seed: int = 0) -> np.ndarray:
    """Camera-frame positions of a body whose every bone turns freely and smoothly while the whole turns once."""
    g = np.random.default_rng(seed)
    time = np.linspace(0, 1, frames)
    whole = Rotation.from_rotvec(np.outer(2 * np.pi * time, [0.0, 1.0, 0.0]))
    points = np.zeros((frames, len(PARENTS), 3))
    points[:, 0] = np.stack([time, 0.05 * np.sin(9 * time), 0 * time], -1)
    for joint, parent in list(enumerate(PARENTS))[1:]:
        rest = g.standard_normal(3)
        swing = Rotation.from_rotvec(np.outer(np.sin(2 * np.pi * time * g.uniform(0.5, 2)), g.standard_normal(3) * 0.6))
        aim = (whole * swing).apply(rest / np.linalg.norm(rest))
        points[:, joint] = points[:, parent] + LENGTHS[joint] * aim
    return points


def made(points: np.ndarray) -> tr.Reconstruction:
    tensor = torch.as_tensor(points)
    eye = torch.eye(3).expand(len(tensor), 3, 3)
    return tr.Reconstruction.from_points(tensor, eye, rank=2, status=tr.Status("ok", "made"))


@pytest.fixture
def rec() -> tr.Reconstruction:
    return made(torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(3)).numpy())


@pytest.fixture
def tracks() -> tr.Tracks:
    xy = torch.rand(4, 5, 2, generator=torch.Generator().manual_seed(4)) * 40
    return tr.Tracks(xy, fps=50.0, names=["left hip", "knee", "knee", "a\tb", ""], edges=[(0, 1), (1, 2)])


# --- readers ---------------------------------------------------------------------------------------------------------


def bvh_positions(text: str) -> tuple[dict[str, np.ndarray], float]:
    """Global positions (frames, 3) by joint name, and frames per second, by plain forward kinematics."""
    words = iter(text[: text.index("MOTION")].split())
    stack: list[str] = []
    joints: list[tuple[str, str | None, list[float], list[str]]] = []
    for word in words:
        if word in ("ROOT", "JOINT"):
            name = next(words)
            joints.append((name, stack[-1] if stack else None, [], []))
        elif word == "End":
            name = f"{stack[-1]}_end"
            joints.append((name, stack[-1], [], []))
            next(words)
        elif word == "{":
            stack.append(name)
        elif word == "}":
            stack.pop()
        elif word == "OFFSET":
            joints[-1][2].extend(float(next(words)) for _ in range(3))
        elif word == "CHANNELS":
            joints[-1][3].extend(next(words) for _ in range(int(next(words))))
    assert not stack
    lines = text[text.index("MOTION") :].splitlines()
    frames, step = int(lines[1].split(":")[1]), float(lines[2].split(":")[1])
    values = np.array([[float(v) for v in line.split()] for line in lines[3:]])
    assert values.shape == (frames, sum(len(channels) for *_, channels in joints))
    place: dict[str, np.ndarray] = {}
    turn: dict[str, Rotation] = {}
    column = 0
    for name, parent, offset, channels in joints:
        block = {c: values[:, column + i] for i, c in enumerate(channels)}
        column += len(channels)
        local = np.broadcast_to(offset, (frames, 3)).copy()
        for axis, letter in enumerate("XYZ"):
            local[:, axis] = block.get(f"{letter}position", local[:, axis])
        order = "".join(c[0] for c in channels if c.endswith("rotation"))
        angles = [block[f"{letter}rotation"] for letter in order]
        own = Rotation.from_euler(order, np.stack(angles, -1), degrees=True) if order else Rotation.identity(frames)
        place[name] = local if parent is None else place[parent] + turn[parent].apply(local)
        turn[name] = own if parent is None else turn[parent] * own
    return place, 1 / step


class Gltf:
    """A .glb by the glTF 2.0 text: header, chunks, accessors, one animation."""

    def __init__(self, content: bytes) -> None:
        magic, version, total = struct.unpack_from("<4sII", content)
        assert (magic, version, total) == (b"glTF", 2, len(content))
        length, kind = struct.unpack_from("<I4s", content, 12)
        assert kind == b"JSON"
        assert length % 4 == 0
        self.json = json.loads(content[20 : 20 + length])
        size, kind = struct.unpack_from("<I4s", content, 20 + length)
        assert kind == b"BIN\0"
        assert size % 4 == 0
        assert 28 + length + size == total
        self.data = content[28 + length :]
        assert self.json["buffers"] == [{"byteLength": size}]

    def read(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        view = self.json["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5123: "<u2"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * width * np.dtype(dtype).itemsize
        array = np.frombuffer(self.data, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
        np.testing.assert_array_equal(array.min(0), np.array(accessor["min"], dtype))
        np.testing.assert_array_equal(array.max(0), np.array(accessor["max"], dtype))
        return array

    def channels(self) -> dict[tuple[str, str], np.ndarray]:
        """Values by node name and path; every path once, every node in the scene once."""
        (animation,) = self.json["animations"]
        found = {}
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            self.times = self.read(sampler["input"])[:, 0]
            node = self.json["nodes"][channel["target"]["node"]]
            key = (node["name"], channel["target"]["path"])
            assert key not in found
            found[key] = self.read(sampler["output"])
            assert len(found[key]) == len(self.times)
        assert self.json["scenes"][self.json["scene"]]["nodes"] == list(range(len(self.json["nodes"])))
        return found


def c3d_points(content: bytes) -> np.ndarray:
    """Points (frames, points, 3) of a little-endian floating-point C3D file, by the header's words of 16 bits."""
    words = struct.unpack_from("<256H", content)
    points, analog, first, last, block = words[1], words[2], words[3], words[4], words[8]
    assert words[0] >> 8 == 0x50
    assert struct.unpack_from("<f", content, 12)[0] < 0  # negative scale: floats
    row = 4 * points + analog
    data = np.frombuffer(content, "<f4", (last - first + 1) * row, 512 * (block - 1)).reshape(-1, row)
    return data[:, : 4 * points].reshape(len(data), points, 4)[..., :3]


def ply(text: str) -> dict[str, np.ndarray]:
    """Elements of an ASCII PLY file as tables."""
    lines = text.splitlines()
    assert lines[:2] == ["ply", "format ascii 1.0"]
    end = lines.index("end_header")
    tables, at = {}, end + 1
    for line in lines[:end]:
        if line.startswith("element "):
            _, name, count = line.split()
            tables[name] = np.array([[float(v) for v in row.split()] for row in lines[at : at + int(count)]])
            at += int(count)
    assert at == len(lines)
    return tables


# --- one test a format -----------------------------------------------------------------------------------------------


def test_csv(rec, tmp_path):
    with export_reconstruction(rec, tmp_path / "a.csv", fps=50.0).open() as stream:
        rows = list(csv.DictReader(stream))
    values = np.array([[float(r[a]) for a in "xyz"] for r in rows]).reshape(4, 5, 3)
    np.testing.assert_allclose(values, rec.points3d, atol=1e-8)
    assert float(rows[5]["time"]) == 0.02
    assert [r["name"] for r in rows[:5]] == ["p0", "p1", "p2", "p3", "p4"]


def test_trc_is_y_up_tab_separated_and_says_its_unit(rec, tracks, tmp_path):
    lines = export_reconstruction(rec, tmp_path / "a.trc", tracks=tracks).read_text().splitlines()
    assert lines[2].split("\t")[:5] == ["50", "50", "4", "5", "px"]
    assert lines[3].split("\t")[2::3] == ["left_hip", "knee", "knee_2", "a_b", "p4"]
    values = np.array([[float(x) for x in line.split("\t")[2:]] for line in lines[6:]]).reshape(4, 5, 3)
    np.testing.assert_allclose(values * UP, rec.points3d, atol=1e-8)
    lines = export_reconstruction(rec, tmp_path / "a.trc", unit_scale=0.5).read_text().splitlines()
    assert lines[2].split("\t")[4] == "m"
    values = np.array([[float(x) for x in line.split("\t")[2:]] for line in lines[6:]]).reshape(4, 5, 3)
    np.testing.assert_allclose(values * UP, 0.5 * rec.points3d, atol=1e-8)


def test_ply(rec, tmp_path):
    body = ply(export_reconstruction(rec, tmp_path / "a.ply").read_text())["vertex"]
    np.testing.assert_allclose(body[:, :3].reshape(4, 5, 3), rec.points3d, atol=1e-8)
    assert body[:, 3].tolist() == sorted([0, 1, 2, 3] * 5)


@pytest.mark.parametrize("name", ["frames/", "walk_%04d.ply"])
def test_ply_sequence(rec, tracks, tmp_path, name):
    export_reconstruction(rec, f"{tmp_path}/{name}", tracks=tracks)
    files = sorted(tmp_path.rglob("*.ply"))
    assert [f.stem[-4:] for f in files] == ["0000", "0001", "0002", "0003"]
    for frame, file in enumerate(files):
        tables = ply(file.read_text())
        np.testing.assert_allclose(tables["vertex"], rec.points3d[frame], atol=1e-8)
        assert tables["edge"].tolist() == [[0, 1], [1, 2]]
    with pytest.raises(tr.ReconError, match="force"):
        export_reconstruction(rec, f"{tmp_path}/{name}")
    short = made(rec.points3d[:2].numpy())
    export_reconstruction(short, f"{tmp_path}/{name}", force=True)
    assert len(list(tmp_path.rglob("*.ply"))) == 2  # nothing of the longer sequence is left to mix in


@pytest.mark.skipif(importlib.util.find_spec("ezc3d") is None, reason="ezc3d is not installed")
def test_c3d(rec, tracks, tmp_path):
    import ezc3d

    path = export_reconstruction(rec, tmp_path / "a.c3d", tracks=tracks)
    np.testing.assert_allclose(c3d_points(path.read_bytes()), rec.points3d, atol=1e-5)
    read = ezc3d.c3d(str(path))
    np.testing.assert_allclose(read["data"]["points"][:3].transpose(2, 1, 0), rec.points3d, atol=1e-5)
    assert read["parameters"]["POINT"]["RATE"]["value"] == [50]
    assert read["parameters"]["POINT"]["UNITS"]["value"] == ["px"]
    assert read["parameters"]["POINT"]["LABELS"]["value"] == ["left_hip", "knee", "knee_2", "a_b", "p4"]


def test_npz(rec, tracks, tmp_path):
    with np.load(export_reconstruction(rec, tmp_path / "a.npz", tracks=tracks), allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["points3d"], rec.points3d)
        assert (float(archive["fps"]), str(archive["unit"]), archive["edges"].tolist()) == (50, "px", [[0, 1], [1, 2]])
        assert archive["names"].tolist() == ["left_hip", "knee", "knee_2", "a_b", "p4"]


def test_glb_nodes_follow_the_points_and_bones_join_them(tmp_path):
    rec = made(walker())
    path = export_reconstruction(rec, tmp_path / "a.glb", fps=30.0, edges=EDGES, unit_scale=1.0)
    scene = Gltf(path.read_bytes())
    found = scene.channels()
    truth = rec.points3d.numpy() * UP
    for index in range(len(PARENTS)):
        np.testing.assert_allclose(found[f"p{index}", "translation"], truth[:, index], atol=1e-6)
    np.testing.assert_allclose(scene.times, np.arange(30) / 30, atol=1e-6)
    assert scene.json["asset"] == {"version": "2.0", "generator": "torchrecon", "extras": {"unit": "m", "fps": 30.0}}
    for a, b in EDGES:
        name = f"p{a}--p{b}"
        turn = Rotation.from_quat(found[name, "rotation"])
        for end, sign in ((a, -1), (b, 1)):  # the octahedron's tips on its y axis
            tip = found[name, "translation"] + turn.apply(sign * found[name, "scale"] * [0, 1, 0])
            np.testing.assert_allclose(tip, truth[:, end], atol=1e-5)
        turns = found[name, "rotation"]
        assert ((turns[1:] * turns[:-1]).sum(-1) >= 0).all()  # players go the short way between frames
    primitive = scene.json["meshes"][0]["primitives"][0]
    corners = scene.read(primitive["attributes"]["POSITION"]).astype(float)
    faces = scene.read(primitive["indices"]).reshape(-1, 3)
    a, b, c = (corners[faces[:, i]] for i in range(3))
    assert (np.einsum("fi,fi->f", np.cross(b - a, c - a), a + b + c) > 0).all()  # counter-clockwise seen from outside
    np.testing.assert_allclose(np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6, 4 / 3)  # closed: its volume


def test_bvh_reproduces_a_body_of_constant_bones(tmp_path):
    rec = made(walker())
    path = export_reconstruction(rec, tmp_path / "a.bvh", fps=30.0, edges=EDGES)
    place, fps = bvh_positions(path.read_text())
    assert fps == pytest.approx(30)
    for index in range(len(PARENTS)):
        np.testing.assert_allclose(place[f"p{index}"] * UP, rec.points3d[:, index], atol=1e-5)
    clip = read_bvh(path, metres_per_unit=1.0)
    again = clip.joints[:, [clip.names.index(f"p{i}") for i in range(len(PARENTS))]].numpy() * UP
    np.testing.assert_allclose(again, rec.points3d, atol=1e-5)


def test_bvh_of_noisy_points_without_edges_is_the_fitted_skeleton(tmp_path):
    noisy = walker(seed=1) + 0.02 * np.random.default_rng(2).standard_normal((30, 12, 3))
    rec = made(noisy)
    motion = to_motion(rec)
    skeleton = fit_skeleton(motion)
    place, _ = bvh_positions(export_reconstruction(rec, tmp_path / "a.bvh").read_text())
    written = np.stack([place[f"p{i}"] * UP for i in range(12)], 1)
    np.testing.assert_allclose(written, skeleton.positions, atol=1e-5)
    for joint, parent in enumerate(skeleton.parents):
        if parent < 0:
            continue
        bones = np.linalg.norm(written[:, joint] - written[:, parent], axis=-1)
        distances = np.linalg.norm(motion.points[:, joint] - motion.points[:, parent], axis=-1)
        np.testing.assert_allclose(bones, np.median(distances), atol=1e-5)
    # No bone of noise 2 cm can be fitted better than that; a fit that drifted along the limbs would be far worse.
    assert np.linalg.norm(written - motion.points, axis=-1).mean() < 0.05


@pytest.mark.parametrize("case", ["one point", "still", "same place", "reversed", "star"])
def test_bvh_of_degenerate_motions(tmp_path, case):
    points = {
        "one point": np.random.default_rng(0).standard_normal((5, 1, 3)),
        "still": np.tile(walker(1), (4, 1, 1)),
        "same place": np.zeros((3, 4, 3)),
        "reversed": np.array([[[0.0, 0, 0], [1, 0, 0]], [[1.0, 0, 0], [0, 0, 0]], [[0, 1.0, 0], [0, 0, 0]]]),
        "star": np.concatenate([np.zeros((6, 1, 3)), np.random.default_rng(1).standard_normal((6, 7, 3))], 1),
    }[case]
    edges = [(0, i) for i in range(1, 8)] if case == "star" else []
    motion = Motion(points, edges=tuple(edges))
    place, _ = bvh_positions(FORMATS[".bvh"](motion).decode())
    written = np.stack([place[name] * UP for name in motion.names], 1)
    np.testing.assert_allclose(written, fit_skeleton(motion).positions, atol=1e-6)
    if case != "star":  # the bones of all others are constant: the points themselves
        np.testing.assert_allclose(written, points, atol=1e-6)


def test_bvh_of_a_long_chain_is_no_recursion(tmp_path):
    chain = np.cumsum(np.ones((2, 1100, 3)), 1)
    place, _ = bvh_positions(FORMATS[".bvh"](Motion(chain)).decode())
    np.testing.assert_allclose(place["p1099"] * UP, chain[:, 1099], atol=1e-3)


def test_the_tree_of_a_body_is_its_bones():
    points = walker(200)
    assert {frozenset(pair) for pair in rigid_tree(points)} == {frozenset(pair) for pair in EDGES}
    closed = [*EDGES, (3, 6)]  # a pair that closes a circle and changes its length is left out
    assert {frozenset(pair) for pair in rigid_tree(points, closed)} == {frozenset(pair) for pair in EDGES}
    parents, order = root_tree(EDGES, [LENGTHS[joint] for _, joint in EDGES])
    way = np.full((12, 12), np.inf)
    for joint, parent in enumerate(PARENTS):
        way[joint, joint] = 0
        if parent >= 0:
            way[joint, parent] = way[parent, joint] = LENGTHS[joint]
    for middle in range(12):  # Floyd and Warshall
        way = np.minimum(way, way[:, [middle]] + way[[middle]])
    assert order[0] == parents.index(-1) == way.sum(1).argmin()


def test_mp4_shows_rings_dots_and_bones_where_they_belong(tmp_path):
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "frames").mkdir()
    for i in range(6):
        cv2.imwrite(str(tmp_path / "frames" / f"{i:03d}.png"), np.zeros((96, 128, 3), np.uint8))
    x = torch.arange(6.0)[:, None] * 8 + torch.tensor([20.0, 70.0])
    points = torch.stack([x, torch.tensor([30.0, 60.0]).expand(6, 2), torch.zeros(6, 2)], -1)
    rec = made(points.numpy())
    rec = tr.Reconstruction(**{**vars(rec), "translation": points.mean(1)[:, :2]})
    xy = points[..., :2].clone()
    xy[:, 1, 1] += 20  # the second point was measured 20 pixels below where the reconstruction has it
    xy[5, 1] = torch.nan
    tracks = tr.Tracks(xy, fps=10.0, edges=[(0, 1)])
    path = export_reconstruction(rec, tmp_path / "a.mp4", fps=10.0, tracks=tracks, video=tmp_path / "frames")
    capture = cv2.VideoCapture(str(path))
    assert (capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)) == (10, 6)
    for f in range(6):
        good, image = capture.read()
        assert good
        assert image.shape == (96, 128, 3)
        image = image.astype(int)
        left = round(70.0 + 8 * f)
        # An orange dot on the measurement, a line from it to the ring; neither where the point was not seen.
        assert (image[80, left, 2] > image[80, left, 0] + 40) == (f < 5)
        assert (image[70, left, 2] > 60) == (f < 5)
        assert image[45, round(45.0 + 8 * f)].max() > 80  # the bone's middle
        assert image[10:20].max() < 60  # nothing where nothing is
    assert not capture.read()[0]
    with pytest.raises(tr.ReconError, match="6 frames, not 5"):
        export_reconstruction(made(points[:5].numpy()), tmp_path / "b.mp4", video=tmp_path / "frames")
    with pytest.raises(tr.ReconError, match="--video"):
        export_reconstruction(rec, tmp_path / "b.mp4")


def test_rings_are_blue_where_seen_and_grey_where_inferred():
    cv2 = pytest.importorskip("cv2")
    rings = np.array([[20.0, 20.0], [60.0, 20.0], [1e9, np.nan]])  # the last cannot be drawn
    image = np.zeros((40, 80, 3), np.uint8)
    mp4._draw(cv2, image, rings, np.array([[20.0, 20.0], [np.nan, np.nan], [5.0, 35.0]]), 6)
    for x, colour in ((26, mp4._RING), (66, mp4._INFERRED)):  # thin lines are smoothed: the hue stays
        np.testing.assert_allclose(image[20, x] / image[20, x].max(), np.array(colour) / max(colour), atol=0.02)
    assert image[20, 20].tolist() == image[35, 5].tolist() == list(mp4._DOT)
    assert image[20, 60].tolist() == [0, 0, 0]


@pytest.mark.skipif(importlib.util.find_spec("rerun") is not None, reason="rerun-sdk is installed")
def test_rrd_without_rerun_says_how_to_get_it(rec, tmp_path):
    with pytest.raises(tr.ReconError, match=r"torchrecon\[rerun\]"):
        export_reconstruction(rec, tmp_path / "a.rrd")
    assert not list(tmp_path.iterdir())


def test_rrd_is_read_back_by_reruns_own_reader(tmp_path):
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    points = walker(6)
    motion = Motion(points, fps=30.0, edges=tuple(EDGES), names=tuple(f"p{i}" for i in range(12)))
    path = tmp_path / "a.rrd"
    path.write_bytes(FORMATS[".rrd"](motion))
    found = {}
    for part in chunk.RrdReader(path).stream():
        batch = part.to_record_batch()
        for name in set(batch.schema.names) - {"log_time", "rerun.controls.RowId"}:
            column = batch.column(name)
            values = column.cast("int64") if name == "time" else column  # nanoseconds
            found.setdefault((part.entity_path, name), []).extend(values.to_pylist())
    positions = np.array(found["/shape/points", "Points3D:positions"])
    order = np.argsort(found["/shape/points", "frame"])
    np.testing.assert_allclose(positions[order], points, rtol=0, atol=1e-6)
    assert sorted(found["/shape/points", "frame"]) == list(range(6))
    seconds = np.array(found["/shape/points", "time"])[order] / 1e9
    np.testing.assert_allclose(seconds, np.arange(6) / 30, atol=1e-8)
    assert found["/shape/points", "Points3D:labels"][0] == list(motion.names)
    strips = np.array(found["/shape/bones", "LineStrips3D:strips"])[np.argsort(found["/shape/bones", "frame"])]
    np.testing.assert_allclose(strips, points[:, np.array(EDGES)], rtol=0, atol=1e-6)
    assert found["/shape", "ViewCoordinates:xyz"] == [[[3, 2, 5]]]  # right, down, forward


# --- units, names, refusals ------------------------------------------------------------------------------------------


def test_height_scales_to_the_stature_and_depth_is_metres(rec, tracks):
    tall = to_motion(rec, height_m=1.8)
    assert tall.unit == "m"
    assert np.median(np.ptp(tall.points[..., 1], axis=1)) == pytest.approx(1.8)
    np.testing.assert_allclose(np.cross(tall.points, rec.points3d.numpy()), 0, atol=1e-12)  # one scale for all
    k = torch.eye(3)
    seen = tr.Tracks(tracks.xy, intrinsics=k, depth=torch.ones(4, 5))
    ray = tr.Reconstruction(**{**vars(rec), "intrinsics": k})
    assert [to_motion(r, tracks=t).unit for r, t in ((rec, tracks), (ray, None), (ray, seen))] == ["px", "unit", "m"]


def test_placed_points_are_seen_where_the_reconstruction_is(rec):
    k = torch.tensor([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    far = torch.tensor([[0.1, 0.2, 9.0]]) + torch.arange(4.0)[:, None]
    seen = tr.Reconstruction(**{**vars(rec), "intrinsics": k, "translation": far, "scale": torch.full((4,), 0.5)})
    x, y, z = np.moveaxis(to_motion(seen, place=True).points, -1, 0)
    np.testing.assert_allclose(np.stack([500 * x / z + 320, 510 * y / z + 240], -1), seen.reproject(), atol=1e-9)
    with pytest.raises(tr.ReconError, match="--place needs intrinsics"):
        to_motion(rec, place=True)


@pytest.mark.parametrize("suffix", sorted(set(FORMATS) - {".rrd"}))
def test_one_frame_of_one_point_can_be_written(suffix):
    assert FORMATS[suffix](Motion(np.ones((1, 1, 3))))


def test_what_cannot_be_written_is_named(rec, tracks, tmp_path):
    def refuse(words, path="a.csv", **options):
        with pytest.raises(tr.ReconError, match=words):
            export_reconstruction(options.pop("rec", rec), tmp_path / path, **options)

    refuse(r"\.csv", "a.xyz")
    refuse("does not exist", "none/a.csv")
    refuse("exclude", unit_scale=1.0, height_m=1.8)
    refuse("--height", height_m=-1.0)
    refuse("--unit-scale", unit_scale=float("nan"))
    refuse("positive rate", fps=0.0)
    refuse("3 names for 5", names=["a", "b", "c"])
    refuse(r"edge \(0, 5\)", edges=[(0, 5)])
    refuse("tracks it was made from", tracks=tracks.select(frames=slice(0, 2)))
    refuse("place for the frame number", "a_%s.ply")
    refuse("end the name with .ply", "a_%04d.csv")
    hole = rec.points3d.clone()
    hole[2, 3, 1] = torch.nan
    refuse("frame 2, point 3", rec=tr.Reconstruction(**{**vars(rec), "points3d": hole}))
    flat = rec.points3d * torch.tensor([1.0, 0.0, 1.0])
    refuse("vertical extent", rec=made(flat.numpy()), height_m=1.8)
    assert not list(tmp_path.iterdir())
