"""One format a file: each turns a :class:`Motion` into the bytes of a file."""

from __future__ import annotations

from torchrecon.io.writers.motion import Motion

__all__ = ["Motion"]
