"""Whether tracks can tell a shape from a deeper one whose view turns less, or a shallower one (bas-relief).

Under parallel rays a body that turns a little and a deeper body that turns less look nearly alike, and deformation can
take up the rest. So the answer is made deeper about its mean view, its turns out of the image are made smaller by the
same factor, and the search goes on from there; then the same with a shallower one. Where it ends in another shape that
explains the tracks as well, the depth is not determined, whatever the covariance around one optimum says.
After Belhumeur, Kriegman and Yuille (IJCV 1999), who show the ambiguity for one view; the test is derived here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.linalg import nearest_rotation, rotation_angle, rotation_from_vector
from torchrecon.nrsfm.quasi_newton import DescentParams, Growth, descend
from torchrecon.nrsfm.shape_likelihood import (
    Evaluation,
    ShapeModel,
    Views,
    cost_of_modes,
    evaluate,
    grow_loadings,
    tangents,
)

__all__ = ["ReliefParams", "made_deeper", "other_depth"]


@dataclass(frozen=True)
class ReliefParams:
    """Parameters of the test.

    Attributes:
        turn: change of view beyond which it is not needed (degrees).
        factor: by which the body is made deeper, then shallower (no unit).
        coarse: first standard deviation of the residual (rms sizes of the tracks).
        levels: of the residual, geometric down to that of the answer (count).
        last_rounds: of growth and descent on the last level; the others have one (count).
        evidence: what the answer has to gain over the other one (nats per observation). Public sequences whose view
            turns less than ``turn``: those that are solved (error 0.018 and 0.036) gain more, the first 0.08; seven
            filmed by still, panning and hand-held cameras (error 0.11 to 0.67) gain less.
        differs: change of the points, relative to their extent, below which the search came back to the answer.
    """

    turn: float = 90.0
    factor: float = 1.6
    coarse: float = 0.03
    levels: int = 4
    last_rounds: int = 2
    evidence: float = 0.03
    differs: float = 0.1


def made_deeper(model: ShapeModel, factor: float) -> ShapeModel:
    """The model stretched along the mean viewing direction, its turns away from it divided by the same factor.

    Example:
        >>> import torch
        >>> vectors = torch.tensor([[0.0, -0.1, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float64)
        >>> mean = torch.eye(3, dtype=torch.float64)[None]
        >>> still = ShapeModel(
        ...     rotation_from_vector(vectors)[None],
        ...     torch.ones(1, 2, dtype=torch.float64),
        ...     mean,
        ...     torch.zeros(1, 3, 3, 0, dtype=torch.float64),
        ...     torch.linalg.qr(tangents(mean))[0],
        ... )
        >>> deeper = made_deeper(still, 2.0)
        >>> deeper.mean[0].diagonal().tolist(), round(float(rotation_angle(deeper.rotations[0, 1])), 4)
        ([1.0, 1.0, 2.0], 0.05)
    """
    middle = nearest_rotation(model.rotations.sum(-3, keepdim=True))
    away = model.rotations @ middle.mT
    twist = torch.stack(
        [away[..., 2, 1] - away[..., 1, 2], away[..., 0, 2] - away[..., 2, 0], away[..., 1, 0] - away[..., 0, 1]], -1
    )
    size = twist.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(twist.dtype).tiny)
    vector = twist / size * rotation_angle(away)[..., None]
    rotations = rotation_from_vector(vector / vector.new_tensor([factor, factor, 1.0])) @ middle
    stretch = middle[..., 0, :, :].mT @ torch.diag(vector.new_tensor([1.0, 1.0, factor])) @ middle[..., 0, :, :]
    mean = model.mean @ stretch
    loadings = stretch[..., None, :, :] @ model.loadings
    avoided = torch.linalg.qr(tangents(mean))[0]
    flat = loadings.flatten(-3, -2)
    loadings = (flat - avoided @ (avoided.mT @ flat)).view_as(loadings)
    return replace(model, rotations=rotations, mean=mean, loadings=loadings, avoided=avoided)


@torch.no_grad()
def other_depth(
    views: Views,
    model: ShapeModel,
    answer: Evaluation,
    value: float,
    eps: float,
    growth: Growth,
    params: ReliefParams,
    descent: DescentParams,
) -> Float[Tensor, "frames points 3"] | None:
    """Points of a shape of other depth that explains the tracks as well, camera axes; None where there is none.

    Args:
        model, answer: batches of one.
        value: least value of the likelihood that is known for these tracks: the other shape has to come near it, and
            not to that of an answer that gave up likelihood for parts that keep their distances.
        eps: standard deviation of the residual of the answer.
    """
    fall = (eps / params.coarse) ** (1 / (params.levels - 1))
    for factor in (params.factor, 1 / params.factor):
        other = made_deeper(model, factor)
        for level in range(params.levels):
            residual = params.coarse * fall**level
            for _ in range(params.last_rounds if level == params.levels - 1 else 1):
                for _ in range(growth.growths):
                    other = grow_loadings(views, other, residual, growth.modes, growth.noise, growth.draws)
                other, found, _ = descend(views, other, residual, growth.steps, descent)
        points = evaluate(views, other, eps).points[0]
        change = float((points - answer.points[0]).norm() / answer.points[0].norm())
        # Against a rigid body the modes of the other one have to prove themselves; two families are equals.
        bends = 0.0 if model.loadings.shape[-1] else cost_of_modes(views, other)
        gain = (float(found) - value + bends) / float(views.visible.sum())
        if gain < params.evidence and change > params.differs:
            return points
    return None
