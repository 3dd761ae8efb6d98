"""Cosine bases of time: smooth trajectories from few numbers."""

from __future__ import annotations

import torch

from torchrecon._typing import Float, Tensor

__all__ = ["dct", "dct_basis", "dct_share", "inverse_dct"]


def dct_basis(
    frames: int, count: int, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> Float[Tensor, "frames count"]:
    """The first ``count`` vectors of the orthonormal cosine transform (DCT-II), slowest first, as columns.

    Column k is proportional to ``cos(pi k (f + 1/2) / frames)``; column 0 is constant.

    Example:
        >>> import torch
        >>> basis = dct_basis(8, 3)
        >>> torch.allclose(basis.T @ basis, torch.eye(3), atol=1e-6)
        True
    """
    phase = (torch.arange(frames, dtype=dtype or torch.get_default_dtype(), device=device) + 0.5) * torch.pi / frames
    basis = torch.cos(phase[:, None] * torch.arange(count, dtype=phase.dtype, device=device)) * (2 / frames) ** 0.5
    basis[:, :1] *= 0.5**0.5
    return basis


def dct(signal: Float[Tensor, "frames ..."]) -> Float[Tensor, "frames ..."]:
    """Orthonormal cosine transform (DCT-II) over the first dimension by the fast Fourier transform.

    Example:
        >>> import torch
        >>> signal = torch.randn(9, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> torch.allclose(dct(signal), dct_basis(9, 9, dtype=torch.float64).T @ signal)
        True
    """
    frames = len(signal)
    folded = torch.cat([signal[::2], signal[1::2].flip(0)])
    k = torch.arange(frames, dtype=signal.dtype, device=signal.device).view(-1, *[1] * (signal.ndim - 1))
    turned = torch.fft.fft(folded, dim=0) * torch.exp(-0.5j * torch.pi * k / frames)
    scale = torch.where(k == 0, 0.5**0.5, 1.0) * (2 / frames) ** 0.5
    return turned.real * scale


def inverse_dct(power: Float[Tensor, "frames ..."]) -> Float[Tensor, "frames ..."]:
    """The inverse of :func:`dct`.

    Example:
        >>> import torch
        >>> signal = torch.randn(9, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> torch.allclose(inverse_dct(dct(signal)), signal)
        True
    """
    frames = len(power)
    k = torch.arange(frames, dtype=power.dtype, device=power.device).view(-1, *[1] * (power.ndim - 1))
    plain = power / (torch.where(k == 0, 0.5**0.5, 1.0) * (2 / frames) ** 0.5)
    mirrored = torch.cat([torch.zeros_like(plain[:1]), plain[1:].flip(0)])
    folded = torch.fft.ifft((plain - 1j * mirrored) * torch.exp(0.5j * torch.pi * k / frames), dim=0).real
    signal = torch.empty_like(power)
    half = (frames + 1) // 2
    signal[::2], signal[1::2] = folded[:half], folded[half:].flip(0)
    return signal


def dct_share(frames: int, count: int) -> Float[Tensor, " frames"]:
    """Squared length of each frame's axis within the first ``count`` cosine vectors, in closed form; float64.

    Example:
        >>> import torch
        >>> torch.allclose(dct_share(9, 4), dct_basis(9, 4, dtype=torch.float64).square().sum(1))
        True
    """
    angle = 2 * torch.pi * (torch.arange(frames, dtype=torch.float64) + 0.5) / frames
    # 1/n + (1/n) sum over k = 1 .. count - 1 of (1 + cos(k angle)), the sum by Dirichlet's kernel
    return (count + (torch.sin((count - 0.5) * angle) / torch.sin(angle / 2) - 1) / 2) / frames
