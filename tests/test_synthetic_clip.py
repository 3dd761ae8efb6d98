"""Rendered clips: pictures, depth, mask and the true trajectories agree with one another."""

import pytest
import torch

from torchrecon.data.synthetic import (
    ACTIONS,
    BALL_RADIUS,
    PART_NAMES,
    SensorNoise,
    SurfacePoints,
    SyntheticClip,
    handheld_camera,
    panning_camera,
    sample_body,
    sample_motion,
    static_camera,
    turning_camera,
)
from torchrecon.errors import ReconError
from torchrecon.measurement import backproject_points, project_points
from torchrecon.render.raycast import cast_rays

SIZE = (144, 192)
CAMERAS = {"turning": turning_camera, "static": static_camera, "panning": panning_camera, "handheld": handheld_camera}


def _clip(action="pass", seed=0, camera="turning", projection="pinhole", frames=20, noise=None, size=SIZE):
    g = torch.Generator().manual_seed(seed)
    body = sample_body(g)
    motion = sample_motion(action, body, frames=frames, generator=g)
    view = CAMERAS[camera](motion, size=size, projection=projection, generator=g)
    return SyntheticClip(body, motion, view, seed=seed, sensor_noise=noise)


def _body_pixels(frame, count, seed=0):
    v, u = frame.mask.nonzero(as_tuple=True)
    pick = torch.randperm(len(u), generator=torch.Generator().manual_seed(seed))[:count]
    return torch.stack([u, v], -1)[pick]


@pytest.mark.parametrize("projection", ["pinhole", "weak_perspective", "orthographic"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_pixel_to_surface_to_pixel_round_trip(camera, projection):
    clip = _clip(camera=camera, projection=projection)
    frame = clip.render(8)
    xy = _body_pixels(frame, 150).to(torch.float64)
    points = clip.surface_at(8, xy)
    assert (points.part >= 0).all()
    xyz, seen = clip.trajectory(points)
    assert seen[8].float().mean() > 0.99
    assert (clip.camera.project(xyz)[8] - xy).abs().max() < 1e-3
    depth = frame.depth[xy[:, 1].long(), xy[:, 0].long()].double()
    assert (depth - xyz[8, :, 2]).abs().median() < 1e-5
    assert (depth - xyz[8, :, 2]).abs().quantile(0.98) < 2e-3


def test_eq12_depth_image_backprojects_onto_the_body():
    clip = _clip("shoot")
    frame = clip.render(3)
    xy = _body_pixels(frame, 200).double()
    depth = frame.depth[xy[:, 1].long(), xy[:, 0].long()].double()
    space = backproject_points(xy, depth, clip.camera.intrinsics)
    truth = clip.trajectory(clip.surface_at(3, xy))[0][3]
    assert (space - truth).norm(dim=-1).quantile(0.98) < 2e-3
    torch.testing.assert_close(project_points(truth, clip.camera.intrinsics), xy, atol=1e-3, rtol=0)


def test_points_ride_on_their_bones():
    """Two points of one part keep their distance; points of the two shanks do not."""
    clip = _clip("run", frames=25)
    points = clip.sample_surface(120, torch.Generator().manual_seed(1))
    xyz, _ = clip.trajectory(points)
    distance = torch.cdist(xyz, xyz, compute_mode="donot_use_mm_for_euclid_dist")
    spread = distance.amax(0) - distance.amin(0)
    same = points.part[:, None] == points.part[None]
    assert spread[same].max() < 1e-9
    assert spread[~same].max() > 0.3


def test_visibility_agrees_with_one_ray_at_a_time():
    clip = _clip("dribble", seed=4, frames=8)
    points = clip.sample_surface(60, torch.Generator().manual_seed(2))
    xyz, seen = clip.trajectory(points)
    scene = clip._scene
    for f in range(0, 8, 3):
        for n in range(60):
            ray = xyz[f, n] / xyz[f, n, 2]
            hits = []
            for part in range(len(scene.length)):
                cone = type(scene)(
                    scene.rotations[f, [part]], scene.origins[f, [part]], scene.scale[[part]],
                    scene.length[[part]], scene.radii[[part]],
                )  # fmt: skip
                hits.append(cast_rays(cone, torch.zeros(1, 3), ray[None])[0].item())
            u, v = clip.camera.project(xyz[f : f + 1, n : n + 1])[0, 0].tolist()
            inside = -0.5 <= u < SIZE[1] - 0.5 and -0.5 <= v < SIZE[0] - 0.5
            assert seen[f, n].item() == (inside and xyz[f, n, 2].item() <= min(hits) + 2e-3)
    assert 0.1 < seen.float().mean() < 0.7


def test_seen_points_are_where_the_picture_shows_them():
    """The depth image at a point's pixel has its depth if the point is seen, and less if it is hidden.

    Only where the picture is smooth: within half a pixel of an outline the pixel's centre may show something else.
    """
    clip = _clip("shoot", seed=2, frames=6, size=(288, 384))
    points = clip.sample_surface(1500, torch.Generator().manual_seed(0))
    xyz, seen = clip.trajectory(points)
    frame = clip.render(2)
    depth = frame.depth.double()
    local = torch.nn.functional.unfold(depth[None, None], 3, padding=1).view(9, 288, 384)
    smooth = (local - depth).abs().amax(0) < 0.03
    xy = clip.camera.project(xyz)[2].round().long()
    usable = (xy > 0).all(-1) & (xy < torch.tensor([383, 287])).all(-1)
    usable &= smooth[xy[:, 1].clamp(0, 287), xy[:, 0].clamp(0, 383)]
    behind = xyz[2, :, 2] - depth[xy[:, 1].clamp(0, 287), xy[:, 0].clamp(0, 383)]
    assert (usable & seen[2]).sum() > 150
    assert (usable & ~seen[2]).sum() > 150
    assert behind[usable & seen[2]].abs().max() < 0.02
    assert behind[usable & ~seen[2]].min() > -0.02
    assert (behind[usable & ~seen[2]] > 0.02).double().mean() > 0.9
    assert frame.mask[xy[:, 1], xy[:, 0]][usable & seen[2]].all()


def test_ball_hides_the_body():
    """Points whose only obstacle is the ball become visible once it is taken away."""
    clip = _clip("pass", seed=1, frames=10)
    points = clip.sample_surface(400, torch.Generator().manual_seed(3))
    _, with_ball = clip.trajectory(points)
    gone = torch.full_like(clip.motion.ball, torch.nan)
    bare = type(clip.motion)(clip.motion.joints, clip.motion.bones, gone, clip.motion.contacts, "pass", clip.fps)
    _, without = SyntheticClip(clip.body, bare, clip.camera).trajectory(points)
    assert (with_ball <= without).all()
    assert (without & ~with_ball).any()


def test_ball_is_not_body():
    clip = _clip("dribble", seed=4, frames=60)
    centre = clip.camera.project(clip.camera.to_camera(clip.motion.ball[:, None]))[:, 0]
    inside = ((centre > 8) & (centre < torch.tensor([184.0, 136.0]))).all(-1)
    clear = (centre[:, None] - clip.joints2d).norm(dim=-1).amin(-1) > 9
    frame = int((inside & clear).nonzero()[0])
    assert clip.surface_at(frame, centre[frame][None]).part.item() == -1
    u, v = centre[frame].round().long().tolist()
    picture = clip.render(frame)
    assert not picture.mask[v, u]
    z = clip.camera.to_camera(clip.motion.ball[:, None])[frame, 0, 2].item()
    assert picture.depth[v, u].item() == pytest.approx(z - BALL_RADIUS, abs=0.03)
    red, _, blue = picture.rgb[:, v, u].tolist()
    assert red >= blue


@pytest.mark.parametrize("action", ACTIONS)
def test_mask_and_depth_agree(action):
    clip = _clip(action, seed=7, frames=12)
    frame = clip.render(5)
    assert frame.depth.isfinite().all()
    assert 0.02 < frame.mask.double().mean() < 0.4
    root = clip.joints3d[5, 0, 2].item()
    assert ((frame.depth[frame.mask] - root).abs() < 1.3).all()
    # The joints of the trunk lie inside the silhouette, behind its surface.
    for name in ("pelvis", "chest", "l_hip", "r_hip"):
        j = clip.motion.names.index(name)
        u, v = clip.joints2d[5, j].round().long().tolist()
        assert frame.depth[v, u] < clip.joints3d[5, j, 2]


def test_same_seed_same_bits_in_any_order():
    noise = SensorNoise()
    first, second = _clip(noise=noise), _clip(noise=noise)
    a = first.render(4)
    second.render(11)
    b = second.render(4)
    assert torch.equal(a.rgb, b.rgb)
    assert torch.equal(a.depth.nan_to_num(), b.depth.nan_to_num())
    assert torch.equal(a.mask, b.mask)
    other = SyntheticClip(first.body, first.motion, first.camera, seed=9, sensor_noise=noise).render(4)
    assert not torch.equal(a.rgb, other.rgb)
    assert torch.equal(a.mask, other.mask)


def test_sensor_noise_grows_with_the_square_of_depth():
    clean = _clip("idle", camera="static", frames=2)
    noisy = SyntheticClip(clean.body, clean.motion, clean.camera, sensor_noise=SensorNoise(far=30.0))
    exact, sensed = clean.render(0), noisy.render(0)
    assert sensed.depth.isnan().double().mean() > 0.004
    error = (sensed.depth - exact.depth) / exact.depth**2
    finite = error.isfinite()
    # 0.8 mm Gaussian and 0.6 mm rounding at 1 m: sqrt(0.8^2 + 0.6^2 / 12) = 0.82 mm.
    near, far = finite & (exact.depth < 8), finite & (exact.depth > 9)
    assert near.sum() > 500
    assert far.sum() > 500
    assert error[near].std().item() == pytest.approx(0.82e-3, rel=0.1)
    assert error[far].std().item() == pytest.approx(0.82e-3, rel=0.1)


def test_texture_sticks_to_the_body():
    """The colour under a body point stays the same while the body turns before the camera (light apart)."""
    clip = _clip("idle", seed=3, frames=20, size=(288, 384))
    xy = _body_pixels(clip.render(6), 400).double()
    points = clip.surface_at(6, xy)
    xyz, seen = clip.trajectory(points)
    pixel = clip.camera.project(xyz)

    def look(frame, chosen):
        rgb = clip.render(frame).rgb.double()
        grid = pixel[frame, chosen] / torch.tensor([(384 - 1) / 2, (288 - 1) / 2]) - 1
        sampled = torch.nn.functional.grid_sample(rgb[None], grid[None, None], align_corners=True)[0, :, 0]
        return sampled.mean(0)

    both = seen[6] & seen[7]
    assert both.sum() > 250
    a, b = look(6, both), look(7, both)
    shuffled = b[torch.randperm(len(b), generator=torch.Generator().manual_seed(0))]
    assert torch.corrcoef(torch.stack([a, b]))[0, 1] > 0.75
    assert torch.corrcoef(torch.stack([a, shuffled]))[0, 1] < 0.3


def test_surface_samples_are_even_by_area():
    """On the ellipsoid of the head, the share of points above a height equals that of a fine mesh's area."""
    clip = _clip("idle", frames=2)
    points = clip.sample_surface(30000, torch.Generator().manual_seed(0))
    index = PART_NAMES.index("head")
    head = points.part == index
    scale = clip.body.scale[index]
    theta = torch.linspace(0, torch.pi, 401)
    phi = torch.linspace(0, 2 * torch.pi, 401)
    a, b = torch.meshgrid(theta, phi, indexing="ij")
    mesh = torch.stack([a.sin() * b.cos(), a.cos(), a.sin() * b.sin()], -1) * scale
    across = torch.linalg.cross(mesh[1:, :-1] - mesh[:-1, :-1], mesh[:-1, 1:] - mesh[:-1, :-1])
    area = across.norm(dim=-1)
    y = 0.5 * (mesh[1:, :-1, 1] + mesh[:-1, :-1, 1])
    for level in (-0.5, 0.0, 0.6):
        share = area[y > level * scale[1]].sum() / area.sum()
        found = (points.local[head, 1] > level * scale[1]).double().mean()
        sigma = (share * (1 - share) / head.sum()).sqrt()
        assert abs(found - share) < 4 * sigma + 0.002
    # A point on the ellipsoid: its scaled coordinates have norm 1.
    torch.testing.assert_close((points.local[head] / scale).norm(dim=-1), torch.ones(int(head.sum())))


def test_turning_camera_turns_and_follows():
    g = torch.Generator().manual_seed(0)
    body = sample_body(g)
    motion = sample_motion("run", body, generator=g)
    for total in (60.0, 300.0):
        camera = turning_camera(motion, total_turn_deg=total, distance=7.0, generator=g)
        ahead = camera.rotations[:, 2, [0, 2]]
        angle = torch.atan2(ahead[:, 0], ahead[:, 1])
        step = torch.remainder(angle[1:] - angle[:-1] + torch.pi, 2 * torch.pi) - torch.pi
        assert torch.rad2deg(step.sum().abs()).item() == pytest.approx(total, abs=1.0)
        clip = SyntheticClip(body, motion, camera)
        depth = clip.joints3d[:, 0, 2]
        assert (depth - 7.0).abs().max() < 0.8
        xy = clip.joints2d
        assert (xy > 0).all()
        assert (xy < torch.tensor([768.0, 576.0])).all()


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("camera", ["turning", "static"])
def test_player_stays_in_the_image(action, camera):
    for seed in range(3):
        clip = _clip(action, seed=seed, camera=camera, frames=60, size=(576, 768))
        assert (clip.joints2d > 0).all()
        assert (clip.joints2d < torch.tensor([768.0, 576.0])).all()


def test_static_camera_is_static_and_panning_only_turns():
    static = _clip(camera="static").camera
    assert (static.rotations - static.rotations[0]).abs().max() == 0
    panning = _clip("run", camera="panning").camera
    place = -torch.einsum("fji,fj->fi", panning.rotations, panning.translations)
    assert (place - place[0]).abs().max() < 1e-9
    assert (panning.rotations - panning.rotations[0]).abs().max() > 0.01


def test_errors_name_what_is_wrong():
    clip = _clip(frames=4)
    with pytest.raises(ReconError, match="the clip has 4"):
        clip.render(4)
    with pytest.raises(ReconError, match="projection: 'fisheye'"):
        turning_camera(clip.motion, projection="fisheye")
    other = sample_motion("run", clip.body, frames=5)
    with pytest.raises(ReconError, match="motion has 5 frames, camera 4"):
        SyntheticClip(clip.body, other, clip.camera)


def test_points_off_the_body_have_no_path():
    clip = _clip(frames=4)
    points = clip.surface_at(0, torch.tensor([[0.0, 0.0], [191.0, 0.0]]))
    assert isinstance(points, SurfacePoints)
    assert (points.part == -1).all()
    xyz, seen = clip.trajectory(points)
    assert xyz.isnan().all()
    assert not seen.any()


def test_sift_finds_points_on_the_body():
    """An independent detector finds at least 150 points on the typical body at 768 x 576 and 7 m."""
    cv2 = pytest.importorskip("cv2")
    counts = []
    for seed, action in enumerate(("shoot", "run", "jump", "pass", "run")):
        clip = _clip(action, seed=40 + seed, frames=30, noise=SensorNoise(), size=(576, 768))
        frame = clip.render(15)
        grey = (255 * frame.rgb.mean(0)).round().to(torch.uint8).numpy()
        counts.append(len(cv2.SIFT_create().detect(grey, 255 * frame.mask.to(torch.uint8).numpy())))
    assert torch.tensor(counts).median() >= 150
    assert min(counts) >= 80
