"""One step of the tracker: living points are predicted, matched and updated from one frame to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.features.align import Templates, align_window, identity_warp, make_templates, search_translation
from torchrecon.features.klt import pair_of_images, there_and_back
from torchrecon.features.region import Region
from torchrecon.statespace import abg_gains, abg_predict, abg_update

if TYPE_CHECKING:
    from torchrecon.features.tracking import TrackerParams

__all__ = ["Alive", "advance", "born", "match_covariance"]


@dataclass(frozen=True, eq=False)
class Alive:
    """The living tracks, one row each.

    Attributes:
        ids: (n,) number of the track.
        xy: (n, 2) pixels of the image.
        state: (n, 2, 3) alpha-beta-gamma state of x and y, per frame.
        warp: (n, 2, 5) deformation from the template to the last frame, see :func:`align_window`.
        templates: what the point looked like when its template was taken.
        anchor: (n, 2, 2) px^2, covariance of the position at which the template was taken.
        covariance: (n, 2, 2) px^2 of ``xy`` against the point first seen.
        age: (n,) frames since birth.
        score: (n,) correlation of the last match.
    """

    ids: Tensor
    xy: Tensor
    state: Tensor
    warp: Tensor
    templates: Templates
    anchor: Tensor
    covariance: Tensor
    age: Tensor
    score: Tensor

    def select(self, keep: Tensor) -> Alive:
        """The tracks at an index or boolean mask."""
        rows = {f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name != "templates"}
        return Alive(templates=self.templates.select(keep), **rows)

    def join(self, other: Alive) -> Alive:
        """Both sets of tracks."""
        mine = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "templates"}
        both = {name: torch.cat([value, getattr(other, name)]) for name, value in mine.items()}
        return Alive(templates=Templates.join(self.templates, other.templates), **both)


def _identity(count: int, like: Tensor) -> Tensor:
    return torch.eye(2, dtype=like.dtype, device=like.device).expand(count, 2, 2)


def _fine_weights(region: Region, xy: Tensor, half: int) -> Tensor | None:
    weights = region.weights(xy, half)
    return None if weights is None else weights[0]


def born(region: Region, xy: Float[Tensor, "points 2"], first_id: int, half: int, alive: Alive | None) -> Alive:
    """New tracks at ``xy`` (pixels of the image), moving at first as their living neighbours do."""
    count = len(xy)
    velocity = torch.zeros_like(xy)
    if alive is not None and len(alive.ids) > 0:
        nearest = torch.cdist(xy, alive.xy).topk(min(5, len(alive.ids)), largest=False).indices
        velocity = alive.state[:, :, 1][nearest].median(1).values
    here = xy - region.origin
    return Alive(
        ids=torch.arange(first_id, first_id + count, device=xy.device),
        xy=xy,
        state=torch.stack([xy, velocity, torch.zeros_like(xy)], -1),
        warp=identity_warp(count, xy),
        templates=make_templates(region.pyramid[0], here, half, _fine_weights(region, here, half)),
        anchor=torch.zeros(count, 2, 2).to(xy),
        covariance=torch.full((count, 2, 2), torch.nan).to(xy),
        age=torch.zeros(count, dtype=torch.long, device=xy.device),
        score=torch.ones(count).to(xy),
    )


def match_covariance(
    templates: Templates, residual: Float[Tensor, "points samples"], half: int, misfit: float = 0.0
) -> Float[Tensor, "points 2 2"]:
    """Covariance of a matched position: ``2 s_n^2 J^-1 J2 J^-1``, J the structure tensor of the template.

    The noise level comes from the median absolute deviation of the residual. Residuals of neighbouring pixels are
    correlated (the image is smoothed and interpolated, misfits of the warp are smooth), so the number of independent
    samples is lowered by the measured lag-1 correlation along both axes. Eigenvalues are kept in
    [0.05^2, half^2] px^2; the upper one means "not localised along this direction" (aperture).

    Args:
        templates: the matched windows.
        residual: in standard deviations of the template.
        half: half width of the window, pixels.
        misfit: noise that is there however quiet the sensor, in standard deviations of the template, because no warp
            fits a window of a bent surface exactly.
    """
    side = 2 * half + 1
    used = templates.weights > 0.05 * templates.weights.amax(-1, keepdim=True)
    absolute = torch.where(used, residual.abs(), torch.nan)
    deviation = 1.4826 * absolute.nanmedian(-1).values  # of a difference: sqrt(2) s_n
    noise = torch.sqrt(deviation**2 + misfit**2) * templates.deviation
    image = (residual * templates.weights.sqrt()).reshape(-1, side, side)
    power = image.square().mean((-1, -2)).clamp_min(1e-12)
    lag_x = (image[:, :, 1:] * image[:, :, :-1]).mean((-1, -2)) / power
    lag_y = (image[:, 1:, :] * image[:, :-1, :]).mean((-1, -2)) / power
    correlation = torch.stack([lag_x, lag_y], -1).clamp(0.0, 0.9)
    fewer = ((1 + correlation) / (1 - correlation)).prod(-1)
    # Noise in the template adds to its gradients (half its variance per central difference): without taking that
    # out again, a noisy window would look better localised than it is.
    total = templates.weights.sum(-1)
    weakest = torch.linalg.eigvalsh(templates.structure)[:, 0].clamp_min(0.0)
    excess = torch.minimum((deviation * templates.deviation) ** 2 / 4 * total, 0.6 * weakest)
    eye = _identity(len(residual), residual)
    ridge = (1e-4 * templates.structure.diagonal(dim1=-2, dim2=-1).sum(-1)).clamp_min(1e-12)
    inverse = torch.linalg.inv(templates.structure + (ridge - excess)[:, None, None] * eye)
    covariance = (noise**2 * fewer)[:, None, None] * (inverse @ templates.structure2 @ inverse)
    values, vectors = torch.linalg.eigh((covariance + covariance.mT) / 2)
    clamped: Tensor = vectors @ torch.diag_embed(values.clamp(0.05**2, float(half) ** 2)) @ vectors.mT
    return clamped


def _stretch(affine: Tensor) -> Tensor:
    """Largest factor by which an affine map stretches or shrinks a direction."""
    half_power = affine.square().sum((-1, -2)) / 2
    determinant = (affine[:, 0, 0] * affine[:, 1, 1] - affine[:, 0, 1] * affine[:, 1, 0]).abs().clamp_min(1e-6)
    larger = torch.sqrt(half_power + torch.sqrt((half_power**2 - determinant**2).clamp_min(0)))
    return torch.maximum(larger, larger / determinant)


def _bend(affine: Tensor, scale: float) -> Tensor:
    """Variance (n, 2, 2) of a match by the surface being bent: its deviation grows with the stretch of the window.

    An affine map carries a window exactly only on a plane. On a limb the window's outer parts lie deeper than its
    centre, and move against it by more the further the surface has turned since the template was taken. The error
    is the same in every later match with this template, so no average over frames or neighbours lowers it.
    """
    return ((_stretch(affine) - 1.0) * scale).square()[:, None, None] * _identity(len(affine), affine)


def _local_motion(
    xy: Tensor, moved: Tensor, covariance: Tensor, trusted: Tensor, count: int, alike: float
) -> tuple[Tensor, Tensor]:
    """Where each point would be if it moved as its neighbours do, and the variance (px^2) of that guess.

    An affine motion is fitted to the displacements of the ``count`` nearest trusted others; the variance is the
    scatter of the neighbours about the fit. The better localised ones weigh more, and those that moved as the point
    itself did, to within ``alike`` pixels: on a limb most neighbours may lie on the trunk behind it. Where nobody
    moved like the point the weights are even again, and the fit says that it is alone.
    """
    total = int(trusted.sum())
    if total < 6:
        return moved, torch.full_like(moved[:, 0], 1e6)
    distance = torch.cdist(xy, xy).fill_diagonal_(torch.inf)
    distance = distance.masked_fill(~trusted, torch.inf)
    near, index = distance.topk(min(count, total - 1), largest=False)
    weight = 1.0 / (covariance.diagonal(dim1=-2, dim2=-1).sum(-1)[index] + 0.02)
    weight = weight * torch.exp(-0.5 * (near / near.median(1, keepdim=True).values.clamp_min(1.0)) ** 2)
    weight = torch.where(torch.isfinite(near), weight, torch.zeros_like(weight))
    step = moved - xy
    apart = (step[index] - step[:, None]).square().sum(-1)
    weight = weight / (1.0 + apart / alike**2) ** 2
    scale = near.median(1).values.clamp_min(1.0)[:, None, None]
    offset = (xy[index] - xy[:, None]) / scale
    design = torch.cat([torch.ones_like(offset[..., :1]), offset], -1)
    normal = (design * weight[..., None]).mT @ design
    ridge = weight.sum(1)[:, None, None] * torch.diag(xy.new_tensor([1e-4, 0.1, 0.1]))
    fit = torch.linalg.solve(normal + ridge, (design * weight[..., None]).mT @ step[index])
    rest = (step[index] - design @ fit).square().sum(-1) / 2
    # Median, not mean: one stray neighbour must not widen the gate; ln 2 is the median of that chi^2.
    return xy + fit[:, 0], rest.median(1).values / math.log(2.0)


def _search(alive: Alive, last: Region, now: Region, guess: Tensor, params: TrackerParams) -> tuple[Tensor, Tensor]:
    """Where each point went from the last frame, pixels of the image, and whether it came back when followed back.

    From the prediction; where that fails from where the neighbours' motion puts it; where that fails too, from the
    best whole-pixel shift. What fails all three is left where the neighbours put it, to be judged by its template.
    """
    images = pair_of_images(last, now)
    moved, returned = there_and_back(images, alive.xy, guess, params.search_window, params.levels)

    def again(lost: Tensor, begin: Tensor, levels: int) -> Tensor:
        second, missed = there_and_back(images, alive.xy[lost], begin, params.search_window, levels)
        better = missed < params.max_backward
        at = lost.nonzero()[better, 0]
        moved[at], returned[at] = second[better], missed[better]
        return returned >= params.max_backward

    lost = returned >= params.max_backward
    if lost.any() and int((~lost).sum()) >= 6:
        even = _identity(len(moved), moved)
        near, _ = _local_motion(alive.xy, moved, even, ~lost, 12, params.alike * now.size / 100.0)
        moved[lost] = near[lost]
        lost = again(lost, near[lost], max(1, params.levels - 1))
    if lost.any():
        start, begin, half = (alive.xy - last.origin)[lost], (moved - now.origin)[lost], params.window
        weights = last.weights(start, half)
        where = search_translation(
            last.pyramid[1], now.pyramid[1], start / 2, begin / 2, half,
            math.ceil(params.reach * now.size / 200.0), None if weights is None else weights[1],
        )  # fmt: skip
        lost = again(lost, 2 * where + now.origin, max(1, params.levels - 1))
    return moved, ~lost


def advance(alive: Alive, last: Region, now: Region, params: TrackerParams) -> Alive:
    """Carry living tracks from the last frame into this one; tracks that fail a check are left out.

    Match: search from the last frame (:func:`_search`), then affine against the track's own template, which does not
    drift. Where the template no longer fits but the last frame does, the template is taken anew from the last frame
    and the error of the position there stays with the track (``anchor``).
    """
    half, percent = params.window, now.size / 100.0
    predicted = abg_predict(alive.state, 1.0)
    start = alive.xy - last.origin
    moved, found_back = _search(alive, last, now, predicted[..., 0], params)
    moved = moved - now.origin
    image = now.pyramid[0]
    xy, warp, score, residual = align_window(alive.templates, image, moved, alive.warp, half, params.iterations)

    def fits(position: Tensor, deform: Tensor, correlation: Tensor, least: float) -> Tensor:
        near = (position - moved).norm(dim=-1) < params.max_disagreement
        return (correlation > least) & near & (_stretch(deform[..., :2]) < params.max_stretch)

    stale = ~fits(xy, warp, score, params.renew_correlation) & found_back
    templates, anchor = alive.templates, alive.anchor
    if stale.any():
        here = start[stale]
        fresh = make_templates(last.pyramid[0], here, half, _fine_weights(last, here, half))
        start_at, whole = moved[stale], identity_warp(len(here), xy)
        renewed = align_window(fresh, image, start_at, whole, half, params.iterations)
        # A window of little texture may run away in its many parameters: from one frame to the next it can do without.
        kept = align_window(fresh, image, start_at, whole, half, params.iterations, deforms=False)
        away = (renewed[0] - start_at).norm(dim=-1) >= params.max_disagreement
        away |= (renewed[2] <= params.renew_correlation) & (kept[2] >= renewed[2] - 0.1)
        templates = templates.replace_where(stale, fresh)
        xy, warp, score, residual, anchor = (v.clone() for v in (xy, warp, score, residual, anchor))
        for first, second, target in zip(renewed, kept, (xy, warp, score, residual), strict=True):
            target[stale] = torch.where(away.reshape(-1, *[1] * (first.ndim - 1)), second, first)
        anchor[stale] = torch.nan_to_num(alive.covariance[stale])
    match = match_covariance(templates, residual, half, params.misfit)
    # A point that the search did not bring back may still be confirmed by its template, which knows it better.
    good = fits(xy, warp, score, params.min_correlation) & torch.isfinite(xy).all(-1)
    good &= found_back | (score > params.sure_correlation)

    # Along an edge or a stripe the window says little: there the neighbours' motion decides (Kalman update).
    expected, spread = _local_motion(start, xy, match, good, 12, params.alike * percent)
    prior = torch.nan_to_num(alive.covariance) - alive.anchor - _bend(alive.warp[..., :2], params.bend * half)
    prior[stale] = 0.0
    prior = prior + (spread + (params.local_std * percent) ** 2)[:, None, None] * _identity(len(xy), xy)
    innovation = torch.linalg.inv(match + prior)
    gain = match @ innovation
    odd = expected - xy
    good &= (odd[:, None] @ innovation @ odd[..., None])[:, 0, 0] < params.gate**2
    good &= odd.norm(dim=-1) < params.max_neighbour * percent
    xy = xy + (gain @ odd[..., None])[..., 0]
    match = match - gain @ match
    covariance = anchor + (match + match.mT) / 2 + _bend(warp[..., :2], params.bend * half)
    good &= now.admits(xy) & (torch.linalg.eigvalsh(covariance)[:, -1] < (params.max_std * percent) ** 2)

    found = xy + now.origin
    state = abg_update(predicted, found, abg_gains(params.alpha), 1.0)
    # A point seen twice has a velocity; the filter starts from it instead of from a blend with a guess.
    begin = torch.stack([found, found - alive.xy, torch.zeros_like(found)], -1)
    state = torch.where((alive.age == 0)[:, None, None], begin, state)
    new = replace(
        alive, xy=found, state=state, warp=warp, templates=templates, anchor=anchor, covariance=covariance,
        age=alive.age + 1, score=score,
    )  # fmt: skip
    return new.select(good)
