"""The estimated number of shape bases, with the evidence for it."""

from __future__ import annotations

from dataclasses import dataclass

from torchrecon._typing import Float, Int, Tensor

__all__ = ["RankEstimate"]


@dataclass(frozen=True, eq=False)
class RankEstimate:
    """How many shape bases stand above the noise.

    Attributes:
        rank: K, the mean shape counted as a basis; an int for batch ``()``, else an int64 tensor of batch shape.
        deformation_degree: count of signal eigenvalues over 6 (layout ``vector``) or 3 (layout ``stack``),
            not rounded (paper, eq. 27); a float for batch ``()``, else a tensor.
        eigenvalues: (*batch, n) of the whitened second-moment matrix, in units of the noise variance, descending.
        threshold: (*batch, n) value that each eigenvalue has to exceed to count as signal.
        interval: lowest and highest K that the data do not reject.
        rule: name of the rule that was used (never ``auto``).
        layout: ``vector`` (F x 2P) or ``stack`` (2F x P).
        warnings: sentences; empty when nothing is to be said.
    """

    rank: int | Int[Tensor, "*batch"]
    deformation_degree: float | Float[Tensor, "*batch"]
    eigenvalues: Float[Tensor, "*batch n"]
    threshold: Float[Tensor, "*batch n"]
    interval: tuple[int, int] | Int[Tensor, "*batch 2"]
    rule: str
    layout: str
    warnings: tuple[str, ...] = ()
