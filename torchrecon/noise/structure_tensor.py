"""Covariance of a tracked image point from the texture around it (what the paper's eq. 22 means)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import kornia
import torch

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["StructureTensorParams", "clamp_covariance", "grey_image", "image_noise", "structure_tensor_covariance"]

# noise variance of a central difference, in units of the noise variance of the image. Sobel would smooth across the
# derivative and make fine texture look 10 % less trackable than it is.
_GRADIENT_NOISE = 0.5
# a squared central difference is correlated (1/4) with that two pixels away on either side
_GRADIENT_CORRELATION = 1.5
# how many standard deviations above what noise alone gives the texture of a direction has to be
_TEXTURE_SIGMAS = 4.0
# finest Laplacian [1 -2 1; -2 4 -2; 1 -2 1]: blind to planes, its noise is 6 times that of the image
_LAPLACIAN = ((1.0, -2.0, 1.0), (-2.0, 4.0, -2.0), (1.0, -2.0, 1.0))
_LAPLACIAN_GAIN = 6.0
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class StructureTensorParams:
    """Parameters of :func:`structure_tensor_covariance`.

    Attributes:
        window: standard deviation of the Gaussian matching window, pixels.
        radius: half width of the window, pixels; None means ``ceil(2.5 window)``.
        noise: standard deviation of the image noise, intensity units of the image; None estimates it.
        noise_floor: smallest noise that is believed; the rounding noise of an 8-bit image with range 1.
        min_std: smallest standard deviation that is reported, pixels.
    """

    window: float = 4.0
    radius: int | None = None
    noise: float | None = None
    noise_floor: float = 1 / (255 * math.sqrt(12))
    min_std: float = 0.05


def grey_image(image: Float[Tensor, "channels height width"]) -> Float[Tensor, "1 1 height width"]:
    """Luma of an RGB image, or the one channel of a grey image, as a batch of one."""
    if image.shape[0] == 3:
        return kornia.color.rgb_to_grayscale(image[None])
    if image.shape[0] == 1:
        return image[None]
    raise ReconError(f"image: {image.shape[0]} channels; 1 (grey) or 3 (RGB) are needed")


def image_noise(
    image: Float[Tensor, "channels height width"], mask: Bool[Tensor, "height width"] | None = None
) -> Float[Tensor, ""]:
    """Standard deviation of the image noise, from the median absolute value of the finest Laplacian.

    Texture as fine as one pixel counts as noise here, so on strongly textured images it is an upper estimate.

    Args:
        image: any intensity range; the result has its unit.
        mask: pixels to look at.

    Example:
        >>> import torch
        >>> noisy = 0.05 * torch.randn(1, 100, 100, generator=torch.Generator().manual_seed(0))
        >>> round(float(image_noise(noisy)), 2)
        0.05
    """
    grey = grey_image(image)
    kernel = grey.new_tensor(_LAPLACIAN)[None, None]
    response = torch.nn.functional.conv2d(grey, kernel)[0, 0].abs()
    if mask is not None:
        inside = mask[1:-1, 1:-1]
        if not inside.any():
            raise ReconError("mask: no pixel inside; the image noise cannot be estimated")
        response = response[inside]
    return torch.median(response) * _MAD_TO_SIGMA / _LAPLACIAN_GAIN


def clamp_covariance(
    covariance: Float[Tensor, "*b 2 2"], min_std: float, max_std: float
) -> tuple[Float[Tensor, "*b 2 2"], Bool[Tensor, "*b"]]:
    """Clamp the eigenvalues to ``[min_std^2, max_std^2]``; the flag marks those that were above."""
    values, vectors = torch.linalg.eigh(covariance)
    limited = values.clamp(min_std**2, max_std**2)
    result = (vectors * limited[..., None, :]) @ vectors.transpose(-1, -2)
    return (result + result.transpose(-1, -2)) / 2, values[..., -1] > max_std**2


def structure_tensor_covariance(
    image: Float[Tensor, "channels height width"],
    xy: Float[Tensor, "points 2"],
    params: StructureTensorParams | None = None,
) -> tuple[Float[Tensor, "points 2 2"], Bool[Tensor, " points"]]:
    """Covariance of the position at which a patch of this image is found again in an equally noisy image.

    The paper takes the inverse of the brightness Hessian (22), which is indefinite on real corners; meant is the
    Hessian of the matching residual. With the window weights w and the gradients g,
    ``J = sum w g g^T``, ``J2 = sum w^2 g g^T`` and ``Q = 2 s^2 J^-1 J2 J^-1``, s the image noise. What noise alone
    adds to J and J2 is subtracted, and a direction whose J does not stand out from noise counts as not known at all, so
    a patch without texture does not look trackable.

    Args:
        image: any intensity range.
        xy: pixels, integer pixel centres; a NaN position gives a NaN covariance.
        params: see :class:`StructureTensorParams`.

    Returns:
        (covariance, capped): px^2, symmetric positive definite; ``capped`` where the texture fixes the position in
        one direction at most (an edge, a flat patch) and the larger standard deviation was set to the window radius.

    Example:
        >>> import torch
        >>> image = torch.zeros(1, 40, 40)
        >>> image[:, :, 20:] = 1.0
        >>> q, capped = structure_tensor_covariance(image, torch.tensor([[19.5, 20.0]]))
        >>> bool(capped[0]), bool(q[0, 0, 0] < 0.01 < q[0, 1, 1])
        (True, True)
    """
    params = params or StructureTensorParams()
    if not params.window > 0:
        raise ReconError(f"window: {params.window} px is not positive")
    radius = math.ceil(2.5 * params.window) if params.radius is None else params.radius
    grey = grey_image(image)
    noise = image_noise(image) if params.noise is None else image.new_tensor(params.noise)
    noise = noise.clamp(min=params.noise_floor)
    gradient = kornia.filters.spatial_gradient(grey, "diff", order=1, normalized=True)[0, 0]
    height, width = grey.shape[-2:]

    known = torch.isfinite(xy).all(-1)
    position = torch.where(known[:, None], xy, xy.new_zeros(2))
    nearest = position.round().clamp(-1e6, 1e6)
    reach = torch.arange(-radius, radius + 1, device=xy.device)
    dv, du = (grid.flatten() for grid in torch.meshgrid(reach, reach, indexing="ij"))
    u, v = nearest[:, :1].long() + du, nearest[:, 1:].long() + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
    patch = gradient.flatten(1)[:, index]
    distance2 = (u - position[:, :1]) ** 2 + (v - position[:, 1:]) ** 2
    weight = torch.exp(-distance2 / (2 * params.window**2)) * inside

    eye = torch.eye(2, dtype=grey.dtype, device=grey.device)
    bias = _GRADIENT_NOISE * noise**2

    def moment(w: Tensor) -> Tensor:
        raw = torch.einsum("apk,bpk,pk->pab", patch, patch, w)
        return raw - bias * w.sum(-1)[:, None, None] * eye

    values, vectors = torch.linalg.eigh(moment(weight))
    chance = bias * torch.sqrt(2 * _GRADIENT_CORRELATION * (weight**2).sum(-1, keepdim=True))
    textured = values > _TEXTURE_SIGMAS * chance
    flip = vectors.transpose(-1, -2)
    inverse = (vectors * torch.where(textured, 1 / values, torch.zeros_like(values))[:, None, :]) @ flip
    second, turn = torch.linalg.eigh(moment(weight**2))
    second_moment = (turn * second.clamp(min=0)[:, None, :]) @ turn.transpose(-1, -2)
    unknown = (vectors * (~textured)[:, None, :] * (1.01 * radius) ** 2) @ flip
    covariance = 2 * noise**2 * inverse @ second_moment @ inverse + unknown
    covariance, capped = clamp_covariance(covariance, params.min_std, float(radius))
    covariance = torch.where(known[:, None, None], covariance, covariance.new_tensor(float("nan")))
    return covariance, capped & known
