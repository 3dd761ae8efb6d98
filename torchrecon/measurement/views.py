"""Tracks as the matrices that factorisation works on."""

from __future__ import annotations

from typing import Literal

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.measurement.tracks import Tracks

__all__ = ["centre_tracks", "stack_matrix", "tracks_to_matrix", "vector_matrix"]


def stack_matrix(xy: Float[Tensor, "*batch frames points 2"]) -> Float[Tensor, "*batch 2*frames points"]:
    """Rows u_1, v_1, u_2, v_2, ...: the 2F x P measurement matrix W of the factorisation literature.

    Example:
        >>> import torch
        >>> stack_matrix(torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])).tolist()
        [[1.0, 3.0], [2.0, 4.0]]
    """
    return xy.transpose(-1, -2).flatten(-3, -2)


def vector_matrix(xy: Float[Tensor, "*batch frames points 2"]) -> Float[Tensor, "*batch frames 2*points"]:
    """Row i is [u_i1 .. u_iP, v_i1 .. v_iP] (paper, before eq. 18).

    Example:
        >>> import torch
        >>> vector_matrix(torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])).tolist()
        [[1.0, 3.0, 2.0, 4.0]]
    """
    return xy.transpose(-1, -2).flatten(-2)


def centre_tracks(
    xy: Float[Tensor, "*batch frames points 2"], visible: Bool[Tensor, "*batch frames points"]
) -> tuple[Float[Tensor, "*batch frames points 2"], Float[Tensor, "*batch frames 2"]]:
    """Subtract from each frame the mean over the points that are visible in ALL frames.

    A mean over a changing visible subset would inject motion that the body does not have; where no point is
    visible throughout, the translation has to be solved inside the factorisation and this raises.

    Returns:
        centred: invisible entries are NaN.
        centroid: pixels.

    Raises:
        ReconError: no point is visible in every frame.
    """
    always = visible.all(-2, keepdim=True)
    count = always.sum(-1)
    if (count == 0).any():
        raise ReconError("centre_tracks: no point is visible in every frame; solve the translation with the shape")
    weight = always[..., None].to(xy.dtype)
    centroid = (torch.nan_to_num(xy) * weight).sum(-2) / count[..., None].to(xy.dtype)
    centred = torch.where(visible[..., None], xy - centroid[..., None, :], xy.new_tensor(float("nan")))
    return centred, centroid


def tracks_to_matrix(tracks: Tracks, layout: Literal["stack", "vector"] = "stack") -> Float[Tensor, "*batch rows cols"]:
    """Centred tracks in one of the two layouts; entries that were not seen are NaN.

    Example:
        >>> import torch
        >>> tracks_to_matrix(Tracks(torch.rand(6, 4, 2)), "vector").shape
        torch.Size([6, 8])
    """
    if layout not in ("stack", "vector"):
        raise ReconError(f"layout: {layout!r} is not known; use 'stack' (2F x P) or 'vector' (F x 2P)")
    centred, _ = centre_tracks(tracks.xy, tracks.visible)
    return stack_matrix(centred) if layout == "stack" else vector_matrix(centred)
