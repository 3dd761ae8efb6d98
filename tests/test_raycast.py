"""Ray-casting of round cones against slow and obvious twins."""

import math

import pytest
import torch

from torchrecon.errors import ReconError
from torchrecon.render.raycast import RoundCones, cast_image, cast_rays, local_to_outer, surface_normals

_FIELDS = ("rotations", "origins", "scale", "length", "radii")


def _random_rotations(n: int, generator: torch.Generator) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(n, 3, 3, generator=generator))
    q = q * torch.sign(torch.diagonal(r, dim1=-2, dim2=-1))[:, None]
    return q * torch.linalg.det(q)[:, None, None]


def _scene(generator: torch.Generator) -> RoundCones:
    """Tapered both ways, a plain capsule, an ellipsoid; at random places 6 m away."""
    return RoundCones(
        _random_rotations(4, generator),
        torch.tensor([0.0, 0, 6]) + 0.3 * torch.randn(4, 3, generator=generator),
        torch.tensor([[1.0, 1, 1], [1.3, 1, 0.8], [1, 1, 1], [0.2, 0.4, 0.3]]),
        torch.tensor([0.5, 0.4, 0.6, 0.0]),
        torch.tensor([[0.15, 0.05], [0.05, 0.2], [0.1, 0.1], [1.0, 1.0]]),
    )


def _inside_naive(cones: RoundCones, part: int, points: torch.Tensor) -> torch.Tensor:
    """In the hull of two spheres = in some sphere whose centre and radius lie between theirs: tried on a grid."""
    local = (points - cones.origins[part]) @ cones.rotations[part] / cones.scale[part]
    s = torch.linspace(0, 1, 801)
    r0, r1 = cones.radii[part]
    centres = torch.stack([0 * s, s * cones.length[part], 0 * s], -1)
    gap = torch.cdist(local, centres, compute_mode="donot_use_mm_for_euclid_dist") - (r0 + s * (r1 - r0))
    return gap.amin(-1) <= 0


def test_first_hit_agrees_with_marching(generator):
    """A ray is outside all parts before its hit and inside the named part just after it."""
    cones = _scene(generator)
    directions = torch.cat([0.06 * torch.randn(150, 2, generator=generator), torch.ones(150, 1)], -1)
    t, part = cast_rays(cones, torch.zeros(150, 3), directions)
    assert 20 < (part >= 0).sum() < 140
    for ray in range(150):
        stop = t[ray].item() if part[ray] >= 0 else 8.0
        steps = torch.linspace(4.0, stop - 2e-4, 400)[:, None] * directions[ray]
        assert not any(_inside_naive(cones, p, steps).any() for p in range(4))
        if part[ray] >= 0:
            chord = (stop + torch.tensor([2e-5, 1e-4, 5e-4]))[:, None] * directions[ray]
            # A grazing ray is inside for less than a step, so any of the three will do.
            assert _inside_naive(cones, int(part[ray]), chord).any()


def test_sphere_hand_value():
    ball = RoundCones(
        torch.eye(3)[None], torch.tensor([[0.0, 0, 5]]), torch.ones(1, 3), torch.zeros(1), torch.ones(1, 2)
    )
    t, _ = cast_rays(ball, torch.tensor([[0.6, 0.0, 0.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    assert t.item() == pytest.approx(5 - 0.8, abs=1e-12)


def test_float32_is_good_far_away(generator):
    cones = _scene(generator)
    directions = torch.cat([0.04 * torch.randn(500, 2, generator=generator), torch.ones(500, 1)], -1)
    fine, part = cast_rays(cones, torch.zeros(500, 3), directions)
    single = RoundCones(*(getattr(cones, f).float() for f in _FIELDS))
    coarse, same = cast_rays(single, torch.zeros(500, 3).float(), directions.float())
    both = (part >= 0) & (part == same)
    assert both.sum() > 80
    assert (fine - coarse)[both].abs().median() < 2e-6
    assert (fine - coarse)[both].abs().max() < 1e-3


def test_image_equals_rays(generator):
    cones = _scene(generator)
    k = torch.tensor([[120.0, 0, 31.5], [0, 120, 23.5], [0, 0, 1]])
    inverse = torch.linalg.inv(k)
    v, u = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    pixel = torch.stack([u, v, torch.ones_like(u)], -1).reshape(-1, 3)
    boxes = torch.tensor([[0, 0, 64, 48]]).repeat(4, 1)
    depth, part = cast_image(cones, torch.zeros(3, 3), inverse, boxes, (48, 64))
    t, owner = cast_rays(cones, torch.zeros(48 * 64, 3), pixel @ inverse.T)
    assert torch.equal(part.flatten(), owner)
    torch.testing.assert_close(depth.flatten(), t)
    # Parallel rays through the same map interface.
    origin = torch.zeros(3, 3)
    origin[:2] = 6 * inverse[:2]
    ahead = torch.zeros(3, 3)
    ahead[2, 2] = 1
    depth, part = cast_image(cones, origin, ahead, boxes, (48, 64))
    t, owner = cast_rays(cones, pixel @ origin.T, pixel @ ahead.T)
    assert torch.equal(part.flatten(), owner)
    torch.testing.assert_close(depth.flatten(), t)


def test_boxes_of_corners_hold_every_hit(generator):
    cones = _scene(generator)
    corners = cones.corners()
    low, high = (corners[..., :2] / corners[..., 2:]).amin(1), (corners[..., :2] / corners[..., 2:]).amax(1)
    directions = torch.cat([0.12 * torch.randn(2000, 2, generator=generator), torch.ones(2000, 1)], -1)
    for part in range(4):
        one = RoundCones(
            cones.rotations[[part]],
            cones.origins[[part]],
            cones.scale[[part]],
            cones.length[[part]],
            cones.radii[[part]],
        )
        hit = cast_rays(one, torch.zeros(2000, 3), directions)[1] == 0
        assert hit.any()
        assert ((directions[hit][:, :2] >= low[part]) & (directions[hit][:, :2] <= high[part])).all()


def test_normals_are_the_gradient(generator):
    """The surface does not rise along either tangent: moving 1 um along one leaves it by second order only."""
    cones = _scene(generator)
    directions = torch.cat([0.1 * torch.randn(400, 2, generator=generator), torch.ones(400, 1)], -1)
    t, part = cast_rays(cones, torch.zeros(400, 3), directions)
    hit = part >= 0
    part, points = part[hit], (t[:, None] * directions)[hit]
    local = torch.einsum("nji,nj->ni", cones.rotations[part], points - cones.origins[part])
    normal = torch.cat([surface_normals(cones, int(p), x[None]) for p, x in zip(part, local, strict=True)])
    torch.testing.assert_close(local_to_outer(cones, part, local), points)
    outer = torch.einsum("nij,nj->ni", cones.rotations[part], normal)
    assert ((outer * directions[hit]).sum(-1) < 1e-9).all()
    # Cast again from just outside along -normal of a tangentially shifted start: the height is unchanged.
    helper = torch.nn.functional.normalize(
        torch.linalg.cross(outer, torch.tensor([0.3, 0.5, 0.8]).expand_as(outer)), dim=-1
    )
    start = points + 1e-2 * outer + 1e-6 * helper
    heights = torch.stack(
        [
            cast_rays(
                RoundCones(*(getattr(cones, f)[[int(p)]] for f in _FIELDS)),
                s[None], -n[None],
            )[0][0]
            for p, s, n in zip(part, start, outer, strict=True)
        ]
    )  # fmt: skip
    assert (heights - 1e-2).abs().max() < 1e-9


def test_swallowed_sphere_is_refused():
    with pytest.raises(ReconError, match="one sphere lies inside"):
        RoundCones(
            torch.eye(3)[None], torch.zeros(1, 3), torch.ones(1, 3), torch.tensor([0.1]), torch.tensor([[0.3, 0.1]])
        )


def test_hits_behind_the_origin_do_not_count():
    ball = RoundCones(
        torch.eye(3)[None], torch.tensor([[0.0, 0, -5]]), torch.ones(1, 3), torch.zeros(1), torch.ones(1, 2)
    )
    t, part = cast_rays(ball, torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]))
    assert math.isinf(t.item())
    assert part.item() == -1
