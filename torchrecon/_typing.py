"""One axis vocabulary for every annotated signature.

``batch`` (any number of leading dimensions, written ``*batch``), ``frames``, ``points``, ``rank`` (number of
shape bases, the mean shape counted), ``height``, ``width``. Image axes are x right, y down, in pixels with
integer pixel centres; camera axes are x right, y down, z away from the camera.
"""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor

__all__ = ["Bool", "Float", "Int", "Tensor"]
