"""``estimate_rank``: one call for every rule, any pattern of gaps, any batch."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg.noise_edge import count_signals, spectrum
from torchrecon.measurement import RankEstimate, Tracks
from torchrecon.rank.band_limited import band_limited, motion_band
from torchrecon.rank.base import (
    DIVISOR,
    Spectrum,
    complete_points,
    covariance_scales,
    equal_blocks,
    rounding_floor,
    stack_spectrum,
    vector_spectrum,
    whitened_stack,
    whitened_vectors,
)
from torchrecon.rank.bootstrap import BootstrapCount, bootstrap_count
from torchrecon.rank.cross_validation import cross_validate
from torchrecon.rank.gavish_donoho import gavish_donoho_count
from torchrecon.rank.kritchman_nadler import kritchman_nadler, kritchman_nadler_count
from torchrecon.rank.mdl import mdl_count
from torchrecon.rank.mp import mp_count
from torchrecon.rank.paper import paper_count
from torchrecon.rank.tracy_widom import tracy_widom_count

__all__ = ["RULES", "estimate_rank"]

RULES = (
    "auto",
    "band_limited",
    "paper",
    "mp",
    "tracy_widom",
    "kritchman_nadler",
    "mdl",
    "gavish_donoho",
    "bootstrap",
    "cross_validation",
)
# `auto` trusts the complete points when they are at least this many and this share of all
_ENOUGH_POINTS = 12
_ENOUGH_SHARE = 0.5
# largest K that cross-validation tries when no limit is given
_MOST = 10


def estimate_rank(
    tracks: Tracks,
    rule: str = "auto",
    layout: str | None = None,
    noise_scale: str = "estimate",
    max_rank: int | None = None,
    generator: torch.Generator | None = None,
) -> RankEstimate:
    """Number K of shape bases (the mean shape counted) that stand above the noise.

    K is what the data show: a basis whose effect is below the noise, or that the camera never sees move, is not
    counted. ``auto`` takes ``band_limited`` where (enough) points are seen in all frames and
    ``cross_validation`` elsewhere; filled entries must not be given as measurements.

    Args:
        tracks: any batch shape; items are treated one by one.
        rule: ``auto``; ``band_limited`` (``kritchman_nadler`` among the frequencies at which the tracks move; the
            same where noise varies by frame); ``paper`` (eqs. 25-27 as printed: vector layout, given noise scale,
            needs covariance); ``mp``; ``tracy_widom``; ``kritchman_nadler``; ``mdl``; ``gavish_donoho``; ``bootstrap``
            (with an interval of its own); ``cross_validation``.
        layout: ``stack`` (2F x P, rank 3K under any motion) or ``vector`` (F x 2P, rank 6K only under rotation about
            three axes). Default: ``stack``, for ``paper`` ``vector``.
        noise_scale: ``estimate``: the covariance is right up to one factor; ``given``: it is right as it stands.
            ``paper`` always takes it as given.
        max_rank: largest K to report.
        generator: randomness of ``cross_validation`` and ``bootstrap``; default: seed 0.

    Returns:
        eigenvalues and threshold of a batch are padded with zeros and NaN; ``cross_validation`` has no threshold (NaN)
        and reports the eigenvalues of its model in units of the noise variance.

    Raises:
        ReconError: unknown rule or layout, ``paper`` or ``given`` without covariance, ``max_rank`` below 1.

    Example:
        >>> import torch
        >>> g = torch.Generator().manual_seed(0)
        >>> a, b = torch.randn(40, 2, 6, generator=g), torch.randn(30, 6, generator=g)
        >>> xy = torch.einsum("fck,pk->fpc", a, b) + 0.1 * torch.randn(40, 30, 2, generator=g)
        >>> estimate = estimate_rank(Tracks(xy))
        >>> estimate.rank, estimate.deformation_degree, estimate.rule
        (2, 2.0, 'band_limited')
    """
    if rule not in RULES:
        raise ReconError(f"rule: {rule!r} is not known; use one of {', '.join(RULES)}")
    if layout not in (None, "vector", "stack"):
        raise ReconError(f"layout: {layout!r} is not known; use 'stack' (2F x P) or 'vector' (F x 2P)")
    if noise_scale not in ("estimate", "given"):
        raise ReconError(f"noise_scale: {noise_scale!r} is not known; use 'estimate' or 'given'")
    if max_rank is not None and max_rank < 1:
        raise ReconError(f"max_rank: {max_rank}; at least 1 is needed (the mean shape is a basis)")
    if tracks.covariance is None and (rule == "paper" or noise_scale == "given"):
        what = "rule 'paper'" if rule == "paper" else "noise_scale 'given'"
        raise ReconError(f"covariance: {what} needs the covariance of the tracks; give it or use rule='auto'")
    items = [_single(item, rule, layout, noise_scale, max_rank, generator) for item in _items(tracks)]
    return items[0] if not tracks.batch_shape else _stacked(items, tracks.batch_shape)


def _items(tracks: Tracks) -> list[Tracks]:
    if not tracks.batch_shape:
        return [tracks]
    lead = len(tracks.batch_shape)
    xy, visible = tracks.xy.flatten(0, lead - 1), tracks.visible.flatten(0, lead - 1)
    covariance = None if tracks.covariance is None else tracks.covariance.flatten(0, lead - 1)
    return [
        Tracks(xy[i], visible[i], None if covariance is None else covariance[i], fps=tracks.fps) for i in range(len(xy))
    ]


def _stacked(items: list[RankEstimate], shape: torch.Size) -> RankEstimate:
    width = max(len(item.eigenvalues) for item in items)

    def pad(values: Tensor, fill: float) -> Tensor:
        return torch.nn.functional.pad(values, (0, width - len(values)), value=fill)

    eigenvalues = torch.stack([pad(item.eigenvalues, 0.0) for item in items])
    threshold = torch.stack([pad(item.threshold, float("nan")) for item in items])
    rules = sorted({item.rule for item in items})
    warnings = tuple(f"item {i}: {text}" for i, item in enumerate(items) for text in item.warnings)
    return replace(
        items[0],
        rank=torch.tensor([item.rank for item in items]).view(shape),
        deformation_degree=eigenvalues.new_tensor([float(item.deformation_degree) for item in items]).view(shape),
        eigenvalues=eigenvalues.view(*shape, width),
        threshold=threshold.view(*shape, width),
        interval=torch.tensor([item.interval for item in items]).view(*shape, 2),
        rule=" and ".join(rules),
        warnings=warnings,
    )


def _single(
    tracks: Tracks,
    rule: str,
    layout: str | None,
    noise_scale: str,
    max_rank: int | None,
    generator: torch.Generator | None,
) -> RankEstimate:
    warnings: list[str] = []
    complete = tracks.visible.all(0)
    found = int(complete.sum())
    if rule == "auto":
        enough = found == tracks.points or (found >= _ENOUGH_POINTS and found >= _ENOUGH_SHARE * tracks.points)
        rule = "band_limited" if enough else "cross_validation"
        if rule == "band_limited" and found < tracks.points:
            estimate = _spectral(tracks, rule, layout or "stack", noise_scale, max_rank, generator, [])
            # a count near the limit of few points says "at least"; the incomplete points know more
            if float(estimate.deformation_degree) * DIVISOR[estimate.layout] > 0.6 * (found - 1):
                rule = "cross_validation"
    if rule == "cross_validation":
        return _held_out(tracks, layout, max_rank, generator)
    if found < tracks.points:
        warnings.append(
            f"{tracks.points - found} of {tracks.points} points are not seen in every frame and were left out; "
            "rule 'cross_validation' uses them."
        )
    return _spectral(
        tracks, rule, layout or ("vector" if rule == "paper" else "stack"), noise_scale, max_rank, generator, warnings
    )


def _spectral(
    tracks: Tracks,
    rule: str,
    layout: str,
    noise_scale: str,
    max_rank: int | None,
    generator: torch.Generator | None,
    warnings: list[str],
) -> RankEstimate:
    xy = complete_points(tracks)
    frames, points = xy.shape[:2]
    if points < 3 or frames < 2:
        warnings.append(
            f"Only {points} points are seen in all of {frames} frames; at least 3 points and 2 frames are needed to "
            "see a deformation, so K is 1 by default."
        )
        nothing = xy.new_zeros(1)
        return RankEstimate(1, 0.0, nothing, nothing + float("nan"), (1, 1), rule, layout, tuple(warnings))
    floor = rounding_floor(xy, tracks.xy.dtype)
    covariance = None
    if tracks.covariance is not None:
        covariance = tracks.covariance[:, tracks.visible.all(0)].detach().to(torch.float64)
    frame, point = xy.new_ones(frames), xy.new_ones(points)
    if covariance is not None:
        frame, point = covariance_scales(covariance)
    given, blocks = frame[:, None] * point, equal_blocks(xy)
    noise = 1.0 if noise_scale == "given" else None
    if layout == "vector":
        blocks = blocks if covariance is None else covariance.mean(0)
        spectrum_ = vector_spectrum(xy, blocks, floor)
    elif rule in ("kritchman_nadler", "bootstrap") and noise_scale == "estimate":
        spectrum_, frame, point = kritchman_nadler(xy, frame, point, floor)
    elif rule == "band_limited":
        spectrum_, noise = band_limited(xy, frame, point, floor, noise)
    else:
        spectrum_ = stack_spectrum(xy, frame, point, floor)
    if rule == "band_limited" and layout == "vector":
        band = motion_band(whitened_vectors(xy, blocks)[:, None])
        values, samples, _ = spectrum(band.kept)
        spectrum_ = Spectrum(values, samples, layout, spectrum_.floor)
        noise = band.noise if noise is None else noise
    divisor = DIVISOR[layout]
    if rule == "bootstrap":
        factor = torch.linalg.cholesky(equal_blocks(xy) if covariance is None else covariance)
        # what the residuals say beyond the covariance is in the noise that is drawn as well
        factor = factor * (frame[:, None] * point / given)[..., None, None]
        scales = blocks if layout == "vector" else (frame, point)
        drawn = _bootstrapped(xy, factor, scales, noise_scale, spectrum_.floor, generator)
        count, eigenvalues, threshold = drawn.count, drawn.eigenvalues, drawn.threshold
        low, high = drawn.interval
    else:
        count, eigenvalues, threshold = _count(spectrum_, rule, noise, frames)
        known = noise if rule == "band_limited" else None
        low = count_signals(spectrum_.values, spectrum_.samples, known, 0.999)[0]
        high = count_signals(spectrum_.values, spectrum_.samples, known, 0.5)[0]
    if layout == "stack" and rule != "paper":
        warnings += _static_view(xy, floor, count)
    if count >= 0.8 * len(eigenvalues) and rule != "paper":
        warnings.append(
            f"{count} of {len(eigenvalues)} eigenvalues stand above the noise: the tracks are almost free of noise, or "
            "too few for their deformation; K is a lower limit set by the number of points and frames."
        )
    limits = sorted((_round(low, divisor, max_rank), _round(count, divisor, max_rank), _round(high, divisor, max_rank)))
    return RankEstimate(
        _round(count, divisor, max_rank),
        count / divisor,
        eigenvalues.to(tracks.xy.dtype),
        threshold.to(tracks.xy.dtype),
        (limits[0], limits[2]),
        rule,
        layout,
        tuple(warnings),
    )


def _bootstrapped(
    xy: Float[Tensor, "frames points 2"],
    factor: Tensor,
    scales: Tensor | tuple[Tensor, Tensor],
    noise_scale: str,
    floor: float,
    generator: torch.Generator | None,
) -> BootstrapCount:
    """Bootstrap with noise of covariance ``factor factor^T``; ``scales`` whiten the stack (a pair) or the vectors."""
    generator = generator if generator is not None else torch.Generator().manual_seed(0)

    def whiten(values: Tensor) -> Tensor:
        return whitened_stack(values, *scales)[0] if isinstance(scales, tuple) else whitened_vectors(values, scales)

    def draw() -> Tensor:
        white = torch.randn(xy.shape, generator=generator, dtype=xy.dtype).to(xy.device)
        return whiten((factor @ white[..., None])[..., 0])

    return bootstrap_count(whiten(xy), draw, 1.0 if noise_scale == "given" else None, floor)


def _round(count: int, divisor: int, max_rank: int | None) -> int:
    rank = max(1, int(count / divisor + 0.5))
    return rank if max_rank is None else min(rank, max_rank)


def _count(spectrum_: Spectrum, rule: str, noise: float | None, frames: int) -> tuple[int, Tensor, Tensor]:
    values, samples = spectrum_.values, spectrum_.samples
    if rule == "paper":
        return paper_count(values, samples, frames)
    if rule == "kritchman_nadler":
        count, threshold = kritchman_nadler_count(spectrum_)
    elif rule == "band_limited":
        count, threshold = kritchman_nadler_count(spectrum_, noise=noise)
    elif rule == "mp":
        count, threshold = mp_count(values, samples, noise)
    elif rule == "tracy_widom":
        count, threshold = tracy_widom_count(values, samples, noise)
    elif rule == "gavish_donoho":
        count, threshold = gavish_donoho_count(values, samples, noise)
    else:
        count, threshold = mdl_count(values, samples)
    return count, values, threshold


def _static_view(xy: Float[Tensor, "frames points 2"], floor: float, stack_count: int) -> list[str]:
    """A view without rotation has twice as many components in the stack as in the vectors."""
    vectors, _ = kritchman_nadler_count(vector_spectrum(xy, equal_blocks(xy), floor))
    if stack_count >= 2 and abs(stack_count - 2 * vectors) <= 0.1 * stack_count:
        return [
            f"The stack 2F x P shows {stack_count} components and the vectors F x 2P half of them: the body does not "
            "turn relative to the camera, so the tracks carry no information on depth."
        ]
    return []


def _held_out(
    tracks: Tracks, layout: str | None, max_rank: int | None, generator: torch.Generator | None
) -> RankEstimate:
    if layout == "vector":
        raise ReconError("layout: cross_validation works on the stack; leave layout out or use layout='stack'")
    seen = tracks.visible.sum(0) >= 2
    xy = tracks.xy[:, seen].detach().to(torch.float64)
    visible: Bool[Tensor, "frames points"] = tracks.visible[:, seen]
    per_point = int(visible.sum(0).to(torch.float64).median()) if visible.numel() else 0
    # a point has to see more numbers than it has unknowns, and there have to be more points than directions
    most = min((2 * per_point - 1) // 3, (visible.shape[1] - 1) // 3, _MOST if max_rank is None else max_rank)
    if most < 1 or int(visible.sum()) < 40:
        text = f"Only {int(visible.sum())} observations of points seen at least twice: too few to see a deformation."
        nothing = tracks.xy.new_zeros(1)
        return RankEstimate(
            1,
            0.0,
            nothing,
            nothing + float("nan"),
            (1, 1),
            "cross_validation",
            "stack",
            (text + " K is 1 by default.",),
        )
    if tracks.covariance is not None:
        variance = tracks.covariance[:, seen].to(torch.float64).diagonal(dim1=-2, dim2=-1).mean(-1)
        kept = torch.where(visible, variance, torch.zeros_like(variance)).sum(0) / visible.sum(0)
        # noisy tracks would dominate the fit; a point's precision acts as its weight when it is divided out. The
        # translation is no longer common to the points then, so only the noisiest points are left out instead.
        good = kept <= 9 * kept.median()
        xy, visible = xy[:, good], visible[:, good]
    result = cross_validate(xy, visible, most, generator)
    gram = torch.einsum("fck,fcl->kl", result.model.rows, result.model.rows)
    factor = torch.linalg.cholesky(gram + 1e-12 * gram.diagonal().max() * torch.eye(len(gram), dtype=gram.dtype))
    values, samples, _ = spectrum(result.model.points @ factor)
    eigenvalues = (values * samples / max(2 * tracks.frames, samples) / result.model.noise).to(tracks.xy.dtype)
    warnings = []
    if result.interval[1] == most and max_rank is None and result.rank == most:
        warnings.append(f"The prediction was still improving at K = {most}, the largest that these tracks allow.")
    return RankEstimate(
        result.rank,
        float(result.rank),
        eigenvalues,
        torch.full_like(eigenvalues, float("nan")),
        result.interval,
        "cross_validation",
        "stack",
        tuple(warnings),
    )
