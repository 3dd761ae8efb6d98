"""Small files of every format that ``load_tracks`` reads, written from known values without the project's writers."""

from __future__ import annotations

import gzip
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

FRAMES = 12


def walk(points: int, start: tuple[float, float] = (100.0, 200.0), speed: float = 4.0, frames: int = FRAMES):
    """(frames, points, 2) pixels: a body of 60 x 160 pixels that moves to the right and nods; quarters, so exact."""
    rng = np.random.default_rng(points)
    body = np.round(rng.uniform([0, 0], [60, 160], (points, 2)) * 4) / 4
    t = np.arange(frames)[:, None]
    x = start[0] + body[:, 0] + speed * t
    y = start[1] + body[:, 1] + np.round(8 * np.sin(0.5 * t + np.arange(points)) * 4) / 4
    return np.stack([x, y], -1)


def scores(points: int, frames: int = FRAMES):
    """(frames, points) confidence in eighths: some 0 (not seen), some 1."""
    return np.random.default_rng(points + 1).integers(0, 9, (frames, points)) / 8


def _json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def tracks_npz(folder: Path) -> Path:
    path = folder / "tracks.npz"
    np.savez(path, xy=walk(6), visible=scores(6) > 0.1, fps=30.0, names=np.array(list("abcdef")), edges=[[0, 1]])
    return path


def cotracker(folder: Path) -> Path:
    path = folder / "cotracker.npz"
    np.savez(path, pred_tracks=walk(7)[None], pred_visibility=(scores(7) > 0.5)[None])
    return path


def tapir(folder: Path) -> Path:
    path = folder / "tapir.npz"
    xy = walk(8)
    query = np.stack([np.arange(8) % FRAMES, *xy[np.arange(8) % FRAMES, np.arange(8)].T[::-1]], -1)
    np.savez(path, tracks=xy.swapaxes(0, 1), occluded=(scores(8) <= 0.5).T, query_points=query)
    return path


def tapnext(folder: Path) -> Path:
    path = folder / "tapnext.npz"
    xy = walk(8)
    query = np.stack([np.arange(8) % FRAMES, *xy[np.arange(8) % FRAMES, np.arange(8)].T], -1)
    np.savez(path, tracks=xy[None], visible_logits=np.where(scores(8) > 0.5, 3.0, -3.0)[None, ..., None], queries=query)
    return path


def bare_npy(folder: Path) -> Path:
    path = folder / "bare.npy"
    np.save(path, walk(9))
    return path


def _openpose_frame(bodies: list[np.ndarray]) -> dict[str, Any]:
    return {"version": 1.3, "people": [{"pose_keypoints_2d": body.reshape(-1).tolist()} for body in bodies]}


def openpose_folder(folder: Path) -> Path:
    target = folder / "openpose"
    target.mkdir(exist_ok=True)
    body = np.concatenate([walk(25), scores(25)[..., None]], -1)
    for t in range(FRAMES):
        _json(target / f"clip_{t + 3:012d}_keypoints.json", _openpose_frame([body[t]]))
    return target


def openpose_list(folder: Path) -> Path:
    body = np.concatenate([walk(18), scores(18)[..., None]], -1)
    return _json(folder / "openpose.json", [_openpose_frame([frame]) for frame in body])


def coco_results(folder: Path) -> Path:
    body = np.concatenate([walk(17), scores(17)[..., None]], -1)
    other = np.concatenate([walk(17, (400.0, 210.0), -3.0), np.full((FRAMES, 17, 1), 0.5)], -1)
    entries = [
        {"image_id": t, "category_id": 1, "keypoints": b[t].reshape(-1).tolist(), "score": 0.9}
        for t in range(FRAMES)
        for b in ((body, other) if t % 2 else (other, body))
    ]
    return _json(folder / "coco_results.json", entries)


def coco_annotations(folder: Path) -> Path:
    flags = np.random.default_rng(3).integers(0, 3, (FRAMES, 17, 1)).astype(float)
    body = np.concatenate([walk(17), flags], -1)
    content = {
        "images": [{"id": 900 + 7 * t, "frame_id": t, "file_name": f"{t}.jpg"} for t in range(FRAMES)],
        "categories": [{"id": 1, "keypoints": [f"k{i}" for i in range(17)], "skeleton": [[1, 2], [2, 3]]}],
        "annotations": [
            {"image_id": 900 + 7 * t, "keypoints": body[t].reshape(-1).tolist(), "num_keypoints": 17, "track_id": 5}
            for t in range(FRAMES)
        ],
    }
    return _json(folder / "coco_annotations.json", content)


def mediapipe(folder: Path) -> Path:
    xy, seen = walk(33), scores(33)
    frames = [
        {
            "frame": t,
            "pose_landmarks": [
                {"x": x / 640, "y": y / 480, "z": 0.1, "visibility": v}
                for (x, y), v in zip(xy[t].tolist(), seen[t].tolist(), strict=True)
            ],
        }
        for t in range(FRAMES)
    ]
    return _json(folder / "mediapipe.json", {"image_height": 480, "image_width": 640, "frames": frames})


def mmpose_json(folder: Path) -> Path:
    xy, seen = walk(17), scores(17)
    info = [
        {"frame_id": t + 1, "instances": [{"keypoints": xy[t].tolist(), "keypoint_scores": seen[t].tolist()}]}
        for t in range(FRAMES)
    ]
    return _json(folder / "mmpose.json", {"meta_info": {"dataset_name": "coco"}, "instance_info": info})


def rtmlib_json(folder: Path) -> Path:
    xy, seen = walk(17), scores(17)
    frames = [{"keypoints": [xy[t].tolist()], "scores": [seen[t].tolist()]} for t in range(FRAMES)]
    return _json(folder / "rtmlib.json", frames)


def rtmlib_npz(folder: Path) -> Path:
    path = folder / "rtmlib.npz"
    np.savez(path, keypoints=walk(17)[:, None], scores=scores(17)[:, None])
    return path


def penn_action(folder: Path) -> Path:
    import scipy.io

    path = folder / "penn.mat"
    xy = walk(13) + 1.0
    labels = {"x": xy[..., 0], "y": xy[..., 1], "visibility": (scores(13) > 0.1) * 1.0, "action": "jump"}
    scipy.io.savemat(path, {**labels, "dimensions": np.array([[480.0, 640.0, FRAMES]])}, do_compression=True)
    return path


def mpii_csv(folder: Path) -> Path:
    path = folder / "mpii.csv.gz"
    with gzip.open(path, "wt") as stream:
        stream.write(",NAME,r ankle_X,r ankle_Y,Scale,Activity,Category\n0,a.jpg,620,394,3.02,curling,sports\n")
    return path


def mpii_json(folder: Path) -> Path:
    entry = {"joints_vis": [1] * 16, "joints": [[1.0, 2.0]] * 16, "image": "a.jpg", "scale": 4.7, "center": [3, 4]}
    return _json(folder / "mpii.json", [entry])


def humaneva(folder: Path) -> Path:
    path = folder / "humaneva.npz"
    xy = walk(15)
    np.savez(path, A__xy=np.stack([xy, xy + 1])[:, :8], B__xy=np.stack([xy, xy + 5]), B__xyz=np.zeros((FRAMES, 15, 3)))
    return path


def _deeplabcut(animals: int) -> tuple[list[tuple[str, ...]], np.ndarray]:
    """Column names and values of a table as DeepLabCut writes it."""
    parts = ("nose", "ear", "paw", "tail")
    names, columns = [], []
    for k in range(animals):
        xy, seen = walk(4, (100.0 + 300 * k, 200.0)), np.maximum(scores(4), 0.125 * (1 + k))
        for i, part in enumerate(parts):
            for coord, values in (("x", xy[:, i, 0]), ("y", xy[:, i, 1]), ("likelihood", seen[:, i])):
                names.append(("net", f"mouse{k}", part, coord) if animals > 1 else ("net", part, coord))
                columns.append(values)
    return names, np.stack(columns, -1)


def deeplabcut_csv(folder: Path, animals: int = 1) -> Path:
    names, values = _deeplabcut(animals)
    rows = ("scorer", "individuals", "bodyparts", "coords") if animals > 1 else ("scorer", "bodyparts", "coords")
    lines = [",".join([row, *(name[i] for name in names)]) for i, row in enumerate(rows)]
    lines += [",".join([str(t), *(str(x) for x in values[t])]) for t in range(FRAMES)]
    path = folder / f"dlc{animals}.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def deeplabcut_csv2(folder: Path) -> Path:
    return deeplabcut_csv(folder, 2)


def deeplabcut_h5(folder: Path, animals: int = 1) -> Path:
    """The layout of pandas' ``to_hdf(format="table")``, as read from files that it wrote."""
    names, values = _deeplabcut(animals)
    table = np.zeros(FRAMES, dtype=[("index", "<i8"), ("values_block_0", "<f8", (len(names),))])
    table["index"], table["values_block_0"] = np.arange(FRAMES), values
    path = folder / f"dlc{animals}.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_(b"frame_table")
        group["table"] = table
        group["table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(names, 0))
    return path


def deeplabcut_h5_2(folder: Path) -> Path:
    return deeplabcut_h5(folder, 2)


def deeplabcut_fixed(folder: Path) -> Path:
    """The layout of pandas' ``to_hdf(format="fixed")``."""
    names, values = _deeplabcut(1)
    path = folder / "dlc_fixed.h5"
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = np.bytes_(b"frame")
        for i in range(3):
            level = sorted({name[i] for name in names})
            group[f"block0_items_level{i}"] = np.array([x.encode() for x in level])
            group[f"block0_items_label{i}"] = np.array([level.index(name[i]) for name in names], np.int8)
        group["block0_values"] = values
    return path


def sleap_h5(folder: Path) -> Path:
    path = folder / "sleap.h5"
    xy = np.stack([walk(5), walk(5, (500.0, 100.0))])
    xy[1, 6:] = np.nan
    with h5py.File(path, "w") as file:
        file["tracks"] = xy.transpose(0, 3, 2, 1)
        file["point_scores"] = np.stack([scores(5).T, scores(5).T])
        file["node_names"] = np.array([f"n{i}".encode() for i in range(5)])
        file["track_names"] = np.array([b"first", b"second"])
        file["edge_inds"] = np.array([[0, 1], [1, 2]])
    return path


def sleap_csv(folder: Path) -> Path:
    xy, seen = walk(5), scores(5)
    nodes = [f"n{i}" for i in range(5)]
    head = ["track", "frame_idx", "instance.score", *(f"{n}.{c}" for n in nodes for c in ("x", "y", "score"))]
    lines = [",".join(head)]
    for t in range(FRAMES):
        cells = [f"{xy[t, i, 0]},{xy[t, i, 1]},{seen[t, i]}" if seen[t, i] else ",," for i in range(5)]
        lines.append(",".join(["", str(t), "0.9", *cells]))
    path = folder / "sleap.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def long_csv(folder: Path) -> Path:
    xy, seen = walk(6), scores(6)
    lines = ["frame,point,x,y,confidence"]
    lines += [f"{t},p{i},{xy[t, i, 0]},{xy[t, i, 1]},{seen[t, i]}" for t in range(FRAMES) for i in range(6)]
    path = folder / "long.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def wide_csv(folder: Path) -> Path:
    xy, seen = walk(6), scores(6)
    lines = [";".join(["frame", *(f"p{i}_{c}" for i in range(6) for c in ("x", "y", "likelihood"))])]
    rows = np.concatenate([xy, seen[..., None]], -1).reshape(FRAMES, -1)
    lines += [";".join([str(t), *map(str, row)]) for t, row in enumerate(rows.tolist())]
    path = folder / "wide.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def solid(points: int = 4) -> np.ndarray:
    """(frames, points, 3) millimetres, whole numbers; the last point is not seen in frame 2."""
    xyz = np.round(np.random.default_rng(9).uniform(-900, 900, (FRAMES, points, 3)))
    xyz[2, -1] = np.nan
    return xyz


def c3d(folder: Path) -> Path:
    import ezc3d

    xyz = solid()
    document = ezc3d.c3d()
    document["parameters"]["POINT"]["RATE"]["value"] = [50.0]
    document["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    document["parameters"]["POINT"]["LABELS"]["value"] = [f"M{i}" for i in range(4)]
    document["data"]["points"] = np.concatenate([xyz, np.ones((FRAMES, 4, 1))], -1).transpose(2, 1, 0)
    path = folder / "markers.c3d"
    document.write(str(path))
    return path


def trc(folder: Path) -> Path:
    xyz = solid()
    lines = ["PathFileType\t4\t(X/Y/Z)\ta.trc", "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits"]
    lines += [f"50\t50\t{FRAMES}\t4\tmm", "Frame#\tTime\t" + "\t\t\t".join(f"M{i}" for i in range(4)) + "\t\t"]
    lines += ["\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, 5)), ""]
    for t in range(FRAMES):
        cells = ["" if np.isnan(v) else f"{v:g}" for v in xyz[t].reshape(-1)]
        lines.append("\t".join([str(t + 1), f"{t / 50:.3f}", *cells]))
    path = folder / "markers.trc"
    path.write_text("\n".join(lines) + "\n")
    return path


def bvh(folder: Path) -> Path:
    text = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Knee
  {
    OFFSET 0 -40 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -30 0
    }
  }
}
MOTION
Frames: 3
Frame Time: 0.04
0 100 0 0 0 0 0 0 0
10 100 5 90 0 0 0 0 0
0 100 0 0 90 0 0 0 90
"""
    path = folder / "clip.bvh"
    path.write_text(text)
    return path


def free_throw(folder: Path) -> Path:
    """Feet; the ball is literally NaN."""
    feet = np.round(np.random.default_rng(5).uniform(0, 6, (FRAMES, 3, 3)), 3)
    frames = [
        {
            "frame": t,
            "time": round(t * 1000 / 30),
            "data": {
                "ball": [float("nan")] * 3,
                "player": {n: feet[t, i].tolist() for i, n in enumerate(("NOSE", "L_HIP", "R_HIP"))},
            },
        }
        for t in range(FRAMES)
    ]
    path = folder / "throw.json.gz"
    with gzip.open(path, "wt") as stream:
        json.dump({"participant_id": "P1", "result": "made", "tracking": frames}, stream)
    return path


# Writers by the name of the format that must recognise them.
WRITERS: dict[str, tuple[Callable[[Path], Path], ...]] = {
    "torchrecon tracks": (tracks_npz,),
    "CoTracker": (cotracker,),
    "MMPose or rtmlib": (mmpose_json, rtmlib_json, rtmlib_npz),
    "HumanEva collection": (humaneva,),
    "TAPIR or TAPNext": (tapir, tapnext, bare_npy),
    "MPII Human Pose": (mpii_csv, mpii_json),
    "Penn Action": (penn_action,),
    "OpenPose JSON": (openpose_folder, openpose_list),
    "COCO keypoint JSON": (coco_results, coco_annotations),
    "SPL free throw JSON": (free_throw,),
    "MediaPipe landmarks JSON": (mediapipe,),
    "SLEAP analysis H5": (sleap_h5,),
    "DeepLabCut H5": (deeplabcut_h5, deeplabcut_h5_2, deeplabcut_fixed),
    "C3D": (c3d,),
    "TRC": (trc,),
    "BVH": (bvh,),
    "DeepLabCut CSV": (deeplabcut_csv, deeplabcut_csv2),
    "SLEAP CSV": (sleap_csv,),
    "CSV of points": (long_csv, wide_csv),
}
