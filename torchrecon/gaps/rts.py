"""Filler by the constant-acceleration smoother: uses the future too. Best for gaps of one or two frames."""

from __future__ import annotations

from torchrecon.gaps.base import Gaps, Guess
from torchrecon.statespace import rts_smooth

__all__ = ["fill_rts"]

# a parabola through a gap longer than this is no longer to be relied on, frames
_TRUSTED = 5


def fill_rts(gaps: Gaps) -> Guess:
    """Positions and variances of the Rauch-Tung-Striebel smoother, each point with its own tracking index.

    Beyond the first and last observation of a point its velocity fades out; such values are low in confidence.
    """
    smooth = rts_smooth(gaps.xy, gaps.visible, gaps.variance, gaps.index, gaps.steps)
    doubtful = ~gaps.visible & (~gaps.inside | (gaps.length > _TRUSTED))
    return Guess(smooth.position, smooth.variance, doubtful)
