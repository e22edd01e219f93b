"""How a job tells what it is doing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from benchsim.bench.names import printable

Progress = Callable[[str, float], None]
"""Called with what is being done and the fraction done."""


def silent(what: str, done: float) -> None:
    """Tell nobody."""


@contextmanager
def bar() -> Iterator[Progress]:
    """A bar on stderr while the block lasts; silence where that is a pipe."""
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task("starting", total=1.0)
        yield lambda what, done: shown.update(task, description=printable(what), completed=done)
