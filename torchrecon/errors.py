"""The one error that torchrecon raises for input it cannot use."""

from __future__ import annotations

__all__ = ["ReconError"]


class ReconError(ValueError):
    """Input that cannot be used: the message names what must hold, where it fails and what to do.

    It is also a ``ValueError``, so callers that know nothing of torchrecon can catch it.

    Example:
        >>> try:
        ...     raise ReconError("xy: frame 3 has no visible point; drop the frame or mark it missing")
        ... except ValueError as error:
        ...     print(str(error).split(":")[0])
        xy
    """
