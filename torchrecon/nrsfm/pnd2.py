"""Procrustean normal distribution (Lee, Cho, Choi and Oh 2013; Lee, Cho and Oh 2016), fitted by an annealed EM.

Model: the shape of a frame, turned and scaled onto the mean shape by Procrustes, is Gaussian, and what Procrustes
takes away (rotation, scale, translation) is no deformation: the covariance is orthogonal to the seven tangents of the
similarities at the mean. Depths and unseen entries are latent and integrated out; no number of bases is given.

Recalled from the papers: this distribution, EM with the depths latent, no K. Derived here: the covariance
``L L^T + eps^2 I`` whose L takes the directions that exceed ``eps^2`` (so every frame costs r x r algebra), views and
sizes by Fisher scoring on the marginal likelihood in place of a re-alignment of the expected shapes (which stops
far from the optimum), and the annealing of eps. It is not the authors' code and has no motion prior from frame to
frame. Not used: measured depth, the covariance of observations. eps does not learn the noise:
what exceeds its last value is taken for deformation, so on noisy tracks ``eps_fine`` has to be raised to the noise.
Cost: linear in frames, cubic in points.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.linalg import rotation_from_vector
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.base import check_size, looks_static, mirror_sign, solve_items, turn_of_view
from torchrecon.nrsfm.bridging import bridging
from torchrecon.nrsfm.common import STATIC_TURN, filled
from torchrecon.nrsfm.observations import observe
from torchrecon.nrsfm.upgrade import UpgradeParams, upgraded_rotations

__all__ = [
    "Pnd2Params",
    "ProcrusteanNormal",
    "first_views",
    "fit_procrustean",
    "pnd2",
    "rigid_start",
    "similarity_tangents",
    "solve_pnd2",
]


OVERSHOOT = 1.0  # nats per frame by which a step may raise the cost: directions come and go as eps falls
LONGEST_TURN = 0.3  # radians that one scoring step may turn a view: beyond it the linearisation says nothing


@dataclass(frozen=True)
class Pnd2Params:
    """Parameters of the fit; lengths are in units of the rms size of the tracks.

    Attributes:
        eps_coarse: first standard deviation outside the deformation subspace (rms size).
        eps_fine: last standard deviation outside the deformation subspace (rms size).
        short_iterations: EM steps spent on every start, eps falling all the way (count).
        long_iterations: EM steps at ``eps_fine`` spent on the best start (count).
        keep: starts that are tried, those of the lowest residual of each K first (count).
        largest_rank: most deformation directions (count).
        tolerance: gain of log-likelihood per step and frame at which the fit has converged (nats).
        upgrade: of the metric upgrade, which supplies the starts.
    """

    eps_coarse: float = 0.1
    eps_fine: float = 3e-3
    short_iterations: int = 80
    long_iterations: int = 300
    keep: int = 2
    largest_rank: int = 60
    tolerance: float = 1e-3
    upgrade: UpgradeParams = field(default_factory=UpgradeParams)


@dataclass(frozen=True, eq=False)
class ProcrusteanNormal:
    """Views, sizes and the distribution of the aligned shapes.

    Attributes:
        rotations: canonical -> camera.
        scale: size of each frame's shape relative to the mean shape, geometric mean 1.
        translation: image position of the centroid.
        mean: shape about its centroid.
        loadings: standard deviations times directions of the deformations.
    """

    rotations: Float[Tensor, "*batch frames 3 3"]
    scale: Float[Tensor, "*batch frames"]
    translation: Float[Tensor, "*batch frames 2"]
    mean: Float[Tensor, "*batch points 3"]
    loadings: Float[Tensor, "*batch points 3 rank"]


def similarity_tangents(mean: Float[Tensor, "*batch points 3"]) -> Float[Tensor, "*batch coordinates 7"]:
    """Orthonormal directions in which a shape changes when it is moved, turned or scaled (rows: x, y, z per point).

    Example:
        >>> import torch
        >>> basis = similarity_tangents(torch.randn(6, 3, generator=torch.Generator().manual_seed(0)))
        >>> basis.shape, bool((basis.T @ basis - torch.eye(7)).abs().max() < 1e-5)
        (torch.Size([18, 7]), True)
    """
    wide = mean[..., None, :, :].expand(*mean.shape[:-2], 3, *mean.shape[-2:])
    axes = torch.eye(3, dtype=mean.dtype, device=mean.device)[:, None].expand_as(wide)
    columns = torch.cat([axes, torch.linalg.cross(axes, wide), mean[..., None, :, :]], -3)
    basis: Tensor = torch.linalg.qr(columns.flatten(-2).mT)[0]
    return basis


def _covariance_of_depths(lifted: Tensor, view: Tensor, eps2: float) -> Tensor:
    """Mean over frames of the posterior covariance of canonical shapes when every point is seen: depth alone varies."""
    points = lifted.shape[-2]
    blocks = lifted @ lifted.mT
    blocks.diagonal(dim1=-2, dim2=-1).add_(eps2)
    along = (view[..., :, None] * view[..., None, :]).flatten(-2) / view.shape[-2]
    mean = (along.mT @ blocks.flatten(-2)).unflatten(-1, (points, points)).unflatten(-3, (3, 3))
    return mean.movedim((-4, -3), (-3, -1)).flatten(-4, -3).flatten(-2)


def _covariance(lifted: Tensor, rotations: Tensor, missing: Tensor, eps2: float) -> Tensor:
    """The same where entries are missing, which vary in all three coordinates; ``lifted`` (F, 3, P, r), camera axes."""
    frames, _, points, rank = lifted.shape[-4:]
    turned = (rotations.mT @ lifted.flatten(-2)).unflatten(-1, (points, rank))
    flat = turned.movedim((-2, -3), (-4, -3)).flatten(-2).flatten(-3, -2)
    total = (flat @ flat.mT / frames).unflatten(-2, (points, 3)).unflatten(-1, (points, 3))
    free = torch.stack([missing, missing, torch.ones_like(missing)], -2)
    noise = torch.einsum("...fia,...fip,...fib->...abp", rotations, free, rotations) * (eps2 / frames)
    total.diagonal(dim1=-4, dim2=-2).add_(noise)
    return total.flatten(-4, -3).flatten(-2)


def _step(
    xy: Tensor, seen: Tensor, model: ProcrusteanNormal, eps2: float, largest: int, pace: Tensor
) -> tuple[ProcrusteanNormal, Tensor, Tensor]:
    """One EM step with one scoring step of the views.

    Both start from the same posterior: taking them in turn halves the pace along the valley in which a tilt of the
    views trades with depth. Together they can also overshoot, so ``pace`` (batch) shortens the scoring step.

    Returns:
        new model; expected camera-frame shapes (F, P, 3) and mean minus twice log-likelihood of the old one.
    """
    frames, points = seen.shape[-2:]
    rotations, scale, mean = model.rotations, model.scale, model.mean
    rank = model.loadings.shape[-1]
    width = scale[..., None, None]
    noise = eps2 * scale.square()
    per = noise[..., None, None]
    placed = model.loadings.movedim(-2, -3).flatten(-2)[..., None, :, :]
    moved = ((rotations @ placed) * width).unflatten(-1, (points, rank))
    centre = mean[..., None, :, :] @ rotations.mT * width
    loads = (moved[..., :2, :, :] * seen[..., None, :, None]).flatten(-3, -2)
    rest = ((xy - centre[..., :2] - model.translation[..., None, :]) * seen[..., None]).mT.flatten(-2)
    # posterior of the deformation weights: r x r per frame
    inner = loads.mT @ loads / per
    inner.diagonal(dim1=-2, dim2=-1).add_(1)
    factor = torch.linalg.cholesky(inner)
    weights = torch.cholesky_solve((loads.mT @ rest[..., None]) / per, factor)
    unexplained = rest - (loads @ weights)[..., 0]
    dual = unexplained / noise[..., None]
    count = 2 * seen.sum(-1)
    cost = 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + count * noise.log() + (rest * dual).sum(-1)
    shape = centre + (moved.flatten(-3, -2) @ weights)[..., 0].unflatten(-1, (3, points)).mT
    expected = shape.clone()
    expected[..., :2] += unexplained.unflatten(-1, (2, points)).mT

    # half the gradient and the Fisher information in (rotation vector, log size, translation)
    x, y, z = shape.unbind(-1)
    zero, one = torch.zeros_like(seen), seen
    columns = [(zero, -z), (z, zero), (-y, x), (x, y), (one, zero), (zero, one)]
    both = torch.cat([seen, seen], -1)[..., None]
    jacobian = torch.stack([torch.cat(pair, -1) for pair in columns], -1) * both
    half_inverse = torch.linalg.solve_triangular(
        factor, torch.eye(rank, dtype=xy.dtype, device=xy.device).expand_as(factor), upper=False
    )
    lifted = moved @ half_inverse.mT[..., None, :, :]
    along = (loads @ half_inverse.mT).unflatten(-2, (2, points))
    depth = (lifted[..., 2, :, :] * seen[..., None])[..., None, :, :]
    trade = (along * depth).sum((-2, -1)) / noise[..., None]
    gradient = -(jacobian.mT @ dual[..., None])[..., 0]
    gradient[..., 0] -= trade[..., 1]
    gradient[..., 1] += trade[..., 0]
    gradient[..., 3] += count - dual.square().sum(-1) * noise
    explained = half_inverse @ (loads.mT @ jacobian)
    information = (jacobian.mT @ jacobian - explained.mT @ explained / per) / per
    ridge = 1e-6 * information.diagonal(dim1=-2, dim2=-1)[..., :4].mean(-1, keepdim=True)
    information.diagonal(dim1=-2, dim2=-1).add_(ridge)
    change = -torch.linalg.solve(information, gradient[..., None])[..., 0]
    change = change * (LONGEST_TURN / change[..., :3].norm(dim=-1, keepdim=True).clamp_min(LONGEST_TURN))

    change = change * pace[..., None, None]

    # moments of the canonical shapes about the old mean
    offset = ((expected - centre) @ rotations / width).flatten(-2)
    shift = offset.mean(-2)
    moment = offset.mT @ offset / frames - shift[..., :, None] * shift[..., None, :]
    lifted = lifted / width[..., None]
    if bool(seen.all()):
        moment = moment + _covariance_of_depths(lifted[..., 2, :, :], rotations[..., 2, :], eps2)
    else:
        missing = 1 - seen
        free = torch.stack([missing, missing, torch.ones_like(missing)], -2)[..., None]
        moment = moment + _covariance(lifted * free, rotations, missing, eps2)
    size = scale * change[..., 3].clamp(-0.1, 0.1).exp()
    unit = size.log().mean(-1).exp()[..., None]
    mean = (mean + shift.unflatten(-1, (points, 3))) * unit[..., None]
    mean = mean - mean.mean(-2, keepdim=True)
    tangents = similarity_tangents(mean)
    moment = moment - tangents @ (tangents.mT @ moment)
    moment = (moment - (moment @ tangents) @ tangents.mT) * unit[..., None].square()
    values, vectors = torch.linalg.eigh(moment)
    kept = min(max(1, int((values > eps2).sum(-1).max())), largest, 3 * points)
    spread = (values[..., -kept:] - eps2).clamp_min(1e-12).sqrt()
    new = ProcrusteanNormal(
        rotation_from_vector(change[..., :3]) @ rotations,
        size / unit,
        model.translation + change[..., 4:],
        mean,
        (vectors[..., -kept:] * spread[..., None, :]).unflatten(-2, (points, 3)),
    )
    return new, expected, cost.mean(-1)


def _choose(which: Tensor, first: ProcrusteanNormal, second: ProcrusteanNormal) -> ProcrusteanNormal:
    """Batch items of ``first`` where ``which`` holds, else of ``second``; loadings are padded with zeros."""
    rank = max(first.loadings.shape[-1], second.loadings.shape[-1])

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(which.reshape(*which.shape, *(1,) * (a.ndim - which.ndim)), a, b)

    pad = torch.nn.functional.pad
    return ProcrusteanNormal(
        pick(first.rotations, second.rotations),
        pick(first.scale, second.scale),
        pick(first.translation, second.translation),
        pick(first.mean, second.mean),
        pick(*(pad(model.loadings, (0, rank - model.loadings.shape[-1])) for model in (first, second))),
    )


def fit_procrustean(
    xy: Float[Tensor, "*batch frames points 2"],
    visible: Bool[Tensor, "*batch frames points"],
    model: ProcrusteanNormal,
    iterations: int,
    params: Pnd2Params,
    *,
    anneal: bool,
) -> tuple[ProcrusteanNormal, Float[Tensor, "*batch frames points 3"], Float[Tensor, "*batch"], bool]:
    """EM from a given model; any leading batch, which shares the number of deformation directions.

    Args:
        xy: in units of the rms size; entries that are not visible have to be finite, their value does not matter.
        anneal: let eps fall over the first 90 % of the iterations; else it stays at its fine value.

    Returns:
        the model, the expected shapes in camera axes, minus twice the log-likelihood per frame at ``eps_fine`` (it
        ranks answers for the same tracks) and whether all had converged before the limit.
    """
    seen = visible.to(xy.dtype)
    falling = 0.9 * iterations if anneal else 0.0
    ratio = params.eps_fine / params.eps_coarse
    pace = xy.new_ones(seen.shape[:-2])
    lowest = previous = torch.full_like(pace, torch.inf)
    good, converged = model, False
    for index in range(iterations):
        eps = params.eps_coarse * ratio ** (index / falling) if index < falling else params.eps_fine
        new, _, cost = _step(xy, seen, model, eps**2, params.largest_rank, pace)
        worse = ~(cost <= lowest + OVERSHOOT)
        lowest = torch.where(worse, lowest, cost)
        good = _choose(worse, good, model)
        model = _choose(worse, good, new)
        pace = torch.where(worse, pace / 2, (1.2 * pace).clamp(max=1))
        if index >= falling and index % 10 == 9:
            if bool(((previous - lowest).abs() < 10 * params.tolerance).all()) and bool((pace == 1).all()):
                converged = True
                break
            previous = lowest
    _, expected, cost = _step(xy, seen, good, params.eps_fine**2, params.largest_rank, pace)
    return good, expected, cost, converged


def rigid_start(
    xy: Float[Tensor, "*batch frames points 2"], rotations: Float[Tensor, "*batch frames 3 3"]
) -> ProcrusteanNormal:
    """The rigid shape that fits complete tracks best under the given views, with no deformation yet."""
    shift = xy.mean(-2)
    rows = rotations[..., :2, :].flatten(-3, -2)
    stack = (xy - shift[..., None, :]).mT.flatten(-3, -2)
    shape = (torch.linalg.pinv(rows.mT @ rows) @ (rows.mT @ stack)).mT
    return ProcrusteanNormal(
        rotations, torch.ones_like(shift[..., 0]), shift, shape, torch.zeros_like(shape)[..., None]
    )


def first_views(
    xy: Float[Tensor, "frames points 2"], params: UpgradeParams, keep: int, generator: torch.Generator
) -> list[Float[Tensor, "frames 3 3"]]:
    """Views of the metric upgrade of complete tracks, lowest residual first."""
    stack = (xy - xy.mean(1, keepdim=True)).mT.flatten(0, 1)
    starts = sorted(upgraded_rotations(stack, params, generator), key=lambda start: start[0])
    return [views for _, _, views in starts[:keep]]


def solve_pnd2(item: Tracks, rank: int, generator: torch.Generator, params: Pnd2Params | None = None) -> Reconstruction:
    """Solve one sequence (batch ``()``); works in float64 whatever the tracks are."""
    params = params or Pnd2Params()
    data = observe(item)
    kind = data.xy.dtype
    data = replace(data, xy=data.xy.double())
    xy, visible = data.xy, data.visible
    complete, _ = filled(data, 6)
    tried = [
        fit_procrustean(xy, visible, rigid_start(complete, views), params.short_iterations, params, anneal=True)
        for views in first_views(complete, params.upgrade, params.keep, generator)
    ]
    best = min(tried, key=lambda answer: float(answer[2]))
    model, points3d, _, converged = fit_procrustean(xy, visible, best[0], params.long_iterations, params, anneal=False)
    flip = xy.new_ones(3)
    flip[2] = mirror_sign(points3d)
    points3d, rotations = points3d * flip, model.rotations * (flip[:, None] * flip)
    turn = float(turn_of_view(rotations))
    status = check_size(item, rank)
    if status is None and (turn < STATIC_TURN or looks_static(complete - complete.mean(1, keepdim=True))):
        status = Status(
            "undetermined", "the tracks look as from a view that never changes; they do not determine the depth"
        )
    if status is None and not converged:
        status = Status(
            "not_converged", f"the likelihood still rose after {params.long_iterations} steps from the best start"
        )
    if status is None:
        deformations = model.loadings.shape[-1]
        status = Status("ok", f"{deformations} deformation directions, view turning by {turn:.0f} degrees")
    scale = torch.ones_like(model.scale)
    if item.intrinsics is not None:  # weak perspective: what the frames differ in is distance, not size
        scale, points3d = model.scale, points3d / model.scale[:, None, None]
    return data.reconstruction(
        points3d.to(kind), rotations.to(kind), scale.to(kind), model.translation.to(kind), rank=rank, status=status
    )


def pnd2(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Procrustean normal distribution from orthographic or weak-perspective tracks, gaps allowed; any leading batch.

    Args:
        tracks: seen entries only are read.
        rank: reported as it is given; the fit finds its own number of deformations.
        generator: starts of the metric upgrade.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(12, 3, generator=g)
        >>> turn = rotation_from_vector(torch.linspace(0, 2, 15)[:, None] * torch.tensor([0.1, 1.0, 0.0]))
        >>> truth = shape @ turn.mT
        >>> rec = pnd2(Tracks(truth[..., :2]), 1)
        >>> bool((rec.reproject() - truth[..., :2]).abs().max() < 1e-3), rec.status.code
        (True, 'ok')
    """
    return solve_items(tracks, rank, bridging(solve_pnd2), generator)
