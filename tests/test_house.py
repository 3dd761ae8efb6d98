"""The house: what loads when, which names are public, which tests the equations name."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import torchrecon as tr

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"torch", "kornia", "cv2", "lightning", "matplotlib", "plotly", "numpy"}


def loaded_after(code: str) -> set[str]:
    script = f"import sys\n{code}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=ROOT)
    return set(done.stdout.split())


def test_import_loads_nothing_heavy():
    assert not loaded_after("import torchrecon") & HEAVY


def test_help_loads_nothing_heavy():
    code = "from torchrecon.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass"
    assert not loaded_after(code) & HEAVY


def test_first_use_loads_no_video_training_or_plotting():
    names = loaded_after("import torchrecon as tr\ntr.Tracks, tr.reconstruct")
    assert "torch" in names
    assert not names & {"cv2", "lightning", "matplotlib", "plotly", "torchmetrics", "torchvision"}


def test_public_names_are_the_recorded_ones():
    recorded = (ROOT / "tests" / "public_names.txt").read_text().split()
    assert sorted(tr.__all__) == recorded
    for name in recorded:
        assert getattr(tr, name).__doc__


def test_nothing_imports_eval_by_name():
    for path in [*ROOT.glob("torchrecon/**/*.py"), *ROOT.glob("train/**/*.py"), *ROOT.glob("eval/**/*.py")]:
        top = path.relative_to(ROOT).parts[0]
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module or ""] if isinstance(node, ast.ImportFrom) and node.level == 0 else []
            roots = {module.split(".")[0] for module in modules}
            assert "eval" not in modules, path
            if top == "torchrecon":
                assert not roots & {"train", "eval", "tests"}, path
            if top == "train":
                assert not roots & {"eval", "tests"}, path
            if top == "eval":
                assert not roots & {"train", "tests"}, path


def test_every_equation_names_a_test_that_exists():
    rows = re.findall(r"^\| \((\d+)\) \|.*\| ([^|]+) \|$", (ROOT / "docs" / "equations.md").read_text(), re.M)
    assert [int(number) for number, _ in rows] == list(range(1, 35))
    have = {
        node.name
        for path in (ROOT / "tests").glob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    for number, tests in rows:
        names = re.findall(r"`(test_\w+)`", tests)
        assert names or tests.strip() == "open", number
        assert set(names) <= have, (number, set(names) - have)
        built = int(number) <= 31
        assert names or not built, f"equation {number} is built and has no test"
