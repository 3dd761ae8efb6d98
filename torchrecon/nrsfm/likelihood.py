"""How likely tracks are under a camera path, when every point moves as a Gaussian process in the axes of the body.

Point p follows ``Y_p(t) = S_p + u_p(t)`` in canonical axes: a rest position S_p ~ N(0, rest) and a deviation whose
three coordinates are independent Gaussian processes with kernel ``G_c(t, t')``, where the class c of the point (part
of a trunk, of a limb, of a hand ...) is not known and is summed over. An observation is linear in Y given the camera:
``(R_1:2 - u R_3) Y = u D - t`` for a pinhole at distance D (u: tangents of the viewing angle), ``s R_1:2 Y = x - t``
for scaled orthography, ``R_3 Y = z - D`` for measured depth. The points are integrated out in closed form, each from
its own seen entries alone: tracks may be born and die, and nothing is ever filled in. Cost: linear in the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch

from torchrecon._typing import Bool, Float, Int, Tensor
from torchrecon.nrsfm.observations import Observations

__all__ = [
    "CameraPath",
    "MotionPrior",
    "Packed",
    "learn_kernels",
    "matern32",
    "negative_log_likelihood",
    "pack",
    "posterior_points",
]


_BATCH = 60_000  # pairs of observations in a batch; a pair takes 4 to 9 numbers


@dataclass(frozen=True, eq=False)
class Packed:
    """Seen entries of every point, first ones first, padded to the longest track.

    Attributes:
        frame: (points, n) frame of the entry; seen: (points, n) false where it is padding.
        xy: (points, n, 2) solver units; weight: (points, n, 2, 2) whitening factor, zero for padding.
        depth: (points, n) distance along the optical axis in solver units; depth_weight: (points, n) one over its
            standard deviation, zero where there is none.
        unit, offset: of the observations; perspective: True with intrinsics.
    """

    frame: Int[Tensor, "points n"]
    seen: Bool[Tensor, "points n"]
    xy: Float[Tensor, "points n 2"]
    weight: Float[Tensor, "points n 2 2"]
    depth: Float[Tensor, "points n"] | None
    depth_weight: Float[Tensor, "points n"] | None
    unit: Float[Tensor, ""]
    offset: Float[Tensor, " 2"]
    perspective: bool

    def select(self, points: Int[Tensor, " m"], longest: int | None = None) -> Packed:
        """The same for some of the points, cut to their ``longest`` track."""
        return Packed(
            self.frame[points, :longest],
            self.seen[points, :longest],
            self.xy[points, :longest],
            self.weight[points, :longest],
            None if self.depth is None else self.depth[points, :longest],
            None if self.depth_weight is None else self.depth_weight[points, :longest],
            self.unit,
            self.offset,
            self.perspective,
        )

    @cached_property
    def batches(self) -> list[tuple[Int[Tensor, " m"], Packed]]:
        """Points of like length together, with their indices: most tracks are far shorter than the longest, and the
        cost of one grows with the cube of its length. No batch is larger than what a processor holds close by."""
        count = self.seen.sum(1)
        order = torch.argsort(count, stable=True)
        lengths = count[order].tolist()
        parts, first = [], 0
        while first < len(lengths):
            last = first + 1
            while (
                last < len(lengths)
                and lengths[last] <= max(4, 1.25 * lengths[first])
                and (last + 1 - first) * lengths[last] ** 2 <= _BATCH
            ):
                last += 1
            points = order[first:last]
            parts.append((points, self.select(points, max(1, lengths[last - 1]))))
            first = last
        return parts


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Pose of every frame in solver units: rotations (F, 3, 3), translation (F, 2), and the logarithm of the image
    scale (F,): for a pinhole the body is ``exp(-log_scale) / unit`` away."""

    rotations: Float[Tensor, "frames 3 3"]
    translation: Float[Tensor, "frames 2"]
    log_scale: Float[Tensor, " frames"]


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Covariance of rest positions (3, 3), kernels of the classes (C, F, F), their log shares (C,)."""

    rest: Float[Tensor, "3 3"]
    kernels: Float[Tensor, "classes frames frames"]
    log_share: Float[Tensor, " classes"]


def matern32(times: Float[Tensor, " frames"], length: float) -> Float[Tensor, "frames frames"]:
    """Matern-3/2 kernel of variance one: paths with a velocity but rough acceleration, as limbs have.

    Example:
        >>> import torch
        >>> matern32(torch.tensor([0.0, 1.0]), 1.0).diagonal().tolist()
        [1.0, 1.0]
    """
    r = math.sqrt(3.0) * (times[:, None] - times[None, :]).abs() / length
    return (1 + r) * torch.exp(-r)


def pack(data: Observations, every: int = 1) -> Packed:
    """Gather the seen entries of every point; ``every`` keeps each n-th frame only (indices stay those of the film)."""
    visible = data.visible
    if every > 1:
        kept = torch.zeros_like(visible)
        kept[::every] = True
        visible = visible & kept
    longest = max(1, int(visible.sum(0).max()))
    order = torch.argsort((~visible).to(torch.int8), dim=0, stable=True)[:longest].T.contiguous()
    seen = visible.T.gather(1, order)
    points = torch.arange(visible.shape[1], device=order.device)[:, None]
    zero = data.xy.new_zeros(())
    weight = torch.where(seen[..., None, None], data.weight[order, points], zero)
    depth = depth_weight = None
    if data.tracks.depth is not None:
        measured = data.tracks.depth[order, points]
        there = seen & torch.isfinite(measured)
        length = data.length
        depth = torch.where(there, measured / length, zero)
        variance = data.tracks.depth_variance
        spread = depth.new_full(depth.shape, 0.02) if variance is None else variance[order, points].sqrt() / length
        depth_weight = torch.where(there, 1 / torch.where(there, spread, spread.new_ones(())), zero)
    perspective = data.tracks.intrinsics is not None
    return Packed(order, seen, data.xy[order, points], weight, depth, depth_weight, data.unit, data.offset, perspective)


def _rows(packed: Packed, path: CameraPath, noise: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Whitened rows (P, m, 3) of the linear observations, their targets (P, m), frames (P, m), and which are real."""
    rotations, shift = path.rotations[packed.frame], path.translation[packed.frame]
    log_scale = path.log_scale[packed.frame]
    if packed.perspective:
        tangent = packed.offset + packed.unit * packed.xy
        distance = torch.exp(-log_scale) / packed.unit
        rows = rotations[..., :2, :] - tangent[..., None] * rotations[..., 2:, :]
        target = tangent * distance[..., None] - shift
    else:
        distance = torch.zeros_like(log_scale)
        rows = rotations[..., :2, :] * torch.exp(log_scale)[..., None, None]
        target = packed.xy - shift
    rows = packed.weight @ rows / noise
    target = (packed.weight @ target[..., None])[..., 0] / noise
    real = packed.seen[..., None].expand_as(target)
    if packed.depth is not None and packed.depth_weight is not None:
        rows = torch.cat([rows, (packed.depth_weight[..., None] * rotations[..., 2, :])[..., None, :]], -2)
        target = torch.cat([target, (packed.depth_weight * (packed.depth - distance))[..., None]], -1)
        real = torch.cat([real, (packed.depth_weight > 0)[..., None]], -1)
    frame = packed.frame[..., None].expand_as(target)
    return rows.flatten(1, 2), target.flatten(1), frame.flatten(1), real.flatten(1)


def _factor(
    rows: Tensor, target: Tensor, frame: Tensor, prior: MotionPrior, index: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Kernel entries, Cholesky factor, ``K^-1 target`` and log-likelihood (no constants) of each point in a class."""
    frames = prior.kernels.shape[-1]
    kernel = prior.kernels[index].reshape(-1)[frame[:, :, None] * frames + frame[:, None, :]]
    covariance = rows @ prior.rest @ rows.mT + kernel * (rows @ rows.mT)
    covariance.diagonal(dim1=1, dim2=2).add_(1.0)
    factor = torch.linalg.cholesky(covariance)
    solved = torch.cholesky_solve(target[..., None], factor)[..., 0]
    value = -0.5 * (target * solved).sum(-1) - factor.diagonal(dim1=1, dim2=2).log().sum(-1)
    return kernel, factor, solved, value


class _Likelihood(torch.autograd.Function):
    """Negative log-likelihood with its analytic gradient; autograd through the factor costs several times more."""

    @staticmethod
    def forward(ctx, rows, target, frame, prior):  # type: ignore[no-untyped-def]
        parts = [_factor(rows, target, frame, prior, c) for c in range(len(prior.kernels))]
        joint = torch.stack([part[3] for part in parts]) + prior.log_share[:, None]
        total = torch.logsumexp(joint, 0)
        share = (joint - total).exp()
        slope_rows, slope_target = torch.zeros_like(rows), torch.zeros_like(target)
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            rest = rows @ prior.rest
            for (kernel, factor, solved, _), weight in zip(parts, share, strict=True):
                excess = torch.cholesky_inverse(factor) - solved[:, :, None] * solved[:, None, :]
                slope_rows += weight[:, None, None] * (excess @ rest + (excess * kernel) @ rows)
                slope_target += weight[:, None] * solved
        ctx.save_for_backward(slope_rows, slope_target)
        return -total.sum()

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        slope_rows, slope_target = ctx.saved_tensors
        return grad * slope_rows, grad * slope_target, None, None


def negative_log_likelihood(packed: Packed, path: CameraPath, prior: MotionPrior, noise: float) -> Float[Tensor, ""]:
    """Minus the log-likelihood of all points in nats (constants left out); differentiable in the camera path.

    Args:
        noise: standard deviation of the whitened observations.
    """
    total = path.rotations.new_zeros(())
    for _, batch in packed.batches:
        rows, target, frame, real = _rows(batch, path, noise)
        value: Tensor = _Likelihood.apply(rows, target, frame, prior)
        total = total + value + real.sum() * math.log(noise)
    return total


def posterior_points(
    packed: Packed, path: CameraPath, prior: MotionPrior, noise: float
) -> tuple[Float[Tensor, "frames points 3"], Float[Tensor, "frames points 3 3"], Float[Tensor, "classes points"]]:
    """Mean and covariance of every point in every frame in canonical axes, and its share in each class.

    Entries that were not seen are predicted from the same point's other entries and are as uncertain as that is.
    The covariance is that of the likeliest class; the noise and the camera are taken as known.
    """
    answers = [_posterior(batch, path, prior, noise) for _, batch in packed.batches]
    back = torch.argsort(torch.cat([points for points, _ in packed.batches]))
    mean, covariance = (torch.cat([answer[i] for answer in answers])[back].transpose(0, 1) for i in (0, 1))
    return mean, covariance, torch.cat([answer[2] for answer in answers], 1)[:, back]


def _posterior(packed: Packed, path: CameraPath, prior: MotionPrior, noise: float) -> tuple[Tensor, Tensor, Tensor]:
    """Mean (points, frames, 3), covariance (points, frames, 3, 3) and shares (classes, points) of one batch."""
    rows, target, frame, _ = _rows(packed, path, noise)
    points, size, _ = rows.shape
    frames = prior.kernels.shape[-1]
    parts = [_factor(rows, target, frame, prior, c) for c in range(len(prior.kernels))]
    joint = torch.stack([part[3] for part in parts]) + prior.log_share[:, None]
    share = (joint - torch.logsumexp(joint, 0)).exp()
    mean = rows.new_zeros(points, frames, 3)
    for c, (_, _, solved, _) in enumerate(parts):
        pull = rows.new_zeros(points, frames, 3)
        pull.scatter_add_(1, frame[..., None].expand(-1, -1, 3), solved[..., None] * rows)
        moved = pull.sum(1, keepdim=True) @ prior.rest + prior.kernels[c] @ pull
        mean += share[c][:, None, None] * moved
    likeliest = share.argmax(0)
    factor = torch.stack([part[1] for part in parts])[likeliest, torch.arange(points, device=rows.device)]
    kernels = prior.kernels[likeliest]
    across = kernels.gather(2, frame[:, None, :].expand(-1, frames, -1))
    cross = (rows @ prior.rest)[:, None] + across[..., None] * rows[:, None]
    white = torch.linalg.solve_triangular(factor, cross.transpose(1, 2).flatten(2), upper=False)
    white = white.view(points, size, frames, 3)
    eye = torch.eye(3, dtype=rows.dtype, device=rows.device)
    before = prior.rest + kernels.diagonal(dim1=1, dim2=2)[..., None, None] * eye
    covariance = before - torch.einsum("pmfi,pmfj->pfij", white, white)
    return mean, covariance, share


def learn_kernels(
    packed: Packed, path: CameraPath, prior: MotionPrior, noise: float, *, weight: float, iterations: int
) -> MotionPrior:
    """Kernels and shares of the classes from the tracks themselves, by expectation maximisation.

    Each kernel becomes the mean second moment of the deviations of its points, ``G + G S G / n`` with S the slope of
    the likelihood, drawn towards the kernel it began with as by ``weight`` coordinates more (inverse Wishart prior).

    Args:
        weight: of the first kernels (coordinates; a point in a class counts three).
        iterations: rounds; every one costs about as much as a gradient.
    """
    first, frames = prior.kernels, prior.kernels.shape[-1]
    batches = []
    for _, batch in packed.batches:
        rows, target, frame, _ = _rows(batch, path, noise)
        pairs = frame[:, :, None] * frames + frame[:, None, :]
        batches.append((rows, target, frame, pairs.flatten(), rows @ rows.mT))
    for _ in range(iterations):
        slope = torch.zeros_like(first).flatten(1)
        members = first.new_zeros(len(first))
        for rows, target, frame, index, products in batches:
            parts = [_factor(rows, target, frame, prior, c) for c in range(len(first))]
            joint = torch.stack([part[3] for part in parts]) + prior.log_share[:, None]
            share = (joint - torch.logsumexp(joint, 0)).exp()
            members += share.sum(1)
            for c, (_, factor, solved, _) in enumerate(parts):
                excess = solved[:, :, None] * solved[:, None, :] - torch.cholesky_inverse(factor)
                slope[c].index_add_(0, index, (share[c][:, None, None] * excess * products).flatten())
        count = 3 * members[:, None, None]
        kernel = prior.kernels
        moved = count * kernel + kernel @ slope.view_as(kernel) @ kernel
        kernels = (weight * first + (moved + moved.mT) / 2) / (weight + count)
        prior = MotionPrior(prior.rest, kernels, torch.log((members + 1) / (members + 1).sum()))
    return prior
