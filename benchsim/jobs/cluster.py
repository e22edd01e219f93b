"""Independent cases: on processes of this machine, of one thread each, or on a Dask scheduler of one's own.

A worker that dies on the way loses its case, which another takes up; what a case writes, it writes beside its place
and moves there whole, so that nothing is left half-done. A scheduler listens, and runs what anyone sends whom it lets
in; processes of this machine do not.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.staging import permit, staged
from benchsim.jobs.workers import ProcessDied, cores, ended, processes

Each = Callable[[Callable[..., Any], Sequence[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
"""each(function, tasks) yields (index of the task, result or the exception that ended it) as they come."""

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
        yield k, ended(function, *task)


@contextmanager
def beside(target: Path) -> Iterator[Path]:
    """A folder that is moved to ``target`` when all has gone well; if something lies there by then, that stays."""
    with staged(target) as staging:
        yield staging
        permit(staging, 0o777)
        try:
            os.rename(staging, target)
        except OSError:
            if not target.is_dir():
                raise


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


@contextmanager
def _processes(count: int) -> Iterator[Each]:
    """`Each` on processes of this machine."""

    def each(function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
        for k, found in pool.each(function, [[task] for task in tasks], TRIES):
            if isinstance(found, ProcessDied):
                yield k, BenchsimError(f"{TRIES} processes died of it; if memory ran out, give fewer --workers")
            else:
                yield k, found if isinstance(found, Exception) else found[0]

    with processes(count) as pool:
        yield each


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
    return ended(function, *arguments)
