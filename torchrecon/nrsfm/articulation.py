"""Parts of a body that keep their distances: what tells answers apart between which low rank cannot choose.

The likelihood of a low-rank family is a flat valley: tilt, depth and modes give way to one another at hardly any cost.
A body is articulated, so many pairs of its points keep a constant distance while it moves. Which pairs do is not
given: every point takes the few partners to which its distance varies least in the answer that low rank has found, and
how much these distances vary is added to the likelihood, with a loss that gives up on pairs that bend after all. A
common change of all distances in a frame is taken for a change of the camera's scale and costs nothing.
Derived here; the loss is Geman and McClure's (1987).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.nrsfm.shape_likelihood import Evaluation, ShapeModel, Views, evaluate, moved

__all__ = ["Articulation", "ArticulationParams", "broken", "evaluate_with", "find_partners"]


@dataclass(frozen=True)
class ArticulationParams:
    """Parameters of the term; lengths are in units of the rms size of the tracks.

    Attributes:
        partners: of each point (count); none leaves the term out.
        blurred: deviation that noise gives to a distance beyond which no rigid pair can be told.
        deviation: of the distance in a rigid pair at least; noise comes on top.
        loosest: the same at most. In between, what the pairs show: markers on skin are looser than points on bones.
        keep: share of the pairs that keep to what they show.
        gives_up: times that deviation at which a pair has lost half of its pull (no unit).
        weight: of the term against the likelihood; pairs are many and not independent (no unit).
        judged: deviation at which it is asked whether a body is articulated at all.
        believed: share of what the term can cost there up to which it is.
        fallen: the same relative to what it was without the term. Six random smooth deformations kept .90 to .99, exact
            families of few modes .54 to .66: the solver leaves those out.
        steps: quasi-Newton steps with the term (count).
    """

    partners: int = 3
    blurred: float = 0.1
    deviation: float = 0.002
    loosest: float = 0.02
    keep: float = 0.75
    gives_up: float = 2.0
    weight: float = 0.5
    judged: float = 0.01
    believed: float = 0.33
    fallen: float = 0.67
    steps: int = 25


@dataclass(frozen=True, eq=False)
class Articulation:
    """Pairs of points that are taken to keep their distance.

    Attributes:
        pairs: (pairs, 2) indices of points.
        width: deviation of the distance in a rigid pair.
        noise: variance of a coordinate that is measured.
        gives_up, weight: as in the parameters.
    """

    pairs: Int[Tensor, "pairs 2"]
    width: float
    noise: float
    gives_up: float
    weight: float

    def cost(self, points: Float[Tensor, "*b frames points 3"]) -> Float[Tensor, "*b"]:
        """What the variation of the distances costs, nats; points in camera axes."""
        return 0.5 * self.weight * self.gives_up**2 * points.shape[-3] * self._lost(points).sum(-1)

    def unmet(self, points: Float[Tensor, "*b frames points 3"]) -> Float[Tensor, "*b"]:
        """Share of what the term can cost at most, zero for rigid pairs and one where all have given up."""
        return self._lost(points).mean(-1)

    def _lost(self, points: Tensor) -> Float[Tensor, "*b pairs"]:
        varies = _variation(points, self.pairs)
        return varies / (varies + self.gives_up**2 * (self.width**2 + 2 * self.noise))


def _distances(points: Tensor, pairs: Tensor) -> Float[Tensor, "*b frames pairs"]:
    apart = points[..., pairs[:, 0], :] - points[..., pairs[:, 1], :]
    # The ridge keeps the root differentiable where two points coincide.
    return (apart.square().sum(-1) + 1e-8).sqrt()


def _variation(points: Tensor, pairs: Tensor) -> Float[Tensor, "*b pairs"]:
    """Variance over frames of each distance, a common factor of every frame taken out."""
    distance = _distances(points, pairs)
    logarithm = distance.log()
    common = (logarithm - logarithm.mean(-2, keepdim=True)).mean(-1, keepdim=True)
    return (distance * torch.exp(-common)).var(-2, correction=0)


@torch.no_grad()
def find_partners(
    points: Float[Tensor, "frames points 3"], noise: float, params: ArticulationParams
) -> Articulation | None:
    """For each point the partners to which its distance varies least.

    None where there are fewer than three frames, where noise hides what is rigid, or where so many partners were more
    than a third of all points: of a handful of points the best pairs say little.

    Args:
        noise: variance of a coordinate that is measured.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> rest, away = torch.randn(12, 3, generator=g), torch.randn(40, 1, 3, generator=g)
        >>> points = torch.cat([rest[:6].expand(40, 6, 3), rest[6:] + away], 1)  # two rigid halves
        >>> found = find_partners(points, 0.0, ArticulationParams(partners=2))
        >>> bool(((found.pairs < 6).sum(-1) != 1).all())  # no pair joins them
        True
    """
    frames, count = points.shape[:2]
    if not 0 < 3 * params.partners < count or frames < 3 or 2 * noise > params.blurred**2:
        return None
    first, second = torch.triu_indices(count, count, 1, device=points.device)
    varies = _distances(points, torch.stack([first, second], -1)).var(0, correction=0)
    table = torch.full((count, count), torch.inf, dtype=points.dtype, device=points.device)
    table[first, second] = varies
    table[second, first] = varies
    nearest = table.topk(params.partners, largest=False).indices
    own = torch.arange(count, device=points.device)[:, None].expand_as(nearest)
    pairs = torch.stack([torch.minimum(own, nearest), torch.maximum(own, nearest)], -1).flatten(0, 1).unique(dim=0)
    shown = float(_variation(points, pairs).quantile(params.keep)) - 2 * noise
    width = min(max(shown, 0.0) ** 0.5, params.loosest)
    width = max(width, params.deviation)
    return Articulation(pairs, width, noise, params.gives_up, params.weight)


def broken(points: Float[Tensor, "frames points 3"], noise: float, params: ArticulationParams) -> float:
    """How far a body is from keeping the distances in its pairs to ``params.judged``: 0 for rigid parts, 1 for none.

    Args:
        noise: variance of a coordinate that is measured.

    Example:
        >>> import torch
        >>> points = torch.randn(40, 12, 3, generator=torch.Generator().manual_seed(0))
        >>> broken(points, 0.0, ArticulationParams()) > 0.9
        True
    """
    rigid = find_partners(points, noise, replace(params, deviation=params.judged, loosest=params.judged))
    return 1.0 if rigid is None else float(rigid.unmet(points))


def evaluate_with(articulation: Articulation, views: Views, model: ShapeModel, eps: float) -> Evaluation:
    """The likelihood and its gradient with the term added; its curvature and posterior are those of the likelihood."""
    with torch.enable_grad():
        pose = torch.zeros_like(model.scale)[..., None].repeat(*[1] * model.scale.ndim, 4).requires_grad_()
        mean = torch.zeros_like(model.mean).requires_grad_()
        loadings = torch.zeros_like(model.loadings).requires_grad_()
        found = evaluate(views, moved(model, pose, mean, loadings), eps)
        cost = articulation.cost(found.points)
        by_pose, by_mean, by_loadings = torch.autograd.grad(cost.sum(), (pose, mean, loadings))
    flat = by_loadings.flatten(-3, -2)
    by_loadings = (flat - model.avoided @ (model.avoided.mT @ flat)).view_as(by_loadings)
    return Evaluation(
        value=(found.value + cost).detach(),
        pose=found.pose.detach() + by_pose,
        mean=found.mean.detach() + by_mean - by_mean.mean(-2, keepdim=True),
        loadings=found.loadings.detach() + by_loadings,
        pose_fisher=found.pose_fisher.detach(),
        points=found.points.detach(),
        spread=None,
        translation=found.translation.detach(),
    )
