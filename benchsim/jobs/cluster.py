"""Independent cases: on processes of this machine, of one thread each, or on a Dask scheduler of one's own.

A worker that dies on the way loses its case, which another takes up; what a case writes, it writes beside its place
and moves there whole, so that nothing is left half-done. Local processes are spoken to over pairs of sockets without a
name, which nobody else can open; a scheduler listens, and runs what anyone sends whom it lets in.
"""

from __future__ import annotations

import os
import pickle
import shutil
import tempfile
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import permit
from benchsim.jobs.workers import ONE_THREAD, begin, cores, environment

Each = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
"""each(function, tasks) yields (index of the task, result or the exception that ended it) as they come."""

MEMORY_KEPT = {"MALLOC_TRIM_THRESHOLD_": str(2**32), "MALLOC_MMAP_MAX_": "0"}
"""Environment of processes that work on pictures: to hand freed memory back to the kernel and fetch it again was a
third of their time."""

TRIES = 3
"""Processes that may die of a case before it is given up."""


@dataclass(frozen=True)
class Scheduler:
    """A running ``dask scheduler``, whose workers see the same folders under the same names.

    Attributes
    ----------
    address : str
    tls : tuple of path, optional
        The authority that both sides trust, and one's own certificate and key (PEM); default those of Dask's
        configuration (``distributed.comm.tls``).
    insecure : bool
        Whether an address without TLS will do.
    """

    address: str
    tls: tuple[Path, Path, Path] | None = None
    insecure: bool = False

    def options(self) -> list[str]:
        """On the command line."""
        files = [] if self.tls is None else ["--tls", *map(str, self.tls)]
        return ["--scheduler", self.address, *files, *(["--insecure"] if self.insecure else [])]


def here(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
    """`Each` in this process, one after the other."""
    for k, task in enumerate(tasks):
        yield k, _ended(function, *task)


def _ended(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result, or the exception that ended it with a note on where: the others go on."""
    try:
        return function(*arguments)
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)[-3:]
        error.add_note(" < ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in reversed(frames)))
        return error.with_traceback(None)


@contextmanager
def beside(target: Path) -> Iterator[Path]:
    """A folder that is moved to ``target`` when all has gone well; if something lies there by then, that stays."""
    staging = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}-"))
    try:
        yield staging
        permit(staging, 0o777)
        try:
            os.rename(staging, target)
        except OSError:
            if not target.is_dir():
                raise
    finally:
        shutil.rmtree(staging, ignore_errors=True)


@contextmanager
def cluster(scheduler: Scheduler | None = None, workers: int | None = None, timeout: float = 20.0) -> Iterator[Each]:
    """`Each` on other processes.

    Parameters
    ----------
    scheduler : Scheduler, optional
    workers : int, optional
        Local processes where no scheduler is given; default one per core, 0 none: one case after the other, here.
    timeout : float
        How long the scheduler may take to answer [s].

    Raises
    ------
    BenchsimError
        If the scheduler does not answer, or cannot be told from anyone else.
    """
    if scheduler is not None:
        with _dask(scheduler, timeout) as each:
            yield each
    elif workers == 0:
        yield here
    else:
        with _processes(workers or cores()) as each:
            yield each


class _Process:
    """A process of this machine that does one case after the other."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other,))
        self._process.start()
        # Its end is then its own alone, and closed when it dies.
        other.close()

    def end(self) -> None:
        self.connection.close()
        self._process.kill()
        self._process.join()


@contextmanager
def _processes(count: int) -> Iterator[Each]:
    """`Each` on processes of this machine, started as they are needed."""
    started: list[_Process] = []
    idle: list[_Process] = []

    def another() -> _Process:
        started.append(_Process())
        return started[-1]

    def each(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        waiting, deaths = deque(range(len(tasks))), [0] * len(tasks)
        busy: dict[Any, tuple[int, _Process]] = {}
        try:
            while waiting or busy:
                while waiting and len(busy) < count:
                    k, process = waiting.popleft(), idle.pop() if idle else another()
                    busy[process.connection] = (k, process)
                    try:
                        process.connection.send_bytes(pickle.dumps((function, tasks[k])))
                    except OSError:
                        pass  # it died, which is seen below
                for connection in wait(list(busy)):
                    k, process = busy[connection]
                    try:
                        result = pickle.loads(process.connection.recv_bytes())
                        idle.append(process)
                    except (EOFError, OSError):
                        process.end()
                        deaths[k] += 1
                        result = BenchsimError(f"{TRIES} processes died of it; if memory ran out, give fewer --workers")
                    del busy[connection]
                    if process in idle or deaths[k] == TRIES:
                        yield k, result
                    else:
                        waiting.append(k)
        finally:
            for _, process in busy.values():
                process.end()

    with environment(ONE_THREAD | MEMORY_KEPT):
        try:
            yield each
        finally:
            for process in started:
                process.end()


def _serve(connection: Connection) -> None:
    """Of a local process: do what comes, until nobody is there to send more."""
    begin()
    while True:
        try:
            task = connection.recv_bytes()
        except (EOFError, OSError):
            return
        connection.send_bytes(_packed(_ended(_unpacked, task)))


def _unpacked(task: bytes) -> Any:
    function, arguments = pickle.loads(task)
    return function(*arguments)


def _packed(result: Any) -> bytes:
    """A result as it is sent; in place of one that cannot be, or an exception that cannot be made again, its words."""
    try:
        data = pickle.dumps(result)
        if isinstance(result, Exception):
            pickle.loads(data)
    except Exception as error:
        return pickle.dumps(RuntimeError(f"{type(result).__name__}: {result!s:.500} (not sent: {error})"))
    return data


@contextmanager
def _dask(scheduler: Scheduler, timeout: float) -> Iterator[Each]:
    """`Each` on a scheduler of one's own."""
    from distributed import Client, as_completed
    from distributed.security import Security

    address = f"--scheduler {scheduler.address}"
    encrypted = scheduler.address.startswith("tls://")
    if not encrypted and not scheduler.insecure:
        raise BenchsimError(
            f"{address}: without TLS anyone who reaches it, or listens on the way, can run programs as you; start it "
            "with certificates and give tls://, or --insecure where nobody else is"
        )
    keys = ("tls_ca_file", "tls_client_cert", "tls_client_key")
    files = dict(zip(keys, map(str, scheduler.tls), strict=True)) if scheduler.tls else {}
    security = Security(**files, require_encryption=encrypted)
    if encrypted and not all(getattr(security, key) for key in keys):
        raise BenchsimError(
            f"{address}: no certificates; give --tls CA CERTIFICATE KEY, or them in Dask's configuration"
        )
    try:
        client = Client(scheduler.address, timeout=timeout, set_as_default=False, security=security)
    except (OSError, ValueError) as error:
        mend = "check the address, and the certificates" if encrypted else "check the address"
        raise BenchsimError(f"{address}: does not answer ({error}); {mend}") from None

    def each(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        futures = {client.submit(_quiet, function, *task, pure=False): k for k, task in enumerate(tasks)}
        for future in as_completed(list(futures), loop=client.loop):
            error = future.exception()
            yield futures[future], future.result() if error is None else error
            future.release()

    try:
        yield each
    finally:
        client.close()


def _quiet(function: Callable[..., Any], *arguments: Any) -> Any:
    """One thread for OpenCV too: the others are set by Dask for the processes that it starts."""
    import cv2

    cv2.setNumThreads(1)
    return _ended(function, *arguments)
