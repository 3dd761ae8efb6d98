"""Cut the body out of the cloud by a box around it (paper, eq. 17)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["BoxParams", "auto_box", "depth_cluster", "range_box"]


@dataclass(frozen=True)
class BoxParams:
    """Parameters of :func:`depth_cluster` and :func:`auto_box`.

    Attributes:
        step: largest depth difference of two neighbouring pixels of one surface, metres per metre of depth.
        step_floor: the same, metres, for near surfaces.
        centre_width: standard deviation of the window in which a cluster has to lie, fraction of the image's smaller
            side; not used where a mask is given.
        margin: what the box is larger than the cluster on each side, metres.
        reach: how far before or behind the cluster other pixels of a mask still are the body: arms before the trunk
            and legs below a shirt are surfaces of their own, metres.
    """

    step: float = 0.02
    step_floor: float = 0.03
    centre_width: float = 0.06
    margin: float = 0.02
    reach: float = 0.7


def range_box(
    points: Float[Tensor, "*b 3"], centre: Float[Tensor, "*c 3"], half: Float[Tensor, "*c 3"]
) -> Bool[Tensor, "*b"]:
    """Which points lie in an axis-aligned box: ``max_a |p_a - c_a| / h_a <= 1``.

    The paper's (17) writes zeros in place of the points it drops; here a mask is returned, so no point at the origin
    is invented. The paper's sentence (points beyond the threshold are retained) contradicts its formula; the formula
    is followed.

    Args:
        points: metres, camera axes; NaN points are outside.
        centre: metres.
        half: half the side of the box along each axis, metres.

    Example:
        >>> import torch
        >>> points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 3.0]])
        >>> range_box(points, torch.tensor([0.0, 0.0, 2.0]), torch.tensor([0.5, 1.0, 0.5])).tolist()
        [True, False]
    """
    if not (half > 0).all():
        raise ReconError("half: every half side of the box must be positive (metres)")
    return ((points - centre).abs() / half).amax(-1) <= 1


def depth_cluster(
    depth: Float[Tensor, "height width"],
    mask: Bool[Tensor, "height width"] | None = None,
    params: BoxParams | None = None,
) -> Bool[Tensor, "height width"]:
    """The largest connected surface near the mask, or near the image centre without one.

    Neighbouring pixels belong together where their depths differ by less than the step; of the connected parts the
    one with the most pixels in the mask is taken, without a mask the one with the most weight under a Gaussian window
    at the image centre. A floor that touches the feet has no step there and joins the body unless a mask is given;
    with a mask only its pixels can belong to the cluster.

    Args:
        depth: metres; NaN, zero and negative mean "none".
        mask: pixels that may belong to the body.

    Raises:
        ReconError: no pixel with depth (in the mask).
    """
    params = params or BoxParams()
    z = torch.where(depth > 0, depth, depth.new_tensor(float("nan"))).detach().cpu().to(torch.float64).numpy()
    allowed = np.isfinite(z)
    if mask is not None:
        allowed &= mask.cpu().numpy()
    if not allowed.any():
        raise ReconError("depth: no pixel has a positive depth" + (" inside the mask" if mask is not None else ""))
    height, width = z.shape
    index = np.arange(height * width).reshape(height, width)
    pairs = []
    for a, b in (((slice(None), slice(-1)), (slice(None), slice(1, None))), ((slice(-1),), (slice(1, None),))):
        limit = np.maximum(params.step_floor, params.step * np.minimum(z[a], z[b]))
        joined = allowed[a] & allowed[b] & (np.abs(z[a] - z[b]) < limit)
        pairs.append(np.stack([index[a][joined], index[b][joined]]))
    rows, cols = np.concatenate(pairs, 1)
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, cols)), shape=(height * width,) * 2)
    _, label = connected_components(graph, directed=False)
    if mask is None:
        v, u = np.mgrid[:height, :width]
        sigma = params.centre_width * min(height, width)
        weight = np.exp(-((v - (height - 1) / 2) ** 2 + (u - (width - 1) / 2) ** 2) / (2 * sigma**2))
    else:
        weight = np.ones((height, width))
    score = np.bincount(label, weights=(weight * allowed).ravel())
    best = (label == int(score.argmax())).reshape(height, width) & allowed
    return torch.from_numpy(best).to(depth.device)


def auto_box(
    points: Float[Tensor, "3 height width"],
    mask: Bool[Tensor, "height width"] | None = None,
    params: BoxParams | None = None,
) -> tuple[Float[Tensor, "xyz=3"], Float[Tensor, "xyz=3"]]:
    """Centre and half sides of the box around the body, for :func:`range_box`.

    Args:
        points: organised cloud of :func:`torchrecon.depth.backproject`, metres; NaN where there is no depth.
        mask: pixels that may belong to the body; see :func:`depth_cluster`. All of them that lie within reach of the
            cluster are in the box: what a mask has too much of, and far behind, is not.

    Returns:
        (centre, half), metres, camera axes.

    Example:
        >>> import torch
        >>> cloud = torch.zeros(3, 20, 20)
        >>> cloud[2] = 5.0
        >>> cloud[2, 5:15, 8:12] = 2.0
        >>> centre, half = auto_box(cloud)
        >>> round(float(centre[2]), 3), round(float(half[2]), 3)
        (2.0, 0.02)
    """
    params = params or BoxParams()
    inside = depth_cluster(points[2], mask, params)
    if mask is not None:
        near, far = points[2, inside].amin() - params.reach, points[2, inside].amax() + params.reach
        inside = mask & (points[2] > near) & (points[2] < far)
    body = points[:, inside]
    low, high = body.amin(-1), body.amax(-1)
    return (low + high) / 2, (high - low) / 2 + params.margin
