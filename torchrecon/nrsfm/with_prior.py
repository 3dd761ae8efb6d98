"""A solver's answer and a learned prior as two Gaussians over one shape.

Where the view determines the shape, the solver's answer is made more precise by the prior, which also tells the mirror.
Where it does not, the depth is the prior's, and the status says so.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.measurement import Reconstruction, ShapeBelief, ShapePrior, Solver, Status, Tracks
from torchrecon.nrsfm.base import solve_items

__all__ = ["CONTRADICTION", "fuse", "with_prior"]

CONTRADICTION = 2.0
"""Mean squared distance in depth between solver and prior, over that which their spreads allow (1 where both hold)."""


def with_prior(solver: Solver, prior: ShapePrior) -> Solver:
    """A solver that also asks a prior; any leading batch.

    Raises:
        ReconError: from the prior, where the points are not what it knows.

    Example:
        >>> import torch
        >>> from torchrecon.nrsfm.rigid import rigid
        >>> class Flat:
        ...     def __call__(self, tracks):
        ...         points = torch.nn.functional.pad(tracks.xy, (0, 1))
        ...         spread = torch.eye(3).expand(*points.shape, 3)
        ...         return ShapeBelief(points - points.mean(1, keepdim=True), spread, points.mean(1)[:, :2],
        ...                            torch.ones(points.shape[1]) > 0, "a guess")
        >>> still = torch.rand(9, 3, generator=torch.Generator().manual_seed(0))[:, :2].expand(6, 9, 2)
        >>> with_prior(rigid, Flat())(Tracks(still), 1).status.code
        'undetermined'
    """

    def solve(
        tracks: Tracks, rank: int | Int[Tensor, "*batch"], *, generator: torch.Generator | None = None
    ) -> Reconstruction:
        def solve_one(item: Tracks, k: int, source: torch.Generator) -> Reconstruction:
            belief = prior(item)  # first: it refuses points that it does not know before anything is solved
            return fuse(solver(item, k, generator=source), belief, item)

        return solve_items(tracks, rank, solve_one, generator)

    return solve


def fuse(answer: Reconstruction, belief: ShapeBelief, tracks: Tracks) -> Reconstruction:
    """Combine the solver's answer and the prior's belief for one sequence.

    Without ``ok`` from the solver, and without measured depth, the belief is the answer. Else the belief is brought to
    the scale of the solver's answer and chooses the mirror where there are no intrinsics. A solver states what its
    model leaves open, not whether its model holds; the prior's spread is that of real people. Where both are farther
    apart in depth than :data:`CONTRADICTION` times what the spreads allow, people do not move as the solver says, and
    the belief is the answer. Else both are multiplied as Gaussians, the solver's covariance widened, across the image
    and along depth, until it explains how far apart they are. The prior is left out for points that it does not know,
    and but for the mirror where the solver states no covariance.

    Args:
        answer: of any solver.
        belief: of the prior, same points.
        tracks: what both have seen.
    """
    found = answer.statuses[0]
    if not found.ok and tracks.depth is None:
        return _belief_alone(answer, belief, tracks, found.text)
    prior = belief.points3d
    if tracks.intrinsics is None and _misfit(answer.mirrored().points3d, prior) < _misfit(answer.points3d, prior):
        answer = answer.mirrored()
    if answer.covariance3d is None:
        text = f"{found.text}; of the prior ({belief.source}) only the mirror is used"
        return replace(answer, status=Status("ok", text))
    image = prior[..., :2]
    scale = (answer.points3d[..., :2] * image).sum() / image.square().sum().clamp_min(torch.finfo(prior.dtype).tiny)
    eye = torch.eye(3, dtype=prior.dtype, device=prior.device)
    # The solver's covariance is singular along rays that are measured exactly; a trace of its size keeps it invertible.
    own = answer.covariance3d
    own = own + 1e-6 * (own.diagonal(dim1=-2, dim2=-1).mean() + torch.finfo(own.dtype).tiny) * eye
    apart = (scale * prior - answer.points3d)[:, belief.known].square().mean((0, 1))
    spread, stated = (
        c[:, belief.known].diagonal(dim1=-2, dim2=-1).mean((0, 1)) for c in (scale.square() * belief.covariance3d, own)
    )
    if tracks.depth is None and float(apart[2]) > CONTRADICTION * float(spread[2] + stated[2]):
        text = f"the solver's answer is not how people move: {float((apart[2] / spread[2]).sqrt()):.1f} spreads apart"
        return _belief_alone(answer, belief, tracks, text)
    wider = ((apart - spread) / stated).clamp_min(1)
    wider = torch.stack([wider[:2].mean(), wider[:2].mean(), wider[2]]).sqrt()
    own = wider[:, None] * own * wider
    gain = own @ torch.linalg.inv(own + scale.square() * belief.covariance3d)
    gain = gain * belief.known[:, None, None]
    moved = (gain @ (scale * prior - answer.points3d)[..., None])[..., 0]
    points = answer.points3d + moved
    share = float(gain[..., belief.known, 2, 2].mean())
    said = f"{found.text}; the prior ({belief.source}) has {100 * share:.0f} % of the depth"
    return Reconstruction.from_points(
        points,
        answer.rotations,
        rank=answer.rank,
        status=Status("ok" if share < 0.5 else "undetermined", said),
        deformation_degree=answer.deformation_degree,
        scale=answer.scale,
        translation=answer.translation,
        covariance3d=(eye - gain) @ own,
        intrinsics=answer.intrinsics,
        observed=answer.observed,
    )


def _misfit(points: Float[Tensor, "frames points 3"], prior: Float[Tensor, "frames points 3"]) -> float:
    """What the best scale leaves, up to terms that a mirror does not change."""
    return -float((points * prior).sum())


def _belief_alone(answer: Reconstruction, belief: ShapeBelief, tracks: Tracks, why: str) -> Reconstruction:
    """The prior's answer in the form of a reconstruction; the camera stands, so its axes are the canonical ones."""
    points = belief.points3d
    depth = belief.covariance3d[..., 2, 2].clamp_min(0).sqrt()
    size = points.square().sum(-1).mean().sqrt()
    strangers = int((~belief.known).sum())
    text = (
        f"the view alone does not determine the shape ({why}); all depth is that of the prior "
        f"({belief.source}), with a standard deviation of {100 * float(depth.mean() / size):.0f} % of the rms size"
    )
    if strangers:
        text += f"; {strangers} of {points.shape[-2]} points are no joints that it knows and hang on the nearest joint"
    return Reconstruction.from_points(
        points,
        torch.eye(3, dtype=points.dtype, device=points.device).expand(len(points), 3, 3),
        rank=answer.rank,
        status=Status("undetermined", text),
        deformation_degree=answer.deformation_degree,
        translation=belief.translation,
        covariance3d=belief.covariance3d,
        intrinsics=tracks.intrinsics,
        observed=tracks.visible,
    )
