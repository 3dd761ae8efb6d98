"""A small network that corrects 2D keypoints, trained through the reconstruction: its only teacher is the 3D shape.

The detector of this example draws every joint towards two others, always in the same way. No 2D truth is ever shown:
the loss is the distance of the reconstructed points from 3D truth, and its gradient reaches the network through
``Reconstructor``.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor, nn

import torchrecon as tr
from torchrecon.linalg import rotation_from_vector

JOINTS = 8


class Refiner(nn.Module):
    """Every joint as a weighted sum of all; begins as the identity."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.eye(JOINTS))

    def forward(self, xy: Tensor) -> Tensor:
        """(frames, joints, 2) to the same."""
        middle = xy.mean(-2, keepdim=True)
        return middle + self.weight @ (xy - middle)


def film(seed: int, frames: int) -> Tensor:
    """A body of two shape bases before a turning camera: (frames, joints, 3), pixels."""
    g = torch.Generator().manual_seed(seed)
    time = torch.linspace(0, 3, frames)
    rest, mode = torch.randn(2, JOINTS, 3, generator=g)
    shape = 100 * (rest + 0.3 * torch.sin(2 * time + seed)[:, None, None] * mode)
    turn = rotation_from_vector(time[:, None] * torch.tensor([0.3, 1.0, 0.1]))
    return (shape - shape.mean(1, keepdim=True)) @ turn.mT


def loss_of(answer: tr.Reconstruction, truth: Tensor) -> Tensor:
    """Mean distance per mean size, for the better of the two mirror images."""
    errors = [(points - truth).norm(dim=-1).mean() for points in (answer.points3d, answer.mirrored().points3d)]
    return torch.stack(errors).min() / truth.norm(dim=-1).mean()


def main(films: int = 3, rounds: int = 8, frames: int = 8) -> list[float]:
    """Train, and print the 3D error of a film that was not trained on before and after; the error of every round."""
    g = torch.Generator().manual_seed(0)
    drawn = torch.eye(JOINTS) + 0.15 * (torch.eye(JOINTS)[torch.randperm(JOINTS, generator=g)] - torch.eye(JOINTS))

    refiner, solve = Refiner(), tr.Reconstructor(rank=2)
    optimiser = torch.optim.Adam(refiner.parameters(), lr=0.02)
    covariance = torch.eye(2).expand(frames, JOINTS, 2, 2)

    def error(truth: Tensor) -> Tensor:
        seen = drawn @ truth[..., :2]
        return loss_of(solve(tr.Tracks(refiner(seen), covariance=covariance)), truth)

    unseen = film(100, frames)
    with torch.no_grad():
        before = float(error(unseen))
    errors = []
    for turn in range(rounds):
        total = 0.0
        for seed in range(films):
            loss = error(film(seed, frames))
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            total += float(loss.detach())
        errors.append(total / films)
        print(f"round {turn + 1}: mean 3D error {errors[-1]:.4f}", flush=True)
    with torch.no_grad():
        after = float(error(unseen))
    print(f"a film that was not trained on: {before:.4f} before, {after:.4f} after")
    return errors


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
