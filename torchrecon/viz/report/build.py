"""The page put together: everything it shows as data, its own style and script, nothing from outside."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from typing import Any, Protocol

from torchrecon.errors import ReconError
from torchrecon.measurement import RankEstimate, Reconstruction, Tracks
from torchrecon.viz.report.content import content, plain, times_of
from torchrecon.viz.report.payload import Block

__all__ = ["Film", "build_report"]

_SCRIPTS = ("data.js", "film.js", "scene.js", "charts.js", "page.js")


class Film(Protocol):
    """Pictures of a clip: image ``i`` shows frames ``i * every`` up to the next one."""

    @property
    def images(self) -> Sequence[bytes]: ...

    @property
    def every(self) -> int: ...

    @property
    def size(self) -> tuple[int, int]: ...


def build_report(
    reconstruction: Reconstruction,
    tracks: Tracks | None = None,
    rank: RankEstimate | None = None,
    film: Callable[[int], Film] | None = None,
    *,
    title: str = "Reconstruction",
    fps: float = 25.0,
    command: str | None = None,
    versions: Mapping[str, str] | None = None,
    settings: Mapping[str, object] | None = None,
    max_bytes: int = 8_000_000,
) -> bytes:
    """One HTML file that works from disk, without a network, in any current browser.

    It shows the film with the tracks on it, in step with a 3D view that can be turned, front, side and top view, a
    timeline, the evidence for K, gaps, bones, warnings in words and what made it. What was not given is named.

    Args:
        reconstruction: batch ``()``.
        tracks: the tracks it was made from, batch ``()``.
        rank: the estimate of K on these tracks.
        film: called with the number of bytes that its JPEG images may take together; ``size`` is the (height, width)
            in pixels of the coordinates in ``tracks``, whatever the size of the images.
        title: of the page; shown as text, whatever it holds.
        fps: frames per second where there are no tracks to tell.
        command: the command that made it.
        versions: program -> version.
        settings: what the run was asked for, name -> value.
        max_bytes: largest page. The film gets what the points leave; if the points alone need more than half of it,
            they are stored coarser, then fewer of them are drawn, and the page says so.

    Raises:
        ReconError: a batch, tracks or a rank estimate that do not fit, or more data than ``max_bytes`` can hold.

    Example:
        >>> import torch
        >>> from torchrecon.measurement import Status
        >>> rec = Reconstruction.from_points(torch.randn(3, 4, 3), torch.eye(3).expand(3, 3, 3), rank=1,
        ...                                  status=Status("ok", "by hand"))
        >>> build_report(rec, title="<b>").startswith(b"<!doctype html>")
        True
    """
    if reconstruction.points3d.ndim != 3:
        raise ReconError("build_report: one reconstruction at a time; index the batch first")
    frames, points = reconstruction.points3d.shape[:2]
    if tracks is not None and tuple(tracks.xy.shape[:-1]) != (frames, points):
        raise ReconError(
            f"build_report: the tracks are {tuple(tracks.xy.shape[:-1])} frames x points, the reconstruction is "
            f"{(frames, points)}; give the tracks it was made from"
        )
    if rank is not None and rank.eigenvalues.ndim != 1:
        raise ReconError("build_report: one rank estimate at a time; index the batch first")
    data, blocks = content(reconstruction, tracks, rank, film is not None, max_bytes)
    data |= {"title": title, "fps": tracks.fps if tracks is not None else fps}
    data["times"] = [round(t, 6) for t in times_of(tracks, frames, fps)]
    data["made"] = {"command": command, "versions": dict(versions or {}), "settings": plain(settings or {})}
    page = _page(title, data, blocks)
    if film is not None:
        # Base64 makes four characters of three bytes; the rest is the list of lengths.
        room = (max_bytes - len(page)) * 3 // 4 - 16 * frames - 4096
        pictures = film(max(room, 0))
        data["film"] = {"every": pictures.every, "sizes": [len(image) for image in pictures.images]}
        # Integer pixel centres: the first pixel begins at -0.5.
        data |= {"corner": [-0.5, -0.5], "size": list(pictures.size)}
        blocks["film"] = Block(base64.b64encode(b"".join(pictures.images)).decode("ascii"))
        page = _page(title, data, blocks)
    if len(page) > max_bytes:
        raise ReconError(f"build_report: {len(page)} bytes do not fit into max_bytes={max_bytes}; allow more")
    return page


def _page(title: str, data: Mapping[str, Any], blocks: Mapping[str, Block]) -> bytes:
    """Fill the template; the policy lets nothing run or load but this style, this script and images of the page."""
    style = _asset("page.css")
    script = '(() => {\n"use strict";\n' + "\n".join(_asset(name) for name in _SCRIPTS) + "\n})();\n"
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; img-src blob: data:; "
        "base-uri 'none'; form-action 'none'"
    )
    held = "\n".join(
        f'<script type="text/plain" id="block-{name}">{block.text}</script>' for name, block in blocks.items()
    )
    # "<" is the only character with which text in a script element could end it or open a comment.
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {"policy": policy, "title": html.escape(title), "style": style, "data": text, "blocks": held}
    parts["script"] = script
    filled = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _asset("page.html"))
    return filled.encode("utf-8", "replace")


def _asset(name: str) -> str:
    return (resources.files("torchrecon.viz.report") / name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
