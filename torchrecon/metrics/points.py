"""Errors of reconstructed 3D points; each function states its alignment, unit and whether a reflection is allowed.

Convention:
    Points are (*batch, frames, points, 3). All figures are "lower is better". Both shapes are centred per frame
    over the entries that count (``visible``), so translation never counts.
"""

from __future__ import annotations

from typing import Literal

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg import nearest_orthogonal, nearest_rotation

__all__ = [
    "centre_visible",
    "error3d_akhter",
    "error3d_camera",
    "error3d_camera_frameflip",
    "mpjpe",
    "nrmse",
    "pa_mpjpe",
    "procrustes_disparity",
    "similarity_align",
]


def _pair(points3d: Tensor, truth: Tensor, visible: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Both shapes centred over the entries that count, zeros elsewhere, and the mask."""
    if points3d.shape != truth.shape or points3d.shape[-1:] != (3,):
        raise ReconError(
            f"points3d: shape {tuple(points3d.shape)} does not fit truth {tuple(truth.shape)}; "
            "both must be (*batch, frames, points, 3)"
        )
    if visible is None:
        visible = torch.ones(truth.shape[:-1], dtype=torch.bool, device=truth.device)
    elif visible.shape != truth.shape[:-1]:
        raise ReconError(
            f"visible: shape {tuple(visible.shape)} does not fit truth; {tuple(truth.shape[:-1])} is needed"
        )
    for name, value in (("points3d", points3d), ("truth", truth)):
        wrong = visible & ~torch.isfinite(value).all(-1)
        if wrong.any():
            where = tuple(int(i) for i in wrong.nonzero()[0])
            raise ReconError(f"{name}: entry {where} is not finite; a metric over it would not be a number")
    return centre_visible(points3d, visible), centre_visible(truth, visible), visible


def centre_visible(
    points: Float[Tensor, "*batch frames points 3"], visible: Bool[Tensor, "*batch frames points"]
) -> Float[Tensor, "*batch frames points 3"]:
    """Subtract from each frame the mean over its visible points; entries that are not visible become zero.

    Example:
        >>> import torch
        >>> shape = torch.tensor([[[1.0, 0, 0], [3.0, 0, 0], [9.0, 9, 9]]])
        >>> centre_visible(shape, torch.tensor([[True, True, False]]))[0, :, 0].tolist()
        [-1.0, 1.0, 0.0]
    """
    mask = visible[..., None]
    kept = torch.where(mask, points, points.new_zeros(()))
    count = mask.sum(-2, keepdim=True).clamp_min(1)
    return torch.where(mask, kept - kept.sum(-2, keepdim=True) / count, points.new_zeros(()))


def _frame_errors(estimate: Tensor, truth: Tensor) -> Tensor:
    """||X_f - Xhat_f|| / ||X_f|| per frame; NaN for frames in which the truth has no extent."""
    size = truth.square().sum((-1, -2)).sqrt()
    distance = (truth - estimate).square().sum((-1, -2)).sqrt()
    return torch.where(size > 0, distance / size.clamp_min(torch.finfo(size.dtype).tiny), size.new_tensor(float("nan")))


def _both_flips(estimate: Tensor, truth: Tensor, align_scale: str) -> Tensor:
    """Frame errors (2, *batch, frames) of the estimate as it is and with every depth negated."""
    if align_scale not in ("none", "sequence"):
        raise ReconError(f"align_scale: {align_scale!r} is not known; use 'none' or 'sequence'")
    errors = []
    for sign in (1.0, -1.0):
        flipped = estimate * estimate.new_tensor([1.0, 1.0, sign])
        if align_scale == "sequence":
            energy = flipped.square().sum((-1, -2, -3), keepdim=True).clamp_min(torch.finfo(truth.dtype).tiny)
            flipped = flipped * (flipped * truth).sum((-1, -2, -3), keepdim=True) / energy
        errors.append(_frame_errors(flipped, truth))
    return torch.stack(errors)


def error3d_camera(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
    *,
    align_scale: Literal["none", "sequence"] = "none",
) -> Float[Tensor, "*batch"]:
    """Camera-frame error with ONE depth flip for the sequence (Lee et al.): the headline figure.

    Alignment: centring per frame, then the better of two depth signs, chosen once per sequence; no rotation.
    ``align_scale="sequence"`` also fits one least-squares scale per sequence, for answers that are known up to one
    global scale only. Unit: relative to the size of the true shape, mean over frames of ||X_f - Xhat_f|| / ||X_f||
    (frames without a visible extent are left out). Reflection: only the depth flip.

    Example:
        >>> import torch
        >>> truth = torch.randn(5, 8, 3, generator=torch.Generator().manual_seed(0))
        >>> float(error3d_camera(truth * torch.tensor([1.0, 1.0, -1.0]) + 3.0, truth)) < 1e-6
        True
    """
    estimate, target, _ = _pair(points3d, truth, visible)
    return _both_flips(estimate, target, align_scale).nanmean(-1).amin(0)


def error3d_camera_frameflip(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
    *,
    align_scale: Literal["none", "sequence"] = "none",
) -> Float[Tensor, "*batch"]:
    """As :func:`error3d_camera`, but with the better depth sign in EVERY frame: never the headline figure.

    Example:
        >>> import torch
        >>> truth = torch.randn(2, 8, 3, generator=torch.Generator().manual_seed(0))
        >>> flip = torch.tensor([[[1.0, 1.0, 1.0]], [[1.0, 1.0, -1.0]]])
        >>> float(error3d_camera_frameflip(truth * flip, truth)) < 1e-6 < float(error3d_camera(truth * flip, truth))
        True
    """
    estimate, target, _ = _pair(points3d, truth, visible)
    return _both_flips(estimate, target, align_scale).amin(0).nanmean(-1)


def error3d_akhter(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
) -> Float[Tensor, "*batch"]:
    """Mean point distance after one orthogonal 3x3 for the sequence (Akhter et al.).

    Alignment: centring per frame, then one orthogonal matrix per sequence, the polar factor of the affine
    least-squares map. Unit: sigma, the mean over frames and axes of the standard deviation over points (ddof 0) of
    the truth; no scale is fitted. Reflection: ALLOWED. Pass canonical shapes with a world-frame truth, or
    camera-frame shapes with a camera-frame truth.

    Example:
        >>> import torch
        >>> truth = torch.randn(5, 8, 3, generator=torch.Generator().manual_seed(0))
        >>> turn = torch.tensor([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
        >>> float(error3d_akhter(truth @ turn, truth)) < 1e-5
        True
    """
    estimate, target, mask = _pair(points3d, truth, visible)
    count = mask.sum(-1).clamp_min(1)
    spread = (target.square().sum(-2) / count[..., None]).sqrt()
    sigma = spread.mean((-1, -2))
    a, b = estimate.flatten(-3, -2), target.flatten(-3, -2)
    affine = torch.linalg.pinv(a.mT @ a) @ (a.mT @ b)
    aligned = estimate @ nearest_orthogonal(affine)[..., None, :, :]
    distance = (aligned - target).square().sum(-1).sqrt()
    return distance.sum((-1, -2)) / mask.sum((-1, -2)).clamp_min(1) / sigma


def mpjpe(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
) -> Float[Tensor, "*batch"]:
    """Mean distance per point. Alignment: centring only. Unit: that of ``truth``. Reflection: none.

    Example:
        >>> import torch
        >>> shape = torch.tensor([[[0.0, 0, 0], [2.0, 0, 0]]])
        >>> float(mpjpe(shape * 2, shape))
        1.0
    """
    estimate, target, mask = _pair(points3d, truth, visible)
    return (estimate - target).square().sum(-1).sqrt().sum((-1, -2)) / mask.sum((-1, -2)).clamp_min(1)


def _similarity(estimate: Tensor, target: Tensor) -> Tensor:
    """Per-frame rotation (never a reflection) and scale that bring centred ``estimate`` onto ``target``."""
    cross = estimate.mT @ target
    turned = estimate @ nearest_rotation(cross)
    energy = turned.square().sum((-1, -2), keepdim=True).clamp_min(torch.finfo(target.dtype).tiny)
    return turned * ((turned * target).sum((-1, -2), keepdim=True) / energy).clamp_min(0)


def pa_mpjpe(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
) -> Float[Tensor, "*batch"]:
    """Mean distance per point after a similarity in every frame (rotation, scale, translation).

    Alignment: per-frame similarity. Unit: that of ``truth``. Reflection: never.

    Example:
        >>> import torch
        >>> shape = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0))
        >>> float(pa_mpjpe(2 * shape + 1, shape)) < 1e-5
        True
    """
    estimate, target, mask = _pair(points3d, truth, visible)
    distance = (_similarity(estimate, target) - target).square().sum(-1).sqrt()
    return distance.sum((-1, -2)) / mask.sum((-1, -2)).clamp_min(1)


def similarity_align(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
) -> tuple[Float[Tensor, "*batch frames points 3"], Float[Tensor, "*batch frames points 3"]]:
    """Bring a whole sequence onto the truth by one rotation and one scale, after centring per frame.

    Alignment: centring per frame, one least-squares similarity per sequence. Reflection: never.

    Returns:
        aligned, target: both centred per frame over the entries that count; zero elsewhere.

    Example:
        >>> import torch
        >>> shape = torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0))
        >>> turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        >>> aligned, target = similarity_align(3 * shape @ turn + 1, shape)
        >>> bool(torch.allclose(aligned, target, atol=1e-5))
        True
    """
    estimate, target, _ = _pair(points3d, truth, visible)
    # One similarity of a sequence is that of a single frame which holds the points of all frames.
    aligned = _similarity(estimate.flatten(-3, -2), target.flatten(-3, -2))
    return aligned.unflatten(-2, estimate.shape[-3:-1]), target


def procrustes_disparity(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
) -> Float[Tensor, "*batch"]:
    """min over rotation, scale, translation of ||X - s R Y - t||^2 / ||X - mean||^2, mean over frames ("Pro-D").

    Alignment: per-frame similarity. Unit: none (a squared ratio). Reflection: never, unlike
    ``scipy.spatial.procrustes`` and torchmetrics, for which a mirrored shape scores 0.

    Example:
        >>> import torch
        >>> shape = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0))
        >>> float(procrustes_disparity(3 * shape, shape)) < 1e-8 < float(procrustes_disparity(-shape, shape))
        True
    """
    estimate, target, _ = _pair(points3d, truth, visible)
    return _frame_errors(_similarity(estimate, target), target).square().nanmean(-1)


def nrmse(
    points3d: Float[Tensor, "*batch frames points 3"],
    truth: Float[Tensor, "*batch frames points 3"],
    visible: Bool[Tensor, "*batch frames points"] | None = None,
    *,
    align_scale: Literal["none", "sequence"] = "none",
) -> Float[Tensor, "*batch"]:
    """Root mean square error of position (paper, eq. 31) in per cent of the rms distance to the centroid.

    Alignment: centring per frame and one depth flip per sequence, as in :func:`error3d_camera`;
    ``align_scale="sequence"`` fits one scale. Unit: per cent. Reflection: only the depth flip.

    Example:
        >>> import torch
        >>> truth = torch.randn(5, 8, 3, generator=torch.Generator().manual_seed(0))
        >>> round(float(nrmse(1.1 * truth, truth)), 3)
        10.0
    """
    if align_scale not in ("none", "sequence"):
        raise ReconError(f"align_scale: {align_scale!r} is not known; use 'none' or 'sequence'")
    estimate, target, _ = _pair(points3d, truth, visible)
    tiny = torch.finfo(target.dtype).tiny
    size = target.square().sum((-1, -2, -3)).clamp_min(tiny)
    figures = []
    for sign in (1.0, -1.0):
        flipped = estimate * estimate.new_tensor([1.0, 1.0, sign])
        if align_scale == "sequence":
            energy = flipped.square().sum((-1, -2, -3), keepdim=True).clamp_min(tiny)
            flipped = flipped * (flipped * target).sum((-1, -2, -3), keepdim=True) / energy
        figures.append(100.0 * ((flipped - target).square().sum((-1, -2, -3)) / size).sqrt())
    return torch.stack(figures).amin(0)
