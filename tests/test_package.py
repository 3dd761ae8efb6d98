"""The wheel: what it ships, and that it works where the repository is not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "torchrecon", source / "torchrecon", ignore=shutil.ignore_patterns("__pycache__"))
    (source / "train").mkdir()  # a neighbour that must not be shipped
    (source / "train" / "__init__.py").touch()
    code = "from setuptools import build_meta; print(build_meta.build_wheel('dist'))"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return source / "dist" / done.stdout.split()[-1]


def test_the_wheel_holds_the_package_its_types_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"torchrecon"}
    shipped = {name for name in names if name.startswith("torchrecon/")}
    written = {str(p.relative_to(ROOT)) for p in (ROOT / "torchrecon").rglob("*.py")}
    assert written | {"torchrecon/py.typed"} <= shipped
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert any(name.endswith("entry_points.txt") for name in names)


def test_the_wheel_works_without_the_repository(wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    code = "\n".join(
        [
            "import pathlib, torch, torchrecon as tr",
            "from torchrecon.cli import main",
            f"assert pathlib.Path(tr.__file__).is_relative_to({str(tmp_path / 'site')!r}), tr.__file__",
            "tr.Tracks(torch.randn(12, 8, 2, generator=torch.Generator().manual_seed(0))).save('t.npz')",
            "assert main(['solve', 't.npz', '-o', 'r.npz', '--rank', '1', '--solver', 'rigid']) == 0",
            "assert main(['export', 'r.npz', '-o', 'r.bvh', '--tracks', 't.npz']) == 0",
        ]
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site"), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "r.bvh").read_text().startswith("HIERARCHY")
