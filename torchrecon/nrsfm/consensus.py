"""Consensus of non-rigid reconstructions (Lee, Cho and Oh 2016): many small overlapping groups of points.

A few points move more simply than a body. Each group is reconstructed on its own, all groups in one batch; the signs
of their depths are reconciled over the graph of overlaps, and the depth of every point is the one that agrees best
with the groups it belongs to, up to one offset per group and frame.

Recalled from the paper: groups of trajectories, a weak reconstruction of each, signs, a robust agreement. Derived
here: the weak reconstruction (Procrustean normal distribution, from views of the metric upgrade of all points), the
signs (leading eigenvector of the correlations over shared points) and the agreement (least absolute deviations by
reweighting). It is not the authors' code. Not used: measured depth, the covariance of observations, a prior from
frame to frame. Half the groups are neighbours in the image, half are drawn from the whole body: neighbours alone
leave the depth between distant parts to a long chain.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.linalg import nearest_rotation
from torchrecon.measurement import Reconstruction, Status, Tracks
from torchrecon.nrsfm.base import check_size, looks_static, mirror_sign, solve_items, turn_of_view
from torchrecon.nrsfm.bridging import bridging
from torchrecon.nrsfm.common import STATIC_TURN, filled
from torchrecon.nrsfm.observations import observe
from torchrecon.nrsfm.pnd2 import Pnd2Params, first_views, fit_procrustean, rigid_start
from torchrecon.nrsfm.upgrade import UpgradeParams

__all__ = ["ConsensusParams", "agree_on_depth", "agree_on_sign", "consensus", "draw_groups"]


@dataclass(frozen=True)
class ConsensusParams:
    """Parameters of the consensus.

    Attributes:
        size: points of a group (count); all points where there are no more.
        uses: groups that hold a point, on average (count).
        iterations: EM steps of every group, from each start (count).
        reweighting: rounds of the robust agreement (count).
        keep: starts that every group tries, those of the lowest residual first (count).
        weak: of the weak reconstruction of a group.
        upgrade: of the metric upgrade, which supplies the starts.
    """

    size: int = 12
    uses: int = 8
    iterations: int = 80
    reweighting: int = 10
    keep: int = 2
    weak: Pnd2Params = field(default_factory=lambda: Pnd2Params(largest_rank=8))
    upgrade: UpgradeParams = field(default_factory=UpgradeParams)


def draw_groups(
    xy: Float[Tensor, "frames points 2"], size: int, uses: int, generator: torch.Generator
) -> Int[Tensor, "groups size"]:
    """Overlapping groups of points that hold every point: random ones and neighbours in turn.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> index = draw_groups(torch.randn(5, 20, 2, generator=g), 6, 3, g)
        >>> index.shape, len(index.unique())
        (torch.Size([10, 6]), 20)
    """
    points = xy.shape[1]
    if size >= points:
        return torch.arange(points, device=xy.device)[None]
    distance = torch.cdist(xy, xy).mean(0)
    used = torch.zeros(points, dtype=torch.float64)
    chosen = []
    for index in range(-(-uses * points // size)):
        draw = torch.rand(points, generator=generator, dtype=torch.float64)
        first = int((used + draw).argmin())  # of the points used least
        pool = 2 * size if index % 2 else points
        near = distance[first].cpu().argsort()[:pool]
        near = near[near != first]
        members = near[draw[near].argsort()[: size - 1]]
        group = torch.cat([torch.tensor([first]), members])
        used[group] += 1
        chosen.append(group)
    return torch.stack(chosen).to(xy.device)


def agree_on_sign(depth: Float[Tensor, "groups frames size"], index: Int[Tensor, "groups size"]) -> Tensor:
    """+1 or -1 for each group: leading eigenvector of the correlations of depth over what two groups share."""
    points = int(index.max()) + 1
    groups, frames, size = depth.shape
    spread = depth.new_zeros(groups, frames, points)
    spread.scatter_(2, index[:, None].expand(groups, frames, size), depth)
    there = depth.new_zeros(groups, points).scatter_(1, index, 1.0)
    shared = there @ there.mT
    product = spread.flatten(1) @ spread.flatten(1).mT
    sums = torch.einsum("gfp,hp->ghf", spread, there)
    centred = product - (sums * sums.transpose(0, 1)).sum(-1) / shared.clamp_min(1)
    square = torch.einsum("gfp,hp->gh", spread.square(), there) - sums.square().sum(-1) / shared.clamp_min(1)
    size_of = (square * square.mT).clamp_min(torch.finfo(depth.dtype).tiny).sqrt()
    correlation = torch.where(shared >= 2, centred / size_of, torch.zeros_like(centred))
    leading = torch.linalg.eigh(correlation)[1][:, -1]
    return torch.where(leading < 0, -1.0, 1.0).to(depth.dtype)


def agree_on_depth(
    depth: Float[Tensor, "groups frames size"], index: Int[Tensor, "groups size"], points: int, rounds: int
) -> tuple[Float[Tensor, "frames points"], Float[Tensor, "groups frames"]]:
    """Depths that minimise the sum over groups and frames of the distance to the group's, offsets removed.

    Distances are not squared, so a group that went wrong in a frame is outvoted; reweighted least squares, from
    weights that do not let a group run away with its size.

    Returns:
        depths, and the weight of every group and frame.

    Example:
        >>> import torch
        >>> truth = torch.randn(2, 5, generator=torch.Generator().manual_seed(0))
        >>> truth = truth - truth.mean(1, keepdim=True)
        >>> index = torch.tensor([[0, 1, 2], [1, 2, 3], [2, 3, 4], [0, 1, 4]])
        >>> found, _ = agree_on_depth(truth[:, index].transpose(0, 1) + 3.0, index, 5, 3)
        >>> bool((found - truth).abs().max() < 1e-4)
        True
    """
    frames = depth.shape[1]
    pick = torch.nn.functional.one_hot(index, points).to(depth.dtype)
    pick = pick - pick.mean(1, keepdim=True)
    normal = (pick.mT @ pick).flatten(1)
    centred = depth - depth.mean(-1, keepdim=True)
    right = centred @ pick
    size = centred.square().mean(-1).sqrt()
    weight = (size.median() / size.clamp_min(torch.finfo(depth.dtype).tiny)).clamp(max=1).square()
    anchor = torch.full((points, points), 1.0 / points, dtype=depth.dtype, device=depth.device)
    floor = 1e-3 * size.median()
    found = depth.new_zeros(frames, points)
    for _ in range(rounds):
        matrix = (weight.mT @ normal).view(frames, points, points)
        scale = matrix.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
        vector = (weight[..., None] * right).sum(0)
        found = torch.linalg.solve(matrix + scale * anchor, vector[..., None])[..., 0]
        distance = (torch.einsum("gsp,fp->gfs", pick, found) - centred).square().mean(-1).sqrt()
        weight = 1 / distance.clamp_min(floor)
    return found - found.mean(1, keepdim=True), weight


def _aligned(points3d: Tensor, starts: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Rotations (F, 3, 3) and sizes (F,) that align the frames best with their mean shape (Procrustes)."""
    best = (float("-inf"), starts[0], points3d.new_ones(len(points3d)))
    for rotations in starts:
        for _ in range(20):
            mean = (points3d @ rotations).mean(0)
            rotations = nearest_rotation(points3d.mT @ mean)
        fit = ((points3d @ rotations) * mean).sum((1, 2)) / mean.square().sum()
        energy = float((points3d @ rotations).mean(0).square().sum())
        if energy > best[0]:
            best = (energy, rotations, fit / fit.mean())
    return best[1], best[2]


def solve_consensus(
    item: Tracks, rank: int, generator: torch.Generator, params: ConsensusParams | None = None
) -> Reconstruction:
    """Solve one sequence (batch ``()``); works in float64 whatever the tracks are."""
    params = params or ConsensusParams()
    data = observe(item)
    kind = data.xy.dtype
    data = replace(data, xy=data.xy.double())
    complete, _ = filled(data, 6)
    centred = complete - complete.mean(1, keepdim=True)
    starts = first_views(complete, params.upgrade, params.keep, generator)
    index = draw_groups(complete, params.size, params.uses, generator)
    xy = data.xy[:, index].transpose(0, 1)
    visible = data.visible[:, index].transpose(0, 1)
    shapes, costs = [], []
    for views in starts:
        begin = rigid_start(complete[:, index].transpose(0, 1), views.expand(len(index), *views.shape))
        model, expected, cost, _ = fit_procrustean(xy, visible, begin, params.iterations, params.weak, anneal=True)
        plane = expected[..., :2] + model.translation[..., None, :]
        shapes.append(torch.cat([plane, expected[..., 2:]], -1))
        costs.append(cost)
    best = torch.stack(costs).argmin(0)
    chosen = torch.stack(shapes)[best, torch.arange(len(index), device=xy.device)]
    depth = chosen[..., 2] * agree_on_sign(chosen[..., 2], index)[:, None, None]
    points = data.visible.shape[1]
    found, weight = agree_on_depth(depth, index, points, params.reweighting)
    # an unseen position is the mean over the groups that hold the point, by the same weights
    pick = torch.nn.functional.one_hot(index, points).to(xy.dtype)
    total = torch.einsum("gf,gfsa,gsp->fpa", weight, chosen[..., :2], pick)
    mean = total / torch.einsum("gf,gsp->fp", weight, pick)[..., None]
    plane = torch.where(data.visible[..., None], data.xy, mean)
    translation = plane.mean(1)
    points3d = torch.cat([plane - translation[:, None], found[..., None]], -1)
    flip = xy.new_ones(3)
    flip[2] = mirror_sign(points3d)
    points3d = points3d * flip
    views = starts[0]
    rotations, size = _aligned(
        points3d, [views, views * (xy.new_tensor([1, 1, -1])[:, None] * xy.new_tensor([1, 1, -1]))]
    )
    turn = float(turn_of_view(rotations))
    status = check_size(item, rank)
    if status is None and (turn < STATIC_TURN or looks_static(centred)):
        status = Status(
            "undetermined", "the tracks look as from a view that never changes; they do not determine the depth"
        )
    if status is None:
        status = Status("ok", f"{len(index)} groups agreed, view turning by {turn:.0f} degrees")
    scale = torch.ones_like(size)
    if item.intrinsics is not None:  # weak perspective: what the frames differ in is distance, not size
        scale, points3d = size, points3d / size[:, None, None]
    return data.reconstruction(
        points3d.to(kind), rotations.to(kind), scale.to(kind), translation.to(kind), rank=rank, status=status
    )


def consensus(
    tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
) -> Reconstruction:
    """Consensus of small groups from orthographic tracks, gaps allowed; any leading batch.

    Args:
        tracks: seen entries only are read.
        rank: reported as it is given; each group finds its own number of deformations.
        generator: the groups, and the starts of the metric upgrade.

    Example:
        >>> import torch
        >>> from torchrecon.linalg import rotation_from_vector
        >>> g = torch.Generator().manual_seed(0)
        >>> shape = torch.randn(14, 3, generator=g)
        >>> turn = rotation_from_vector(torch.linspace(0, 2, 15)[:, None] * torch.tensor([0.1, 1.0, 0.0]))
        >>> truth = shape @ turn.mT
        >>> rec = consensus(Tracks(truth[..., :2]), 1)
        >>> bool((rec.reproject() - truth[..., :2]).abs().max() < 1e-3), rec.status.code
        (True, 'ok')
    """
    return solve_items(tracks, rank, bridging(solve_consensus), generator)
