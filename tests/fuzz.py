"""Damaged inputs for every reader: ``python -m tests.fuzz --count 2000`` (``make fuzz``).

Each reader runs in a process of its own with 1 GiB of address space beyond what the imports take. An input passes if it
gives tracks or a ReconError within 5 s; everything else is counted under what it was: another exception, too slow, the
process died, or it did what a reader must not (write outside its folder, run code, start a process, open a socket).
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

from tests.mutants import mutate
from tests.track_files import WRITERS

SECONDS = 5.0
GIB = 1 << 30
_FORBIDDEN = (
    *("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "socket.connect", "pickle.find_class"),
    *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.chmod", "os.link", "os.symlink", "shutil.rmtree"),
)


def read_mutants(name: str, count: int, seed: int, folder: Path, watch: Any = None):
    """Read ``count`` damaged files of a format; yields the number, the outcome and the seconds of each."""
    from torchrecon.errors import ReconError
    from torchrecon.io.tracks import load_tracks
    from torchrecon.measurement import Tracks

    originals = [write(folder) for write in WRITERS[name]]
    for index in range(count):
        rng = random.Random(f"{name} {seed} {index}")
        original = rng.choice(originals)
        target = mutate(original, folder / f"mutant{original.suffix}", rng)
        view = rng.choice((None, "front"))
        if watch is not None:
            watch(True)
        start = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", UserWarning)  # what readers tell the user
                answer = load_tracks(target, view=view)
            outcome = "tracks" if isinstance(answer, Tracks) else f"returned {type(answer).__name__}"
        except ReconError as error:
            outcome = (
                "ReconError" if str(folder) in str(error) or str(error).startswith("fps") else f"names no file: {error}"
            )
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"[:200]
        finally:
            if watch is not None:
                watch(False)
        yield index, outcome, time.perf_counter() - start


def _worker(name: str, count: int, seed: int) -> None:
    """One line of JSON per damaged file."""
    import h5py  # noqa: F401  (so that its import is not taken for the reader's doing)
    import scipy.optimize  # noqa: F401

    state = {"on": False, "bad": ""}

    def audit(event: str, arguments: tuple[Any, ...]) -> None:
        if not state["on"]:
            return
        if event.startswith(_FORBIDDEN):
            state["bad"] = event
        elif event == "exec" and not Path(arguments[0].co_filename).is_file() and "frozen" not in str(arguments[0]):
            state["bad"] = f"runs {arguments[0]}"  # code that is no module of the installation
        elif event == "open" and (set(str(arguments[1] or "")) & set("wax+") or (arguments[2] or 0) & 3):
            state["bad"] = f"writes {arguments[0]}"

    class Slow(BaseException):
        pass

    def ring(*_: Any) -> None:
        raise Slow

    def watch(on: bool) -> None:
        state["on"] = on
        signal.setitimer(signal.ITIMER_REAL, SECONDS if on else 0)

    sys.addaudithook(audit)
    signal.signal(signal.SIGALRM, ring)
    with tempfile.TemporaryDirectory() as folder:
        list(read_mutants(name, 3, seed - 1, Path(folder)))  # what is imported on first use
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + GIB
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for index, outcome, seconds in read_mutants(name, count, seed, Path(folder), watch):
            grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
            print(json.dumps([index, state["bad"] or outcome, seconds, grown / 1024]), flush=True)
            state["bad"] = ""


def main() -> int:
    """Run all readers and print a table; 1 if any input failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000, help="damaged files per reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", choices=sorted(WRITERS), help="only this one")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        _worker(options.format, options.count, options.seed)
        return 0
    failed = 0
    print(f"{'reader':26} {'files':>6} {'tracks':>7} {'errors':>7} {'failed':>7} {'worst s':>8} {'peak MiB':>9}")
    for name in [options.format] if options.format else WRITERS:
        command = [sys.executable, "-m", "tests.fuzz", "--worker", "--format", name]
        command += ["--count", str(options.count), "--seed", str(options.seed)]
        done = subprocess.run(command, capture_output=True, text=True)
        rows = [json.loads(line) for line in done.stdout.splitlines()]
        outcomes = Counter(row[1] for row in rows)
        good = outcomes["tracks"] + outcomes["ReconError"]
        slow = [row[0] for row in rows if row[2] > SECONDS]
        bad = options.count - good + len(slow)
        failed += bad
        worst, peak = (max((row[i] for row in rows), default=0.0) for i in (2, 3))
        counts = f"{len(rows):6} {outcomes['tracks']:7} {outcomes['ReconError']:7} {bad:7}"
        print(f"{name:26} {counts} {worst:8.2f} {peak:9.0f}", flush=True)
        for row in rows:
            if row[1] not in ("tracks", "ReconError"):
                print(f"    {name} {row[0]}: {row[1]}")
        if done.returncode:
            print(f"    {name} {len(rows)}: the process ended with {done.returncode}: {done.stderr[-500:]}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
