"""Values over time where only some frames have one."""

from __future__ import annotations

import torch

from torchrecon._typing import Bool, Float, Tensor

__all__ = ["interpolated"]


def interpolated(values: Float[Tensor, "frames ..."], there: Bool[Tensor, " frames"]) -> Float[Tensor, "frames ..."]:
    """Values of every frame: those that are there, straight lines between them, the nearest at either end.

    Args:
        values: any leading size ``frames``; what is not there is never used.
        there: at least one true.

    Example:
        >>> import torch
        >>> interpolated(torch.tensor([0.0, 1.0, 9.0, 3.0]), torch.tensor([False, True, False, True])).tolist()
        [1.0, 1.0, 2.0, 3.0]
    """
    known = there.nonzero()[:, 0]
    frame = torch.arange(len(there), device=there.device)
    after = known[torch.searchsorted(known, frame).clamp_max(len(known) - 1)]
    before = known[(torch.searchsorted(known, frame, right=True) - 1).clamp_min(0)]
    share = ((frame - before) / (after - before).clamp_min(1)).clamp(0, 1).to(values.dtype)
    share = share.view(-1, *[1] * (values.ndim - 1))
    return (1 - share) * values[before] + share * values[after]
