"""Damped Gauss-Newton (Levenberg-Marquardt) on normal equations, for a batch of starts at once."""

from __future__ import annotations

from collections.abc import Callable

import torch

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["damped_gauss_newton"]


def damped_gauss_newton(
    evaluate: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
    start: Float[Tensor, "*b unknowns"],
    iterations: int = 100,
    tolerance: float = 1e-8,
    enough: float = 0.0,
) -> tuple[Float[Tensor, "*b unknowns"], Float[Tensor, "*b"], Bool[Tensor, "*b"]]:
    """Minimise a sum of squares, each start with a damping of its own.

    Args:
        evaluate: from unknowns to ``r^T r`` (*b), ``J^T r`` (*b, unknowns) and ``J^T J`` (*b, unknowns, unknowns) of
            residuals r with Jacobian J.
        tolerance: relative fall of the cost in an accepted step at which a start has converged.
        enough: cost at which it has converged whatever the fall: the rounding of a problem that can be met exactly.

    Returns:
        unknowns, cost and whether the start converged before the limit.

    Example:
        >>> import torch
        >>> def rosenbrock(x):
        ...     r = torch.stack([10 * (x[..., 1] - x[..., 0] ** 2), 1 - x[..., 0]], -1)
        ...     zero, one = torch.zeros_like(x[..., 0]), torch.ones_like(x[..., 0])
        ...     j = torch.stack([torch.stack([-20 * x[..., 0], 10 * one], -1), torch.stack([-one, zero], -1)], -2)
        ...     return r.square().sum(-1), (j.mT @ r[..., None])[..., 0], j.mT @ j
        >>> damped_gauss_newton(rosenbrock, torch.tensor([[-1.2, 1.0], [3.0, -2.0]]))[0].round(decimals=3).tolist()
        [[1.0, 1.0], [1.0, 1.0]]
    """
    eps = torch.finfo(start.dtype).eps
    tiny = torch.finfo(start.dtype).tiny
    x = start
    cost, gradient, normal = evaluate(x)
    damping = torch.full_like(cost, 1e-2)
    converged = cost <= enough
    for _ in range(iterations):
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        # the share of the largest entry keeps unknowns that nothing depends on where they are
        scale = diagonal + eps * diagonal.amax(-1, keepdim=True) + tiny
        damped = normal + torch.diag_embed(damping[..., None] * scale)
        trial = x - torch.linalg.solve(damped, gradient[..., None])[..., 0]
        cost_new, gradient_new, normal_new = evaluate(trial)
        better = cost_new < cost
        fall = (cost - cost_new) / cost.clamp_min(tiny)
        converged |= (better & (fall < tolerance)) | (~better & (damping > 1e4)) | (cost_new <= enough)
        wide = better[..., None]
        x, gradient = torch.where(wide, trial, x), torch.where(wide, gradient_new, gradient)
        normal, cost = torch.where(wide[..., None], normal_new, normal), torch.where(better, cost_new, cost)
        damping = torch.where(better, damping * 0.3, damping * 4).clamp(0.1 * eps**0.5, 1e6)
        if bool(converged.all()):
            break
    return x, cost, converged
