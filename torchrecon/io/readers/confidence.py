"""What a detector's confidence says about a position: one rule for every reader."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrecon.io.readers.source import Floats

__all__ = ["ConfidenceParams", "body_size", "visible_and_covariance"]


@dataclass(frozen=True)
class ConfidenceParams:
    """Confidence ``c`` to visibility and to an isotropic standard deviation ``std(c) = std(1) * c ** -power``.

    A point is visible where ``c`` is above the floor; ``c`` above 1 counts as 1 (some detectors give raw scores).
    Where every visible point has ``c = 1`` nothing is said about the noise, and the tracks get no covariance.

    The numbers are a convention, not a calibration: detectors differ in what their confidence means.

    Attributes:
        floor: body keypoints at or below it are not visible (no unit).
        body_share: std of a keypoint at ``c = 1``, as a share of the body's size in the image (no unit).
        tracker_floor: points of a point tracker at or below it are not visible (no unit).
        tracker_std: std of a tracked point at ``c = 1``, pixels.
        power: how fast the std grows as ``c`` falls (no unit).
    """

    floor: float = 0.1
    body_share: float = 0.01
    tracker_floor: float = 0.5
    tracker_std: float = 1.0
    power: float = 1.0


def body_size(xy: Floats) -> float:
    """Median over the frames of the diagonal of the box around the finite points; (frames, points, 2) to pixels.

    Example:
        >>> body_size(np.array([[[0.0, 0.0], [3.0, 4.0], [np.nan, 1.0]]]))
        5.0
    """
    seen = np.asarray(np.isfinite(xy).all(-1, keepdims=True))
    high = np.where(seen, xy, -np.inf).max(-2)
    low = np.where(seen, xy, np.inf).min(-2)
    some = seen[..., 0].any(-1)
    diagonal = np.linalg.norm(high[some] - low[some], axis=-1)
    return float(np.median(diagonal)) if len(diagonal) else 0.0


def visible_and_covariance(
    xy: Floats, confidence: Floats, params: ConfidenceParams, body: bool = True
) -> tuple[np.ndarray, Floats | None]:
    """The rule of :class:`ConfidenceParams`.

    Args:
        xy: (*batch, frames, points, 2) pixels.
        confidence: (*batch, frames, points).
        params: the rule.
        body: True for keypoints of one body, False for a point tracker's points.

    Returns:
        ``visible`` (*batch, frames, points) and the covariance (*batch, frames, points, 2, 2) in px^2, or None.

    Example:
        >>> xy = np.array([[[0.0, 0.0], [300.0, 400.0], [1.0, 1.0]]])
        >>> visible, covariance = visible_and_covariance(xy, np.array([[1.0, 0.5, 0.05]]), ConfidenceParams())
        >>> visible.tolist(), covariance[0, :2, 0, 0].round(6).tolist()
        ([[True, True, False]], [25.0, 100.0])
    """
    finite = np.isfinite(xy).all(-1)
    visible = finite & (confidence > (params.floor if body else params.tracker_floor))
    c = np.where(visible, np.minimum(confidence, 1.0), 1.0)
    if (c == 1.0).all():
        return visible, None
    shown = np.where(visible[..., None], xy, np.nan)
    best = params.body_share * body_size(shown.reshape(-1, *xy.shape[-2:])) if body else params.tracker_std
    variance = (max(best, 1e-3) * c**-params.power) ** 2
    return visible, variance[..., None, None] * np.eye(2)
