"""Files and folders made under a temporary name beside their place: what a kill left there, the next run takes away.

Whoever makes one holds a lock on it, which the kernel drops when he dies, however he does. Windows has none that lets
what is locked be moved: there what a killed process left stays, since it may be in use.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

OLD = "old"
"""In a staging folder: what was at its target, put aside for the moment in which the new is moved there."""


@contextmanager
def staged(target: Path, *, folder: bool = True) -> Iterator[Path]:
    """An empty folder or file, for its owner alone, beside ``target``; removed at the end if it is still there.

    Parameters
    ----------
    target : Path
        What it is to become, in a folder that exists; the caller moves it there.
    folder : bool
        False: a file.
    """
    sweep(target)
    while True:
        handle: int | None = None
        if folder:
            staging = Path(tempfile.mkdtemp(dir=target.parent, prefix=_prefix(target)))
            if fcntl:
                handle = os.open(staging, os.O_RDONLY)
        else:
            handle, name = tempfile.mkstemp(dir=target.parent, prefix=_prefix(target))
            staging = Path(name)
            if not fcntl:
                os.close(handle)
                handle = None
        try:
            # Before it was locked, another may have taken it for a stale one.
            if (handle is None or _locked(handle) is not False) and staging.exists():
                yield staging
                return
        finally:
            # Locked until it is gone, and nobody else removes it meanwhile.
            _remove(staging, target)
            if handle is not None:
                os.close(handle)


def sweep(target: Path) -> None:
    """Remove what killed processes left beside ``target``; what they had put aside of it is put back."""
    if not fcntl:
        return
    prefix = _prefix(target)
    try:
        stale = [p for p in target.parent.iterdir() if p.name.startswith(prefix)]
    except OSError:
        return
    for path in stale:
        try:
            handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except OSError:
            continue
        try:
            # Where locks cannot be had it may be in use.
            if _locked(handle):
                _remove(path, target)
        finally:
            os.close(handle)


def _prefix(target: Path) -> str:
    """No name that a person would give, whose own files must stay; short enough for any name that a file may have."""
    return f".{os.fsdecode(os.fsencode(target.name)[:200])}-benchsim-"


def _locked(handle: int) -> bool | None:
    """Whether it could be locked, None where the file system has no locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _remove(path: Path, target: Path) -> None:
    if (path / OLD).exists() and not target.exists():
        os.rename(path / OLD, target)
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def permit(path: Path, mode: int) -> None:
    """Give a temporary file or folder, which only its owner may read, the mode that a new one would have."""
    mask = os.umask(0)
    os.umask(mask)
    path.chmod(mode & ~mask)
