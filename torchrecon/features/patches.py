"""Image pyramids and patches around sub-pixel points, for many points at once.

Convention:
    Points are (x, y) in pixels with integer pixel centres. Level l of a pyramid holds every 2^l-th pixel of the
    blurred image, so that point (x, y) of the image is point (x, y) / 2^l of the level, without an offset.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F

from torchrecon._typing import Float, Tensor

__all__ = ["gaussian_blur", "gaussian_kernel1d", "image_pyramid", "patch_grid", "sample_image", "to_gray"]


def to_gray(frame: Float[Tensor, "channels height width"]) -> Float[Tensor, "height width"]:
    """Luma of an RGB frame (Rec. 601 weights), or the single channel of a grey one.

    Example:
        >>> import torch
        >>> round(float(to_gray(torch.ones(3, 2, 2))[0, 0]), 6)
        1.0
    """
    if frame.shape[0] == 1:
        return frame[0]
    return (frame[:3] * frame.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(0)


def gaussian_kernel1d(sigma: float, like: Tensor) -> Float[Tensor, " taps"]:
    """Sampled Gaussian, normalised to sum 1, cut at 4 sigma."""
    radius = max(1, int(4 * sigma + 0.5))
    x = torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device)
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    return kernel / kernel.sum()


def gaussian_blur(image: Float[Tensor, "height width"], sigma: float) -> Float[Tensor, "height width"]:
    """Separable Gaussian blur with the border repeated; ``sigma`` in pixels.

    Example:
        >>> import torch
        >>> bool(torch.allclose(gaussian_blur(torch.ones(5, 7), 2.0), torch.ones(5, 7)))
        True
    """
    kernel = gaussian_kernel1d(sigma, image)
    radius = kernel.numel() // 2
    padded = F.pad(image[None, None], (radius,) * 4, mode="replicate")
    blurred: Tensor = F.conv2d(F.conv2d(padded, kernel[None, None, None]), kernel[None, None, :, None])
    return blurred[0, 0]


def image_pyramid(image: Float[Tensor, "height width"], levels: int, sigma: float = 0.8) -> list[Tensor]:
    """Pyramid of ``levels`` images, each half the one below.

    Args:
        image: grey values.
        levels: number of images.
        sigma: blur of level 0 in pixels; interpolation between pixels is then nearly free of bias.
    """
    pyramid = [gaussian_blur(image, sigma) if sigma > 0 else image]
    for _ in range(levels - 1):
        pyramid.append(gaussian_blur(pyramid[-1], 1.0)[::2, ::2])
    return pyramid


def patch_grid(half: int, like: Tensor) -> Float[Tensor, "samples 2"]:
    """Offsets (x, y) of a (2 half + 1)^2 patch, row by row."""
    axis = torch.arange(-half, half + 1, dtype=like.dtype, device=like.device)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x.reshape(-1), y.reshape(-1)], -1)


def sample_image(
    image: Float[Tensor, "height width"], points: Float[Tensor, "*batch 2"], mode: str = "bilinear"
) -> Float[Tensor, "*batch"]:
    """Grey values at sub-pixel points; outside the image the border value is taken.

    Args:
        image: grey values.
        points: (x, y) in pixels.
        mode: ``bilinear``, ``bicubic`` or ``nearest``.

    Example:
        >>> import torch
        >>> ramp = torch.arange(5.0).expand(3, 5)
        >>> float(sample_image(ramp, torch.tensor([2.25, 1.0])))
        2.25
    """
    height, width = image.shape
    size = points.new_tensor([max(width - 1, 1), max(height - 1, 1)])
    grid = (points * (2.0 / size) - 1.0).reshape(1, 1, -1, 2)
    values = F.grid_sample(image[None, None], grid.to(image), mode=mode, padding_mode="border", align_corners=True)
    return values.reshape(points.shape[:-1])
