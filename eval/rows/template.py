"""The surface template of the Ref. 4-style row, and its prior from training bodies of the synthetic world.

A template point is a place on a body part in the part's own proportions, so the same point exists on every body.
Test films take other seeds, hence other bodies, than :data:`PRIOR_SEED` and what follows it.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import torch

from eval.job import read_arrays, write_arrays
from eval.rows.ref4_style import ActionShapes, fit_prior
from torchrecon._typing import Float, Int, Tensor
from torchrecon.data.synthetic import Body, Motion, sample_body, sample_motion
from torchrecon.errors import ReconError

__all__ = ["PRIOR_SEED", "load_prior", "place_template", "save_prior", "template_layout", "train_prior"]

PRIOR_SEED = 500_000_000
TEMPLATE_POINTS = 280


@functools.cache
def template_layout() -> tuple[Int[Tensor, " points"], Float[Tensor, "points 2"]]:
    """Part of each template point, and its place there: height in [0, 1] and angle about the part's axis, radians.

    The points of a part are as many as its surface on one fixed training body asks for.
    """
    body = sample_body(torch.Generator().manual_seed(PRIOR_SEED))
    radius = body.radii.mean(-1) * body.scale[:, [0, 2]].prod(-1).sqrt()
    area = radius * (body.length + 2 * body.radii.mean(-1)) * body.scale[:, 1]
    counts = (TEMPLATE_POINTS * area / area.sum()).round().clamp_min(3).int().tolist()
    golden = math.pi * (3 - math.sqrt(5))
    parts, places = [], []
    for index, count in enumerate(counts):
        i = torch.arange(count, dtype=torch.float64)
        parts.append(torch.full((count,), index))
        places.append(torch.stack([(i + 0.5) / count, golden * i], -1))
    return torch.cat(parts), torch.cat(places)


def place_template(body: Body, motion: Motion) -> Float[Tensor, "frames points 3"]:
    """World positions of the template points in every frame, metres."""
    part, place = template_layout()
    cones = body.place(motion.joints.double(), motion.bones.double())
    height, angle = place.unbind(-1)
    length, low, high = cones.length[part], cones.radii[part, 0], cones.radii[part, 1]
    # Ellipsoids (length 0) spread their points over height as a sphere does, cones along their axis.
    round_part = length == 0
    radius = torch.where(round_part, low * (1 - (2 * height - 1).square()).sqrt(), low + (high - low) * height)
    along = torch.where(round_part, low * (2 * height - 1), length * height)
    local = torch.stack([radius * angle.cos(), along, radius * angle.sin()], -1) * cones.scale[part]
    return torch.einsum("fpij,pj->fpi", cones.rotations[:, part], local) + cones.origins[:, part]


def _canonical(world: Tensor, motion: Motion) -> Tensor:
    """Centred, of rms size 1, facing the camera of axes x right, y down, z away, whatever way the body looked."""
    forward = motion.bones[:, 0, :, 2].double()
    yaw = torch.atan2(forward[:, 0], forward[:, 2])
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    turn = torch.stack([yaw.cos(), zero, -yaw.sin(), zero, one, zero, yaw.sin(), zero, yaw.cos()], -1)
    centred = world - world.mean(1, keepdim=True)
    body = centred @ turn.unflatten(-1, (3, 3)).mT
    size = body.square().sum(-1).mean().sqrt()
    return body / size * torch.tensor([1.0, -1.0, -1.0], dtype=body.dtype)


def train_prior(actions: tuple[str, ...], bodies: int = 24, frames: int = 60, seed: int = 0) -> dict[str, ActionShapes]:
    """Principal components of the template for each action, over training bodies and their motions."""
    shapes: dict[str, Tensor] = {}
    for a, action in enumerate(actions):
        sample = []
        for b in range(bodies):
            generator = torch.Generator().manual_seed(PRIOR_SEED + 100_000 * seed + 1000 * a + b)
            body = sample_body(generator)
            motion = sample_motion(action, body, frames=frames, generator=generator)
            sample.append(_canonical(place_template(body, motion), motion)[::2])
        shapes[action] = torch.cat(sample)
    return fit_prior(shapes)


def save_prior(path: Path, prior: dict[str, ActionShapes]) -> None:
    """Write a prior, atomically."""
    arrays = {}
    for action, shapes in prior.items():
        arrays |= {f"{action}/{name}": getattr(shapes, name) for name in ("mean", "modes", "deviations")}
    write_arrays(path, arrays)


def load_prior(path: Path) -> dict[str, ActionShapes]:
    """Read what :func:`save_prior` wrote."""
    if not path.is_file():
        raise ReconError(f"{path}: no such file; the shape prior of the Ref. 4-style row is trained by the job")
    arrays = {name: torch.from_numpy(value) for name, value in read_arrays(path).items()}
    actions = dict.fromkeys(name.split("/")[0] for name in arrays)
    return {a: ActionShapes(arrays[f"{a}/mean"], arrays[f"{a}/modes"], arrays[f"{a}/deviations"]) for a in actions}
