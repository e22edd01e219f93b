"""Processes of this machine with one thread each: tasks as they are finished, or a ``map`` for pieces of a job.

They are spoken to over pairs of sockets without a name, which nobody else can open, and end when those are closed:
with the job, or when it is killed. They never run the script that started them. Where workers cannot be had (one
core, what is to be done is the script's own, a machine that forbids them) a ``map`` is done in this process.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import ModuleType
from typing import Any

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of processes: numerical libraries read it when they are loaded, that is when a process starts."""

MEMORY_KEPT = {"MALLOC_TRIM_THRESHOLD_": str(2**32), "MALLOC_MMAP_MAX_": "0"}
"""Environment of processes that work on pictures: to hand freed memory back to the kernel and fetch it again was a
third of their time."""

MOST = 8
"""Processes of a map at most: each holds a picture and its profiles."""

CHUNKS = 4
"""Chunks of a map per process: few enough that sending them costs nothing, enough that no process waits long."""

FUNCTIONS_KEPT = 4
"""Functions that a process keeps, so that they need not be sent again: a problem of many megabytes hangs on them."""


class ProcessDied(Exception):
    """A process died of its tasks."""


class Unsent(Exception):
    """A function or its arguments cannot be sent to another process."""


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ended(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result, or the exception that ended it with a note on where: the others go on."""
    try:
        return function(*arguments)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)[-3:]
        error.add_note(" < ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in reversed(frames)))
        return error.with_traceback(None)


class _Process:
    """A process of this machine that does one piece of work after the other."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.connection, other = context.Pipe()
        self._kept: deque[Callable[..., Any]] = deque(maxlen=FUNCTIONS_KEPT)
        self._process = context.Process(target=_serve, args=(other,))
        with environment(ONE_THREAD | MEMORY_KEPT), _no_script():
            self._process.start()
        # Its end is then its own alone, and closed when it dies.
        other.close()

    def send(self, function: Callable[..., Any], tasks: bytes) -> None:
        place = next((k for k, kept in enumerate(self._kept) if kept is function), None)
        data = None
        if place is None:
            data = _sendable(function)
            self._kept.append(function)
        try:
            self.connection.send((place, data))
            self.connection.send_bytes(tasks)
        except OSError:
            pass  # it died, which is seen when its answer is waited for

    def end(self) -> None:
        self.connection.close()
        self._process.kill()
        self._process.join()


class Processes:
    """So many processes, started as they are needed; see `processes`."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._all: list[_Process] = []
        self._idle: list[_Process] = []

    def each(
        self, function: Callable[..., Any], pieces: Sequence[Sequence[tuple[Any, ...]]], tries: int = 1
    ) -> Generator[tuple[int, Any], None, None]:
        """Index of a piece, and its results or the exception that ended it, as they come.

        Parameters
        ----------
        function : callable
        pieces : sequence of sequence of tuple
            Its arguments, once per call.
        tries : int
            Processes that may die of a piece before `ProcessDied` is its result.

        Raises
        ------
        Unsent
            If the function or its arguments cannot be pickled.
        """
        waiting, deaths = deque(range(len(pieces))), [0] * len(pieces)
        busy: dict[Any, tuple[int, _Process]] = {}
        # All at once: each takes seconds to begin, and listens only then.
        while len(self._idle) < min(self.count, len(pieces)):
            self._another()
        try:
            while waiting or busy:
                while waiting and len(busy) < self.count:
                    tasks = _sendable(pieces[waiting[0]])
                    if not self._idle:
                        self._another()
                    process = self._idle.pop()
                    busy[process.connection] = (waiting.popleft(), process)
                    process.send(function, tasks)
                for connection in wait(list(busy)):
                    k, process = busy.pop(connection)
                    try:
                        result = pickle.loads(process.connection.recv_bytes())
                        self._idle.append(process)
                    except (EOFError, OSError):
                        self._end(process)
                        deaths[k] += 1
                        if deaths[k] < tries:
                            waiting.append(k)
                            continue
                        result = ProcessDied()
                    yield k, result
        finally:
            for _, process in busy.values():
                self._end(process)

    def _another(self) -> None:
        process = _Process()
        self._all.append(process)
        self._idle.append(process)

    def _end(self, process: _Process) -> None:
        process.end()
        if process in self._all:
            self._all.remove(process)

    def end(self) -> None:
        """Whatever they are at."""
        while self._all:
            self._end(self._all[-1])


@contextmanager
def processes(count: int) -> Iterator[Processes]:
    """Processes of this machine, ended with the block."""
    started = Processes(count)
    try:
        yield started
    finally:
        started.end()


class Workers:
    """Processes that live as long as the job; see `workers`."""

    def __init__(self, pool: Processes | None) -> None:
        self._pool = pool

    def each(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
        """``map`` in which every call is a task of its own: for few, long, uneven pieces of work."""
        yield from self._run(function, list(zip(*arguments, strict=False)), 1)

    def spread(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
        """``map`` in chunks, for many short calls of one function, which is sent to the workers once."""
        tasks = list(zip(*arguments, strict=False))
        count = self._pool.count if self._pool else 1
        return list(self._run(function, tasks, -(-len(tasks) // (CHUNKS * count)) or 1))

    def _run(self, function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], chunk: int) -> Iterator[Any]:
        done = 0
        if self._pool is not None and len(tasks) > 1:
            pieces = [tasks[i : i + chunk] for i in range(0, len(tasks), chunk)]
            try:
                with closing(self._pool.each(function, pieces)) as pairs:
                    for results in _in_order(pairs):
                        if isinstance(results, Exception):
                            raise results
                        for result in results:
                            yield result
                            done += 1
            except ProcessDied:
                self._pool = None
            except Unsent:
                pass
        for task in tasks[done:]:
            yield function(*task)


def _in_order(pairs: Iterable[tuple[int, Any]]) -> Iterator[Any]:
    found, following = {}, 0
    for k, value in pairs:
        found[k] = value
        while following in found:
            yield found.pop(following)
            following += 1


@contextmanager
def workers(count: int | None = None) -> Iterator[Workers]:
    """Processes for a job, ended with it.

    Parameters
    ----------
    count : int, optional
        Default: one per core, at most `MOST`; fewer than two work in this process.
    """
    number = min(MOST, cores()) if count is None else count
    if number < 2:
        yield Workers(None)
        return
    with processes(number) as pool:
        yield Workers(pool)


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


@contextmanager
def _no_script() -> Iterator[None]:
    """Processes that are started within do not import the script, which would do again all that has no guard."""
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def _serve(connection: Connection) -> None:
    """Of a process: do what comes, until nobody is there to send more.

    The terminal's Ctrl-C goes to all processes; the job ends those it started itself. A parent that was killed cannot,
    but the pipe that it held is then closed.
    """
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import cv2

    cv2.setNumThreads(1)
    kept: deque[Any] = deque(maxlen=FUNCTIONS_KEPT)
    while True:
        try:
            place, data = connection.recv()
            tasks = connection.recv_bytes()
        except (EOFError, OSError):
            return
        if data is not None:
            kept.append(ended(pickle.loads, data))
        connection.send_bytes(_packed(ended(_batch, kept[-1 if place is None else place], tasks)))


def end_with_parent() -> None:
    """Of a process that was spawned: end as soon as its parent does, in the midst of whatever it is at."""
    parent = parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _batch(function: Any, tasks: bytes) -> list[Any]:
    if isinstance(function, Exception):
        raise function
    return [function(*task) for task in pickle.loads(tasks)]


def _sendable(what: Any) -> bytes:
    try:
        data = pickle.dumps(what, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise Unsent(str(error)) from error
    if b"__main__" in data:
        raise Unsent("it is made of what the script defines")
    return data


def _packed(result: Any) -> bytes:
    """A result as it is sent; in place of one that cannot be, or an exception that cannot be made again, its words."""
    try:
        data = pickle.dumps(result)
        if isinstance(result, Exception):
            pickle.loads(data)
    except Exception as error:
        return pickle.dumps(RuntimeError(f"{type(result).__name__}: {result!s:.500} (not sent: {error})"))
    return data
