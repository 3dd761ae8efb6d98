"""Measured depth of the body: filter, back-project, cut out, sample at the tracks (paper, section B)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.config import DepthParams
from torchrecon.depth import SampleParams, auto_box, backproject, bilateral_depth, range_box, sample_depth
from torchrecon.errors import ReconError
from torchrecon.measurement import Tracks

__all__ = ["BodyDepth", "body_depth", "with_depth"]


@dataclass(frozen=True, eq=False)
class BodyDepth:
    """Depth of the body in one frame.

    Attributes:
        depth: (height, width) metres, filtered; NaN where there is none.
        body: (height, width) pixels inside mask and range box.
    """

    depth: Float[Tensor, "height width"]
    body: Bool[Tensor, "height width"]


def body_depth(
    depth: Float[Tensor, "height width"],
    mask: Bool[Tensor, "height width"] | None,
    intrinsics: Float[Tensor, "3 3"],
    params: DepthParams = DepthParams(),
) -> BodyDepth:
    """Filter a depth image (13)-(16), back-project it (12) and keep what lies in the body's range box (17).

    A frame in which the sensor reaches nothing (of the mask) has no body: people walk out of a sensor's range.
    """
    filtered = bilateral_depth(depth, params=params.bilateral)
    reached = filtered > 0 if mask is None else (filtered > 0) & mask
    if not reached.any():
        return BodyDepth(filtered, reached)
    cloud = backproject(filtered[None, None], intrinsics[None].to(filtered))[0]
    centre, half = auto_box(cloud, mask, params.box)
    body = range_box(cloud.permute(1, 2, 0), centre, half)
    return BodyDepth(filtered, body if mask is None else body & mask)


def with_depth(
    tracks: Tracks,
    depths: Iterable[Float[Tensor, "height width"]],
    intrinsics: Float[Tensor, "3 3"],
    params: SampleParams = DepthParams().sample,
) -> Tracks:
    """Tracks with the depth, and its variance, under every observation; where the surface is not clear, by default,
    that of the body around it, and NaN where there is none.

    Raises:
        ReconError: no observation has a depth.
    """
    sampled = [sample_depth(d.to(xy), xy, params) for d, xy in zip(depths, tracks.xy, strict=True)]
    depth, variance = (torch.stack(values) for values in zip(*sampled, strict=True))
    if not torch.isfinite(depth[tracks.visible]).any():
        raise ReconError(
            "depth: no tracked point has one in any frame; is it registered to the colour images, and in metres?"
        )
    return replace(tracks, intrinsics=intrinsics, depth=depth, depth_variance=variance)
