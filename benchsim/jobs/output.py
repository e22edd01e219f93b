"""Output folders: staged beside their place, then moved whole, so that nothing is lost or half-written."""

from __future__ import annotations

import atexit
import errno
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any

import benchsim
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording
from benchsim.bench.names import file_name, printable
from benchsim.bench.paths import STAMP
from benchsim.bench.reading import file_hash, load_json
from benchsim.bench.staging import OLD, permit, staged, sweep
from benchsim.bench.writing import write_text

_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless", "scikit-image")


def default_folder(source: Path, command: str) -> Path:
    """``./NAME-COMMAND/``, NAME being the file's stem or the folder's name."""
    path = source.resolve()
    if os.path.isfile(path) and path.name == "recording.toml":
        path = path.parent
    # False for a name that no file can have, too, which is told when it is read.
    return Path(f"{file_name(path.stem if os.path.isfile(path) else path.name)}-{command}")


def label(recording: Recording) -> str:
    """What the person calls the recording: its folder, or folder and file."""
    folder, file = recording.folder.resolve().name, recording.path.name
    return printable(folder if file == "recording.toml" else f"{folder}/{file}")


def written(folder: Path | None, page: bool = False) -> str:
    """Last line of a summary: where the results are, if anywhere, and the page to open."""
    if folder is None:
        return ""
    return f"\nwritten: {folder}/" + (f"; open {folder / 'report.html'}" if page else "")


def lasting_folder(name: str) -> Path:
    """Where to put what nobody asked to keep, under a name for people; it lasts as long as this process."""
    folder = Path(mkdtemp(prefix="benchsim-"))
    atexit.register(rmtree, folder, ignore_errors=True)
    return folder / file_name(name)


@contextmanager
def wanted_folder(
    target: Path | str | None,
    command: str,
    inputs: Sequence[Path],
    options: dict[str, Any] | None = None,
    defaults: Sequence[str] = (),
) -> Iterator[Path | None]:
    """`output_folder`, or None where nothing is to be written."""
    if target is None:
        yield None
        return
    with output_folder(Path(target), command, inputs, options, defaults) as staging:
        yield staging


@contextmanager
def output_folder(
    target: Path,
    command: str,
    inputs: Sequence[Path],
    options: dict[str, Any] | None = None,
    defaults: Sequence[str] = (),
) -> Iterator[Path]:
    """Yield a staging folder that becomes ``target`` when the block ends without an exception.

    A folder that the same command wrote is replaced whole; any other non-empty folder is refused before the work
    starts. On failure the staging folder is removed and ``target`` stays as it was.

    Parameters
    ----------
    target : Path
        The folder to write.
    command : str
        Written into ``benchsim.json`` with the hashes of ``inputs``, versions, options and defaults used.
    inputs : sequence of Path
        Files that were read; none may lie inside ``target``, which would replace them.

    Raises
    ------
    BenchsimError
        If the folder cannot be used.
    """
    target = target.absolute()
    sweep(target)
    _refuse_unusable(target, command, inputs)
    begun = ""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with staged(target) as staging:
            begun = str(staging)
            stamp = _stamp(command, inputs, options or {}, defaults)
            yield staging
            (staging / STAMP).write_text(json.dumps(stamp, indent=1) + "\n", encoding="utf-8")
            permit(staging, 0o777)
            _swap(staging, target)
    except OSError as error:
        # A full disk is told without a name.
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        if full or not begun or (error.filename and str(error.filename).startswith(begun)):
            raise BenchsimError(
                f"{target}: cannot be written ({error.strerror}); choose another folder with -o"
            ) from None
        raise


def begun_folder(target: Path, command: str, *inputs: Path) -> None:
    """Make a folder that a command fills piece by piece, each written whole; one that it has begun is gone on with.

    Raises
    ------
    BenchsimError
        If the folder cannot be used, as in `output_folder`.
    """
    _refuse_unusable(target.absolute(), command, inputs)
    try:
        target.mkdir(parents=True, exist_ok=True)
        if not (target / STAMP).is_file():
            write_text(target / STAMP, json.dumps(_stamp(command, (), {}, ()), indent=1) + "\n")
    except OSError as error:
        raise BenchsimError(f"{target}: cannot be written ({error.strerror}); choose another folder with -o") from None


def _refuse_unusable(target: Path, command: str, inputs: Sequence[Path]) -> None:
    if target.exists() and not target.is_dir():
        raise BenchsimError(f"{target}: is a file, not a folder; choose another name with -o")
    if target.is_dir():
        try:
            entries = list(target.iterdir())
        except OSError as error:
            raise BenchsimError(f"{target}: cannot be read ({error.strerror}); choose another folder with -o") from None
        if entries and _command_of(target) != command:
            raise BenchsimError(
                f"{target}: not empty and not written by 'benchsim {command}'; choose another with -o or empty it"
            )
    for path in inputs:
        if path.resolve().is_relative_to(target.resolve()):
            raise BenchsimError(
                f"{target}: holds the input {path.name}, which would be replaced; choose another folder with -o"
            )
    existing = next(p for p in [target, *target.parents] if p.exists())
    if not os.access(existing, os.W_OK):
        raise BenchsimError(f"{target}: cannot be written (permission denied); choose another folder with -o")


def _command_of(folder: Path) -> str | None:
    try:
        return load_json(folder / STAMP)["command"]
    except (BenchsimError, KeyError, TypeError):
        return None


def _stamp(command: str, inputs: Sequence[Path], options: dict[str, Any], defaults: Sequence[str]) -> dict[str, Any]:
    return {
        "format": "benchsim-output/1",
        "command": command,
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "options": options,
        "inputs": {_short(path, inputs[0].parent): file_hash(path) for path in inputs},
        "versions": _versions(),
        "defaults_used": list(defaults),
    }


@cache
def _versions() -> dict[str, str]:
    versions = {"benchsim": benchsim.__version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def _short(path: Path, folder: Path) -> str:
    """Name under the input's folder: two pictures of one name may lie in different folders below it."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def _swap(staging: Path, target: Path) -> None:
    """Move the staging folder into place; an older folder is put aside first, and removed or put back last."""
    if not target.exists():
        os.rename(staging, target)
        return
    with staged(target) as aside:
        os.rename(target, aside / OLD)
        os.rename(staging, target)
