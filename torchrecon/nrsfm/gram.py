"""Rotations from the column space of the measurement matrix by way of a Gram matrix: convex, so without starts.

If ``W = M B`` with M (2F x m) a basis of the column space, one triplet Q (m x 3) makes the rows of ``M_f Q``
orthonormal in every frame. In ``G = Q Q^T`` these conditions are linear; of the positive semidefinite G that meet
them the one of least trace is sought (a semidefinite programme, solved by splitting), its three leading eigenvectors
start a damped Gauss-Newton refinement of Q itself. The trace is taken in the basis ``U sqrt(s)``, in which a weak
column of M is dear: where several triplets fit, the one that lives in the strong columns is taken.

A turn in proportion to a shape weight violates orthonormality to second order only. Where shapes change slowly the
minimum is therefore flat along such turns: the shape seen by the camera is right, and the world frame drifts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg import rotation_from_rows
from torchrecon.linalg.gauss_newton import damped_gauss_newton

__all__ = ["GramParams", "Upgrade", "gram_upgrade", "least_trace_gram"]


@dataclass(frozen=True)
class GramParams:
    """Parameters of the upgrade.

    Attributes:
        penalty: weight of the trace against the mean squared violation of orthonormality (no unit).
        splitting: steps of the semidefinite programme (count).
        refinement: Gauss-Newton steps on Q (count).
    """

    penalty: float = 1e-3
    splitting: int = 300
    refinement: int = 200


@dataclass(frozen=True, eq=False)
class Upgrade:
    """Cameras of one sequence.

    Attributes:
        rotations: (frames, 3, 3), canonical -> camera.
        scale: (frames,) size of the rows of the motion, mean one; all ones when the views are not scaled.
        residual: mean over frames of the squared violation of orthonormality.
        converged: whether the refinement of Q ended before its limit.
    """

    rotations: Float[Tensor, "frames 3 3"]
    scale: Float[Tensor, " frames"]
    residual: float
    converged: bool


def _products(u: Tensor, v: Tensor) -> Float[Tensor, "frames packed"]:
    """Rows r with ``r . pack(G) = u^T G v``, where pack keeps the upper triangle, off-diagonals times sqrt 2."""
    i, j = torch.triu_indices(u.shape[-1], u.shape[-1], device=u.device)
    return (u[:, i] * v[:, j] + u[:, j] * v[:, i]) * torch.where(i == j, 0.5, 0.5**0.5).to(u.dtype)


def least_trace_gram(
    motion: Float[Tensor, "frames 2 m"], *, penalty: float = 1e-3, iterations: int = 300
) -> Float[Tensor, "m m"]:
    """Minimise ``penalty tr G + violation / 2`` over positive semidefinite G, by the splitting of Douglas and Rachford.

    Args:
        motion: rows of the column space, of the order of one; orthonormality is demanded of unit rows.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> rows = rotation_from_vector(torch.randn(30, 3, generator=torch.Generator().manual_seed(0)))[:, :2]
        >>> gram = least_trace_gram(rows, penalty=1e-6)
        >>> bool((gram - torch.eye(3)).abs().max() < 1e-3)
        True
    """
    u, v = motion[:, 0], motion[:, 1]
    frames, m = u.shape
    rows = torch.cat([_products(u, u), _products(v, v), 2**0.5 * _products(u, v)])
    target = torch.cat([u.new_ones(2 * frames), u.new_zeros(frames)])
    normal, right = rows.mT @ rows / frames, rows.mT @ target / frames
    weight = 0.1 * normal.diagonal().mean()
    factor = torch.linalg.cholesky(normal + weight * torch.eye(len(normal), dtype=u.dtype, device=u.device))
    i, j = torch.triu_indices(m, m, device=u.device)
    root = torch.where(i == j, 1.0, 2**0.5).to(u.dtype)
    eye = torch.eye(m, dtype=u.dtype, device=u.device)
    gram, dual = torch.zeros_like(eye), torch.zeros_like(eye)
    for _ in range(iterations):
        packed = torch.cholesky_solve((right + weight * (gram - dual)[i, j] * root)[:, None], factor)[:, 0]
        free = torch.zeros_like(eye)
        free[i, j] = packed / root
        free[j, i] = packed / root
        values, vectors = torch.linalg.eigh(free + dual - penalty / weight * eye)
        gram = (vectors * values.clamp_min(0)) @ vectors.mT
        dual = dual + free - gram
    return gram


def _orthonormality(
    motion: Float[Tensor, "frames 2 m"], scaled: bool
) -> Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]:
    """Normal equations of three residuals a frame, each condition counted once, for Q flattened.

    Unscaled: ``|a|^2 - 1, |b|^2 - 1, a.b`` for the rows a, b of ``motion_f Q``. Scaled: ``(|a|^2 - |b|^2) / n`` and
    ``2 a.b / n`` with ``n = |a|^2 + |b|^2``, which do not change when the two rows are turned or scaled in the plane,
    and the mean size of all rows, which does nothing but fix the scale of Q.
    """
    u, v = motion[:, 0], motion[:, 1]

    def evaluate(flat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q = flat.unflatten(-1, (-1, 3))
        a, b = u @ q, v @ q
        aa, bb, ab = a.square().sum(-1), b.square().sum(-1), (a * b).sum(-1)
        slope_aa = 2 * (u[:, :, None] * a[:, None, :]).flatten(1)
        slope_bb = 2 * (v[:, :, None] * b[:, None, :]).flatten(1)
        slope_ab = (u[:, :, None] * b[:, None, :] + v[:, :, None] * a[:, None, :]).flatten(1)
        if scaled:
            size, slope = aa + bb, slope_aa + slope_bb
            even, skew = (aa - bb) / size, 2 * ab / size
            residual = torch.cat([even, skew, size.mean()[None] / 2 - 1])
            jacobian = torch.cat(
                [
                    (slope_aa - slope_bb - even[:, None] * slope) / size[:, None],
                    (2 * slope_ab - skew[:, None] * slope) / size[:, None],
                    slope.mean(0, keepdim=True) / 2,
                ]
            )
        else:
            residual = torch.cat([aa - 1, bb - 1, ab])
            jacobian = torch.cat([slope_aa, slope_bb, slope_ab])
        return residual.square().sum(), jacobian.mT @ residual, jacobian.mT @ jacobian

    return evaluate


def gram_upgrade(
    stack: Float[Tensor, "rows points"], columns: int, *, scaled: bool, params: GramParams | None = None
) -> Upgrade:
    """Cameras from the ``columns`` leading left singular vectors of a centred 2F x P stack.

    Args:
        stack: rows u_1, v_1, u_2, v_2, ...; columns beyond its numerical rank are not used.
        columns: 3K.
        scaled: demand equal size and orthogonality of the two rows of a frame, and unit size in the mean only, so
            that each frame has a scale of its own; otherwise unit size in every frame. With more than one basis a
            scale and a common change of all weights are the same thing; the one found is near to constant.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> g = torch.Generator().manual_seed(0)
        >>> rows = rotation_from_vector(torch.randn(30, 3, generator=g))[:, :2]
        >>> upgrade = gram_upgrade((rows @ torch.randn(3, 9, generator=g)).flatten(0, 1), 3, scaled=False)
        >>> upgrade.rotations.shape, upgrade.residual < 1e-6
        (torch.Size([30, 3, 3]), True)
    """
    params = params or GramParams()
    u, s, _ = torch.linalg.svd(stack, full_matrices=False)
    noise = torch.finfo(s.dtype).eps * max(stack.shape) * s[0]
    kept = max(1, min(columns, int((s > noise).sum())))
    frames = stack.shape[0] // 2
    root = (s[:kept] / s[0].clamp_min(torch.finfo(s.dtype).tiny)).sqrt()
    motion = (u[:, :kept] * root * frames**0.5).unflatten(0, (frames, 2))
    gram = least_trace_gram(motion, penalty=params.penalty, iterations=params.splitting)
    values, vectors = torch.linalg.eigh(gram)
    q = vectors[:, -3:] * values[-3:].clamp_min(0).sqrt()
    q = torch.nn.functional.pad(q, (3 - q.shape[1], 0))
    exact = frames * torch.finfo(s.dtype).eps
    flat, cost, converged = damped_gauss_newton(
        _orthonormality(motion, scaled), q.flatten(), params.refinement, enough=exact
    )
    rows = motion @ flat.unflatten(-1, (-1, 3))
    scale = (rows.square().sum((-1, -2)) / 2).sqrt() if scaled else torch.ones_like(rows[:, 0, 0])
    return Upgrade(rotation_from_rows(rows), scale / scale.mean(), float(cost) / frames, bool(converged))
