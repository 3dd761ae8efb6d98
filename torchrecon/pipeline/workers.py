"""A few processes that work through many items, where the loss of one process loses the item in its hands only."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import TypeVar

__all__ = ["Died", "available_cores", "pin_threads", "work_through"]

Item = TypeVar("Item")
Result = TypeVar("Result")
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Died:
    """Stands for the result of an item whose process ended before it had one.

    Attributes:
        code: exit code; negative for a signal.
    """

    def __init__(self, code: int | None) -> None:
        self.code = code


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def pin_threads(threads: int) -> int:
    """Let torch and OpenCV use so many threads in this process; returns what torch used before."""
    import cv2
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    return before


def work_through(
    work: Callable[[Item], Result], items: Iterable[Item], workers: int, threads: int = 1
) -> Iterator[tuple[Item, Result | Died]]:
    """Yield each item with its result, in the order in which they are done.

    Args:
        work: a picklable function; what it raises ends its process.
        items: picklable, handed out one by one.
        workers: number of processes; 0 works in this one.
        threads: threads of each process, so that workers do not share cores and results do not depend on how many
            there are.
    """
    if workers == 0:
        before = pin_threads(threads)
        try:
            yield from ((item, work(item)) for item in items)
        finally:
            pin_threads(before)
        return
    waiting = deque(items)
    idle: list[tuple[SpawnProcess, Connection]] = []
    busy: dict[Connection, tuple[SpawnProcess, Item]] = {}
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                process, pipe = idle.pop() if idle else _start(work, threads)
                item = waiting.popleft()
                busy[pipe] = (process, item)
                try:
                    pipe.send(item)
                except OSError:  # it ended while it had nothing to do; reading finds that out
                    continue
            ready = wait(list(busy))
            for pipe in [pipe for pipe in busy if pipe in ready]:
                process, item = busy.pop(pipe)
                try:
                    result: Result = pipe.recv()
                except (EOFError, OSError):
                    process.join()
                    yield item, Died(process.exitcode)
                    continue
                idle.append((process, pipe))
                yield item, result
    finally:
        for process in (*(process for process, _ in idle), *(process for process, _ in busy.values())):
            process.terminate()
            process.join()


def _start(work: Callable[[Item], Result], threads: int) -> tuple[SpawnProcess, Connection]:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(work, there, threads), daemon=True)
    with _environment(dict.fromkeys(_THREADS, str(threads))):  # numerical libraries read it as they are loaded
        process.start()
    there.close()  # else the end of the process would not close the pipe
    return process, here


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(work: Callable[[Item], Result], pipe: Connection, threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent too, which ends this process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    pin_threads(threads)
    while True:
        try:
            item = pipe.recv()
        except EOFError:
            return
        pipe.send(work(item))


def _end_with_parent() -> None:
    """A parent that was killed cannot end its workers, and the next run must not meet them at its files."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
