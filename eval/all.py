"""Everything on one page: ``python -m eval.all``.

Runs the jobs of all tables and figures one after another, each from its own cache, so that an interrupted run goes on
where it was; a job whose result comes from this very code is not run again. Then it writes one self-contained page:
tables with their definitions, figures, and every prose claim of the paper with what became of it. ``--page``: no job is
run, the page shows what is there.
"""

from __future__ import annotations

import argparse
import base64
import html
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eval.claims import CLAIMS, judge
from eval.job import ROOT, provenance, read_json, source_digest, write_json, write_text
from torchrecon.errors import ReconError

__all__ = ["Job", "jobs_of", "main", "page"]

_STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:72em;margin:2em auto;padding:0 1em}"
    "pre{background:#f4f4f4;padding:.8em;overflow-x:auto;font-size:12px}img{max-width:100%}"
    "td,th{text-align:left;vertical-align:top;padding:.25em .6em;border-bottom:1px solid #ccc}"
    ".yes{color:#060}.no{color:#a00}"
)


@dataclass(frozen=True)
class Job:
    """A job and the folder that it writes ``NAME.json``, ``NAME.txt`` and pictures into.

    Attributes:
        name, module, out: of its files, of its code, and its folder.
        arguments: of its command line.
        small: it has a version that fits into the smoke run.
        prints: it writes no text of its own; what it prints is kept.
        takes: the options of all jobs that it knows.
    """

    name: str
    module: str
    out: Path
    arguments: tuple[str, ...] = ()
    small: bool = True
    prints: bool = False
    takes: tuple[str, ...] = ("seed", "smoke", "fresh")


def jobs_of(root: Path, regime: str, smoke: bool) -> list[Job]:
    """Everything that the page shows, cheapest answers first where order does not matter.

    Example:
        >>> [job.name for job in jobs_of(Path("runs"), "turning", smoke=True)]
        ['table2', 'table3', 'table4', 'table5', 'figures', 'table1', 'ablation']
        >>> [job.name for job in jobs_of(Path("runs"), "turning", smoke=False) if not job.small]
        ['turns', 'prior', 'reliability', 'frontend']
    """
    tail = "-smoke" if smoke else ""
    where = ("--regime", regime)
    tables = root / f"tables-{regime}{tail}"
    jobs = [Job(f"table{n}", f"eval.table{n}", tables, where) for n in (2, 3, 4, 5)]
    jobs.append(Job("figures", "eval.figures", root / f"figures-{regime}{tail}", (*where, "--tables", str(tables))))
    jobs.append(Job("turns", "eval.turns", root / "turns", small=False, takes=("seed", "fresh")))
    jobs.append(Job("prior", "eval.prior", root / "prior-eval", small=False))
    # The whole grid of the reliability job is hours; its small one shows every part.
    reliability = Job("reliability", "eval.reliability", root / "reliability", ("--smoke",), small=False, takes=())
    frontend = Job(
        "frontend", "eval.frontend", root / "frontend", ("--synthetic",), small=False, prints=True, takes=("seed",)
    )
    jobs += [reliability, frontend]
    jobs.append(Job("table1", "eval.table1", root / f"table1-{regime}{tail}", where))
    # Its answers are read by the recogniser that Table 1 has trained.
    jobs.append(Job("ablation", "eval.ablation", root / f"ablation{tail}"))
    return [job for job in jobs if job.small or not smoke]


def run_job(job: Job, arguments: argparse.Namespace) -> str | None:
    """Run one job in a process of its own; its last sentence where it fails.

    A job is left out where its result was written by this very code and command, and by nothing since.
    """
    command = [sys.executable, "-m", job.module, "-o", str(job.out), *job.arguments]
    command += ["--seed", str(arguments.seed)] * ("seed" in job.takes)
    command += [f"--{name}" for name in ("smoke", "fresh") if name in job.takes and getattr(arguments, name)]
    code = {"code": source_digest("torchrecon", "eval", "train"), "command": command[2:]}
    result, stamp = (job.out / f"{job.name}{tail}.json" for tail in ("", "-code"))
    known = _there(job) and stamp.is_file() and result.stat().st_mtime <= stamp.stat().st_mtime
    if known and not arguments.fresh and read_json(stamp) == code:
        print(f"== {job.name}: kept, the result of this code is there", flush=True)
        return None
    print(f"== {job.name}: python -m {' '.join(command[2:])}", flush=True)
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        if job.prints:
            write_text(job.out / f"{job.name}.txt", done.stdout)
        write_json(stamp, code)
        return None
    said = [line for line in done.stderr.splitlines() if line.strip()] or ["no message"]
    return f"{job.name} ended with exit code {done.returncode}: {said[-1]}"


def page(jobs: list[Job], failures: dict[str, str], source: dict[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    """The page as one HTML text with its pictures inside, and the verdicts on the paper's claims."""
    results = {job.name: read_json(job.out / f"{job.name}.json") for job in jobs if _there(job)}
    verdicts = []
    rows = ["<tr><th>where</th><th>the paper says</th><th>here</th></tr>"]
    for claim in CLAIMS:
        verdict = judge(claim, results)
        verdicts.append({"where": claim.where, "claim": claim.text, "holds": verdict.holds, "why": verdict.why})
        colour = {True: "yes", False: "no", None: ""}[verdict.holds]
        rows.append(
            f"<tr><td>{html.escape(claim.where)}</td><td>{html.escape(claim.text)}</td>"
            f"<td class='{colour}'>{html.escape(str(verdict))}</td></tr>"
        )
    parts = ["<h1>The paper's evaluation</h1>", f"<p>{html.escape(_origin(source))}</p>"]
    parts += [f"<p class='no'>{html.escape(text)}</p>" for text in failures.values()]
    parts += ["<h2>What the paper says in prose</h2>", f"<table>{''.join(rows)}</table>"]
    for job in sorted(jobs, key=lambda job: (job.name == "figures", job.name)):
        parts.append(f"<h2>{html.escape(job.name)}</h2>")
        if not _there(job):
            parts.append(f"<p>not computed; <code>python -m {job.module}</code></p>")
            continue
        commit = results[job.name].get("provenance", {}).get("commit")
        parts.append(f"<p>commit {html.escape(str(commit))}</p>")
        parts.append(f"<pre>{html.escape((job.out / f'{job.name}.txt').read_text(encoding='utf-8'))}</pre>")
        pictures = "figure*.png" if job.name == "figures" else f"{job.name}.png"
        for file in sorted(job.out.glob(pictures)):
            data = base64.b64encode(file.read_bytes()).decode()
            parts.append(f"<h3>{html.escape(file.stem)}</h3><img alt='{file.stem}' src='data:image/png;base64,{data}'>")
    head = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>torchrecon</title><style>{_STYLE}</style>"
    return head + "\n".join(parts) + "</html>\n", verdicts


def _there(job: Job) -> bool:
    return (job.out / f"{job.name}.json").is_file() and (job.out / f"{job.name}.txt").is_file()


def _origin(source: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in source["versions"].items())
    return f"commit {source['commit']}; {versions}; {source['machine']}; seed {source['seed']}"


def main(argv: list[str] | None = None) -> int:
    """Command line of the job; exit code 2 where a job failed (the page says which, and shows the others)."""
    parser = argparse.ArgumentParser(prog="python -m eval.all", description=__doc__.split("\n")[0])
    parser.add_argument("--regime", choices=("turning", "depth"), default="turning")
    parser.add_argument("--only", nargs="+", metavar="JOB", help="table1 ... table5, figures, ablation ...")
    parser.add_argument("--page", action="store_true", help="run nothing, show what is there")
    parser.add_argument("--smoke", action="store_true", help="the small version of every job")
    parser.add_argument("--fresh", action="store_true", help="throw away caches of another configuration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", metavar="DIR", default="runs", help="holds the folders of all jobs")
    arguments = parser.parse_args(argv)
    started = time.perf_counter()
    root = Path(arguments.out)
    jobs = jobs_of(root, arguments.regime, arguments.smoke)
    failures: dict[str, str] = {}
    name = f"all-{arguments.regime}{'-smoke' if arguments.smoke else ''}"
    try:
        unknown = sorted(set(arguments.only or ()) - {job.name for job in jobs})
        if unknown:
            raise ReconError(f"--only {unknown[0]}: is not one of {', '.join(job.name for job in jobs)}")
        for job in jobs:
            if not arguments.page and (arguments.only is None or job.name in arguments.only):
                failed = run_job(job, arguments)
                if failed is not None:
                    failures[job.name] = failed
                    print(f"eval.all: {failed}", file=sys.stderr, flush=True)
        source = provenance("cpu", arguments.seed)
        text, verdicts = page(jobs, failures, source)
        write_json(root / f"{name}.json", {"claims": verdicts, "failures": failures, "provenance": source})
        write_text(root / f"{name}.html", text)
    except ReconError as error:
        print(f"eval.all: {error}", file=sys.stderr)
        return 2
    for verdict in verdicts:
        says = {True: "holds", False: "does not hold", None: "not judged"}[verdict["holds"]]
        print(f"{verdict['where']:<12} {verdict['claim']}\n{'':<12}   {says}: {verdict['why']}")
    print(f"wrote {root}/{name}.html and .json after {time.perf_counter() - started:.0f} s")
    return 2 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
