"""Error of an action recogniser on reconstructed shapes."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Int, Tensor
from torchrecon.errors import ReconError

__all__ = ["action_error"]


def action_error(predicted: Int[Tensor, "*batch n"], actions: Int[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Share of windows whose predicted action is wrong, in per cent: the cell of Table 1 (100 (1 - accuracy)).

    Args:
        predicted: class index per window.
        actions: true class index per window.

    Raises:
        ReconError: shapes differ, or there is no window at all.

    Example:
        >>> import torch
        >>> float(action_error(torch.tensor([0, 1, 1, 3]), torch.tensor([0, 1, 2, 3])))
        25.0
    """
    if predicted.shape != actions.shape or predicted.shape[-1] == 0:
        raise ReconError(
            f"predicted: shape {tuple(predicted.shape)} against actions {tuple(actions.shape)}; "
            "equal shapes with at least one window are needed"
        )
    return 100.0 * (predicted != actions).to(torch.get_default_dtype()).mean(-1)
