"""The synthetic world: bodies and motions."""

import pytest
import torch

from torchrecon.data.synthetic import ACTIONS, BALL_RADIUS, PART_NAMES, sample_body, sample_motion
from torchrecon.data.synthetic.distractors import bounce_cycle
from torchrecon.data.synthetic.pose import chain_frames, swing, two_bone
from torchrecon.data.synthetic.skeleton import MIRROR, PARENTS, forward_kinematics, joint
from torchrecon.errors import ReconError


def _perform(action: str, seed: int, frames: int = 60, fps: float = 25.0):
    g = torch.Generator().manual_seed(seed)
    body = sample_body(g)
    return body, sample_motion(action, body, frames=frames, fps=fps, generator=g)


def test_bodies_span_the_range(generator):
    bodies = [sample_body(generator) for _ in range(200)]
    stature = torch.tensor([b.stature for b in bodies])
    assert 1.55 <= stature.min() < 1.60
    assert 2.05 < stature.max() <= 2.10
    assert 0.05 < sum(not b.right_handed for b in bodies) / 200 < 0.3
    arm = torch.tensor([b.bone("l_elbow") / b.stature for b in bodies])
    assert arm.max() / arm.min() > 1.08


def test_rest_pose_is_as_tall_as_the_stature(generator):
    for _ in range(20):
        body = sample_body(generator)
        eye = torch.eye(3).expand(1, 21, 3, 3)
        joints = forward_kinematics(torch.zeros(1, 3), eye, body.offsets)
        cones = body.place(joints, eye)
        y = cones.corners()[0, :, :, 1]
        height = y[PART_NAMES.index("head")].max() - y[PART_NAMES.index("l_foot")].min()
        assert height.item() == pytest.approx(body.stature, rel=0.012)


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("seed", range(4))
def test_bones_keep_their_length(action, seed):
    body, motion = _perform(action, seed)
    bones = motion.joints[:, 1:] - motion.joints[:, list(PARENTS[1:])]
    expected = body.offsets[1:].norm(dim=-1)
    assert (bones.norm(dim=-1) - expected).abs().max() < 1e-6
    # The bone frames are rotations and carry the rest offsets onto the bones.
    identity = motion.bones @ motion.bones.transpose(-1, -2)
    assert (identity - torch.eye(3)).abs().max() < 1e-9
    assert (torch.linalg.det(motion.bones) > 0).all()
    again = forward_kinematics(motion.joints[:, 0], motion.bones, body.offsets)
    torch.testing.assert_close(again, motion.joints)


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("seed", range(4))
def test_feet_stay_above_the_floor_and_do_not_slide(action, seed):
    body, motion = _perform(action, seed)
    toes = motion.joints[:, [joint("l_toe"), joint("r_toe")]]
    assert (toes[..., 1] > body.toe_height - 1e-6).all()
    feet = [PART_NAMES.index("l_foot"), PART_NAMES.index("r_foot")]
    placed = body.place(motion.joints, motion.bones)
    heel = placed.origins[:, feet, 1] - (placed.radii[feet, 0] * placed.scale[feet, 1])
    assert (heel > -1e-3).all()
    both = motion.contacts[1:] & motion.contacts[:-1]
    assert both.any()
    slide = (toes[1:] - toes[:-1]).norm(dim=-1)
    assert slide[both].max() < 1e-9


@pytest.mark.parametrize("action", ["shoot", "pass"])
@pytest.mark.parametrize("seed", range(6))
def test_ball_flies_under_gravity_after_release(action, seed):
    _, motion = _perform(action, seed)
    first = motion.release
    assert first is not None
    assert 0.35 * len(motion) < first < 0.65 * len(motion)
    flight = motion.ball[first:]
    # Until it comes near the floor, where it bounces.
    last = int((flight[:, 1] < 0.5).nonzero()[0]) if (flight[:, 1] < 0.5).any() else len(flight)
    acceleration = (flight[2:last] - 2 * flight[1 : last - 1] + flight[: last - 2]) * motion.fps**2
    assert len(acceleration) > 5
    torch.testing.assert_close(acceleration, torch.tensor([0.0, -9.81, 0.0]).expand_as(acceleration))
    hands = motion.joints[:, [joint("l_hand"), joint("r_hand")]]
    gap = (hands - motion.ball[:, None]).norm(dim=-1).amin(-1)
    assert gap[:first].max() < 1.6 * BALL_RADIUS
    assert gap[first + 8] > 0.5


def test_dribbled_ball_obeys_gravity_and_the_floor():
    t = torch.arange(0, 2, 0.002)
    height, free = bounce_cycle(t, 0.9, 1.8, 0.2)
    assert height.min() >= BALL_RADIUS - 1e-9
    second = (height[2:] - 2 * height[1:-1] + height[:-2]) / 0.002**2
    flying = (free[:-2] > 0.02) & (free[2:] > 0.02) & (height[1:-1] > BALL_RADIUS + 0.03)
    assert flying.any()
    torch.testing.assert_close(second[flying], torch.full_like(second[flying], -9.81), rtol=1e-4, atol=1e-4)
    speed = (height[1:] - height[:-1]) / 0.002
    # Apart from the bounce the speed is continuous: the hand meets the ball and leaves it without a jerk.
    jumps = (speed[1:] - speed[:-1]).abs()
    assert jumps[height[1:-1] > BALL_RADIUS + 0.03].max() < 0.15


@pytest.mark.parametrize("action", ACTIONS)
def test_same_seed_same_bits_whatever_the_default_dtype(action):
    _, first = _perform(action, 5)
    _, second = _perform(action, 5)
    assert torch.equal(first.joints, second.joints)
    _, other = _perform(action, 6)
    assert not torch.equal(first.joints, other.joints)
    torch.set_default_dtype(torch.float32)
    _, single = _perform(action, 5)
    assert single.joints.dtype == torch.float32
    torch.testing.assert_close(single.joints.double(), first.joints, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("action", ACTIONS)
def test_motion_is_smooth(action):
    """No joint is accelerated by more than a sprinter's foot: 400 m/s^2 at 25 fps (a jump of 0.3 m would be 7500)."""
    for seed in range(4):
        _, motion = _perform(action, seed)
        acceleration = (motion.joints[2:] - 2 * motion.joints[1:-1] + motion.joints[:-2]) * motion.fps**2
        assert acceleration.norm(dim=-1).max() < 400


def test_actions_do_what_they_are_called():
    for seed in range(4):
        body, run = _perform("run", seed)
        assert (run.joints[-1, 0] - run.joints[0, 0]).norm() > 4
        steps = (run.contacts[1:] & ~run.contacts[:-1]).sum()
        assert steps >= 5
        assert (~run.contacts.any(-1)).any()
        body, leap = _perform("jump", seed)
        toe = leap.joints[:, joint("l_toe"), 1]
        assert toe.max() - toe.min() > 0.08 * body.stature
        assert leap.ball.isnan().all()
        body, shot = _perform("shoot", seed)
        head = shot.joints[shot.release, joint("head"), 1]
        assert shot.ball[shot.release, 1] > head + 0.1 * body.stature
        _, thrown = _perform("pass", seed)
        out = thrown.ball[thrown.release + 5] - thrown.ball[thrown.release]
        assert out[[0, 2]].norm() > 1.2
        _, bounced = _perform("dribble", seed)
        low = bounced.ball[:, 1] < 0.35
        assert (low[1:] & ~low[:-1]).sum() >= 2
        _, still = _perform("idle", seed)
        assert still.contacts.all()
        assert (still.joints - still.joints.mean(0)).norm(dim=-1)[:, 0].max() < 0.15


def test_left_handed_body_mirrors_the_action():
    """A left-hander's hand that throws is the left one: at release it is the higher hand's side that changes."""
    sides = set()
    for seed in range(40):
        body, motion = _perform("shoot", seed)
        after = min(motion.release + 5, len(motion) - 1)
        left, right = motion.joints[after, joint("l_hand")], motion.joints[after, joint("r_hand")]
        # The shooting hand drops at the wrist: its fingers are below its wrist.
        drop_left = motion.joints[after, joint("l_wrist"), 1] - left[1]
        drop_right = motion.joints[after, joint("r_wrist"), 1] - right[1]
        assert (drop_right > drop_left).item() == body.right_handed
        sides.add(body.right_handed)
    assert sides == {True, False}


def test_mirror_table_swaps_sides():
    assert [MIRROR[i] for i in MIRROR] == list(range(21))
    assert MIRROR[joint("l_knee")] == joint("r_knee")


def test_two_bone_chain_reaches_its_target(generator):
    start, end = torch.randn(50, 3, generator=generator), torch.randn(50, 3, generator=generator)
    end = start + 0.6 * torch.nn.functional.normalize(end - start, dim=-1)
    pole = torch.randn(50, 3, generator=generator)
    middle, reached = two_bone(start, end, pole, 0.4, 0.35)
    torch.testing.assert_close(reached, end)
    torch.testing.assert_close((middle - start).norm(dim=-1), torch.full((50,), 0.4))
    torch.testing.assert_close((end - middle).norm(dim=-1), torch.full((50,), 0.35))
    assert (((middle - start) * pole).sum(-1) > ((end - start) * pole).sum(-1) * 0.0 - 1.0).all()
    upper, lower = chain_frames(start, middle, end, knee=True)
    torch.testing.assert_close(middle - start, -0.4 * upper[..., 1])
    torch.testing.assert_close(end - middle, -0.35 * lower[..., 1])
    torch.testing.assert_close(upper[..., 0], lower[..., 0])


def test_swing_is_the_smallest_rotation(generator):
    a, b = torch.randn(20, 3, generator=generator), torch.randn(20, 3, generator=generator)
    turned = swing(torch.eye(3).expand(20, 3, 3), a, b)
    aim = torch.einsum("nij,nj->ni", turned, torch.nn.functional.normalize(a, dim=-1))
    torch.testing.assert_close(aim, torch.nn.functional.normalize(b, dim=-1))
    angle = torch.acos(((torch.diagonal(turned, dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    torch.testing.assert_close(angle, torch.acos(torch.nn.functional.cosine_similarity(a, b, dim=-1)))


@pytest.mark.parametrize(("frames", "fps"), [(12, 25.0), (60, 50.0), (240, 30.0)])
@pytest.mark.parametrize("action", ACTIONS)
def test_any_length_and_rate(action, frames, fps):
    _, motion = _perform(action, 3, frames=frames, fps=fps)
    assert motion.joints.shape == (frames, 21, 3)
    assert motion.joints.isfinite().all()


def test_unknown_action_is_refused(generator):
    with pytest.raises(ReconError, match="shoot, run"):
        sample_motion("fly", sample_body(generator), generator=generator)
    with pytest.raises(ReconError, match="at least 2 frames"):
        sample_motion("run", sample_body(generator), frames=1, generator=generator)
