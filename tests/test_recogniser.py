"""The read-out (what it must not see, and must) and the recogniser."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.kill import SMALL_TRAINING, check_whole, kill_after
from torchrecon.data.mocap import MocapClip
from torchrecon.data.synthetic import ACTIONS, sample_body, sample_motion
from torchrecon.errors import ReconError
from torchrecon.models.recogniser import (
    ReadOut,
    Recogniser,
    classify_windows,
    load_recogniser,
    read_out,
    save_recogniser,
    weights_hash,
    yaws_of,
)
from torchrecon.models.views import settle
from train.films import AS_TRACKED, MOCAP_CLASSES, Film, augment, mocap_film
from train.recogniser import Training

ROOT = Path(__file__).parents[1]
VIEWS = ReadOut()


def _camera(angle):
    """A level camera whose optical axis has this angle to world -Z about Y, one per frame."""
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    forward = torch.stack([angle.sin(), zero, -angle.cos()], -1)
    down = torch.stack([zero, -one, zero], -1)
    return torch.stack([torch.linalg.cross(down, forward), down, forward], -2)


def _clip(generator, frames=12, points=60, turn=math.pi):
    """A bending cloud, taller than wide, before a turning camera."""
    rest = torch.randn(points, 3, generator=generator) * torch.tensor([0.2, 0.5, 0.3])
    bend = torch.linspace(-1, 1, frames)[:, None] * rest[:, 1].square()
    world = torch.stack([rest[:, 0] + bend, rest[:, 1].expand_as(bend), rest[:, 2] - 0.5 * bend], -1)
    rotations = _camera(torch.linspace(0, turn, frames))
    visible = torch.rand(frames, points, generator=generator) < 0.6
    return world @ rotations.transpose(-1, -2), visible, rotations


def test_scale_and_translation_of_each_frame_change_nothing(generator):
    points, visible, rotations = _clip(generator)
    moved = 37.0 * points + 100 * torch.randn(len(points), 1, 3, generator=generator)
    expected = read_out(points, visible, rotations, VIEWS)
    torch.testing.assert_close(read_out(moved, visible, rotations, VIEWS), expected, atol=2e-3, rtol=0)


def test_unseen_entries_are_never_read(generator):
    points, visible, rotations = _clip(generator)
    expected = read_out(points, visible, rotations, VIEWS)
    hidden = torch.where(visible[..., None], points, torch.nan)
    assert torch.equal(read_out(hidden, visible, rotations, VIEWS), expected)


def test_order_of_points_changes_nothing(generator):
    points, visible, rotations = _clip(generator)
    order = torch.randperm(points.shape[1], generator=generator)
    shuffled = read_out(points[:, order], visible[:, order], rotations, VIEWS)
    torch.testing.assert_close(shuffled, read_out(points, visible, rotations, VIEWS), atol=1e-5, rtol=0)


def test_yaw_is_a_turn_of_the_world(generator):
    points, visible, rotations = _clip(generator)
    yaw = 0.7
    turn = torch.tensor(
        [[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]]
    )  # about +Y: what read_out does to the world before it looks
    turned = read_out(points, visible, rotations @ turn.T, VIEWS)
    torch.testing.assert_close(turned, read_out(points, visible, rotations, VIEWS, yaw), atol=1e-4, rtol=0)


def test_shape_that_stands_still_in_the_world_stands_still_in_world_views(generator):
    points, visible, rotations = _clip(generator)
    still = points[:1] @ rotations[:1] @ rotations.transpose(-1, -2)
    volume = read_out(still, visible[:1].expand_as(visible), rotations, ReadOut(views=("side", "top")))
    torch.testing.assert_close(volume, volume[:, :1].expand_as(volume), atol=1e-4, rtol=0)


def test_views_show_what_their_axes_say():
    # One far point up, one to +X, one to +Z of a cluster that holds the centre.
    points = torch.cat([torch.zeros(20, 3), torch.tensor([[0, 2.0, 0], [2.0, 0, 0], [0, 0, 2.0]])])[None]
    rotations = _camera(torch.full((1,), 0.4))
    volume = read_out(points @ rotations.transpose(-1, -2), torch.ones(1, 23, dtype=torch.bool), rotations, VIEWS)
    side, top = (picture > 0.03 for picture in volume[:, 0])
    half = VIEWS.size // 2
    up = (slice(0, half - 4), slice(half - 2, half + 2))
    right, left = (slice(half - 2, half + 2), slice(half + 4, None)), (slice(half - 2, half + 2), slice(0, half - 4))
    down = (slice(half + 4, None), slice(half - 2, half + 2))
    assert [bool(side[place].any()) for place in (up, right, left, down)] == [True, True, False, False]
    assert [bool(top[place].any()) for place in (up, right, left, down)] == [False, True, False, True]


def test_camera_that_stands_still_is_never_looked_through(generator):
    yaws, weights = yaws_of(_camera(torch.full((9,), 0.7)), 8)
    points, visible, rotations = _clip(generator, turn=0.0)
    points = points @ rotations @ _camera(torch.full((12,), 0.7)).transpose(-1, -2)
    flat = points * torch.tensor([1.0, 1.0, 0.0])
    widths = [
        float((read_out(flat, visible, _camera(torch.full((12,), 0.7)), yaw=float(yaw))[0] > 0.05).any(1).sum(-1).max())
        for yaw in yaws
    ]
    torch.testing.assert_close(weights[[2, 6]], torch.zeros(2), atol=1e-12, rtol=0)
    assert weights.argmax() in (0, 4)
    assert widths[0] == widths[4] == min(widths)  # a line: all of the flat shape that has depth is its height
    assert widths[2] == max(widths)
    _, even = yaws_of(_camera(2 * math.pi * torch.arange(50) / 50), 8)
    torch.testing.assert_close(even, torch.full((8,), 1 / 8))


def test_how_densely_points_lie_changes_nearly_nothing(generator):
    points, visible, rotations = _clip(generator)
    visible = torch.ones_like(visible)
    upper = points[:, points[0, :, 1] < points[0, :, 1].median()]
    crowd = [upper + 0.01 * torch.randn(upper.shape, generator=generator) for _ in range(10)]
    crowded = torch.cat([points, *crowd], 1)
    expected = read_out(points, visible, rotations, VIEWS)
    volume = read_out(crowded, torch.ones(crowded.shape[:2], dtype=torch.bool), rotations, VIEWS)
    assert (volume - expected).abs().sum() < 0.25 * expected.sum()


def test_centre_stays_where_it_is_as_points_come_and_go(generator):
    points, _, rotations = _clip(generator, frames=30, points=200)
    born = 30 * torch.rand(200, generator=generator) - 8
    clock = torch.arange(30)[:, None]
    visible = (clock >= born) & (clock < born + 8)
    visible &= (clock % 10 < 5) | (points[0, :, 1] < 0)  # the lower half comes and goes

    def sway(anchor):
        settled = settle(points, visible, rotations, ReadOut(anchor=anchor))
        world = points @ rotations
        order = visible.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)[:, : settled.world.shape[1]]
        scale = (world[0, visible[0]].std(0) / settled.world[0, : visible[0].sum()].std(0)).mean()
        there = world.gather(1, order[..., None].expand(-1, -1, 3)) / scale
        shown = settled.weight > 0
        return torch.stack([(a - b)[c].mean(0) for a, b, c in zip(there, settled.world, shown, strict=True)]).std(0)

    assert sway(0.003)[1] < 0.25 * sway(100.0)[1]


def test_flat_points_do_not_pass_for_a_body(generator):
    points, visible, rotations = _clip(generator)
    flat = points * torch.tensor([1.0, 1.0, 0.0])
    true, without = (read_out(x, visible, rotations, VIEWS) for x in (points, flat))
    assert (true - without).abs().sum((1, 2, 3)).div(true.sum((1, 2, 3))).gt(0.25).all()


def test_own_view_reads_no_depth(generator):
    points, visible, rotations = _clip(generator)
    params = ReadOut(views=("camera",), yaws=1)
    without = points * torch.tensor([1.0, 1.0, 0.0])
    assert torch.equal(read_out(points, visible, rotations, params), read_out(without, visible, rotations, params))


def test_batch_equals_one_by_one(generator):
    clips = [_clip(generator) for _ in range(3)]
    batch = read_out(*(torch.stack(parts) for parts in zip(*clips, strict=True)), VIEWS)
    for volume, clip in zip(batch, clips, strict=True):
        torch.testing.assert_close(volume, read_out(*clip, VIEWS), atol=1e-5, rtol=0)


def test_some_frames_are_a_part_of_all_frames(generator):
    clip = _clip(generator)
    part = read_out(*clip, VIEWS, frames=slice(3, 7))
    torch.testing.assert_close(part, read_out(*clip, VIEWS)[:, 3:7])


def test_bad_input_is_named(generator):
    points, visible, rotations = _clip(generator)
    visible[2, 5] = True
    points[2, 5, 1] = torch.nan
    with pytest.raises(ReconError, match=r"\[2, 5\]"):
        read_out(points, visible, rotations)
    with pytest.raises(ReconError, match="nothing is visible"):
        read_out(points, torch.zeros_like(visible), rotations)
    with pytest.raises(ReconError, match="views"):
        ReadOut(views=("front",))


def test_film_shows_what_is_tracked_more_or_all(generator):
    points, _, rotations = _clip(generator, frames=20, points=100)
    visible = torch.ones(20, 100, dtype=torch.bool)
    film = Film(points.float(), visible, rotations.float(), torch.full((100,), 0.1), 0)
    seen = []
    for shown in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        how = replace(AS_TRACKED, points=(50, 51), life=(6, 9), speed=(1.0, 1.0), shown=shown)
        seen.append(augment(film, how, torch.Generator().manual_seed(0)).visible)
    tracked, held, always = seen
    starts = tracked & ~torch.cat([torch.zeros(1, tracked.shape[1], dtype=torch.bool), tracked[:-1]])
    assert tracked.sum() / starts.sum() >= AS_TRACKED.shortest[0]
    assert always.all()
    assert (held | ~tracked).all()
    assert tracked.sum() < held.sum() <= always.sum()


def test_a_tracker_holds_fewer_points_the_faster_they_are(generator):
    speed = torch.tensor([0.0, 0.02, -0.02, 0.06, -0.06]).repeat(600)
    way = torch.arange(12)[:, None, None] * speed[:, None] * torch.tensor([1.0, 0.0, 0.0])
    points = torch.randn(3000, 3, generator=generator) + way
    visible, eye = torch.ones(12, 3000, dtype=torch.bool), torch.eye(3).expand(12, 3, 3)
    how = replace(AS_TRACKED, points=(3000, 3001), life=(1e6, 1e6), speed=(0.02, 0.02), shortest=(1, 1))
    film = augment(Film(points.float(), visible, eye, torch.full((3000,), 0.1), 0), how, generator)
    pace = (film.points3d[1] - film.points3d[0])[:, 0].abs()
    still, slow, fast = ((pace - value).abs() < 1e-4 for value in (0.0, 0.02, 0.06))
    held = torch.tensor([float(film.visible[:, group].sum()) / 12 for group in (still, slow, fast)])
    # A quarter of the time is between two lives; of the rest half is lost at that speed, at three times it 3 of 4.
    expected = 0.75 * torch.tensor([600 * 1.0, 1200 * 0.5, 1200 * 0.25])
    torch.testing.assert_close(held, expected, rtol=0.1, atol=0)


def test_overfits_eight_clips(generator):
    torch.manual_seed(0)
    params = ReadOut(size=16)
    clips = [_clip(generator, frames=6) for _ in range(8)]
    volume = torch.stack([read_out(*clip, params) for clip in clips]).double()
    label = torch.arange(8) % 4
    recogniser = Recogniser(("shoot", "run", "jump", "pass"), params, width=8)
    optimiser = torch.optim.Adam(recogniser.parameters(), lr=5e-3)
    for _ in range(50):
        loss = torch.nn.functional.cross_entropy(recogniser(volume), label)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert torch.equal(recogniser(volume).argmax(-1), label)


def test_windows_are_those_of_the_clip(generator):
    recogniser = Recogniser(("shoot", "run", "jump"), ReadOut(yaws=1)).eval()
    clip = _clip(generator, frames=21)
    scores = classify_windows(recogniser, *clip, window=8, stride=4)
    assert scores.probabilities.shape == (4, 3)
    assert torch.equal(scores.predicted, scores.probabilities.argmax(-1))
    yaw = float(yaws_of(clip[2], 1)[0])
    for index in range(4):
        volume = read_out(*clip, recogniser.params, yaw, slice(4 * index, 4 * index + 8)).double()
        torch.testing.assert_close(scores.probabilities[index], recogniser(volume).softmax(-1).detach())
    assert classify_windows(recogniser, *clip, window=32).predicted.shape == (1,)


def test_save_and_load_give_the_same_logits_and_hash(tmp_path, generator):
    torch.set_default_dtype(torch.float32)
    recogniser = Recogniser(("run", "jump"), ReadOut(views=("side", "top"), size=16), width=8).eval()
    path = save_recogniser(recogniser, tmp_path / "recogniser.safetensors", {"note": 1})
    loaded = load_recogniser(path)
    volume = torch.rand(3, 2, 8, 16, 16, generator=generator)
    assert torch.equal(loaded(volume), recogniser(volume))
    assert (loaded.params, loaded.classes) == (recogniser.params, recogniser.classes)
    known = json.loads(path.with_suffix(".json").read_text())
    assert known["weights_hash"] == weights_hash(loaded) == weights_hash(recogniser)
    assert known["note"] == 1
    assert sorted(file.name for file in tmp_path.iterdir()) == ["recogniser.json", "recogniser.safetensors"]
    with torch.no_grad():
        recogniser.to_classes.bias[0] += 1e-6
    assert weights_hash(recogniser) != known["weights_hash"]


def test_what_is_no_recogniser_is_refused(tmp_path):
    with pytest.raises(ReconError, match="no such file"):
        load_recogniser(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    with pytest.raises(ReconError, match="is no recogniser"):
        load_recogniser(tmp_path / "bad.safetensors")
    with pytest.raises(ReconError, match="existing folder"):
        save_recogniser(Recogniser(("run",)), tmp_path / "none" / "a.safetensors")


def test_a_distractor_without_clips_is_performed_by_the_synthetic_world(generator):
    body = sample_body(generator)
    motion = sample_motion("run", body, frames=40, generator=generator)
    clip = MocapClip(motion.joints, motion.parents, motion.names, 30.0, "run")
    clips = {name: [clip] for name in MOCAP_CLASSES if name != "dribble"} | {"dribble": []}
    label = MOCAP_CLASSES.index("dribble")
    made = mocap_film(label, clips, 60)
    assert made.label == label
    assert len(made.points3d) == 60  # the synthetic world's own length, not that of a clip
    assert len(mocap_film(label + 1, clips, 60).points3d) < 60  # walking, which the synthetic world cannot


def test_every_other_film_of_real_motion_is_synthetic(generator):
    body = sample_body(generator)
    motion = sample_motion("run", body, frames=40, generator=generator)
    clip = MocapClip(motion.joints, motion.parents, motion.names, 30.0, "run")
    clips = {name: [clip] for name in MOCAP_CLASSES}
    run, walk = MOCAP_CLASSES.index("run"), MOCAP_CLASSES.index("walk")
    lengths = [[len(mocap_film(6 * turn + label, clips, 60).points3d) for turn in range(4)] for label in (run, walk)]
    assert lengths == [[60, 40, 60, 40], [40] * 4]


def test_only_clear_evidence_speaks_for_a_distractor():
    training = Training(("run", "dribble"), ReadOut(), distractor_prior=0.1)
    before = training.recogniser.to_classes.bias.detach().clone()
    after = training.trained().to_classes.bias
    change = torch.tensor([0.0, math.log(0.1), math.log(0.1)])  # run, dribble, flat
    torch.testing.assert_close(after - before, change, rtol=0, atol=1e-6)


def test_training_job_that_is_killed_goes_on_and_does_nothing_twice(tmp_path):
    out = tmp_path / "recogniser.safetensors"
    words = ["--out", str(out), *SMALL_TRAINING, "--trainer.max_epochs=2"]
    assert kill_after(["train.recogniser", *words], lambda: any(tmp_path.rglob("last.ckpt")))
    check_whole(tmp_path)
    twice = f"""
from train.recogniser import Training, main
Training.on_train_epoch_start = lambda self: print("epoch", self.current_epoch)
main({words})
main({words})
"""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = subprocess.run([sys.executable, "-c", twice], cwd=ROOT, capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr[-2000:]
    assert "epoch 0" not in run.stdout
    assert "epoch 1" in run.stdout
    assert run.stdout.count("wrote") == run.stdout.count("already there") == 1
    assert load_recogniser(out).classes == (*ACTIONS, "flat")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["recogniser.json", "recogniser.safetensors"]
