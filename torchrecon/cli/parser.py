"""What the command line understands; loads neither torch nor anything that does."""

from __future__ import annotations

import argparse

import torchrecon
from torchrecon.cli.examples import EXAMPLES

__all__ = ["build_parser"]


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser(
        prog="torchrecon",
        description="Tracked points on something that bends, in; its 3D shape over time, out.",
        epilog=_examples(""),
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
    solve.add_argument("--prior", metavar="FILE", help="learned prior of human shape, for tracks of named joints")

    rank = _command(commands, "rank", "number of shape bases of a tracks file")
    _tracks(rank)
    rank.add_argument("-o", "--out", metavar="OUT.json", help="also write the result here")
    rank.add_argument("--rule", default="auto", metavar="NAME", help="rule (default: auto)")
    rank.add_argument("--figure", metavar="FILE", help="also draw the eigenvalues and the noise edge (.png, .svg)")
    rank.add_argument("--layout", choices=["vector", "stack"], help="default: the rule's own")

    track = _command(commands, "track", "video to tracks with covariance and visibility")
    _video(track)
    track.add_argument("-o", "--out", required=True, metavar="TRACKS.npz", help="replaced atomically")
    track.add_argument("--pose", choices=["rtmlib"], help="joints by a pose estimator instead of points on the skin")
    track.add_argument("--person", type=int, metavar="N", help="with --pose: which person (default: 0)")

    reconstruct = _command(commands, "reconstruct", "video to tracks, reconstruction and report")
    _video(reconstruct)
    reconstruct.add_argument("-o", "--out", required=True, metavar="DIR", help="holds everything of this run")
    reconstruct.add_argument("--rank", default="auto", metavar="auto|INT", help="number of shape bases (default: auto)")
    reconstruct.add_argument("--solver", default="auto", metavar="NAME", help="solver (default: auto)")
    reconstruct.add_argument("--force", action="store_true", help="replace another run's results in DIR")

    batch = _command(commands, "batch", "every clip and tracks file of a folder, each to a folder of its own")
    batch.add_argument(
        "folder",
        metavar="FOLDER",
        help="holds videos, folders of images (or NAME/{frames,masks,depth,camera.json}), tracks files",
    )
    batch.add_argument("-o", "--out", required=True, metavar="OUT", help="OUT/NAME/ for each, and manifest.json")
    batch.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each core)")
    batch.add_argument("--threads", type=int, default=1, metavar="N", help="threads of each process (default: 1)")
    batch.add_argument("--rank", default="auto", metavar="auto|INT", help="number of shape bases (default: auto)")
    batch.add_argument("--solver", default="auto", metavar="NAME", help="solver (default: auto)")
    batch.add_argument("--camera", metavar="FILE", help="camera JSON, the same for all")
    batch.add_argument("--config", metavar="FILE", help="YAML with stage parameters (see configs/)")
    batch.add_argument("--force", action="store_true", help="replace the results of a batch with other settings")

    report = _command(commands, "report", "page to look at a reconstruction, one file that works offline")
    report.add_argument("reconstruction", metavar="RECON.npz", help="what solve and reconstruct write")
    report.add_argument("-o", "--out", required=True, metavar="report.html", help="replaced atomically")
    report.add_argument("--tracks", metavar="TRACKS.npz", help="the tracks it was made from: gaps, confidence, K")
    report.add_argument("--video", metavar="VIDEO", help="the clip they were found in")

    export = _command(commands, "export", "reconstruction to other programs' formats, chosen by the suffix")
    export.add_argument("reconstruction", metavar="RECON.npz", help="what solve and reconstruct write")
    export.add_argument(
        "-o", "--out", required=True, metavar="FILE", help=".bvh .c3d .csv .glb .mp4 .npz .ply .rrd .trc"
    )
    export.add_argument("--tracks", metavar="TRACKS", help="rate, names, bones (default: those of RECON's own run)")
    export.add_argument("--fps", type=float, help="frames per second (default: that of the tracks, else 25)")
    scale = export.add_mutually_exclusive_group()
    scale.add_argument("--height", type=float, metavar="M", help="stature of the person: scales the result to metres")
    scale.add_argument("--unit-scale", type=float, metavar="X", help="metres per unit of the reconstruction")
    export.add_argument("--place", action="store_true", help="keep the place before the camera; needs intrinsics")
    export.add_argument("--video", metavar="VIDEO", help="the clip, for .mp4")
    export.add_argument("--force", action="store_true", help="replace an earlier sequence of .ply files")

    doctor = _plain(commands, "doctor", "what is installed, and what a missing extra would give")
    doctor.add_argument("--json", action="store_true", help="print the result as JSON on stdout")

    completion = _plain(commands, "completion", "print the completion script of a shell")
    completion.add_argument("shell", choices=["bash", "zsh", "fish"], help="whose script to print")
    return parser


def _examples(command: str) -> str:
    width = max(len(line) for line, _ in EXAMPLES[command])
    return "\n".join(["examples:", *(f"  {line:{width}}   {text}" for line, text in EXAMPLES[command])])


def _plain(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, text: str
) -> argparse.ArgumentParser:
    return commands.add_parser(
        name,
        help=text,
        description=text[0].upper() + text[1:] + ".",
        epilog=_examples(name),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, text: str
) -> argparse.ArgumentParser:
    command = _plain(commands, name, text)
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
    command.add_argument(
        "video",
        metavar="VIDEO",
        help="video file or folder of numbered images (frames/ in it brings masks/, depth/ and camera.json)",
    )
    command.add_argument("--masks", metavar="DIR", help="one image per frame, non-zero = person")
    command.add_argument("--depth", metavar="DIR", help="one 16-bit image per frame, millimetres, 0 = none")
    command.add_argument("--camera", metavar="FILE", help='JSON: {"K": 3x3} or {"cameras": [{"intrinsic": 3x3}]}')
    command.add_argument("--config", metavar="FILE", help="YAML with stage parameters (see configs/)")
