"""``report.html``: one file that shows a reconstruction, in step with its film, and how far to trust it."""

from torchrecon.viz.report.build import Film, build_report

__all__ = ["Film", "build_report"]
