"""The documentation site; ``make docs`` builds it, warnings are errors, nothing is fetched."""

from __future__ import annotations

import importlib
import pkgutil
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE)]

import pictures  # noqa: E402

import torchrecon  # noqa: E402

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project, author, release = "torchrecon", "the torchrecon authors", torchrecon.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "reference/*.in"]
html_theme, html_title = "furo", "torchrecon"
html_copy_source = False
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
maximum_signature_line_length = 100
autodoc_default_options = {"members": True, "member-order": "bysource"}
napoleon_use_ivar = True
napoleon_use_rtype = False
STAGES = {
    "measurement": "Containers and camera models",
    "pipeline": "From tracks or a video to 3D",
    "io": "Files: videos, tracks, exports",
    "features": "SIFT, matching and tracking",
    "contour": "Contours and silhouettes",
    "depth": "Measured depth",
    "noise": "Covariance of a tracked point",
    "gaps": "Filling gaps",
    "rank": "Number of shape bases",
    "nrsfm": "Solvers",
    "models": "Recogniser",
    "metrics": "Metrics",
    "data": "Synthetic world, motion capture, benchmarks",
    "statespace": "Filters and smoothers",
    "linalg": "Linear algebra",
    "render": "Splatting and ray casting",
    "viz": "Pictures and the report page",
}


def modules(name: str) -> list[str]:
    """The module and all below it that name something public."""
    module = importlib.import_module(name)
    found = [name] if getattr(module, "__all__", None) or hasattr(module, "__path__") else []
    for info in pkgutil.iter_modules(getattr(module, "__path__", [])):
        if not info.name.startswith("_"):
            found += modules(f"{name}.{info.name}")
    return found


def write_reference(folder: Path) -> None:
    """A page for each package, a section for each module; names that a package re-exports stand at their home."""
    folder.mkdir(exist_ok=True)
    pages = []
    for package, title in STAGES.items():
        lines = [f"{title}", "=" * len(title), ""]
        for name in modules(f"torchrecon.{package}"):
            if name == "torchrecon.pipeline.predict":  # loads Lightning, which takes longer than all the rest
                continue
            is_package = hasattr(importlib.import_module(name), "__path__")
            heading = f"``{name}``"
            lines += [heading, "-" * len(heading), "", f".. automodule:: {name}"]
            lines += ["   :no-members:" if is_package else "   :members:", ""]
        pages.append(package)
        (folder / f"{package}.rst").write_text("\n".join(lines))
    listed = "\n".join(f"   {page}" for page in pages)
    (folder / "stages.rst").write_text(f"Stages\n======\n\n.. toctree::\n   :maxdepth: 1\n\n{listed}\n")


def tidy(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Docstrings write ``*batch`` and ``|x|`` as they are, which reStructuredText takes for markup."""
    example = False
    for index, line in enumerate(lines):
        example = (example and bool(line.strip())) or line.lstrip().startswith(">>>")
        if not example:
            parts = re.split(r"(``.*?``|`.*?`)", line)
            parts[::2] = [re.sub(r"(?<![\w*])\*(?=\w)|\|", r"\\\g<0>", part) for part in parts[::2]]
            lines[index] = "".join(parts)


def link_code(app: Sphinx, name: str, source: list[str]) -> None:
    """Links to source files lead to the reference, which shows the source; in the repository they open the file."""
    path = re.compile(r"\]\(\.\./(torchrecon/[\w/]+?)(?:/__init__)?(?:\.py|/)\)")
    source[0] = path.sub(lambda found: f"](#{found[1].replace('/', '.')})", source[0])


def begin(app: Sphinx) -> None:
    write_reference(HERE / "reference")
    pictures.draw_all(HERE / "pictures")


def setup(app: Sphinx) -> None:
    app.connect("builder-inited", begin)
    app.connect("autodoc-process-docstring", tidy)
    app.connect("source-read", link_code)
