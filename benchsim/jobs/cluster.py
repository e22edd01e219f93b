"""Independent cases on Dask: local worker processes of one thread each, or an existing cluster.

A worker that dies on the way loses its case, which another takes up; what a case writes, it writes beside its place
and moves there whole, so that nothing is left half-done.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import permit

Each = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
"""each(function, tasks) yields (index of the task, result or the exception that ended it) as they come."""

MEMORY_KEPT = {"MALLOC_TRIM_THRESHOLD_": str(2**32), "MALLOC_MMAP_MAX_": "0"}
"""Environment of processes that work on pictures: to hand freed memory back to the kernel and fetch it again, as Dask
has it by default, was a third of their time."""

SETTINGS = {
    "distributed.worker.memory.terminate": False,
    "distributed.worker.memory.pause": False,
    **{f"distributed.nanny.pre-spawn-environ.{key}": value for key, value in MEMORY_KEPT.items()},
}
"""Of Dask, for the local processes."""


def here(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
    """`Each` in this process, one after the other."""
    for k, task in enumerate(tasks):
        yield k, _ended(function, *task)


def _ended(function: Callable[..., Any], *arguments: Any) -> Any:
    """Result, or the exception that ended it with a note on where: a trial goes on, and Dask need not print it."""
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
def cluster(scheduler: str | None = None, workers: int | None = None, timeout: float = 20.0) -> Iterator[Each]:
    """`Each` on Dask.

    Parameters
    ----------
    scheduler : str, optional
        Address of a running ``dask scheduler``; its workers must see the same folders under the same names.
    workers : int, optional
        Local processes where no scheduler is given; default one per core, 0 none: one case after the other, here.
    timeout : float
        How long the scheduler may take to answer [s].

    Raises
    ------
    BenchsimError
        If the scheduler does not answer.
    """
    if scheduler is None and workers == 0:
        yield here
        return
    import logging

    import dask
    from distributed import Client, LocalCluster, as_completed

    from benchsim.jobs.workers import cores

    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=timeout, set_as_default=False)
        except (OSError, ValueError) as error:
            raise BenchsimError(f"--scheduler {scheduler}: does not answer ({error}); check the address") from None
        local = None
    else:
        with dask.config.set(SETTINGS):
            local = LocalCluster(
                n_workers=workers or cores(),
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                silence_logs=logging.ERROR,
            )
        client = Client(local, set_as_default=False)

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
        if local is not None:
            local.close()


def _quiet(function: Callable[..., Any], *arguments: Any) -> Any:
    """One thread for OpenCV too: the others are set by Dask for the processes that it starts."""
    import cv2

    cv2.setNumThreads(1)
    return _ended(function, *arguments)
