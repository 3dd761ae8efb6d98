"""The hall around the player: a floor with planks and lines, four walls; geometry, so it moves with the camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.textures import value_noise

__all__ = ["Court", "sample_court"]

HALF = 22.0
"""Half the side of the square hall, metres."""
CEILING = 12.0
"""Height of the painted part of the walls, metres; above it all is dark."""
_FLOOR_PITCH = 0.05
_WALL_PITCH = 0.08


@dataclass(frozen=True, eq=False)
class Court:
    """Pictures of floor and walls.

    Attributes:
        floor: sharp and blurred colours over the hall's square, x to the right, z downwards.
        walls: colours over the perimeter (four sides one after the other) and height, top row highest.
    """

    floor: Float[Tensor, "2 3 rows cols"]
    walls: Float[Tensor, "3 steps perimeter"]

    def view(
        self, origins: Float[Tensor, "height width 3"], directions: Float[Tensor, "height width 3"]
    ) -> tuple[Float[Tensor, "3 height width"], Float[Tensor, "height width"]]:
        """Colour and ray parameter of the first surface of the hall along world rays that start inside it."""
        ox, oy, oz = origins.unbind(-1)
        dx, dy, dz = directions.unbind(-1)
        # The walls are far enough for their distance to be the smaller of the two exits.
        tx = (HALF * dx.sign() - ox) / torch.where(dx.abs() > 1e-6, dx, 1e-6)
        tz = (HALF * dz.sign() - oz) / torch.where(dz.abs() > 1e-6, dz, 1e-6)
        wall = torch.minimum(tx, tz)
        ground = torch.where(dy < -1e-4, -oy / dy, torch.inf)
        t = torch.minimum(wall, ground)
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        grid = torch.stack([x, z], -1)[None] / HALF
        near = F.grid_sample(self.floor[:1], grid, padding_mode="border", align_corners=False)[0]
        far = F.grid_sample(self.floor[1:], grid, padding_mode="border", align_corners=False)[0]
        # One row of the picture spans depth * spread / height of floor: the far floor needs the blurred colours.
        grazing = ((t * directions.norm(dim=-1)) ** 2 / oy.abs().clamp_min(0.3) / 60).clamp(0, 1)
        floor = near + (far - near) * grazing
        on_x = tx < tz
        along = torch.where(on_x, z * dx.sign(), -x * dz.sign()) / HALF
        side = torch.where(on_x, torch.where(dx > 0, 0.0, 2.0), torch.where(dz > 0, 1.0, 3.0)).to(along)
        u = (side + 0.5 * (along + 1)) / 2 - 1
        v = 1 - 2 * y / CEILING
        walls = F.grid_sample(
            self.walls[None], torch.stack([u, v], -1)[None], padding_mode="border", align_corners=False
        )[0]
        return torch.where(ground < wall, floor, walls), t


@lru_cache(maxsize=2)
def sample_court(seed: int) -> Court:
    """A hall of random colours; the two last ones are kept."""
    g = torch.Generator().manual_seed(seed)

    def rand(n: int) -> Tensor:
        return torch.rand(n, generator=g, dtype=torch.float32)

    n = round(2 * HALF / _FLOOR_PITCH)
    axis = ((torch.arange(n, dtype=torch.float32) + 0.5) / n * 2 - 1) * HALF
    z, x = axis[:, None], axis[None]
    plank = torch.floor((x + 40) / 0.12).long()
    piece = torch.floor((z + 40 + 0.6 * torch.remainder(plank * 0.618, 1.0)) / 1.2).long()
    shade = torch.sin((plank * 12.9898 + piece * 78.233).float()) * 43758.55
    shade = shade - torch.floor(shade)
    wood = torch.tensor([0.72, 0.52, 0.33], dtype=torch.float32) * (0.75 + 0.35 * rand(1))
    extent = torch.tensor([2 * HALF, 2 * HALF])
    grain = value_noise(extent, (n, n), (1.5, 0.4, 0.12), g)
    floor = wood[:, None, None] * (0.92 + 0.16 * shade + 0.07 * grain)
    paint = 0.2 + 0.7 * rand(3)
    zone = (x.abs() < 2.45) & ((z.abs() - 11.1).abs() < 2.9)
    floor[:, zone] = paint[:, None]
    radius = torch.hypot(x, z)
    arc = torch.hypot(x, z.abs() - 12.4)
    lines = (radius - 1.8).abs() < 0.05
    lines |= (z.abs() < 0.05) & (x.abs() < 7.5)
    lines |= (((x.abs() - 7.5).abs() < 0.05) & (z.abs() < 14.05)) | (((z.abs() - 14).abs() < 0.05) & (x.abs() < 7.55))
    lines |= ((arc - 6.75).abs() < 0.05) & (z.abs() < 14)
    floor[:, lines] = 0.92
    floor = (floor + 0.02 * value_noise(extent, (n, n), (0.1,), g)).clamp(0, 1)
    blurred = F.interpolate(F.avg_pool2d(floor[None], 8), size=(n, n), mode="bilinear", align_corners=False)[0]

    rows, cols = round(CEILING / _WALL_PITCH), round(8 * HALF / _WALL_PITCH)
    height = (CEILING * (1 - (torch.arange(rows, dtype=torch.float32) + 0.5) / rows))[:, None]
    s = 8 * HALF * ((torch.arange(cols, dtype=torch.float32) + 0.5) / cols)[None]
    base, seat = 0.35 + 0.4 * rand(3), 0.15 + 0.6 * rand(3)
    walls = base[:, None, None].expand(3, rows, cols).clone()
    stand = (height > 1.2) & (height < 5.5)
    step = torch.remainder(height - 1.2, 0.72) < 0.2
    walls[:, (stand & step).expand(rows, cols)] = seat[:, None]
    # Spectators: coarse random colours in the stands.
    crowd = torch.rand(3, rows // 5 + 1, cols // 6 + 1, generator=g, dtype=torch.float32)
    crowd = F.interpolate(crowd[None], size=(rows, cols), mode="nearest")[0]
    there = (stand & ~step) & (torch.remainder(torch.floor(s / 6.0), 3) != 1)
    walls = torch.where(there, 0.55 * walls + 0.45 * crowd, walls)
    board = (height > 0.1) & (height < 1.1)
    panel = torch.rand(3, 1, cols // 30 + 1, generator=g, dtype=torch.float32)
    panel = F.interpolate(panel[None], size=(1, cols), mode="nearest")[0].expand(3, rows, cols)
    walls = torch.where(board, panel * 0.8 + 0.1, walls)
    pillar = (torch.remainder(s, 5.5) < 0.5) & (height > 5.5)
    walls[:, pillar] *= 0.6
    walls += 0.05 * value_noise(torch.tensor([8 * HALF, CEILING]), (rows, cols), (1.0, 0.4, 0.2), g)
    walls *= torch.where(height < 6, 1.0, (1 - 0.12 * (height - 6)).clamp_min(0.25))
    return Court(torch.stack([floor, blurred]).contiguous(), walls.clamp(0, 1).contiguous())
