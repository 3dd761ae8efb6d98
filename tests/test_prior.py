"""The prior of human shape: names, geometry of its answers, the two Gaussians, what it is trained on, its job."""

from __future__ import annotations

import inspect
import json
import math

import pytest
import torch

import torchrecon as tr
from eval.prior import mahalanobis
from torchrecon.cli import main
from torchrecon.errors import ReconError
from torchrecon.io.readers import layouts
from torchrecon.measurement import ShapeBelief, ShapePrior, Status, project_points
from torchrecon.models.joints import JOINTS, MIRROR, PARENTS, match_joints
from torchrecon.models.lifting import Lifting, centre_and_size
from torchrecon.models.prior import HumanPrior, load_prior, save_prior
from torchrecon.nrsfm.with_prior import fuse
from train.motions import Variation, Windows, synthetic_clip
from train.prior import Motions, calibrate

LIMBS = tuple(f"{side}_{joint}" for side in "lr" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle"))


@pytest.fixture
def prior(generator):
    """A small network with weights that nobody has trained, but that do something."""
    made = HumanPrior(24, (0, 1, 4)).to(torch.float64)
    for value in made.network.parameters():
        value.data = 0.2 * torch.randn(value.shape, generator=generator)
    return made.eval()


@pytest.fixture
def walker():
    """A person of the synthetic world in camera axes, 5 m away, metres; all joints of the prior."""
    clip = synthetic_clip(1)
    joints = (clip.joints - clip.joints[:, :1].mean(0))[:50].double() * torch.tensor([1.0, -1.0, -1.0])
    return joints + torch.tensor([0.3, -0.2, 5.0])


def test_names_of_the_known_keypoint_sets_are_matched():
    for layout in ("COCO_17", "BODY_25", "OPENPOSE_18", "MEDIAPIPE_33", "MPII_16", "PENN_13", "HUMANEVA_15"):
        names = getattr(layouts, layout).names
        found = {JOINTS[index] for index in match_joints(names) if index is not None}
        assert set(LIMBS) <= found, layout
    spelled = ["LeftHip", "hip_r", "L Shoulder", "rclavicle", "left_knee", "R_ELBOW", "ltibia", "nose", "lfoot"]
    expected = ["l_hip", "r_hip", "l_shoulder", "r_shoulder", "l_knee", "r_elbow", "l_ankle", None, "l_toe"]
    assert [None if index is None else JOINTS[index] for index in match_joints(spelled)] == expected


def test_points_that_are_no_joints_are_refused_with_what_is_needed():
    for names in (None, ["a", "b"], [name for name in LIMBS if name != "l_hip"]):
        with pytest.raises(ReconError, match="both hips"):
            match_joints(names)
    with pytest.raises(ReconError, match="l_hip"):
        match_joints([name for name in LIMBS if name != "l_hip"])
    with pytest.raises(ReconError, match="l_ankle"):
        match_joints(["l_shoulder", "r_shoulder", "l_hip", "r_hip", "head"])


def test_a_mirrored_scene_gives_the_mirrored_answer(prior, generator):
    xy = torch.randn(2, 32, 21, 2, generator=generator)
    seen = torch.rand(2, 32, 21, generator=generator) < 0.8
    order, flip = list(MIRROR), torch.tensor([-1.0, 1.0, 1.0])
    mean, deviation = prior.network.both_sides(xy, seen)
    mirrored, other = prior.network.both_sides(xy[:, :, order] * flip[:2], seen[:, :, order])
    torch.testing.assert_close(mirrored[:, :, order] * flip, mean)
    torch.testing.assert_close(other[:, :, order], deviation)


def test_unseen_entries_are_never_read(prior, walker, generator):
    seen = torch.rand(walker.shape[:2], generator=generator) < 0.8
    xy = 200 * walker[..., :2]
    answers = [prior(tr.Tracks(torch.where(seen[..., None], xy, fill), seen, names=JOINTS)) for fill in (math.nan, 1e6)]
    torch.testing.assert_close(answers[0].points3d, answers[1].points3d, rtol=0, atol=0)
    assert torch.isfinite(answers[0].points3d).all()


def test_a_person_who_is_out_of_sight_for_a_while_stays_on_the_way(prior, walker):
    xy = 200 * walker[:40, :, :2] + torch.arange(40.0)[:, None, None] * torch.tensor([9.0, 0.0]) + 500
    gone = (torch.arange(40) >= 14) & (torch.arange(40) < 22)
    for value in prior.network.leave.parameters():
        value.data.zero_()  # what is seen stands where it is seen, what is not at the centre
    belief = prior(tr.Tracks(xy, ~gone[:, None].expand(40, 21), names=JOINTS))
    torch.testing.assert_close(belief.translation[~gone][:12], xy.mean(1)[:12], atol=1e-6, rtol=0)
    assert float((belief.translation - xy.mean(1)).norm(dim=-1).max()) < 12.0  # of 500 pixels and more
    lone = prior(tr.Tracks(xy[:1], names=JOINTS))
    assert lone.points3d.shape == (1, 21, 3)
    assert bool(torch.isfinite(lone.points3d).all())


def test_answer_follows_place_and_size_of_the_image(prior, walker):
    xy = 200 * walker[..., :2]
    plain = prior(tr.Tracks(xy, names=JOINTS))
    moved = prior(tr.Tracks(3 * xy + torch.tensor([40.0, -7.0]), names=JOINTS))
    torch.testing.assert_close(moved.points3d, 3 * plain.points3d)
    torch.testing.assert_close(moved.covariance3d, 9 * plain.covariance3d)
    torch.testing.assert_close(moved.translation, 3 * plain.translation + torch.tensor([40.0, -7.0]))


def test_answer_does_not_depend_on_the_frame_rate(prior, walker):
    xy = 200 * walker[:45, :, :2]
    slow = prior(tr.Tracks(xy[::2], names=JOINTS, fps=15.0))
    fast = prior(tr.Tracks(xy, names=JOINTS, fps=30.0))
    torch.testing.assert_close(fast.points3d[::2], slow.points3d)


def test_with_intrinsics_points_lie_on_the_rays_and_bones_fix_the_size(prior, walker):
    k = torch.tensor([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    tracks = tr.Tracks(project_points(walker, k), names=JOINTS, intrinsics=k)
    belief = prior(tracks)
    placed = belief.points3d + belief.translation[:, None]
    torch.testing.assert_close(project_points(placed, k), tracks.xy)
    # Along the ray through a joint all is uncertain, across it nothing is: it was measured.
    along = torch.nn.functional.normalize(placed, dim=-1)
    across = belief.covariance3d.diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close((along[..., None, :] @ belief.covariance3d @ along[..., None])[..., 0, 0], across)


def test_a_point_without_a_name_hangs_on_the_joint_beside_it(prior, walker):
    xy = 200 * walker[..., :2]
    wrist = JOINTS.index("l_wrist")
    watch = xy[:, wrist : wrist + 1] + torch.tensor([2.0, 0.0])
    belief = prior(tr.Tracks(torch.cat([xy, watch], 1), names=[*JOINTS, "watch"]))
    assert belief.known.tolist() == [True] * 21 + [False]
    lone = prior(tr.Tracks(xy, names=JOINTS))
    apart = (lone.points3d[..., :2] + lone.translation[:, None] - watch).square().sum(-1).mean(0)
    nearest = int(apart.argmin())
    depth = belief.points3d[:, [nearest, 21], 2]
    torch.testing.assert_close(depth[:, 0], depth[:, 1])
    expected = belief.covariance3d[:, nearest, 2, 2] + apart[nearest] / 2
    torch.testing.assert_close(belief.covariance3d[:, 21, 2, 2], expected)


def test_saved_and_loaded_is_the_same(prior, walker, tmp_path):
    path = save_prior(prior, tmp_path / "p.safetensors", {"remark": "none"})
    assert json.loads(path.with_suffix(".json").read_text())["remark"] == "none"
    tracks = tr.Tracks(200 * walker[..., :2], names=JOINTS)
    loaded = load_prior(path)
    assert isinstance(loaded, ShapePrior)
    torch.testing.assert_close(loaded(tracks).points3d, prior(tracks).points3d, rtol=1e-4, atol=1e-2)
    (tmp_path / "q.safetensors").write_bytes(b"no weights")
    for name, text in (("none.safetensors", "no such file"), ("q.safetensors", "no shape prior")):
        with pytest.raises(ReconError, match=text):
            load_prior(tmp_path / name)


def _answer(points, covariance, code="ok"):
    eye = torch.eye(3).expand(len(points), 3, 3)
    return tr.Reconstruction.from_points(points, eye, rank=1, status=Status(code, "by hand"), covariance3d=covariance)


def _spd(generator, size, *shape):
    root = torch.randn(*shape, 3, 3, generator=generator)
    return size * (root @ root.mT / 3 + 0.5 * torch.eye(3))


def test_two_gaussians_that_agree_are_multiplied(generator):
    points = torch.randn(200, 9, 3, generator=generator)
    points = 10 * (points - points.mean(1, keepdim=True))
    own, learned = _spd(generator, 0.5, 200, 9), _spd(generator, 2.0, 200, 9)
    belief = ShapeBelief(points, learned, torch.zeros(200, 2), torch.arange(9) < 8, "hand")
    tracks = tr.Tracks(points[..., :2])
    fused = fuse(_answer(points, own), belief, tracks)
    product = torch.linalg.inv(torch.linalg.inv(own) + torch.linalg.inv(learned))
    torch.testing.assert_close(fused.covariance3d[:, :8], product[:, :8], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(fused.covariance3d[:, 8], own[:, 8], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(fused.points3d, points)
    assert fused.status.ok
    mirrored = fuse(_answer(points * torch.tensor([1.0, 1.0, -1.0]), own), belief, tracks)
    torch.testing.assert_close(mirrored.points3d, points)


def test_a_solver_that_the_prior_contradicts_does_not_count(generator):
    points = 10 * torch.randn(60, 9, 3, generator=generator)
    points = points - points.mean(1, keepdim=True)
    wrong = torch.cat([points[..., :2], 10 * torch.randn(60, 9, 1, generator=generator)], -1)
    tight = 1e-4 * torch.eye(3).expand(60, 9, 3, 3)
    belief = ShapeBelief(points, torch.eye(3).expand(60, 9, 3, 3), torch.zeros(60, 2), torch.ones(9) > 0, "hand")
    fused = fuse(_answer(wrong, tight), belief, tr.Tracks(points[..., :2]))
    torch.testing.assert_close(fused.points3d, points)
    torch.testing.assert_close(fused.covariance3d, belief.covariance3d)
    assert fused.status.code == "undetermined"
    assert "not how people move" in fused.status.text


def test_a_solver_surer_than_it_may_be_is_widened_to_what_it_misses_by(generator):
    points = 30 * torch.randn(2000, 9, 3, generator=generator)
    points = points - points.mean(1, keepdim=True)
    eye = torch.eye(3).expand(2000, 9, 3, 3)
    # The prior is off by what it says, 1; the solver by 0.8 in depth, of which it knows nothing.
    learned = points + torch.randn(points.shape, generator=generator)
    solved = points + 0.8 * torch.randn(points.shape, generator=generator) * torch.tensor([0.0, 0.0, 1.0])
    belief = ShapeBelief(learned - learned.mean(1, keepdim=True), eye, torch.zeros(2000, 2), torch.ones(9) > 0, "hand")
    fused = fuse(_answer(solved, 1e-6 * eye), belief, tr.Tracks(points[..., :2]))
    left = (1 - 1 / 9) * 1.64 - 1  # centring takes a ninth of what both miss by
    assert float(fused.covariance3d[..., 2, 2].mean()) == pytest.approx(left / (1 + left), rel=0.1)
    error = (fused.points3d - points)[..., 2].square().mean()
    assert float(error) < 0.9 * 0.64


def test_a_still_view_leaves_all_depth_to_the_prior(prior, walker):
    still = 200 * walker[:1, :, :2].expand(12, 21, 2)
    tracks = tr.Tracks(still, names=JOINTS)
    answer = tr.reconstruct(tracks, rank=1, solver="rigid", prior=prior)
    torch.testing.assert_close(answer.points3d, prior(tracks).points3d)
    assert answer.status.code == "undetermined"
    assert "all depth is that of the prior" in answer.status.text
    batch = tr.Tracks(still.expand(2, 12, 21, 2), names=JOINTS)
    both = tr.Reconstructor(rank=1, solver="rigid", prior=prior)(batch)
    torch.testing.assert_close(both.points3d[1], answer.points3d)
    with pytest.raises(ReconError, match="shape prior"):
        inspect.unwrap(tr.reconstruct)(tracks, prior="human")  # unwrapped of the type check of the test session


def test_command_line_takes_a_prior(prior, walker, tmp_path, capsys):
    weights = str(save_prior(prior, tmp_path / "p.safetensors"))
    named = tr.Tracks(200 * walker[:1, :, :2].expand(12, 21, 2), names=JOINTS)
    nameless = tr.Tracks(named.xy)
    for tracks, code in ((named, 0), (nameless, 2)):
        file = str(tracks.save(tmp_path / "tracks.npz"))
        words = ["solve", file, "-o", str(tmp_path / "r.npz"), "--rank", "1", "--solver", "rigid", "--prior", weights]
        assert main(words) == code
    assert "no point has a name" in capsys.readouterr().err


def test_bodies_of_the_training_keep_their_bones_where_nothing_is_varied():
    torch.set_default_dtype(torch.float32)
    clip = synthetic_clip(2)
    world = Windows([clip], Variation(bones=0.0), 0)._bodies(6)
    parents = list(PARENTS[1:])
    lengths = [(j[..., 1:, :] - j[..., parents, :]).norm(dim=-1) for j in (clip.joints, world)]
    order = [index - 1 for index in MIRROR[1:]]
    expected = lengths[0].mean(0)
    found = lengths[1].mean(1)
    nearest = torch.minimum((found - expected).abs().amax(-1), (found - expected[order]).abs().amax(-1))
    assert float(nearest.max()) < 5e-3  # straight lines between frames shorten a swinging bone a little


def test_what_is_learned_is_the_pinhole_image_without_its_perspective():
    torch.set_default_dtype(torch.float32)
    still = Variation(follow=1.0, whole=1.0, noise=(1e-7, 1e-7))
    batch = Windows([synthetic_clip(0)], still, 3).draw(4)
    points, seen = batch.points3d.double(), batch.xy.double()
    # A camera that follows has the pelvis on its axis: image and answer differ by each joint's depth over the pelvis'.
    weak, exact = points[..., 1:, :2] - points[..., :1, :2], seen[..., 1:, :] - seen[..., :1, :]
    ratio = (weak * exact).sum(-1) / exact.square().sum(-1) - 1  # = depth over the pelvis' - 1
    depth = points[..., 1:, 2] - points[..., :1, 2]
    size = (ratio * depth).sum((1, 2)) / depth.square().sum((1, 2))
    assert bool((size > 0).all())
    torch.testing.assert_close(exact * (1 + size[:, None, None, None] * depth[..., None]), weak, atol=2e-3, rtol=0)


def test_held_out_bodies_set_the_spread(generator):
    torch.set_default_dtype(torch.float32)
    windows = Windows([synthetic_clip(3)], Variation(), 5)

    class Guess(Lifting):
        """Errors of 0.02 and 0.06, said to be 0.01 each."""

        def both_sides(self, xy, seen):
            error = torch.randn(*truth.shape, generator=generator) * torch.tensor([0.02, 0.02, 0.06])
            return truth + error, torch.full((*truth.shape[:-1], 2), 0.01)

    made = HumanPrior(8, (0,))
    made.network = Guess(8, (0,))
    truth = torch.zeros(())

    class Known:
        def draw(self, count):
            nonlocal truth
            batch = windows.draw(count)
            truth = batch.points3d
            return batch

    calibrate(made, Known(), batches=4, size=16)
    assert made.widen.tolist() == pytest.approx([2.0, 6.0], rel=0.03)


@pytest.mark.data
def test_subjects_that_are_excluded_are_not_trained_on_and_unknown_ones_refused(data_dir):
    torch.set_default_dtype(torch.float32)
    file = str(data_dir / "mocap" / "dev.npz")
    motions = Motions(Variation(), [file], ["hdm05_bk", "cmu_02"])
    motions.setup("fit")
    frames = [sum(len(clip.joints) for clip in clips) for clips in (motions.training, motions.held)]
    assert sum(frames) == 26782 - 4504 - 3130  # optical frames of the file without those of two subjects
    assert 0.1 <= frames[1] / sum(frames) < 0.2
    motions = Motions(Variation(), [file], ["nobody"])
    with pytest.raises(ReconError, match="nobody"):
        motions.setup("fit")


def test_ellipsoids_hold_the_share_that_they_claim(generator):
    truth = torch.randn(4000, 30, 3, generator=generator)
    covariance = _spd(generator, 0.01, 4000, 30)
    noise = (torch.linalg.cholesky(covariance) @ torch.randn(4000, 30, 3, 1, generator=generator))[..., 0]
    distance = mahalanobis(7 * (truth + noise) + 1, truth, 49 * covariance, in_camera=True)
    assert float((distance <= 7.815).double().mean()) == pytest.approx(0.95, abs=0.01)


def test_centre_and_size_do_not_see_what_is_not_seen(generator):
    xy = torch.randn(3, 8, 21, 2, generator=generator)
    seen = torch.rand(3, 8, 21, generator=generator) < 0.7
    centre, size = centre_and_size(torch.where(seen[..., None], xy, torch.nan), seen)
    for window in range(3):
        rest = [xy[window, f, seen[window, f]] - centre[window, f] for f in range(8)]
        assert max(float(r.mean(0).abs().max()) for r in rest) < 1e-9
        assert float(size[window]) == pytest.approx(float(torch.cat(rest).square().mean().sqrt()))
