"""Values, with covariances, for what was not seen (eqs. 28-30)."""

from torchrecon.gaps.base import neighbour_covariance
from torchrecon.gaps.fill import METHODS, GapParams, fill_gaps
from torchrecon.gaps.low_rank import LowRankParams

__all__ = ["METHODS", "GapParams", "LowRankParams", "fill_gaps", "neighbour_covariance"]
