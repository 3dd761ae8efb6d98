"""The alpha-beta-gamma filter: the steady state of a Kalman filter with constant acceleration (paper, eqs. 28-29).

Convention:
    A state is (position, velocity, acceleration) of one scalar coordinate, in px, px/s, px/s^2 when ``dt`` is in
    seconds (or per frame when ``dt`` is 1). Everything is elementwise over the leading dimensions: u and v of many
    points are just a batch. With gamma = beta^2 / alpha the acceleration gain is gamma / (2 dt^2); the form
    beta^2 / (2 alpha) that stands elsewhere belongs to a gain gamma / dt^2 and must not be mixed with this one.
"""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError

__all__ = [
    "abg_alpha",
    "abg_covariance",
    "abg_gains",
    "abg_innovation_variance",
    "abg_predict",
    "abg_tracking_index",
    "abg_update",
]

Gains = tuple[Tensor, Tensor, Tensor]


def _alpha(alpha: float | Tensor) -> Tensor:
    value = torch.as_tensor(alpha)
    value = value if value.is_floating_point() else value.to(torch.get_default_dtype())
    if not ((value > 0) & (value < 1)).all():
        raise ReconError(f"alpha: {alpha} is not between 0 and 1 (exclusive); it is the position gain of the filter")
    return value


def abg_gains(alpha: float | Tensor) -> Gains:
    """The three gains that one number fixes (paper, eq. 29).

    ``beta = 2 (2 - alpha) - 4 sqrt(1 - alpha)`` and ``gamma = beta^2 / alpha``.

    Args:
        alpha: position gain in (0, 1), any shape.

    Returns:
        (alpha, beta, gamma), tensors of the shape of ``alpha``.

    Raises:
        ReconError: alpha outside (0, 1).

    Example:
        >>> [round(float(gain), 4) for gain in abg_gains(0.75)]
        [0.75, 0.5, 0.3333]
    """
    a = _alpha(alpha)
    # 2 (1 - s)^2 with s = sqrt(1 - alpha) is the same number without cancellation for small alpha
    beta = 2 * (a / (1 + torch.sqrt(1 - a))) ** 2
    return a, beta, beta**2 / a


def abg_predict(state: Float[Tensor, "*b 3"], dt: float | Tensor) -> Float[Tensor, "*b 3"]:
    """Carry a state ``dt`` ahead with constant acceleration (paper, eq. 28, first half).

    Args:
        state: (..., 3) position, velocity, acceleration.
        dt: time step, seconds (or frames); a tensor broadcasts over the leading dimensions.

    Example:
        >>> import torch
        >>> abg_predict(torch.tensor([0.0, 1.0, 2.0]), 2.0).tolist()
        [6.0, 5.0, 2.0]
    """
    x, v, a = state.unbind(-1)
    v_next = v + dt * a
    return torch.stack([x + dt * v + dt * dt * a / 2, v_next, a.expand_as(v_next)], -1)


def abg_update(
    predicted: Float[Tensor, "*b 3"], measured: Float[Tensor, "*b"], gains: Gains, dt: float | Tensor
) -> Float[Tensor, "*b 3"]:
    """Correct a prediction by a measured position (paper, eq. 28, second half).

    Args:
        predicted: (..., 3) what :func:`abg_predict` returned.
        measured: (...) position; NaN means "not seen" and leaves the prediction as it is (coasting).
        gains: from :func:`abg_gains`; scalars or one set per coordinate.
        dt: time step, the one of the prediction.

    Example:
        >>> import torch
        >>> gains = abg_gains(torch.tensor(0.75, dtype=torch.float64))
        >>> predicted = torch.zeros(3, dtype=torch.float64)
        >>> [round(x, 4) for x in abg_update(predicted, torch.tensor(1.0, dtype=torch.float64), gains, 1.0).tolist()]
        [0.75, 0.5, 0.1667]
    """
    alpha, beta, gamma = (gain.to(predicted) for gain in gains)
    residual = torch.where(torch.isnan(measured), torch.zeros_like(measured), measured - predicted[..., 0])
    step = torch.stack([alpha * residual, beta / dt * residual, gamma / (2 * dt * dt) * residual], -1)
    return predicted + step


def abg_tracking_index(alpha: float | Tensor) -> Tensor:
    """Tracking index that belongs to alpha: ``dt^2 sigma_w / sigma_v = gamma / (2 sqrt(1 - alpha))``.

    Example:
        >>> round(float(abg_tracking_index(0.75)), 4)
        0.3333
    """
    a, _, gamma = abg_gains(alpha)
    return gamma / (2 * torch.sqrt(1 - a))


def abg_alpha(tracking_index: float | Tensor) -> Tensor:
    """The alpha that is optimal (steady-state Kalman) for a tracking index.

    With ``s = sqrt(1 - alpha)`` the relation reads ``index = 2 (1 - s)^3 / (s (1 + s))``, which falls from infinity
    to 0 on (0, 1); the one root is found by bisection.

    Args:
        tracking_index: ``dt^2 sigma_w / sigma_v``, positive, any shape: sigma_w is the standard deviation of the
            change of acceleration from frame to frame (px/s^2), sigma_v that of a measured position (px).

    Example:
        >>> round(float(abg_alpha(1 / 3)), 4)
        0.75
    """
    index = torch.as_tensor(tracking_index)
    index = index if index.is_floating_point() else index.to(torch.get_default_dtype())
    if not ((index > 0) & torch.isfinite(index)).all():
        raise ReconError(f"tracking_index: {tracking_index} is not positive and finite")
    work = index.to(torch.float64)
    low, high = torch.zeros_like(work), torch.ones_like(work)
    for _ in range(60):
        s = (low + high) / 2
        above = 2 * (1 - s) ** 3 > work * s * (1 + s)
        low, high = torch.where(above, s, low), torch.where(above, high, s)
    s = (low + high) / 2
    tiny = torch.finfo(index.dtype).eps
    return (1 - s * s).to(index.dtype).clamp(tiny, 1 - tiny)


def abg_innovation_variance(alpha: float | Tensor, measurement_variance: float | Tensor) -> Tensor:
    """Variance of measured minus predicted position in the steady state: ``r / (1 - alpha)``.

    Args:
        alpha: position gain in (0, 1).
        measurement_variance: r, px^2; may be a 2x2 covariance (..., 2, 2) when ``alpha`` is a scalar.

    Example:
        >>> float(abg_innovation_variance(0.75, 0.5))
        2.0
    """
    return torch.as_tensor(measurement_variance) / (1 - _alpha(alpha))


def abg_covariance(alpha: float | Tensor, dt: float = 1.0) -> Float[Tensor, "*b 3 3"]:
    """Covariance of the updated state in the steady state, for a measurement variance of 1.

    Multiply by the variance of a measured position (px^2). Closed form of the Riccati equation of the model with
    noise input ``[dt^2/2, dt, 1]`` on (position, velocity, acceleration).

    Example:
        >>> round(float(abg_covariance(0.75)[0, 0]), 4)
        0.75
    """
    a, b, g = abg_gains(alpha)
    rest = 1 - a
    p22 = (8 * a * b + g * (b - 2 * a - 4)) / (8 * rest) / dt**2
    p23 = b * (2 * b - g) / (4 * rest) / dt**3
    p33 = g * (2 * b - g) / (4 * rest) / dt**4
    p12, p13 = b / dt, g / (2 * dt**2)
    rows = [torch.stack(row, -1) for row in ([a, p12, p13], [p12, p22, p23], [p13, p23, p33])]
    return torch.stack(rows, -2)
