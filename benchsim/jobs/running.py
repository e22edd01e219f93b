"""``benchsim run``: the main job; render (or take a recording's photographs), fit, validate, draw, report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read, shipped, sources
from benchsim.bench.model import Recording
from benchsim.jobs import exhibits
from benchsim.jobs.fitting import FitResult, fit_recording, write_fit
from benchsim.jobs.output import default_folder, output_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.rendering import render_into
from benchsim.jobs.reporting import report
from benchsim.jobs.shown import Shown
from benchsim.jobs.validating import ValidationResult, validate_fit, write_validation


@dataclass(frozen=True, repr=False)
class RunResult(Shown):
    """What the main job found: the fit and the validation, and where it all lies."""

    folder: Path
    rendered: bool
    fit: FitResult
    validation: ValidationResult

    def figures(self) -> list[Figure]:
        """Those of the validation."""
        return self.validation.figures()

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "folder": str(self.folder),
            "rendered": self.rendered,
            "fit": self.fit.as_dict(),
            "validation": self.validation.as_dict(),
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        drawn = (
            "The photographs were rendered with errors that hands make, drawn from [uncertainty]: the stated\n"
            "setting is off by those, and whether the model agrees is told with the settings fitted.\n"
            if self.rendered
            else ""
        )
        return f"{self.fit.summary()}\n\n{self.validation.summary()}\n{drawn}{written(self.folder, page=True)}"


def run(
    file: Path | str | None = None,
    output: Path | str | None = None,
    *,
    variant: str | None = None,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> RunResult:
    """Render a bench (or take a recording's photographs), fit, validate and draw.

    Parameters
    ----------
    file : path, optional
        Bench file, or recording folder or file; default: both settings of Fig. 7.
    output : path, optional
        Default ``./NAME-run/``, ``./fig7-run/`` without a file.
    variant : str, optional
        Mitsuba's back end, where something is rendered.
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    RunResult

    Raises
    ------
    BenchsimError
        If the input or the folder cannot be used.
    """
    if file is None:
        recording, inputs, name = *_figure7(), "fig7"
        folder = Path(output) if output is not None else Path(f"{name}-run")
    else:
        source = Path(file)
        recording = read(source, allow_outside=allow_outside)
        inputs = sources(recording)
        folder = Path(output) if output is not None else default_folder(source, "run")
    photographed = [e.image is not None for e in recording.exposures]
    if any(photographed) and not all(photographed):
        missing = photographed.index(False) + 1
        raise BenchsimError(
            f"{recording.path.name}: exposure[{missing}].image: missing, while others have one; "
            "name it, or remove all images to render the bench"
        )
    with output_folder(folder, "run", inputs, {}, recording.defaults_used) as staging:
        if not all(photographed):
            part = staging / "recording"
            part.mkdir()
            recording, _ = render_into(
                recording, part, variant=variant, progress=lambda what, done: progress(what, 0.5 * done)
            )
        fitted = fit_recording(recording, progress=lambda what, done: progress(what, 0.5 + 0.2 * done))
        write_fit(fitted, staging)
        validation = validate_fit(fitted, progress=lambda what, done: progress(what, 0.7 + 0.2 * done))
        write_validation(validation, staging, progress=lambda what, done: progress(what, 0.9 + 0.08 * done))
        result = RunResult(folder, not all(photographed), fitted, validation)
        (staging / "summary.txt").write_text(result.summary() + "\n", encoding="utf-8")
        progress("photographs for the page", 0.98)
        exhibits.write_validation(recording, fitted.fitted, validation.exposures, staging)
    report(folder, progress=lambda what, done: progress(what, 0.98 + 0.02 * done))
    if not result.rendered:
        return result
    lies = replace(fitted, recording=replace(recording, path=folder / "recording" / "recording.toml"))
    return replace(result, fit=lies, validation=replace(validation, fitted=lies))


def _figure7() -> tuple[Recording, list[Path]]:
    """Both settings of Fig. 7 as one bench, from the scenes that come with the package."""
    a, b = (shipped(f"fig7{letter}.toml") for letter in "ab")
    both = replace(a, exposures=a.exposures + b.exposures, title="Fig. 7 of Carretero et al. 2019")
    return both, [b.path, *sources(a)]
