"""Non-rigid structure by probabilistic principal components, EM-PPCA (Torresani, Hertzmann, Bregler 2008).

Model: ``x_fp = s_f R_f[:2] (m_p + V_p z_f) + t_f + noise``, ``z_f ~ N(0, I)`` of K - 1 numbers a frame, noise of one
unknown variance times the covariance of the observation. Expectation: mean and covariance of z_f given the seen
entries. Maximisation, one block after the other: mean shape and modes (exact), rotations (one Gauss-Newton step on
the expected cost, the covariance of z counted), scales (only with intrinsics), translations, noise variance. All
follow from the model. Recalled, not read: that the original starts from a rigid factorisation and may add a linear
dynamical system on z_f, which is not done here. The start here is the metric upgrade of the 3K column space, and the
modes start at the principal components of what the mean shape leaves.

What it is not: smooth in time, robust, or sure of its maximum; EM stays in the basin where it starts, and it is slow
to the end. ``rank`` = K counts the mean shape as a basis and has to be given sensibly.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Reconstruction, Tracks
from torchrecon.nrsfm.base import solve_items
from torchrecon.nrsfm.bridging import bridging
from torchrecon.nrsfm.common import conclude, filled
from torchrecon.nrsfm.gram import GramParams, gram_upgrade
from torchrecon.nrsfm.observations import Observations, observe

__all__ = ["EmPpcaParams", "em_ppca"]


@dataclass(frozen=True)
class EmPpcaParams:
    """Parameters of EM-PPCA.

    Attributes:
        upgrade: of the start.
        iterations: of expectation and maximisation (count).
        tolerance: relative fall of the noise variance in an iteration that counts as converged.
        floor: noise variance never falls below this, in squared units of the body's size.
    """

    upgrade: GramParams = field(default_factory=GramParams)
    iterations: int = 200
    tolerance: float = 1e-3
    floor: float = 1e-8


@dataclass(frozen=True, eq=False)
class _Model:
    """Current estimates; ``bases[:, 0]`` is the mean shape, the others the modes."""

    bases: Float[Tensor, "points rank 3"]
    rotations: Float[Tensor, "frames 3 3"]
    scale: Float[Tensor, " frames"]
    translation: Float[Tensor, "frames 2"]
    noise: Tensor

    @property
    def rows(self) -> Float[Tensor, "frames 2 3"]:
        return self.rotations[:, :2] * self.scale[:, None, None]


def _expect(model: _Model, data: Observations, information: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of ``[1, z_f]`` (frames, rank) and its second moment (frames, rank, rank)."""
    seen = torch.einsum("fai,pki->fpak", model.rows, model.bases)
    mean, modes = seen[..., 0], seen[..., 1:]
    held = information @ modes
    residual = data.xy - model.translation[:, None] - mean
    eye = torch.eye(modes.shape[-1], dtype=modes.dtype, device=modes.device)
    normal = torch.einsum("fpak,fpal->fkl", modes, held) + model.noise * eye
    z = torch.linalg.solve(normal, torch.einsum("fpak,fpa->fk", held, residual)[..., None])[..., 0]
    first = torch.cat([z.new_ones(len(z), 1), z], 1)
    second = first[:, :, None] * first[:, None, :]
    second[:, 1:, 1:] += model.noise * torch.linalg.inv(normal)
    return first, second


def _maximise(
    model: _Model, data: Observations, information: Tensor, first: Tensor, second: Tensor, scaled: bool
) -> _Model:
    """One round over all parameters but the hidden weights."""
    points, rank = model.bases.shape[:2]
    # Mean shape and modes: every point is regressed on the expected weights.
    rows = model.rows
    held = information @ rows[:, None]
    gram = torch.einsum("fai,fpaj->fpij", rows, held)
    normal = torch.einsum("fkl,fpij->pkilj", second, gram).reshape(points, 3 * rank, 3 * rank)
    centred = data.xy - model.translation[:, None]
    right = torch.einsum("fk,fpai,fpa->pki", first, held, centred).flatten(1)
    ridge = 1e-9 * normal.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    ridge = torch.where(ridge > 0, ridge, torch.ones_like(ridge))
    eye = torch.eye(3 * rank, dtype=normal.dtype, device=normal.device)
    bases = torch.linalg.solve(normal + ridge * eye, right[..., None]).view(points, rank, 3)
    # Translation and rotation see the mean shape of the frame and, beside it, a copy for every direction in which its
    # weights are uncertain, for which nothing was observed: together they are the expected cost.
    spread = second - first[:, :, None] * first[:, None, :]
    values, vectors = torch.linalg.eigh(spread[:, 1:, 1:])
    doubt = vectors * values.clamp_min(0).sqrt()[:, None, :]
    mean = torch.einsum("fk,pki->fpi", first, bases)
    shapes = torch.cat([mean[None], torch.einsum("fkc,pki->cfpi", doubt, bases[:, 1:])])
    total = information.sum(1)
    pull = (information @ (data.xy - mean @ rows.mT)[..., None]).sum(1)
    translation = (torch.linalg.pinv(total, hermitian=True) @ pull)[..., 0]
    target = torch.zeros_like(shapes[..., :2])
    target[0] = data.xy - translation[:, None]
    camera = shapes @ model.rotations.mT
    x, y, z = camera.unbind(-1)
    zero = torch.zeros_like(x)
    slope = torch.stack([torch.stack([zero, z, -y], -1), torch.stack([-z, zero, x], -1)], -2)
    residual = target / model.scale[:, None, None] - camera[..., :2]
    weighted = information @ slope
    normal = torch.einsum("cfpai,cfpaj->fij", slope, weighted)
    gradient = torch.einsum("cfpai,cfpa->fi", weighted, residual)
    damping = 1e-9 * normal.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    damping = torch.where(damping > 0, damping, torch.ones_like(damping))
    eye3 = torch.eye(3, dtype=normal.dtype, device=normal.device)
    step = torch.linalg.solve(normal + damping * eye3, gradient[..., None])[..., 0]
    step = step / (step.norm(dim=-1, keepdim=True) / 0.3).clamp_min(1)
    rotations = rotation_from_vector(step) @ model.rotations
    plane = (shapes @ rotations.mT)[..., :2]
    scale = model.scale
    if scaled:
        weighted_plane = (information @ plane[..., None])[..., 0]
        fit, norm = (weighted_plane * target).sum((0, 2, 3)), (weighted_plane * plane).sum((0, 2, 3))
        scale = torch.where(norm > 0, fit / norm, scale)
        size = scale.mean()
        scale, bases, plane = scale / size, bases * size, plane * size
    residual = target - plane * scale[:, None, None]
    cost = (residual * (information @ residual[..., None])[..., 0]).sum()
    return _Model(bases, rotations, scale, translation, cost / (2 * data.visible.sum()))


def _start(data: Observations, rank: int, scaled: bool, params: EmPpcaParams) -> _Model:
    """Cameras from the metric upgrade, one rigid shape, and the principal components of what it leaves."""
    xy, translation = filled(data, 3 * rank)
    centred = xy - translation[:, None]
    found = gram_upgrade(centred.mT.flatten(0, 1), 3 * rank, scaled=scaled, params=params.upgrade)
    rows = found.rotations[:, :2]
    plane = centred / found.scale[:, None, None]
    mean = (torch.linalg.pinv(rows.flatten(0, 1)) @ plane.mT.flatten(0, 1)).mT
    rest = ((plane - mean @ rows.mT) @ rows).flatten(1)
    _, s, vh = torch.linalg.svd(rest, full_matrices=False)
    modes = (s[: rank - 1, None] * vh[: rank - 1] / len(rows) ** 0.5).unflatten(-1, mean.shape)
    modes = torch.nn.functional.pad(modes, (0, 0, 0, 0, 0, rank - 1 - len(modes)))
    noise = rest.square().mean().clamp_min(params.floor)
    bases = torch.cat([mean[:, None], modes.transpose(0, 1)], 1)
    return _Model(bases, found.rotations, found.scale, translation, noise)


def _solve(item: Tracks, rank: int, generator: torch.Generator, params: EmPpcaParams | None = None) -> Reconstruction:
    params = params or EmPpcaParams()
    data = observe(item)
    scaled = item.intrinsics is not None
    information = data.weight.mT @ data.weight
    # The noise variance is in units of the given covariances; without any, in squared units of the body.
    floor = params.floor * float(information.diagonal(dim1=-2, dim2=-1).sum() / (2 * data.visible.sum()))
    model = _start(data, rank, scaled, params)
    model = replace(model, noise=model.noise * floor / params.floor)
    converged, count = False, 0
    for count in range(1, params.iterations + 1):
        first, second = _expect(model, data, information)
        found = _maximise(model, data, information, first, second, scaled)
        noise, model = model.noise, replace(found, noise=found.noise.clamp_min(floor))
        fall = float((noise - model.noise).abs() / model.noise)
        if count > 5 and fall < params.tolerance:
            converged = True
            break
    first, _ = _expect(model, data, information)
    shapes = torch.einsum("fk,pki->fpi", first, model.bases)
    return conclude(
        data,
        shapes @ model.rotations.mT,
        model.rotations,
        model.scale,
        model.translation,
        rank=rank,
        complaint=None if converged else f"the noise variance still fell after {params.iterations} iterations",
        summary=f"mean shape and {rank - 1} modes after {count} iterations",
    )


def em_ppca(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Probabilistic principal components of the shape; entries may be missing; any leading batch.

    Args:
        tracks: seen entries only are read; with intrinsics the views are weak perspective.
        rank: K, the mean shape counted.
        generator: not used; the method has no random part.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> shape = torch.randn(12, 3, generator=torch.Generator().manual_seed(0))
        >>> turn = rotation_from_vector(torch.linspace(0, 3, 15)[:, None] * torch.tensor([0.3, 1.0, 0.1]))
        >>> rec = em_ppca(Tracks((shape @ turn.mT)[..., :2]), 1)
        >>> bool((rec.reproject() - (shape @ turn.mT)[..., :2]).abs().max() < 1e-3), rec.status.code
        (True, 'ok')
    """
    return solve_items(tracks, rank, bridging(_solve), generator)
