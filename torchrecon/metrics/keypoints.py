"""Shares of keypoints that lie near enough to the truth: 3D-PCK and PCKh. Higher is better; unit: per cent."""

from __future__ import annotations

from typing import Literal

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.metrics.points import centre_visible, similarity_align

__all__ = ["pck3d", "pckh"]

REFERENCE_STATURE = 1.80
"""Metres; thresholds of :func:`pck3d` are those of a person of this stature."""


def pck3d(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
    *,
    align: Literal["similarity", "translation"] = "similarity",
    threshold: float = 0.15,
    stature: float = REFERENCE_STATURE,
) -> Float[Tensor, "*batch"]:
    """Share of points within 150 mm of the truth ("3D-PCK"), for a person of 1.80 m.

    Alignment: ``similarity``: centring per frame, then one rotation and one scale for the whole sequence;
    ``translation``: centring per frame only, for answers in true metres. Reflection: never.

    Args:
        points3d, truth: camera axes, metres (``similarity``: any one unit of ``points3d``).
        visible: entries that count; default all.
        align: what is taken out first.
        threshold: metres at a stature of 1.80 m.
        stature: of this person, metres; the threshold grows with it.

    Raises:
        ReconError: shapes differ, an entry that counts is not finite, or a parameter is not usable.

    Example:
        >>> import torch
        >>> truth = torch.randn(5, 8, 3, generator=torch.Generator().manual_seed(0))
        >>> float(pck3d(2 * truth + 1, truth)), float(pck3d(2 * truth, truth, align="translation")) < 50
        (100.0, True)
    """
    if align not in ("similarity", "translation"):
        raise ReconError(f"align: {align!r} is not known; use 'similarity' or 'translation'")
    if not (threshold > 0 and stature > 0):
        raise ReconError(f"threshold {threshold} and stature {stature} must be positive metres")
    aligned, target = similarity_align(points3d, truth, visible)  # also checks shapes and finite entries
    mask = torch.ones_like(truth[..., 0], dtype=torch.bool) if visible is None else visible
    if align == "translation":
        aligned = centre_visible(points3d, mask)
    near = (aligned - target).square().sum(-1).sqrt() <= threshold * stature / REFERENCE_STATURE
    return 100.0 * (near & mask).sum((-1, -2)) / mask.sum((-1, -2))


def pckh(
    predicted: Float[Tensor, "*batch people joints 2"],
    truth: Float[Tensor, "*batch people joints 2"],
    head_size: Float[Tensor, "*batch people"],
    present: Bool[Tensor, "*batch people joints"] | None = None,
    *,
    threshold: float = 0.5,
) -> Float[Tensor, "*batch joints"]:
    """Share of each joint's detections within half a head of the truth (MPII Human Pose, "PCKh@0.5").

    Alignment: none. Reflection: none, left and right are told apart.

    Args:
        predicted, truth: image positions, pixels.
        head_size: 0.6 times the diagonal of the head box, pixels.
        present: joints that are annotated; others are not read and may be NaN. Default: finite truth.
        threshold: in units of ``head_size``.

    Returns:
        Per cent of the people in which the joint is annotated; NaN for a joint that never is.

    Raises:
        ReconError: shapes differ, or a head that counts has no positive size.

    Example:
        >>> import torch
        >>> truth = torch.zeros(4, 1, 2)
        >>> off = torch.tensor([0.0, 4.0, 6.0, 60.0])[:, None, None].expand(4, 1, 2) / 2**0.5
        >>> pckh(off, truth, torch.full((4,), 10.0)).tolist()
        [50.0]
    """
    if predicted.shape != truth.shape or truth.shape[-1:] != (2,) or head_size.shape != truth.shape[:-2]:
        raise ReconError(
            f"predicted {tuple(predicted.shape)}, truth {tuple(truth.shape)} and head_size {tuple(head_size.shape)} "
            "do not fit; (*batch, people, joints, 2) twice and (*batch, people) are needed"
        )
    known = torch.isfinite(truth).all(-1) if present is None else present
    if (known.any(-1) & ~(head_size > 0)).any():
        where = tuple(int(i) for i in (known.any(-1) & ~(head_size > 0)).nonzero()[0])
        raise ReconError(f"head_size: person {where} has annotated joints and no head of positive size")
    distance = (predicted - truth).square().sum(-1).sqrt() / head_size[..., None]
    near = (distance <= threshold) & known  # a prediction that is NaN is not near
    return 100.0 * near.sum(-2) / known.sum(-2).to(truth.dtype)
