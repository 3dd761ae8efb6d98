"""The network inside the shape prior: joints in the image over time to a Gaussian over their places in 3D.

A residual network whose layers look at a frame and at two others, ever farther away in time (temporal convolutions with
dilation, Pavllo et al. 2019, "3D human pose estimation in video with temporal convolutions", with layer normalisation).
"""

from __future__ import annotations

import torch
from torch import nn

from torchrecon._typing import Bool, Float, Tensor
from torchrecon.models.joints import JOINTS, MIRROR

__all__ = ["Lifting", "centre_and_size"]


class _Block(nn.Module):
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        self.norm = nn.LayerNorm(width)
        self.look = nn.Linear(width * (3 if dilation else 1), width)
        self.change = nn.Linear(width, width)
        nn.init.zeros_(self.change.weight)
        nn.init.zeros_(self.change.bias)

    def forward(self, features: Tensor) -> Tensor:
        seen = self.norm(features)
        if self.dilation:
            frame = torch.arange(seen.shape[-2], device=seen.device)
            before = seen[..., (frame - self.dilation).clamp_min(0), :]
            after = seen[..., (frame + self.dilation).clamp_max(len(frame) - 1), :]
            seen = torch.cat([before, seen, after], -1)
        out: Tensor = features + self.change(torch.relu(self.look(seen)))
        return out


class Lifting(nn.Module):
    """Joints in the image to mean and standard deviation of their places, all in units of the input.

    Args:
        width: of the features of a frame.
        dilations: one block each; 0 looks at its own frame alone.

    Example:
        >>> mean, deviation = Lifting(16, (0, 1))(torch.rand(4, 32, 21, 2), torch.ones(4, 32, 21, dtype=torch.bool))
        >>> mean.shape, deviation.shape
        (torch.Size([4, 32, 21, 3]), torch.Size([4, 32, 21, 2]))
    """

    def __init__(self, width: int = 192, dilations: tuple[int, ...] = (0, 1, 2, 4, 8)) -> None:
        super().__init__()
        self.width, self.dilations = width, tuple(dilations)
        self.enter = nn.Linear(3 * len(JOINTS), width)
        self.blocks = nn.ModuleList([_Block(width, dilation) for dilation in self.dilations])
        self.norm = nn.LayerNorm(width)
        self.leave = nn.Linear(width, 5 * len(JOINTS))
        nn.init.normal_(self.leave.weight, std=0.005)
        nn.init.zeros_(self.leave.bias)

    def forward(
        self, xy: Float[Tensor, "*batch frames joints 2"], seen: Bool[Tensor, "*batch frames joints"]
    ) -> tuple[Float[Tensor, "*batch frames joints 3"], Float[Tensor, "*batch frames joints 2"]]:
        """Mean, and standard deviation across the image and along depth.

        Args:
            xy: centred per frame and of unit size per window (:func:`centre_and_size`); zero where not seen.
            seen: which entries are measured.

        Returns:
            mean: image position without the perspective of near and far joints, and depth about the mean of the joints.
            deviation: of both image coordinates, and of depth.
        """
        shown = torch.where(seen[..., None], xy, xy.new_zeros(()))
        features = self.enter(torch.cat([shown.flatten(-2), seen.to(xy.dtype)], -1))
        for block in self.blocks:
            features = block(features)
        out = self.leave(self.norm(features)).unflatten(-1, (len(JOINTS), 5))
        depth = out[..., 2:3] - out[..., 2:3].mean(-2, keepdim=True)
        return torch.cat([shown + out[..., :2], depth], -1), out[..., 3:].clamp(-6.0, 2.0).exp()

    def both_sides(
        self, xy: Float[Tensor, "*batch frames joints 2"], seen: Bool[Tensor, "*batch frames joints"]
    ) -> tuple[Float[Tensor, "*batch frames joints 3"], Float[Tensor, "*batch frames joints 2"]]:
        """The mean of the answers for a scene and for its mirror image, so that left and right are treated alike."""
        order = list(MIRROR)
        mean, deviation = self(xy, seen)
        mirrored, other = self(xy[..., order, :] * xy.new_tensor([-1.0, 1.0]), seen[..., order])
        mirrored = mirrored[..., order, :] * xy.new_tensor([-1.0, 1.0, 1.0])
        return (mean + mirrored) / 2, (deviation + other[..., order, :]) / 2


def centre_and_size(
    xy: Float[Tensor, "*batch frames joints 2"], seen: Bool[Tensor, "*batch frames joints"]
) -> tuple[Float[Tensor, "*batch frames 1 2"], Float[Tensor, "*batch 1 1 1"]]:
    """Mean of what a frame shows, and the rms distance from it over the whole window, per coordinate.

    Example:
        >>> xy = torch.tensor([[[0.0, 0.0], [2.0, 4.0], [torch.nan, torch.nan]]])
        >>> centre, size = centre_and_size(xy, torch.tensor([[True, True, False]]))
        >>> centre.tolist(), round(float(size) ** 2, 4)
        ([[[1.0, 2.0]]], 2.5)
    """
    weight = seen[..., None].to(xy.dtype)
    shown = torch.where(seen[..., None], xy, xy.new_zeros(()))
    centre = shown.sum(-2, keepdim=True) / weight.sum(-2, keepdim=True).clamp_min(1)
    square = ((shown - centre) * weight).square().sum((-1, -2, -3)) / (2 * weight.sum((-1, -2, -3)).clamp_min(1))
    return centre, square.sqrt().clamp_min(torch.finfo(xy.dtype).tiny)[..., None, None, None]
