"""How many shape bases stand above the noise (eqs. 18-20, 25-27), and rules that converge to it."""

from torchrecon.rank.cross_validation import CrossValidationParams, HeldOut, cross_validate
from torchrecon.rank.deformability import Deformability, deformability_over_time, deformability_per_part
from torchrecon.rank.estimate import RULES, estimate_rank

__all__ = [
    "RULES",
    "CrossValidationParams",
    "Deformability",
    "HeldOut",
    "cross_validate",
    "deformability_over_time",
    "deformability_per_part",
    "estimate_rank",
]
