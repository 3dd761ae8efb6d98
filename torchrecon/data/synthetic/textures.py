"""Solid textures of kit, skin and ball: colour as a function of part coordinates, so it sticks to the body.

A part's texture is a small volume of colours over its bounding box, read by trilinear interpolation. The voxel is
about as large as a pixel on the body, which is what keeps the texture from aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from torchrecon._typing import Float, Tensor
from torchrecon.data.synthetic.body import BALL_RADIUS, PART_NAMES, Body

__all__ = ["SolidTexture", "ball_texture", "body_textures", "sample_texture", "value_noise"]

_VOXEL = 0.006
"""Metres."""
_GLYPHS = {
    "0": "01110 10001 10001 10001 10001 10001 01110", "1": "00100 01100 00100 00100 00100 00100 01110",
    "2": "01110 10001 00001 00110 01000 10000 11111", "3": "11110 00001 00001 01110 00001 00001 11110",
    "4": "00010 00110 01010 10010 11111 00010 00010", "5": "11111 10000 11110 00001 00001 10001 01110",
    "6": "01110 10000 10000 11110 10001 10001 01110", "7": "11111 00001 00010 00100 01000 01000 01000",
    "8": "01110 10001 10001 01110 10001 10001 01110", "9": "01110 10001 10001 01111 00001 00001 01110",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class SolidTexture:
    """Colours (3, Z, Y, X) over the box from ``low`` to ``high`` (metres, part axes)."""

    colours: Float[Tensor, "3 depth height width"]
    low: Float[Tensor, " 3"]
    high: Float[Tensor, " 3"]


def sample_texture(texture: SolidTexture, local: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
    """Colours at part coordinates (metres)."""
    grid = (2 * (local - texture.low) / (texture.high - texture.low) - 1)[None, None, None]
    return F.grid_sample(texture.colours[None], grid, mode="bilinear", padding_mode="border", align_corners=True)[
        0, :, 0, 0
    ].T


def value_noise(
    extent: Float[Tensor, " d"], shape: tuple[int, ...], cells: tuple[float, ...], generator: torch.Generator
) -> Tensor:
    """Sum of random lattices of the given cell sizes (same unit as ``extent``), in 2 or 3 dimensions.

    Args:
        extent: size of the box along (x, y, z) or (x, y).
        shape: samples along (z, y, x) or (y, x).
    """
    total = torch.zeros(shape, dtype=torch.float32)
    for cell in cells:
        lattice = tuple(max(2, int(float(e) / cell) + 2) for e in reversed(extent.tolist()))
        values = torch.randn(lattice, generator=generator, dtype=torch.float32)
        mode = "trilinear" if len(shape) == 3 else "bilinear"
        total += F.interpolate(values[None, None], size=shape, mode=mode, align_corners=True)[0, 0]
    total /= len(cells) ** 0.5
    return total


def _colour(generator: torch.Generator, low: float, high: float) -> Tensor:
    return low + (high - low) * torch.rand(3, generator=generator, dtype=torch.float32)


def _grid(part: int, body: Body) -> tuple[Tensor, Tensor, tuple[int, int, int], Tensor]:
    """Low and high corner, volume shape (z, y, x) and voxel positions of a part's box."""
    scale, radii, length = body.scale[part].float(), body.radii[part].float(), float(body.length[part])
    reach = float(radii.max())
    low = torch.tensor([-reach, -float(radii[0]), -reach]) * scale
    high = torch.tensor([reach, length + float(radii[1]), reach]) * scale
    low, high = low.to(torch.float32), high.to(torch.float32)
    nx, ny, nz = (max(4, int(float(e) / _VOXEL) + 2) for e in (high - low))
    axes = [torch.linspace(float(a), float(b), n) for a, b, n in zip(low, high, (nx, ny, nz), strict=True)]
    z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    return low, high, (nz, ny, nx), torch.stack([x, y, z]).to(torch.float32)


def body_textures(body: Body) -> list[SolidTexture]:
    """One texture per part: jersey with number and stripes, shorts, skin, hair and face, socks, shoes."""
    g = torch.Generator().manual_seed(body.texture_seed)
    jersey, shorts = _colour(g, 0.25, 0.8), _colour(g, 0.25, 0.75)
    # The trim (number, stripes, socks) stands out in brightness from the jersey, as on any kit.
    trim = _colour(g, 0.1, 0.5) + (0.45 if float(jersey.mean()) < 0.5 else 0.0)
    tone = float(torch.rand((), generator=g, dtype=torch.float32))
    skin = torch.tensor([0.82, 0.62, 0.5]) * (1 - tone) + torch.tensor([0.48, 0.33, 0.25]) * tone
    skin = skin.to(torch.float32)
    hair, shoe = _colour(g, 0.05, 0.3), _colour(g, 0.1, 0.9)
    number = str(int(torch.randint(1, 100, (), generator=g)))
    stripes = 0.05 + 0.07 * float(torch.rand((), generator=g, dtype=torch.float32))
    h = body.stature
    textures = []
    for part, name in enumerate(PART_NAMES):
        low, high, shape, xyz = _grid(part, body)
        limb = name[2:] if name[1] == "_" else name
        extent = high - low
        noise = torch.stack([value_noise(extent, shape, (0.06, 0.036, 0.022), g) for _ in range(2)])
        base = {
            "thigh": shorts,
            "pelvis": shorts,
            "chest": jersey,
            "collar": jersey,
            "abdomen": jersey,
            "foot": shoe,
        }.get(limb, skin)
        colour = base[:, None, None, None].expand(3, *shape).clone()
        x, y, z = xyz
        contrast = 0.19
        if limb in ("chest", "collar", "abdomen", "pelvis", "thigh"):
            contrast = 0.24
            band = torch.remainder(y + 0.02 * noise[1], stripes) < 0.22 * stripes
            side = x.abs() > 0.82 * float(high[0])
            striped = side if limb == "chest" else band | side
            colour[:, striped] = trim[:, None]
        if limb == "thigh":
            colour[:, y > 0.78 * float(body.length[part])] = skin[:, None]
            contrast = 0.22
        if limb == "chest":
            _print_number(colour, xyz, number, trim, centre=0.42 * float(body.length[part]), height=0.10 * h)
        if limb == "head":
            face = (z > 0.25 * float(high[2])) & (y < 0.35 * float(high[1]))
            colour[:, ~face & (y > -0.25 * float(high[1]) - 0.6 * z.clamp_min(0))] = hair[:, None]
            for sign in (-1.0, 1.0):
                eye = (x - sign * 0.36 * float(high[0])) ** 2 + (y - 0.1 * float(high[1])) ** 2 < (0.012 * h / 1.8) ** 2
                colour[:, eye & (z > 0)] = 0.06
            mouth = (x.abs() < 0.3 * float(high[0])) & ((y + 0.5 * float(high[1])).abs() < 0.006) & (z > 0)
            colour[:, mouth] = torch.tensor([0.5, 0.15, 0.15], dtype=torch.float32)[:, None]
            contrast = 0.19
        if limb == "shank":
            sock = y > 0.68 * float(body.length[part])
            colour[:, sock] = trim[:, None]
            colour[:, sock & (torch.remainder(y, 0.06) < 0.02)] = jersey[:, None]
        if limb == "foot":
            contrast = 0.24
        mottle = contrast * torch.tanh(1.6 * noise[0])
        tint = 0.35 * contrast * torch.stack([noise[1], -0.5 * noise[1], -0.7 * noise[1]])
        textures.append(SolidTexture((colour + mottle + tint).clamp(0.02, 1).contiguous(), low, high))
    return textures


def _print_number(colour: Tensor, xyz: Tensor, number: str, ink: Tensor, centre: float, height: float) -> None:
    """The number on breast and back, readable from outside on both."""
    x, y, z = xyz
    width = 5 / 7 * height
    pitch = 1.25 * width
    for index, digit in enumerate(number):
        shift = (index - 0.5 * (len(number) - 1)) * pitch
        rows = torch.tensor([[int(c) for c in row] for row in _GLYPHS[digit].split()], dtype=torch.bool)
        # Seen from the front the body's left is on the right-hand side of the picture.
        across = torch.where(z > 0, x, -x)
        column = ((across - shift) / width + 0.5) * 5
        row = (0.5 - (y - centre) / height) * 7
        inside = (column >= 0) & (column < 5) & (row >= 0) & (row < 7) & (z.abs() > 0.01)
        hit = inside & rows[row.long().clamp(0, 6), column.long().clamp(0, 4)]
        colour[:, hit] = ink[:, None]


def ball_texture() -> SolidTexture:
    """Orange leather with black seams."""
    g = torch.Generator().manual_seed(7)
    n = 42
    low = torch.full((3,), -BALL_RADIUS, dtype=torch.float32)
    axis = torch.linspace(-BALL_RADIUS, BALL_RADIUS, n).to(torch.float32)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    colour = torch.tensor([0.83, 0.42, 0.14], dtype=torch.float32)[:, None, None, None].expand(3, n, n, n).clone()
    colour += 0.10 * value_noise(-2 * low, (n, n, n), (0.06, 0.03, 0.016), g)
    ring = (torch.hypot(x.abs() - 0.105, y) - 0.06).abs() < 0.0055
    seams = (x.abs() < 0.0055) | (z.abs() < 0.0055) | ring
    colour[:, seams] = 0.08
    return SolidTexture(colour.clamp(0, 1), low, -low)
