"""Ray-casting of round cones: the one primitive of the synthetic body, exact and vectorised.

A round cone is the convex hull of two spheres on the local y axis: radius ``radii[0]`` at 0 and ``radii[1]`` at
``length``. Local coordinates are divided by ``scale`` first, so limbs can be elliptic in cross-section, and an
ellipsoid is the case ``length = 0, radii = 1, scale = semi-axes``. The hull is the union of two spheres and a
truncated cone, hence the first hit of a ray is the smallest entry into any of the three.

Rays are written origin + t * direction. With directions of unit z (as the cameras make them) t is the z-depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError

__all__ = ["RoundCones", "cast_image", "cast_rays", "local_to_outer", "surface_normals"]


@dataclass(frozen=True, eq=False)
class RoundCones:
    """Placed round cones; ``*batch`` is usually frames.

    Attributes:
        rotations: part axes -> outer axes (usually the camera's).
        origins: metres, the centre of the first sphere.
        scale: local metres are divided by it, per axis.
        length: distance of the two centres in scaled units; 0 makes an ellipsoid.
        radii: of the two spheres in scaled units; their difference must be smaller than ``length``, unless that is 0.
    """

    rotations: Float[Tensor, "*batch parts 3 3"]
    origins: Float[Tensor, "*batch parts 3"]
    scale: Float[Tensor, "parts 3"]
    length: Float[Tensor, " parts"]
    radii: Float[Tensor, "parts 2"]

    def __post_init__(self) -> None:
        swallowed = (self.length > 0) & ((self.radii[:, 0] - self.radii[:, 1]).abs() >= self.length)
        if swallowed.any():
            raise ReconError(
                f"round cone {int(swallowed.nonzero()[0])}: one sphere lies inside the other; make length larger than "
                "the difference of the radii, or 0 for an ellipsoid"
            )

    def corners(self) -> Float[Tensor, "*batch parts 8 3"]:
        """The eight corners of each part's bounding box, in outer axes."""
        reach = self.radii.amax(-1)
        low = torch.stack([-reach, -self.radii[:, 0], -reach], -1) * self.scale
        high = torch.stack([reach, self.length + self.radii[:, 1], reach], -1) * self.scale
        pick = torch.tensor([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], dtype=torch.bool, device=low.device)
        local = torch.where(pick, high[:, None], low[:, None])
        return torch.einsum("...pij,pkj->...pki", self.rotations, local) + self.origins[..., None, :]


_FAR = 1e9
"""Stands for "no hit" inside this file: infinities and NaN are slow, and min() must not meet them."""
_TINY = 1e-30


def _entry(
    origin: tuple[Tensor, Tensor, Tensor], direction: tuple[Tensor, Tensor, Tensor], length: float, r0: float, r1: float
) -> Tensor:
    """Smallest t at which rays in scaled local axes enter one round cone; ``_FAR`` or more where they miss.

    Misses are marked by adding ``_FAR * sign(relu(excess))``: several times cheaper on a CPU than a comparison and a
    selection, and square roots of negative or zero numbers are slower still.
    """
    ox, oy, oz = origin
    dx, dy, dz = direction
    a = dx * dx + dy * dy + dz * dz
    # Measured from the point nearest to the first centre the quadratics keep their digits far from the camera.
    shift = -(ox * dx + oy * dy + oz * dz) / a
    px, py, pz = ox + shift * dx, oy + shift * dy, oz + shift * dz
    pp = px * px + py * py + pz * pz
    inside = r0 * r0 - pp
    t = _FAR * torch.relu(-inside).sign() - (inside / a).clamp_min(_TINY).sqrt()
    if length > 0:
        b = -length * dy
        c = pp - 2 * length * py + (length * length - r1 * r1)
        inside = b * b - a * c
        t1 = (-b - inside.clamp_min(_TINY).sqrt()) / a + _FAR * torch.relu(-inside).sign()
        sine = (r0 - r1) / length
        cosine2 = 1 - sine * sine
        # The tiny term keeps a ray along a generator line from dividing by zero.
        qa = cosine2 * a - dy * dy + _TINY
        qb = dy * (sine * r0 - py)
        rim = r0 - sine * py
        qc = cosine2 * (pp - py * py) - rim * rim
        inside = qb * qb - qa * qc
        # This root is the one where the ray goes from outside to inside, whichever sign qa has.
        tc = (-qb - inside.clamp_min(_TINY).sqrt()) / qa
        y = py + tc * dy
        outside = torch.relu(-inside) + torch.relu(r0 * sine - y) + torch.relu(y - (length + r1 * sine))
        t = torch.minimum(torch.minimum(t, t1), tc + _FAR * outside.sign())
    return shift + t


def cast_rays(
    cones: RoundCones, origins: Float[Tensor, "*batch rays 3"], directions: Float[Tensor, "*batch rays 3"]
) -> tuple[Float[Tensor, "*batch rays"], Int[Tensor, "*batch rays"]]:
    """First hit of each ray.

    Returns:
        t: along the ray; inf where nothing is hit. Hits behind the origin are not hits.
        part: index of the hit part, -1 for none.

    Example:
        >>> import torch
        >>> ball = RoundCones(torch.eye(3)[None], torch.tensor([[0.0, 0, 5]]), torch.ones(1, 3), torch.zeros(1),
        ...                   torch.ones(1, 2))
        >>> t, part = cast_rays(ball, torch.zeros(2, 3), torch.tensor([[0.0, 0, 1], [1.0, 0, 1]]))
        >>> t.tolist(), part.tolist()
        ([4.0, inf], [0, -1])
    """
    best = torch.full_like(origins[..., 0], _FAR / 2)
    part = torch.full(best.shape, -1, dtype=torch.long, device=best.device)
    for index in range(len(cones.length)):
        into = cones.rotations[..., index, :, :].transpose(-1, -2) / cones.scale[index][:, None]
        o = torch.einsum("...ij,...rj->i...r", into, origins - cones.origins[..., None, index, :])
        d = torch.einsum("...ij,...rj->i...r", into, directions)
        r0, r1 = cones.radii[index].tolist()
        t = _entry((o[0], o[1], o[2]), (d[0], d[1], d[2]), float(cones.length[index]), r0, r1)
        closer = (t < best) & (t > 0)
        best = torch.where(closer, t, best)
        part = torch.where(closer, index, part)
    return best.masked_fill(part < 0, torch.inf), part


def cast_image(
    cones: RoundCones,
    origin_map: Float[Tensor, "3 3"],
    direction_map: Float[Tensor, "3 3"],
    boxes: Int[Tensor, "parts 4"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "height width"], Int[Tensor, "height width"]]:
    """Depth buffer of one frame: each part is cast only inside its own box of pixels.

    Args:
        cones: without batch dimension.
        origin_map, direction_map: the ray of pixel (u, v) is ``origin_map [u, v, 1] + t direction_map [u, v, 1]``,
            which covers pinhole and parallel projections alike.
        boxes: left, top, right, bottom (exclusive) pixel of each part, inside the image; empty boxes are skipped.
        size: (height, width).

    Returns:
        t: inf where nothing is hit.
        part: -1 where nothing is hit.
    """
    depth = torch.full(size, _FAR / 2, dtype=cones.origins.dtype, device=cones.origins.device)
    part = torch.full(size, -1, dtype=torch.long, device=depth.device)
    for index, (left, top, right, bottom) in enumerate(boxes.tolist()):
        if right <= left or bottom <= top:
            continue
        into = cones.rotations[index].T / cones.scale[index][:, None]
        shift = torch.zeros_like(origin_map)
        shift[:, 2] = cones.origins[index]
        o_map, d_map = into @ (origin_map - shift), into @ direction_map
        u = torch.arange(left, right, dtype=depth.dtype, device=depth.device)
        v = torch.arange(top, bottom, dtype=depth.dtype, device=depth.device)[:, None]
        o = [row[0] * u + row[1] * v + row[2] for row in o_map]
        d = [row[0] * u + row[1] * v + row[2] for row in d_map]
        r0, r1 = cones.radii[index].tolist()
        t = _entry((o[0], o[1], o[2]), (d[0], d[1], d[2]), float(cones.length[index]), r0, r1)
        window = depth[top:bottom, left:right]
        closer = (t < window) & (t > 0)
        window.copy_(torch.where(closer, t, window))
        owner = part[top:bottom, left:right]
        owner.masked_fill_(closer, index)
    return depth.masked_fill_(part < 0, torch.inf), part


def local_to_outer(
    cones: RoundCones, part: Int[Tensor, " points"], local: Float[Tensor, "points 3"]
) -> Float[Tensor, "*batch points 3"]:
    """Part coordinates (metres, unscaled) to outer axes, in every frame of the batch."""
    rotation = cones.rotations[..., part, :, :]
    return torch.einsum("...nij,nj->...ni", rotation, local) + cones.origins[..., part, :]


def surface_normals(cones: RoundCones, part: int, local: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
    """Outward unit normals, in part axes, of points on the surface of one part."""
    scale, (r0, r1), length = cones.scale[part], cones.radii[part].tolist(), float(cones.length[part])
    q = local / scale
    if length > 0:
        sine = (r0 - r1) / length
        # The sphere that touches the hull at q has its centre here; its radius vector is the normal.
        foot = q[:, 1] - (sine / (1 - sine * sine) ** 0.5) * torch.hypot(q[:, 0], q[:, 2])
        q[:, 1] -= foot.clamp(0, length)
    return torch.nn.functional.normalize(q / scale, dim=-1)
