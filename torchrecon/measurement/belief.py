"""What a learned prior says of a moving shape before any geometry is solved for."""

from __future__ import annotations

from dataclasses import dataclass

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["ShapeBelief"]


@dataclass(frozen=True, eq=False)
class ShapeBelief:
    """A Gaussian over the points of every frame, camera axes (x right, y down, z away).

    Attributes:
        points3d: means, centred per frame; unit: pixels of the tracks without intrinsics, metres of a person of average
            size with intrinsics.
        covariance3d: of each point by itself, in that unit squared.
        translation: of each frame, pixels without intrinsics, metres with.
        known: points that the prior knows by name; the others hang on the nearest known one.
        source: what it was learned from, for the status.

    Example:
        >>> import torch
        >>> belief = ShapeBelief(
        ...     torch.zeros(2, 4, 3), torch.eye(3).expand(2, 4, 3, 3), torch.zeros(2, 2), torch.ones(4) > 0, "nothing"
        ... )
        >>> int(belief.known.sum())
        4
    """

    points3d: Float[Tensor, "frames points 3"]
    covariance3d: Float[Tensor, "frames points 3 3"]
    translation: Float[Tensor, "frames dim"]
    known: Bool[Tensor, " points"]
    source: str
