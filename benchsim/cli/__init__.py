"""The command line: parses, calls one job, prints its summary; exit 0 done, 1 unusable data or back end, 2 usage."""

from __future__ import annotations

import errno
import signal
from typing import Any, NoReturn

from benchsim.cli import bench, mounts, plants, trials  # which add their commands to the list
from benchsim.cli.common import app, unprinted

__all__ = ["app", "bench", "main", "mounts", "plants", "trials"]


def _stop(number: int, _: Any) -> NoReturn:
    """End as for Ctrl-C: staging folders are removed and processes ended on the way."""
    raise KeyboardInterrupt(number)


def main() -> None:
    """Entry point of the console script."""
    # A shell may have said that its end is to be outlived.
    for number in (getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _stop)
    try:
        app()
    except OSError as error:
        # Of help, which the parser prints itself; a file that cannot be written has a name.
        if error.filename or error.errno not in (errno.ENOSPC, errno.EPIPE, errno.EIO):
            raise
        unprinted(error)
