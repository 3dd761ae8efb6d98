"""What the command line understands; loads neither torch nor anything that does."""

from __future__ import annotations

import argparse

import torchrecon

__all__ = ["build_parser"]

_EXAMPLES = """examples:
  torchrecon reconstruct clip.mp4 -o out/            a video of a moving person to 3D
  torchrecon solve tracks.npz -o shape.npz           point tracks to 3D
  torchrecon rank tracks.npz --json                  how many shape bases stand above the noise
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="torchrecon",
        description="Tracked points on something that bends, in; its 3D shape over time, out.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=torchrecon.__version__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    solve = _command(commands, "solve", "tracks file to points3d, rotations, rank, ...")
    _tracks(solve)
    solve.add_argument("-o", "--out", required=True, metavar="OUT.npz", help="replaced atomically")
    solve.add_argument("--rank", default="auto", metavar="auto|INT", help="number of shape bases (default: auto)")
    solve.add_argument("--solver", default="auto", metavar="NAME", help="solver (default: auto)")
    solve.add_argument("--camera", metavar="FILE", help="camera JSON with the 3x3 intrinsics")

    rank = _command(commands, "rank", "number of shape bases of a tracks file")
    _tracks(rank)
    rank.add_argument("-o", "--out", metavar="OUT.json", help="also write the result here")
    rank.add_argument("--rule", default="auto", metavar="NAME", help="rule (default: auto)")
    rank.add_argument("--layout", choices=["vector", "stack"], help="default: the rule's own")

    track = _command(commands, "track", "video to tracks with covariance and visibility")
    _video(track)
    track.add_argument("-o", "--out", required=True, metavar="TRACKS.npz", help="replaced atomically")

    reconstruct = _command(commands, "reconstruct", "video to tracks, reconstruction and report")
    _video(reconstruct)
    reconstruct.add_argument("-o", "--out", required=True, metavar="DIR")
    reconstruct.add_argument("--rank", default="auto", metavar="auto|INT")
    reconstruct.add_argument("--solver", default="auto", metavar="NAME")
    reconstruct.add_argument("--force", action="store_true", help="replace another run's results in DIR")

    export = _command(commands, "export", "reconstruction to other programs' formats, chosen by the suffix")
    export.add_argument("reconstruction", metavar="RECON.npz")
    export.add_argument("-o", "--out", required=True, metavar="FILE.{csv,ply,trc,c3d}")
    export.add_argument("--fps", type=float, default=25.0, help="frames per second of the clip (default: 25)")
    return parser


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, text: str
) -> argparse.ArgumentParser:
    command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    command.add_argument("--device", default="cpu", help="torch device (default: cpu)")
    command.add_argument("--seed", type=int, default=0, help="seed of all randomness (default: 0)")
    command.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    return command


def _tracks(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "tracks",
        metavar="TRACKS",
        help="own .npz; CoTracker, TAPIR arrays; OpenPose (also a folder), COCO, MediaPipe, MMPose JSON; Penn Action; "
        "DeepLabCut, SLEAP; CSV; with --view C3D, TRC, BVH; told by content",
    )
    command.add_argument("--person", type=int, metavar="N", help="which person (default: 0, the longest and surest)")
    command.add_argument("--view", choices=["front", "side", "top"], help="take this view of a 3D file, 1 px = 1 mm")
    command.add_argument("--fps", type=float, help="frames per second (default: what the file states, else 25)")
    size = ("HEIGHT", "WIDTH")
    command.add_argument("--image-size", type=int, nargs=2, metavar=size, help="pixels, for positions given as shares")


def _video(command: argparse.ArgumentParser) -> None:
    command.add_argument("video", metavar="VIDEO", help="video file or folder of numbered images")
    command.add_argument("--masks", metavar="DIR", help="one image per frame, non-zero = person")
    command.add_argument("--depth", metavar="DIR", help="one 16-bit image per frame, millimetres, 0 = none")
    command.add_argument("--camera", metavar="FILE", help='JSON: {"K": 3x3} or {"cameras": [{"intrinsic": 3x3}]}')
    command.add_argument("--config", metavar="FILE", help="YAML with stage parameters (see configs/)")
