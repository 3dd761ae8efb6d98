"""What is installed, what works, and what a missing extra would give."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
from importlib import metadata
from typing import Any

import torchrecon
from torchrecon.errors import ReconError

__all__ = ["CORE", "EXTRAS", "examine", "run"]

# Distribution and the module it brings.
CORE = {
    "torch": "torch",
    "kornia": "kornia",
    "numpy": "numpy",
    "opencv-python-headless": "cv2",
    "lightning": "",  # needed in training only and slow to load: its version is enough
    "scipy": "scipy",
    "safetensors": "safetensors",
    "jaxtyping": "jaxtyping",
    "pyyaml": "yaml",
    "tqdm": "tqdm",
}
# Extra, its distributions, and what it gives.
EXTRAS: dict[str, tuple[tuple[str, ...], str]] = {
    "io": (("ezc3d", "h5py"), "writes C3D marker files, reads DeepLabCut and SLEAP H5 files"),
    "viz": (("matplotlib",), "draws views.png beside a reconstruction, and figures"),
    "rerun": (("rerun-sdk",), "exports .rrd recordings for the Rerun viewer"),
    "pose": (("rtmlib", "onnxruntime"), "finds joints in a video: track --pose rtmlib (weights apart)"),
    "train": (("jsonargparse",), "trains the recogniser from the command line"),
}


def run(options: argparse.Namespace) -> None:
    """``torchrecon doctor``."""
    found = examine()
    if options.json:
        print(json.dumps(found, allow_nan=False))
    else:
        print("\n".join(_lines(found)))
    broken = [f"{name} {part['problem']}" for name, part in found["core"].items() if part["problem"]]
    if broken:
        raise ReconError(f"{'; '.join(broken)}; install torchrecon again with pip install --force-reinstall torchrecon")


def examine() -> dict[str, Any]:
    """Versions, problems, devices and extras; loads what it looks at.

    Example:
        >>> found = examine()
        >>> found["core"]["torch"]["problem"] is None, "cpu" in found["devices"]
        (True, True)
    """
    core = {name: _package(name, module) for name, module in CORE.items()}
    return {
        "torchrecon": torchrecon.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "core": core,
        "devices": [] if core["torch"]["problem"] else _devices(),
        "extras": {name: _extra(name, *rest) for name, rest in EXTRAS.items()},
    }


def _package(distribution: str, module: str) -> dict[str, str | None]:
    try:
        version: str | None = metadata.version(distribution)
        if module:
            importlib.import_module(module)
    except metadata.PackageNotFoundError:
        return {"version": None, "problem": "is not installed"}
    except Exception as error:  # a broken binary fails in ways of its own: say how, and look at the rest
        return {"version": version, "problem": f"cannot be loaded ({type(error).__name__}: {error})"}
    return {"version": version, "problem": None}


def _devices() -> list[str]:
    import torch

    found = ["cpu"]
    found += [f"cuda:{i} {torch.cuda.get_device_name(i)}" for i in range(torch.cuda.device_count())]
    return found + (["mps"] if torch.backends.mps.is_available() else [])


def _extra(name: str, distributions: tuple[str, ...], gives: str) -> dict[str, Any]:
    versions = {distribution: _package(distribution, "")["version"] for distribution in distributions}
    missing = [distribution for distribution, version in versions.items() if version is None]
    install = f"pip install 'torchrecon[{name}]'" if missing else None
    return {"gives": gives, "versions": versions, "missing": missing, "install": install}


def _lines(found: dict[str, Any]) -> list[str]:
    lines = [f"torchrecon {found['torchrecon']}, Python {found['python']}, {found['platform']}"]
    lines += [f"devices: {', '.join(found['devices']) or 'none'}; {found['cores']} cores", ""]
    for name, part in found["core"].items():
        lines.append(f"  {'no' if part['problem'] else 'ok'}  {name} {part['version'] or ''} {part['problem'] or ''}")
    lines += ["", "extras:"]
    for name, extra in found["extras"].items():
        state = "no" if extra["missing"] else "ok"
        lines.append(f"  {state}  {name}: {extra['gives']}" + (f"; {extra['install']}" if extra["install"] else ""))
    return [line.rstrip() for line in lines]
