"""What every training job records of itself, and how it knows its own weights again."""

from __future__ import annotations

import json
import platform
import subprocess
from pathlib import Path

import lightning as L
import torch

import torchrecon

__all__ = ["made_by", "origin"]


def origin() -> dict[str, str]:
    """Which code on which machine."""
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return {
        "commit": commit.stdout.strip() or "unknown",
        "torchrecon": torchrecon.__version__,
        "torch": torch.__version__,
        "lightning": L.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def made_by(out: Path) -> str | None:
    """Hash of the settings of the weights that are already there."""
    report = out.with_suffix(".json")
    return json.loads(report.read_text()).get("settings_hash") if out.is_file() and report.is_file() else None
