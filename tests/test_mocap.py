"""Readers of motion capture, and retargeting onto the synthetic body."""

import re

import numpy as np
import pytest
import torch

from torchrecon.data import load_mocap, read_bvh, read_c3d
from torchrecon.data.synthetic import PART_NAMES, retarget_joints, sample_body, sample_motion
from torchrecon.data.synthetic.retarget import match_joints
from torchrecon.data.synthetic.skeleton import JOINTS, PARENTS, joint
from torchrecon.errors import ReconError

BVH = """HIERARCHY
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
LIMBS = [n for n in JOINTS if n.split("_")[-1] in ("elbow", "wrist", "knee", "ankle")]


def _write(tmp_path, text):
    path = tmp_path / "clip.bvh"
    path.write_text(text)
    return path


def test_bvh_hand_checked(tmp_path):
    clip = read_bvh(_write(tmp_path, BVH))
    assert clip.names == ("Hips", "Knee", "Knee_end")
    assert clip.parents == (-1, 0, 1)
    assert clip.fps == pytest.approx(25.0)
    # Frame 0: straight down. Frame 1: 90 degrees about z turn -y into +x. Frame 2: 90 degrees about x turn it into -z.
    expected = torch.tensor(
        [
            [[0, 1.0, 0], [0, 0.6, 0], [0, 0.3, 0]],
            [[0.1, 1.0, 0.05], [0.5, 1.0, 0.05], [0.8, 1.0, 0.05]],
            [[0, 1.0, 0], [0, 1.0, -0.4], [0, 1.0, -0.7]],
        ]
    )
    torch.testing.assert_close(clip.joints, expected)


def test_bvh_rotation_order_is_that_of_the_channels(tmp_path):
    """Z then X, intrinsic: z 90 first, then x 90 about the turned axis: -y -> (Rz Rx)(-y) = Rz(-z) = -z."""
    text = BVH.replace("0 100 0 0 90 0 0 0 90", "0 100 0 90 90 0 0 0 0")
    knee = read_bvh(_write(tmp_path, text)).joints[2, 1]
    torch.testing.assert_close(knee, torch.tensor([0.0, 1.0, -0.4]))
    swapped = text.replace("Zposition Zrotation Xrotation Yrotation", "Zposition Xrotation Zrotation Yrotation")
    # X then Z: (Rx Rz)(-y) = Rx(+x) = +x.
    knee = read_bvh(_write(tmp_path, swapped)).joints[2, 1]
    torch.testing.assert_close(knee, torch.tensor([0.4, 1.0, 0.0]))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("MOTION\n", "", "is not BVH"),
        ("10 100 5 90 0 0 0 0 0", "10 100 5 90", "line 20 has 4 values; the channels of the skeleton are 9"),
        ("10 100 5 90 0 0 0 0 0", "10 100 5 90 0 0 0 0 x", "line 20 holds something that is no number"),
        ("Frames: 3", "Frames: 4", "4 frames .* are announced, 3 are there"),
        ("Frames: 3", "Frames: three", "need a number each"),
        ("Frame Time: 0.04", "Frame Time: nan", "3 frames of nan s are announced"),
        ("Zrotation Xrotation Yrotation\n    End", "Zrotation Qrotation Yrotation\n    End", "line 9 is not BVH"),
        ("OFFSET 0 -40 0", "OFFSET 0 -40", "line 8 is not BVH"),
    ],
)
def test_bvh_errors_name_the_line(tmp_path, old, new, sentence):
    with pytest.raises(ReconError, match=sentence):
        read_bvh(_write(tmp_path, BVH.replace(old, new)))


def test_missing_files_are_named(tmp_path):
    for reader in (read_bvh, read_c3d, load_mocap):
        with pytest.raises(ReconError, match=re.escape(str(tmp_path / "none"))):
            reader(tmp_path / "none")


def test_c3d_markers_in_metres_with_gaps(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [50.0]
    c3d["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = ["LANK", "RANK"]
    points = np.ones((4, 2, 5))
    points[:3] = 1000 * np.arange(30).reshape(3, 2, 5)
    points[:3, 1, 2] = np.nan
    c3d["data"]["points"] = points
    path = tmp_path / "walk.c3d"
    c3d.write(str(path))
    markers = read_c3d(path)
    assert markers.names == ("LANK", "RANK")
    assert markers.fps == 50.0
    assert markers.positions.shape == (5, 2, 3)
    torch.testing.assert_close(markers.positions[3, 1], torch.tensor([8.0, 18.0, 28.0]))
    assert markers.positions[2, 1].isnan().all()
    assert markers.positions.isnan().sum() == 3
    (tmp_path / "bad.c3d").write_bytes(b"no c3d at all")
    with pytest.raises(ReconError, match="cannot read it as C3D"):
        read_c3d(tmp_path / "bad.c3d")


def test_collection_round_trip(tmp_path):
    path = tmp_path / "mini.npz"
    fields = {k: np.array(["a", "b"]) for k in ("label", "subject", "trial", "source", "quality", "license")}
    arrays = {
        "joints": np.array(["pelvis", "neck"]),
        "parents": np.array([-1, 0]),
        "n_clips": np.array(2),
        "fps": np.array([30.0, 25.0]),
        "clip_0000": np.zeros((4, 2, 3), np.float32),
        "clip_0001": np.ones((5, 2, 3), np.float32),
    }
    np.savez(path, **fields, **arrays)
    clips = load_mocap(path)
    assert [len(c) for c in clips] == [4, 5]
    (one,) = load_mocap(path, labels=["b"])
    assert (one.label, one.fps, one.names, one.parents) == ("b", 25.0, ("pelvis", "neck"), (-1, 0))
    assert one.joints.dtype == torch.get_default_dtype()
    np.savez(path, **fields, **{k: v for k, v in arrays.items() if k != "parents"})
    with pytest.raises(ReconError, match="'parents' is missing"):
        load_mocap(path)


def _direction(joints, name, names=JOINTS, parents=PARENTS):
    index = names.index(name)
    return torch.nn.functional.normalize(joints[:, index] - joints[:, parents[index]], dim=-1)


def test_retargeting_onto_the_own_body_is_the_identity_for_limbs(generator):
    """A motion of body A on body B: B's bone lengths, A's limb directions; on A itself the same legs and arms."""
    a, b = sample_body(generator), sample_body(generator)
    source = sample_motion("shoot", a, generator=generator)
    for body in (a, b):
        motion = retarget_joints(source.joints, PARENTS, JOINTS, body, source.fps)
        for name in LIMBS:
            torch.testing.assert_close(_direction(motion.joints, name), _direction(source.joints, name))
        length = (motion.joints[:, 1:] - motion.joints[:, list(PARENTS[1:])]).norm(dim=-1)
        assert (length - body.offsets[1:].norm(dim=-1)).abs().max() < 1e-6
    same = retarget_joints(source.joints, PARENTS, JOINTS, a, source.fps).joints
    assert (same - source.joints).norm(dim=-1).median() < 0.02
    assert (same - source.joints).norm(dim=-1).max() < 0.12


def test_twist_of_bent_limbs_follows_their_plane(generator):
    """The recovered thigh and arm frames agree with those that made the motion, where the limb is bent."""
    body = sample_body(generator)
    source = sample_motion("run", body, generator=generator)
    motion = retarget_joints(source.joints, PARENTS, JOINTS, body, source.fps)
    for name, limit in (("l_knee", 25.0), ("r_ankle", 25.0), ("l_elbow", 15.0), ("r_wrist", 15.0)):
        index = joint(name)
        relative = source.bones[:, index].transpose(-1, -2) @ motion.bones[:, index]
        cosine = (torch.diagonal(relative, dim1=-2, dim2=-1).sum(-1) - 1) / 2
        angle = torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))
        assert angle.median() < limit / 2
        assert angle.max() < limit


def test_bvh_names_are_matched():
    arm, leg = ("Shoulder", "Arm", "ForeArm", "Hand"), ("UpLeg", "Leg", "Foot", "ToeBase")
    sides = [side + part for chain in (arm, leg) for side in ("Left", "Right") for part in chain]
    names = ("Hips", "Spine", "Spine1", "Neck", "Head", *sides)
    found = {ours: names[index] for ours, index in match_joints(names).items()}
    assert found["l_shoulder"] == "LeftArm"
    assert found["l_elbow"] == "LeftForeArm"
    assert found["r_wrist"] == "RightHand"
    assert found["l_hip"] == "LeftUpLeg"
    assert found["l_knee"] == "LeftLeg"
    assert found["r_ankle"] == "RightFoot"
    assert found["r_toe"] == "RightToeBase"
    assert "l_hand" not in found


def test_unusable_skeletons_are_refused(generator):
    body = sample_body(generator)
    joints = torch.randn(3, 21, 3, generator=generator)
    names = ["elbow_of_nobody" if n == "l_knee" else n for n in JOINTS]
    with pytest.raises(ReconError, match="no joint for l_knee"):
        retarget_joints(joints, PARENTS, names, body, 30.0)
    joints[1, 4, 0] = torch.nan
    with pytest.raises(ReconError, match="frame 1 has positions that are not finite"):
        retarget_joints(joints, PARENTS, JOINTS, body, 30.0)


@pytest.mark.data
@pytest.mark.parametrize("file", ["dev.npz", "general.npz"])
def test_real_clips_on_a_body(data_dir, generator, file):
    clips = load_mocap(data_dir / "mocap" / file)
    body = sample_body(generator)
    matched = match_joints(clips[0].names)
    assert len(matched) == 21
    for clip in clips[::25]:
        motion = retarget_joints(clip.joints, clip.parents, clip.names, body, clip.fps)
        length = (motion.joints[:, 1:] - motion.joints[:, list(PARENTS[1:])]).norm(dim=-1)
        assert (length - body.offsets[1:].norm(dim=-1)).abs().max() < 1e-6
        for name in LIMBS:
            parent = JOINTS[PARENTS[joint(name)]]
            source = clip.joints[:, matched[name]] - clip.joints[:, matched[parent]]
            cosine = torch.nn.functional.cosine_similarity(source, _direction(motion.joints, name), dim=-1)
            assert cosine.min() > 1 - 1e-9
        toes = motion.joints[:, [joint("l_toe"), joint("r_toe")], 1] - body.toe_height
        feet = [PART_NAMES.index("l_foot"), PART_NAMES.index("r_foot")]
        placed = body.place(motion.joints, motion.bones)
        heels = placed.origins[:, feet, 1] - placed.radii[feet, 0]
        assert torch.minimum(toes.min(), heels.min()).item() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.data
def test_named_actions_can_be_told_in_the_real_clips(data_dir):
    clips = load_mocap(data_dir / "mocap" / "dev.npz", labels=["shoot", "run"])
    assert {c.label for c in clips} == {"shoot", "run"}
    assert sum(c.label == "shoot" for c in clips) == 31
    assert all(c.license for c in clips)
