"""What ``import benchsim`` offers: the jobs under their commands' names, and the classes that a bench is made of.

A job tells how far it is to whatever callable ``progress`` is; here it may also be True, for a bar.
"""

from __future__ import annotations

import functools
import warnings
from pathlib import Path
from typing import Any

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import Camera, Exposure, Laser, Mirror, Physics, Recording, Screen, Uncertainty
from benchsim.jobs.progress import bar, silent

Bench = Recording

__all__ = [
    "Bench", "BenchsimError", "Camera", "Exposure", "Laser", "Mirror", "Physics", "Recording", "Screen", "Uncertainty",
    "load", "render",
]  # fmt: skip


def load(path: Path | str, *, allow_outside: bool = False) -> Recording:
    """Read a bench file, a recording's file or its folder, and check it.

    Parameters
    ----------
    path : path
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder.

    Returns
    -------
    Recording
        In mm, rad and s.

    Raises
    ------
    BenchsimError
        One sentence that names file, key and mend.

    Examples
    --------
    >>> import benchsim as bs
    >>> bench = bs.load("scenes/fig7a.toml")
    >>> bench.exposures[0].mirror_position  # mm
    (1500.0, -160.0, -1430.0)
    """
    return read(path, allow_outside=allow_outside)


def render(bench: Recording | Path | str, output: Path | str | None = None, **options: Any) -> Recording:
    """Render what the camera would photograph of a bench.

    Parameters
    ----------
    bench : Recording or path
    output : path, optional
        Folder to write; by default one that lasts as long as this process: keep what is in it by ``save``.
    **options
        ``seed``, ``effects``, ``noise``, ``setting_errors``, ``conceal``, ``variant`` and ``progress`` of
        `jobs.rendering.render`.

    Returns
    -------
    Recording
        What there is to say about it is warned of.

    Raises
    ------
    BenchsimError
        If the bench cannot be used or the folder not be written.
    """
    made = _with_bar(jobs.render)(bench, output, **options)
    for note in made.notes:
        warnings.warn(note, stacklevel=2)
    return made.recording


def _with_bar(job: Any) -> Any:
    """A job whose progress may be a truth value too."""

    @functools.wraps(job)
    def wrapped(*arguments: Any, progress: Any = False, **options: Any) -> Any:
        if callable(progress):
            return job(*arguments, progress=progress, **options)
        if not progress:
            return job(*arguments, progress=silent, **options)
        with bar() as shown:
            return job(*arguments, progress=shown, **options)

    return wrapped


def __getattr__(name: str) -> Any:
    if name not in jobs.__all__:
        raise AttributeError(f"module 'benchsim.api' has no attribute {name!r}")
    return _with_bar(getattr(jobs, name))
