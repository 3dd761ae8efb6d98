"""What every rule for the number of shape bases works on: whitened, centred matrices and their spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError
from torchrecon.linalg.noise_edge import Complement, spectrum
from torchrecon.measurement import Tracks, stack_matrix, vector_matrix

__all__ = [
    "DIVISOR",
    "Spectrum",
    "complete_points",
    "covariance_scales",
    "equal_blocks",
    "stack_spectrum",
    "vector_spectrum",
    "whitened_stack",
    "whitened_vectors",
]

# eigenvalues per shape basis: three coordinates in the stack 2F x P, six rotation entries in the vectors F x 2P
DIVISOR = {"stack": 3, "vector": 6}


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues of one whitened matrix.

    Attributes:
        values: descending, in units of the entries' variance.
        samples: n, the larger side of the matrix.
        layout: ``stack`` or ``vector``.
        floor: eigenvalue that rounding of the coordinates alone can cause.
    """

    values: Float[Tensor, " d"]
    samples: int
    layout: str
    floor: float


def complete_points(tracks: Tracks) -> Float[Tensor, "frames points 2"]:
    """float64 coordinates of the points that are seen in every frame (batch shape ``()``)."""
    return tracks.xy[:, tracks.visible.all(0)].detach().to(torch.float64)


def rounding_floor(xy: Tensor, dtype: torch.dtype) -> float:
    """Variance that rounding to ``dtype`` leaves in coordinates of this size, px^2, with some room."""
    return (4 * torch.finfo(dtype).eps * float(xy.abs().max())) ** 2 if xy.numel() else 0.0


def covariance_scales(
    covariance: Float[Tensor, "frames points 2 2"],
) -> tuple[Float[Tensor, " frames"], Float[Tensor, " points"]]:
    """One standard deviation per frame and one factor per point that together describe the covariances.

    The stack keeps its rank only under operations on whole rows and whole columns, so the four numbers of each 2x2
    matrix have to become one: the mean of the u and v variances, split into ``frame^2 * point^2``.
    """
    variance = covariance.to(torch.float64).diagonal(dim1=-2, dim2=-1).mean(-1)
    frame = variance.mean(1)
    point = (variance / frame[:, None]).mean(0)
    return frame.sqrt(), point.sqrt()


def whitened_stack(
    xy: Float[Tensor, "frames points 2"], frame: Float[Tensor, " frames"], point: Float[Tensor, " points"]
) -> tuple[Float[Tensor, "rows cols"], Complement]:
    """The 2F x (P-1) stack whose entries have equal noise, without translation.

    The translation of a frame multiplies ones; after division by the points' factors it multiplies ``1 / point``, so
    the complement of that vector is kept, which leaves the noise white (a plain mean would not).

    Returns:
        (matrix, space): the matrix and the coordinates of its columns, which lead back to points.
    """
    stack = stack_matrix(xy) / frame.repeat_interleave(2)[:, None] / point
    space = Complement(1 / point)
    return space.down(stack), space


def stack_spectrum(xy: Float[Tensor, "frames points 2"], frame: Tensor, point: Tensor, floor: float) -> Spectrum:
    """Spectrum of the whitened stack."""
    matrix, _ = whitened_stack(xy, frame, point)
    values, samples, _ = spectrum(matrix)
    return Spectrum(values, samples, "stack", floor / float((frame.min() * point.min()) ** 2))


def equal_blocks(xy: Float[Tensor, "frames points 2"]) -> Float[Tensor, "points 2 2"]:
    """Covariance blocks of points that are all as noisy."""
    return torch.eye(2, dtype=xy.dtype, device=xy.device).expand(xy.shape[1], 2, 2)


def whitened_vectors(
    xy: Float[Tensor, "frames points 2"], blocks: Float[Tensor, "points 2 2"]
) -> Float[Tensor, "frames cols"]:
    """The F x (2P-2) matrix of vectors, each point whitened by its own 2x2 factor, without translation (eqs. 23-25).

    Raises:
        ReconError: a block is not positive definite.
    """
    factor, info = torch.linalg.cholesky_ex(blocks.to(xy.dtype))
    if (info != 0).any():
        raise ReconError(f"covariance: the mean of point {int(info.nonzero()[0])} is not positive definite")
    white = torch.linalg.solve_triangular(factor, xy[..., None], upper=False)[..., 0]
    # what a translation in u and one in v look like after whitening; their complement carries no translation
    moved = torch.linalg.solve_triangular(factor, equal_blocks(xy), upper=False)
    along_u, along_v = (moved[:, :, axis].T.flatten() for axis in (0, 1))
    first = Complement(along_u)
    return Complement(first.down(along_v)).down(first.down(vector_matrix(white)))


def vector_spectrum(
    xy: Float[Tensor, "frames points 2"], blocks: Float[Tensor, "points 2 2"], floor: float
) -> Spectrum:
    """Spectrum of the whitened vectors (paper, eqs. 23-25)."""
    values, samples, _ = spectrum(whitened_vectors(xy, blocks))
    smallest = float(torch.linalg.eigvalsh(blocks).min())
    return Spectrum(values, samples, "vector", floor / smallest)
