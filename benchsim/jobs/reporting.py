"""``benchsim report``: one HTML file of a finished folder, for a person to read; the other jobs end with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from jinja2 import TemplateError

from benchsim.bench.errors import BenchsimError
from benchsim.bench.paths import STAMP, inside
from benchsim.bench.reading import load_json, read_file
from benchsim.bench.writing import write_text
from benchsim.jobs.progress import Progress, silent
from benchsim.reports import forms, page, page_trial

NAME = "report.html"

MOST_NAMED = 4
"""Files that are named where there is no page: a sentence, not a listing."""


@dataclass(frozen=True)
class ReportResult:
    """The page that was written, and of what: "diagnosis", "validation" or "trial"."""

    path: Path
    of: str
    size: int

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {"report": str(self.path), "of": self.of, "bytes": self.size}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return f"written: {self.path} ({self.size / 1e6:.1f} MB), the page of a {self.of}"


def report(
    folder: Path | str,
    output: Path | str | None = None,
    *,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> ReportResult:
    """Write one self-contained HTML file of a folder that ``run``, ``validate``, ``diagnose`` or a trial left.

    Parameters
    ----------
    folder : path
        Holds ``diagnosis.json``, ``validation.json`` or ``score.json``.
    output : path, optional
        The file to write; default ``report.html`` in the folder.
    allow_outside : bool
        Whether photographs and results may lie outside of the folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    ReportResult

    Raises
    ------
    BenchsimError
        If the folder holds no finished result, or a file of it cannot be read.
    """
    source = Path(folder)
    target = source / NAME if output is None else Path(output)
    progress("writing the page", 0.5)
    of, html = build(source, allow_outside)
    try:
        write_text(target, html)
    except OSError as error:
        raise BenchsimError(f"{target}: cannot be written ({error.strerror}); choose another file with -o") from None
    progress("done", 1.0)
    return ReportResult(target, of, len(html.encode("utf-8")))


def build(folder: Path, allow_outside: bool = False) -> tuple[str, str]:
    """What a finished folder holds ("diagnosis", "validation", "trial"), and its page as HTML."""
    if not folder.is_dir():
        raise BenchsimError(f"{folder}: no such folder; name one that run, diagnose or trial open wrote")

    def held(name: str) -> Any:
        return load_json(inside(folder, name, f"{folder}: {name}", allow_outside=allow_outside))

    stamp = held(STAMP) if (folder / STAMP).is_file() else {}
    if (folder / "score.json").is_file():
        score = held("score.json")
        _of_format(folder / "score.json", score, page_trial.FORMAT)
        return "trial", _drawn(folder, "score.json", lambda: page.trial_page(score, stamp))
    result = next((n for n in ("diagnosis.json", "validation.json") if (folder / n).is_file()), None)
    if result is None:
        raise BenchsimError(_no_page(folder, stamp))
    if not (folder / "page.json").is_file():
        raise BenchsimError(
            f"{folder}: holds no page.json, without which there is nothing to draw; write the folder anew with "
            f"benchsim {'diagnose' if result == 'diagnosis.json' else 'run'}"
        )
    found, extra = held(result), held("page.json")
    _of_format(folder / "page.json", extra, page.FORMAT)
    forms.checked(forms.Page, folder / "page.json", extra)
    photographs = {}
    for number, x in enumerate(extra["exposures"], 1):
        if x["photograph"] is not None:
            key = f"{folder / 'page.json'}: exposures[{number}].photograph"
            path = inside(folder, x["photograph"], key, allow_outside=allow_outside)
            if path.is_file():
                photographs[x["photograph"]] = read_file(path)
    if result == "diagnosis.json":
        pixels = held("pixels.json") if (folder / "pixels.json").is_file() else None
        forms.checked(forms.Diagnosis, folder / result, found)
        forms.checked(forms.Stamp, folder / STAMP, stamp)
        forms.checked(forms.Pixels, folder / "pixels.json", pixels)
        draw = partial(page.diagnosis_page, found, extra, photographs, stamp, pixels)
        return "diagnosis", _drawn(folder, result, draw)
    conics = held("conics.json")
    forms.checked(forms.Validation, folder / result, found)
    forms.checked(forms.Stamp, folder / STAMP, stamp)
    draw = partial(page.validation_page, found, conics, extra, photographs, stamp)
    return "validation", _drawn(folder, f"{result} or conics.json", draw)


def _no_page(folder: Path, stamp: Any) -> str:
    """What a folder without a page is, and what to open in it instead."""
    command = stamp.get("command") if isinstance(stamp, dict) else None
    there = [p.name for p in sorted(folder.iterdir()) if p.name in (NAME, "summary.txt") or p.suffix == ".png"]
    if isinstance(command, str) and NAME in there:
        return f"{folder}: 'benchsim {command}' has written its page; open {folder / NAME}"
    if isinstance(command, str) and there:
        more = f" and {len(there) - MOST_NAMED} more" if len(there) > MOST_NAMED else ""
        names = ", ".join(there[:MOST_NAMED])
        return f"{folder}: of 'benchsim {command}' no page is made; open {names}{more} in it"
    return (
        f"{folder}: holds no diagnosis.json, validation.json or score.json; name a folder that run, diagnose or trial "
        "open wrote"
    )


def _drawn(folder: Path, name: str, draw: Callable[[], str]) -> str:
    """The page, or what of a result in no form of its own kept it from being drawn."""
    try:
        html = draw()
        html.encode()
        return html
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, TemplateError) as error:
        raise BenchsimError(
            f"{folder / name}: cannot be shown ({type(error).__name__}: {str(error)[:100]}); write the folder "
            "anew with this benchsim"
        ) from None


def _of_format(path: Path, value: Any, wanted: str) -> None:
    said = value.get("format") if isinstance(value, dict) else None
    if said != wanted:
        raise BenchsimError(f"{path}: format: {said!r} is not {wanted!r}; write the folder anew with this benchsim")
