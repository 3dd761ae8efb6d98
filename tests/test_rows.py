"""Each comparison row recovers exactly what its idea can know, and fails where its idea must."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from eval.rows import SIBLINGS, all_rows, rows_of
from eval.rows.base import Context, Views, in_camera, registered_views, with_perspective
from eval.rows.oracle import solve_true_rotations
from eval.rows.ref4_style import TemplateParams, _solve_chain, fit_prior, fit_template
from eval.rows.ref4_style import solve as solve_ref4
from eval.rows.ref5_style import piecewise_rigid
from eval.rows.ref5_style import solve as solve_ref5
from eval.rows.ref6_style import ObserverParams, observe
from eval.rows.ref6_style import solve as solve_ref6
from eval.rows.ref7_style import partners, triangulate
from eval.rows.ref7_style import solve as solve_ref7
from eval.rows.ref8_style import SeriesParams, cosines, series_solve
from eval.rows.ref8_style import solve as solve_ref8
from torchrecon.errors import ReconError
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import FilledTracks, Reconstruction, Status, Tracks
from torchrecon.measurement.camera import project_points
from torchrecon.metrics import error3d_camera

FRAMES, POINTS = 60, 300


def turns(total: float, frames: int = FRAMES) -> torch.Tensor:
    """Yaw of a level camera, canonical -> camera."""
    angle = torch.linspace(0, total, frames)
    return rotation_from_vector(torch.stack([0 * angle, angle, 0 * angle], -1))


def torso(generator: torch.Generator, points: int = POINTS) -> tuple[torch.Tensor, torch.Tensor]:
    """Points and outward normals of an elliptic cylinder, 1.6 high."""
    angle = 2 * math.pi * torch.rand(points, generator=generator)
    height = 1.6 * (torch.rand(points, generator=generator) - 0.5)
    place = torch.stack([0.35 * angle.cos(), height, 0.2 * angle.sin()], -1)
    normal = torch.stack([angle.cos() / 0.35, 0 * angle, angle.sin() / 0.2], -1)
    return place, normal / normal.norm(dim=-1, keepdim=True)


def band(rotations: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    """Seen while facing the camera: tracks of 15-40 frames on a turning body, as the tracker gives them."""
    return (normal @ rotations.mT)[..., 2] < -0.2


def views_of(points: torch.Tensor, visible: torch.Tensor, rotations: torch.Tensor, shape: torch.Tensor) -> Views:
    nan = torch.tensor(float("nan"))
    return Views(torch.where(visible[..., None], points[..., :2], nan), visible, rotations, shape)


def depth_error(points: torch.Tensor, truth: torch.Tensor, visible: torch.Tensor) -> float:
    return float((points - truth)[..., 2][visible].square().mean().sqrt())


@pytest.fixture
def rigid_world(generator):
    rotations = turns(5.2)
    shape, normal = torso(generator)
    visible = band(rotations, normal)
    truth = shape @ rotations.mT
    lengths = visible.sum(0)
    assert 10 < float(lengths.float().mean()) < 40
    assert not visible.all(0).any()
    return rotations, shape, visible, truth


def test_ref5_is_exact_on_a_rigid_body(rigid_world):
    rotations, shape, visible, truth = rigid_world
    assert depth_error(piecewise_rigid(views_of(truth, visible, rotations, shape)), truth, visible) < 1e-9


def test_ref5_follows_a_body_that_changes_between_groups(rigid_world):
    rotations, shape, visible, _ = rigid_world
    width = torch.linspace(0.6, 1.4, FRAMES)
    world = shape * torch.stack([width, torch.ones(FRAMES), torch.ones(FRAMES)], -1)[:, None]
    truth = torch.einsum("fij,fpj->fpi", rotations, world)
    still = world.mean(0)
    rigid = depth_error(still @ rotations.mT, truth, visible)
    assert depth_error(piecewise_rigid(views_of(truth, visible, rotations, still)), truth, visible) < 0.85 * rigid


def test_ref6_depth_of_a_rigid_turning_cloud_converges(rigid_world):
    rotations, shape, visible, truth = rigid_world
    wrong = shape + 0.1 * torch.randn(shape.shape, generator=torch.Generator().manual_seed(1))
    points, variance = observe(views_of(truth, visible, rotations, wrong), ObserverParams(image_walk=0, depth_walk=0))
    age = visible.cumsum(0)
    old, young = visible & (age > 12), visible & (age == 1)
    error = (points - truth)[..., 2].abs()
    assert float(error[old].mean()) < 0.1 * float(error[young].mean())
    assert float(variance[old].mean()) < 0.1 * float(variance[young].mean())


def test_ref6_static_camera_teaches_no_depth(rigid_world):
    _, shape, visible, _ = rigid_world
    still = torch.eye(3).expand(FRAMES, 3, 3)
    truth = shape.expand(FRAMES, POINTS, 3)
    prior = shape * torch.tensor([1.0, 1.0, 0.5])
    points, variance = observe(views_of(truth, visible, still, prior))
    assert torch.allclose(points[..., 2], prior[:, 2].expand(FRAMES, POINTS))
    first = (ObserverParams().first_depth ** 2) * prior.square().sum(-1).mean()
    assert bool((variance[visible] >= first - 1e-12).all())


def test_ref6_unknown_input_on_both_image_axes_hides_depth(rigid_world):
    rotations, shape, visible, truth = rigid_world
    views = views_of(truth, visible, rotations, shape)
    _, known = observe(views, ObserverParams(image_walk=0, depth_walk=0))
    _, unknown = observe(views, ObserverParams(image_walk=1e3, depth_walk=0))
    old = visible & (visible.cumsum(0) > 8)
    # Turning mixes depth with the image plane; what is left after that is what the observer started from.
    assert float(known[old].mean()) < 0.05 * float(unknown[old].mean())


def test_ref6_unknown_input_is_not_taken_for_depth(rigid_world):
    rotations, shape, visible, truth = rigid_world
    # Half way the whole body jumps along what is then the image's x axis.
    late = (torch.arange(FRAMES) >= FRAMES // 2).to(truth)[:, None, None]
    jump = truth + late * (rotations @ rotations[FRAMES // 2].T @ torch.tensor([0.3, 0.0, 0.0]))[:, None]
    views = views_of(jump, visible, rotations, shape)
    with_input, _ = observe(views)
    without, _ = observe(views, ObserverParams(unknown_input=False))
    assert depth_error(with_input, jump, visible) < 0.7 * depth_error(without, jump, visible)


def test_ref6_is_causal(rigid_world):
    rotations, shape, visible, truth = rigid_world
    late = truth.clone()
    late[40:] += 0.5
    a, _ = observe(views_of(truth, visible, rotations, shape))
    b, _ = observe(views_of(late, visible, rotations, shape))
    assert torch.equal(a[:40], b[:40])
    assert not torch.equal(a[40:], b[40:])


def test_ref7_is_exact_on_a_rigid_body_and_pairs_are_wide(rigid_world):
    rotations, shape, visible, truth = rigid_world
    views = views_of(truth, visible, rotations, shape + 1.0)  # a wrong rigid shape must not matter where paired
    partner = partners(views)
    paired = partner >= 0
    assert float(paired.sum() / visible.sum()) > 0.9
    assert bool(visible[partner[paired], paired.nonzero()[:, 1]].all())
    angle = torch.linspace(0, 5.2, FRAMES)
    gap = (angle[paired.nonzero()[:, 0]] - angle[partner[paired]]).abs()
    assert float(torch.rad2deg(gap).min()) >= 35.0
    assert depth_error(triangulate(views), truth, paired) < 1e-9


def test_ref7_without_turn_has_no_partner(rigid_world):
    _, shape, visible, _ = rigid_world
    still = torch.eye(3).expand(FRAMES, 3, 3)
    views = views_of(shape.expand(FRAMES, POINTS, 3), visible, still, shape)
    assert bool((partners(views) < 0).all())


def test_ref8_recovers_a_band_limited_trajectory(generator):
    vectors = torch.cumsum(0.5 * torch.randn(FRAMES, 3, generator=generator), 0)
    rotations = rotation_from_vector(vectors)
    coefficients = torch.randn(20, 4, 3, generator=generator) * 0.2
    world = torch.randn(20, 3, generator=generator) + torch.einsum("fk,pki->fpi", cosines(FRAMES, 4), coefficients)
    truth = torch.einsum("fij,fpj->fpi", rotations, world)
    visible = torch.rand(FRAMES, 20, generator=generator) < 0.6
    views = views_of(truth, visible, rotations, torch.zeros(20, 3))
    assert depth_error(series_solve(views, SeriesParams(largest=4)), truth, visible) < 1e-8


def test_ref8_truncation_follows_the_noise(generator):
    """With more noise fewer frequencies are kept, and the error stays near the noise."""
    rotations = rotation_from_vector(torch.cumsum(0.5 * torch.randn(FRAMES, 3, generator=generator), 0))
    coefficients = torch.randn(40, 3, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.3])[:, None]
    world = torch.randn(40, 3, generator=generator) + torch.einsum("fk,pki->fpi", cosines(FRAMES, 3), coefficients)
    truth = torch.einsum("fij,fpj->fpi", rotations, world)
    seen = torch.ones(FRAMES, 40, dtype=torch.bool)
    noisy = truth + 0.02 * torch.randn(truth.shape, generator=generator)
    views = views_of(noisy, seen, rotations, world.mean(0))
    views = Views(views.xy, views.visible, views.rotations, views.shape, noise=0.02)
    assert depth_error(series_solve(views), truth, seen) < 0.03


def test_cosines_are_orthogonal():
    basis = cosines(30, 7)
    assert torch.allclose(basis.T @ basis, 30 * torch.eye(7))


def wave(shape: torch.Tensor, phase: float, amount: float = 0.5) -> torch.Tensor:
    """A torso whose upper part sways to and fro: one non-rigid action."""
    sway = amount * torch.sin(torch.linspace(0, 4, FRAMES) + phase)[:, None] * shape[:, 1].clamp_max(0).abs()
    return shape + torch.stack([0 * sway, 0 * sway, sway], -1)


def bulge(shape: torch.Tensor, phase: float, amount: float = 0.4) -> torch.Tensor:
    """A torso that widens and narrows: another."""
    width = 1 + amount * torch.sin(torch.linspace(0, 4, FRAMES) + phase)
    return shape * torch.stack([width, torch.ones(FRAMES), torch.ones(FRAMES)], -1)[:, None]


@pytest.mark.parametrize(("action", "body"), [("wave", wave), ("bulge", bulge)])
def test_ref4_names_the_template_and_beats_rigid(generator, action, body):
    rotations = turns(5.2)
    shape, _ = torso(generator, 200)
    size = shape.square().sum(-1).mean().sqrt()
    prior = fit_prior(
        {
            name: torch.cat([move(shape, 0.7 * k) for k in range(8)]) / size
            for name, move in (("wave", wave), ("bulge", bulge))
        },
        modes=3,
    )
    other, outward = torso(generator, 250)  # the tracked points are not the template's
    truth = torch.einsum("fij,fpj->fpi", rotations, body(other, 0.35))
    visible = band(rotations, outward)
    heading = rotation_from_vector(torch.tensor([0.0, 1.0, 0.0]))
    shaken = rotations @ heading.T  # canonical axes are those of the first frame, whatever way the body faces
    mean = truth.new_zeros(1) + other @ heading.T
    views = views_of(truth, visible, shaken, mean)
    points, chosen = fit_template(views, prior, TemplateParams(modes=3))
    assert chosen == action
    thickness = float((truth - truth.mean(1, keepdim=True))[..., 2].square().mean().sqrt())
    assert depth_error(points, truth, visible) < 0.35 * thickness


def test_ref4_chain_solver_agrees_with_the_dense_system(generator):
    k, frames = 3, 5
    half = torch.randn(frames, k, k, generator=generator)
    blocks = half @ half.mT + 10 * torch.eye(k)
    link = -torch.diag(torch.rand(k, generator=generator))
    right = torch.randn(frames, k, generator=generator)
    dense = torch.block_diag(*blocks)
    for f in range(frames - 1):
        dense[f * k : f * k + k, f * k + k : f * k + 2 * k] = link
        dense[f * k + k : f * k + 2 * k, f * k : f * k + k] = link
    expected = torch.linalg.solve(dense, right.reshape(-1)).reshape(frames, k)
    assert torch.allclose(_solve_chain(blocks, link, right), expected)


def pinhole_world(rigid_world) -> tuple[Tracks, Reconstruction, torch.Tensor]:
    rotations, _, visible, truth = rigid_world
    k = torch.tensor([[900.0, 0, 384], [0, 900.0, 288], [0, 0, 1]])
    shift = torch.tensor([0.1, -0.05, 7.0]).expand(FRAMES, 3)
    xy = project_points(truth + shift[:, None], k)
    tracks = Tracks(torch.where(visible[..., None], xy, torch.tensor(float("nan"))), intrinsics=k)
    rigid = Reconstruction.from_points(
        truth, rotations, rank=1, status=Status("ok", "by hand"), translation=shift, intrinsics=k, observed=visible
    )
    return tracks, rigid, truth


def test_rows_undo_perspective(rigid_world):
    tracks, rigid, truth = pinhole_world(rigid_world)
    centred = truth - truth.mean(1, keepdim=True)
    first = registered_views(tracks, rigid)
    weak = (first.xy - truth[..., :2])[tracks.visible].abs().max()
    views = registered_views(tracks, rigid, truth[..., 2])
    assert float((views.xy - truth[..., :2])[tracks.visible].abs().max()) < 1e-9 < float(weak)
    model = with_perspective(tracks, rigid, lambda v: in_camera(v, centred))
    assert depth_error(model, centred, tracks.visible) < 1e-12


@pytest.mark.parametrize("row", [solve_ref5, solve_ref6, solve_ref7, solve_ref8])
def test_unsupervised_rows_answer_pinhole_tracks(rigid_world, row):
    tracks, rigid, truth = pinhole_world(rigid_world)
    answer = row(tracks, Context(rigid))
    assert answer.points3d.shape == (FRAMES, POINTS, 3)
    assert torch.equal(answer.visible, tracks.visible)
    assert bool(torch.isfinite(answer.points3d[answer.visible]).all())
    assert depth_error(answer.points3d, truth, tracks.visible) < 0.02


def test_ref4_without_a_prior_is_refused(rigid_world):
    tracks, rigid, _ = pinhole_world(rigid_world)
    with pytest.raises(ReconError, match="shape prior"):
        solve_ref4(tracks, Context(rigid))


def test_the_oracle_needs_the_rotations_and_no_world_axes(rigid_world):
    tracks, rigid, truth = pinhole_world(rigid_world)
    seen = tracks.visible
    with pytest.raises(ReconError, match="true rotations"):
        solve_true_rotations(tracks, Context(rigid))
    answer = solve_true_rotations(tracks, Context(rigid, rotations=rigid.rotations)).points3d
    assert float(error3d_camera(answer, truth, seen, align_scale="sequence")) < 0.02
    # Another upright world, or one that lies on its side, is the same camera path.
    other = rotation_from_vector(torch.tensor([0.3, -1.0, 2.0]))
    again = solve_true_rotations(tracks, Context(rigid, rotations=rigid.rotations @ other)).points3d
    torch.testing.assert_close(again, answer, atol=1e-6, rtol=0)
    # It believes what it is told: half the turn gives a deeper body.
    half = solve_true_rotations(tracks, Context(rigid, rotations=turns(2.6))).points3d
    assert float(error3d_camera(half, truth, seen, align_scale="sequence")) > 0.1


def test_siblings_are_marked_and_work_on_the_filled_matrix(rigid_world):
    rotations, _, visible, truth = rigid_world
    whole = Tracks(100 * truth[..., :2] + 300)
    tracks = replace(whole, visible=visible)
    eye = torch.eye(2).expand(*visible.shape, 2, 2)
    filled = FilledTracks(whole.xy, eye, ~visible, torch.zeros_like(visible))
    still = Reconstruction.from_points(truth, rotations, rank=1, status=Status("ok", "by hand"))
    for row in SIBLINGS[:2]:
        assert row.filled
        answer = row.solve(tracks, Context(still, filled))
        # The gaps are filled with the truth here, so nothing is lost.
        assert float(error3d_camera(answer.points3d, truth, visible, align_scale="sequence")) < 0.02
        assert answer.note.startswith("K = ")


def test_extra_rows_stand_beside_the_default_and_only_the_oracle_is_told():
    for regime in ("turning", "depth"):
        keys = [row.key for row in all_rows(regime)]
        assert set(keys) >= {row.key for row in rows_of(regime)}
        assert len(keys) == len(set(keys))
        assert ("true-rotations" in keys) == (regime == "turning")
        assert [row.key for row in all_rows(regime) if row.oracle] == ["true-rotations"] * (regime == "turning")
