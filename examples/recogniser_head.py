"""``Reconstructor`` inside a model: a network that names the action of tracked points by their 3D shape."""

from __future__ import annotations

import torch
from torch import nn

import torchrecon as tr
from torchrecon.data.synthetic import SyntheticClip, sample_body, sample_motion, turning_camera
from torchrecon.models.recogniser import Recogniser, read_out

CLASSES = ("run", "pass")


class NamesActions(nn.Module):
    """Tracks (*batch, frames, points) to logits (*batch, classes)."""

    def __init__(self, classes: tuple[str, ...], solver: str = "auto") -> None:
        super().__init__()
        self.reconstructor = tr.Reconstructor(solver=solver)  # brings no weights of its own
        self.recogniser = Recogniser(classes)

    @torch.no_grad()  # what is learnt here is the recogniser
    def look(self, tracks: tr.Tracks) -> torch.Tensor:
        """The shape and its mirror image from the side and from above, (2, *batch, views, frames, size, size).

        Parallel views leave the sign of depth open, so the recogniser sees both answers.
        """
        rec = self.reconstructor(tracks)
        upright = torch.diag(rec.points3d.new_tensor([1.0, -1.0, -1.0]))  # the first camera's y points down
        return torch.stack(
            [
                read_out(answer.points3d, tracks.visible, answer.rotations @ upright, self.recogniser.params)
                for answer in (rec, rec.mirrored())
            ]
        )

    def forward(self, tracks: tr.Tracks) -> torch.Tensor:
        return self.recogniser(self.look(tracks)).mean(0)


def film(action: str, seed: int, frames: int, points: int) -> torch.Tensor:
    """Tracks (frames, points, 2) of a synthetic player's skin before a camera that turns, with noise of 0.3 pixels."""
    g = torch.Generator().manual_seed(seed)
    body = sample_body(g)
    motion = sample_motion(action, body, frames=frames, generator=g)
    camera = turning_camera(motion, size=(240, 320), projection="orthographic", generator=g)
    clip = SyntheticClip(body, motion, camera, seed=seed)
    xyz, _ = clip.trajectory(clip.sample_surface(points, g))
    return camera.project(xyz).double() + 0.3 * torch.randn(frames, points, 2, generator=g, dtype=torch.float64)


def main(films: int = 3, frames: int = 40, points: int = 30, steps: int = 60, solver: str = "auto") -> dict[str, float]:
    """Learn a few films of each class by heart, which shows the wiring.

    Naming films of other people takes many more: ``python -m train.recogniser``.
    """
    torch.manual_seed(0)
    labels = torch.arange(len(CLASSES)).repeat(films)
    tracks = tr.Tracks(torch.stack([film(CLASSES[label], i, frames, points) for i, label in enumerate(labels)]))
    model = NamesActions(CLASSES, solver)
    pictures = model.look(tracks)  # they do not change while the recogniser learns
    optimiser = torch.optim.AdamW(model.recogniser.parameters(), lr=1e-3)
    losses = []
    for _ in range(steps):
        loss = nn.functional.cross_entropy(model.recogniser(pictures).flatten(0, 1), labels.repeat(2))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    model.eval()
    right = (model(tracks).argmax(-1) == labels).double().mean().item()
    print(f"loss {losses[0]:.2f} to {losses[-1]:.2f}; {100 * right:.0f} % of {len(labels)} films named rightly")
    return {"first": losses[0], "last": losses[-1], "right": right}


if __name__ == "__main__":
    main()
