"""Worker processes with one thread each: a ``map`` for independent pieces of a job.

Where workers cannot be had (one core, a script without an ``if __name__ == "__main__"`` guard, a machine that forbids
them) the same work is done in this process.
"""

from __future__ import annotations

import os
import pickle
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import lru_cache
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of processes: numerical libraries read it when they are loaded, that is when a process starts."""

MOST = 8
"""Processes at most: each holds a picture and its profiles."""

CHUNKS = 4
"""Chunks of a map per process: few enough that sending them costs nothing, enough that no process waits long."""


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Processes that live as long as the job; see `workers`."""

    def __init__(self, pool: ProcessPoolExecutor | None, folder: Path, count: int) -> None:
        self._pool, self._folder, self._count = pool, folder, count
        # The functions themselves are kept, so that no other can take the identity of one that was sent.
        self._sent: dict[int, tuple[Callable[..., Any], Path]] = {}

    def each(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
        """``map`` in which every call is a task of its own: for few, long, uneven pieces of work."""
        yield from self._run(function, list(zip(*arguments, strict=False)), 1)

    def spread(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
        """``map`` in chunks, for many short calls of one function, which is sent to the workers once."""
        tasks = list(zip(*arguments, strict=False))
        return list(self._run(function, tasks, -(-len(tasks) // (CHUNKS * self._count)) or 1))

    def _run(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], chunk: int) -> Iterator[Any]:
        pool = self._pool
        sent = None if pool is None or len(tasks) < 2 else self._send(function)
        done = 0
        if pool is not None and sent is not None:
            try:
                pieces = [tasks[i : i + chunk] for i in range(0, len(tasks), chunk)]
                for results in pool.map(_batch, [sent] * len(pieces), pieces):
                    for result in results:
                        yield result
                        done += 1
            except BrokenProcessPool:
                self._pool = None
        for task in tasks[done:]:
            yield function(*task)

    def _send(self, function: Callable[..., Any]) -> Path | None:
        """File the workers read the function from; None where it cannot be sent."""
        if id(function) not in self._sent:
            path = self._folder / f"{len(self._sent)}.pickle"
            try:
                path.write_bytes(pickle.dumps(function, protocol=pickle.HIGHEST_PROTOCOL))
            except (pickle.PicklingError, AttributeError, TypeError):
                return None
            self._sent[id(function)] = (function, path)
        return self._sent[id(function)][1]


@contextmanager
def workers(count: int | None = None) -> Iterator[Workers]:
    """Processes for a job, ended with it.

    Parameters
    ----------
    count : int, optional
        Default: one per core, at most `MOST`; fewer than two work in this process.
    """
    number = min(MOST, cores()) if count is None else count
    with tempfile.TemporaryDirectory(prefix="benchsim-") as folder:
        if number < 2:
            yield Workers(None, Path(folder), 1)
            return
        with environment(ONE_THREAD):
            pool = ProcessPoolExecutor(number, mp_context=get_context("spawn"), initializer=begin)
            try:
                yield Workers(pool, Path(folder), number)
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def environment(values: Mapping[str, str]) -> Iterator[None]:
    """Variables of the processes that are started within; this one's are then as they were."""
    before = {key: os.environ.get(key) for key in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def begin() -> None:
    """What every process does first: one thread for OpenCV, no Ctrl-C of its own, and an end when its parent's comes.

    The terminal's Ctrl-C goes to all processes; the job ends those it started itself. A parent that was killed cannot,
    but the pipe that it held is then closed.
    """
    import signal

    import cv2

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@lru_cache(maxsize=4)
def _load(path: Path) -> Callable[..., Any]:
    return pickle.loads(path.read_bytes())


def _batch(path: Path, tasks: Sequence[tuple[Any, ...]]) -> list[Any]:
    function = _load(path)
    return [function(*task) for task in tasks]
