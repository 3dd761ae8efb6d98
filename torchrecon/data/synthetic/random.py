"""Draws from a generator in float64, so that a seed gives the same world under every default dtype."""

from __future__ import annotations

import torch

from torchrecon._typing import Tensor

__all__ = ["chance", "normal", "seed_of", "uniform"]


def uniform(generator: torch.Generator | None, low: float, high: float) -> float:
    """One number between ``low`` and ``high``."""
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def normal(generator: torch.Generator | None, *shape: int) -> Tensor:
    """Standard normal float64 numbers."""
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def chance(generator: torch.Generator | None, probability: float) -> bool:
    """True with the given probability."""
    return uniform(generator, 0.0, 1.0) < probability


def seed_of(generator: torch.Generator | None) -> int:
    """A fresh seed for a generator of its own."""
    return int(torch.randint(2**31 - 1, (), generator=generator))
