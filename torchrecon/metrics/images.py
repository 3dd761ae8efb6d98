"""How alike two pictures are: MSE (34), PSNR (32) and SSIM (33) in their true forms; the printed ones are not usable.

Convention:
    Pictures are (*batch, height, width), one channel; colour channels are one more batch dimension. No figure aligns
    anything: a picture shifted by one pixel is another picture. By hand: pictures of 0 and of 0.1 everywhere have
    MSE 0.01 and, at peak 1, PSNR 20 dB.
"""

from __future__ import annotations

import torch
from kornia.metrics import ssim as ssim_map

from torchrecon._typing import Float, Tensor
from torchrecon.errors import ReconError

__all__ = ["mse", "psnr", "ssim"]

_WINDOW = 11


def _check(picture: Tensor, truth: Tensor, peak: float = 1.0) -> None:
    if picture.shape != truth.shape or picture.ndim < 2 or 0 in picture.shape[-2:]:
        raise ReconError(
            f"picture: shape {tuple(picture.shape)} does not fit truth {tuple(truth.shape)}; "
            "both must be (*batch, height, width) with at least one pixel"
        )
    if not peak > 0:
        raise ReconError(f"peak: {peak} must be positive; it is the largest intensity that a picture can hold")
    for name, value in (("picture", picture), ("truth", truth)):
        wrong = ~torch.isfinite(value)
        if wrong.any():
            where = tuple(int(i) for i in wrong.nonzero()[0])
            raise ReconError(f"{name}: pixel {where} is not finite; a metric over it would not be a number")


def mse(
    picture: Float[Tensor, "*batch height width"], truth: Float[Tensor, "*batch height width"]
) -> Float[Tensor, "*batch"]:
    """Mean squared difference over the pixels (paper, eq. 34; printed without square and sum).

    Unit: squared intensity. Lower is better, 0 for equal pictures.

    Raises:
        ReconError: shapes differ, or a pixel is not finite.

    Example:
        >>> import torch
        >>> round(float(mse(torch.full((4, 6), 0.1), torch.zeros(4, 6))), 6)
        0.01
    """
    _check(picture, truth)
    return (picture - truth).square().mean((-1, -2))


def psnr(
    picture: Float[Tensor, "*batch height width"],
    truth: Float[Tensor, "*batch height width"],
    peak: float = 1.0,
) -> Float[Tensor, "*batch"]:
    """Peak signal-to-noise ratio ``10 log10(peak^2 / MSE)`` (paper, eq. 32; printed without logarithm and sum).

    Unit: decibel. Higher is better, infinite for equal pictures.

    Args:
        picture, truth: intensities of one range.
        peak: largest intensity that a picture can hold: 1, or 255 for bytes.

    Raises:
        ReconError: shapes differ, a pixel is not finite, or ``peak`` is not positive.

    Example:
        >>> import torch
        >>> round(float(psnr(torch.full((4, 6), 0.1), torch.zeros(4, 6))), 3)
        20.0
    """
    _check(picture, truth, peak)
    return 10 * torch.log10(peak**2 / mse(picture, truth))


def ssim(
    picture: Float[Tensor, "*batch height width"],
    truth: Float[Tensor, "*batch height width"],
    peak: float = 1.0,
) -> Float[Tensor, "*batch"]:
    """Structural similarity (paper, eq. 33; printed upside down), mean over all windows that lie inside the picture.

    ``((2 mx my + C1)(2 sxy + C2)) / ((mx^2 + my^2 + C1)(sx^2 + sy^2 + C2))`` with means, variances and covariance in an
    11 x 11 Gaussian window of standard deviation 1.5, C1 = (0.01 peak)^2, C2 = (0.03 peak)^2 (Wang et al. 2004).
    Table 4 of the paper prints 100 times this. Unit: none, in [-1, 1]. Higher is better, 1 for equal pictures.

    Raises:
        ReconError: shapes differ, a pixel is not finite, ``peak`` is not positive, or the picture is smaller than the
            window.

    Example:
        >>> import torch
        >>> picture = torch.rand(16, 20, generator=torch.Generator().manual_seed(0))
        >>> round(float(ssim(picture, picture)), 6), float(ssim(1 - picture, picture)) < 0
        (1.0, True)
    """
    _check(picture, truth, peak)
    if min(picture.shape[-2:]) < _WINDOW:
        raise ReconError(f"picture: {tuple(picture.shape[-2:])} is smaller than the window of {_WINDOW} x {_WINDOW}")
    flat = (value.reshape(-1, 1, *value.shape[-2:]) for value in (picture, truth))
    local = ssim_map(*flat, window_size=_WINDOW, max_val=float(peak), eps=0.0, padding="valid")
    return local.mean((-1, -2, -3)).reshape(picture.shape[:-2])
