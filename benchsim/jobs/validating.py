"""``benchsim validate``: the traces against the vector model, in mm on the screen and mrad of mirror normal."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim import trace, vector
from benchsim.bench.curve import Curve
from benchsim.bench.files import given, sources
from benchsim.bench.model import Recording, Screen
from benchsim.bench.settings import screen_seats
from benchsim.bench.writing import write_text
from benchsim.instruments.bench import board_coordinates
from benchsim.instruments.bench.validation import LEVEL, ExposureValidation, validate_trace
from benchsim.jobs.fitting import FitResult, draw_overlay, fit_recording
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.reports import pictures
from benchsim.trace.pose import Pose

Array = NDArray[np.float64]


@dataclass(frozen=True, repr=False)
class ValidationResult(Shown):
    """The validation of every exposure that gave a trace."""

    fitted: FitResult
    exposures: tuple[ExposureValidation, ...]
    folder: Path | None = None

    @property
    def recording(self) -> Recording:
        """What was validated."""
        return self.fitted.recording

    @property
    def lost(self) -> tuple[str, ...]:
        """One sentence for each exposure that gave no trace."""
        return self.fitted.lost

    @property
    def _title(self) -> str:
        return self.recording.title or self.recording.folder.name

    @cached_property
    def _drawn(self) -> list[pictures.Trace2D]:
        return _beside_models(self)

    def plot_residuals(self) -> Figure:
        """Distance of each trace from the vector model, at the stated setting and with the settings fitted."""
        return pictures.residuals(self._drawn, f"{self._title}: distance of the trace from the vector model")

    def plot_traces(self) -> Figure:
        """Measured and simulated traces on the board, as the paper's Fig. 8."""
        mirror, screen, notes = self.recording.mirror, self.recording.screen, []
        for f in self.fitted:
            conic = vector.trace_conic(mirror, f.exposure)
            notes.append(
                f"C = {_cm(f.exposure.mirror_position)} cm, azimuth {np.degrees(f.exposure.laser_azimuth):.0f}°, "
                f"elevation {np.degrees(f.exposure.laser_elevation):.0f}°\n"
                f"{conic.geometry.kind}, focus toward {conic.focus_side.replace('-', '−')}"
            )
        footer = (
            f"{self._title}: measured and simulated; {mirror.stands_for} cylinder, board seen from the mirror's side "
            "(from behind, as the paper seems to show it, left and right change)"
        )
        return pictures.figure8(self._drawn, screen.size, notes, footer)

    def figures(self) -> list[Figure]:
        """Both pictures."""
        return [self.plot_residuals(), self.plot_traces()]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``validation.json``."""
        return {
            "format": "benchsim-validation/1",
            "model": "vector model of Carretero et al. 2019 with the mirror's own r, and what [physics] adds to it; "
            "vector_alone: as printed",
            "level": LEVEL,
            "exposures": [v.as_dict() for v in self.exposures],
            "lost": list(self.lost),
            "defaults_used": list(self.recording.defaults_used),
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        wide = max(16, *(len(v.name) for v in self.exposures))
        heads = ("stated setting", "settings fitted", "p", "agrees")
        lines = ["rms distance of single profiles from the model, and as a lean of the normal:"]
        lines.append(f"{'':<{wide}}{heads[0]:>23}{heads[1]:>20}{heads[2]:>7}  {heads[3]}")
        words = {True: "yes", False: "no", None: "cannot tell"}
        for v in self.exposures:
            row = v.as_dict()
            before, after = row["before"], row["after"]
            lines.append(
                f"{v.name:<{wide}}{before['rms_mm']:9.3f} mm{before['rms_mrad']:7.3f} mrad"
                f"{1e3 * after['rms_mm']:7.1f} µm{1e3 * after['rms_mrad']:6.1f} µrad"
                f"{after['p_value']:7.3f}  {words[v.agrees]}"
            )
        r = self.recording.mirror.radius
        lines += [
            "What approximations move the model's trace by, rms: a cylinder for the polygon;",
            f"reflection on the axis, not r = {r:.1f} mm from it, the normal as it is or aimed as",
            "if r were 0. And p of the model as printed, a cylinder and a single ray:",
        ]
        for v in self.exposures:
            lines.append(
                f"{v.name:<{wide}}{v.polygon_mm:9.3f} mm{v.radius_mm:10.2f} mm{v.radius_own_aim_mm:8.3f} mm"
                f"{v.vector.p_after:18.3f}"
            )
        lines += [f"lost: {sentence}" for sentence in self.lost]
        return "\n".join(lines) + written(self.folder)


def validate(
    recording: Recording | Path | str,
    output: Path | str | None = None,
    *,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> ValidationResult:
    """Compare every trace of a recording with the vector model.

    Parameters
    ----------
    recording : Recording or path
        A recording, its folder or file.
    output : path, optional
        Folder to write; by default nothing is written.
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    ValidationResult

    Raises
    ------
    BenchsimError
        If the recording or the folder cannot be used, or no exposure gives a trace.
    """
    folder = None if output is None else Path(output)
    checked = given(recording, images=True, allow_outside=allow_outside)
    with wanted_folder(folder, "validate", sources(checked), {}, checked.defaults_used) as staging:
        fitted = fit_recording(checked, progress=lambda what, done: progress(what, 0.5 * done))
        found = validate_fit(fitted, progress=lambda what, done: progress(what, 0.5 + 0.4 * done))
        result = replace(found, folder=folder)
        if staging is not None:
            write_validation(result, staging, progress=lambda what, done: progress(what, 0.9 + 0.1 * done))
    return result


def validate_fit(fitted: FitResult, *, progress: Progress = silent) -> ValidationResult:
    """Validate the traces of a fit."""
    seats = screen_seats(fitted.recording.exposures)
    out = []
    for k, f in enumerate(fitted.fitted):
        progress(f"validating {f.exposure.name}", k / len(fitted.fitted))
        main = trace.only_ridge(f.trace, 0)
        out.append(
            validate_trace(
                fitted.recording,
                f.exposure,
                reseated=seats[f.index] > 0,
                points=main.points,
                s=main.s_mm,
                covariance=trace.covariance(main),
                measured=_measured(fitted.recording, f.trace.pose),
                blur=main.noise[0].blur_mm,
            )
        )
    return ValidationResult(fitted, tuple(out))


def _measured(recording: Recording, pose: Pose | None) -> Callable[[Array], Array] | None:
    """Where light at true places of the board is measured, with what the file says of board, print and camera."""
    seen = (
        board_coordinates.view_of_all(recording, pose)
        if pose is not None and board_coordinates.active(recording)
        else None
    )
    return None if seen is None else lambda board: board_coordinates.measured(recording, seen, board)[0]


def write_validation(result: ValidationResult, folder: Path, *, progress: Progress = silent) -> None:
    """Write ``validation.json``, ``residuals.png``, ``fig8.png`` and the overlays."""
    write_text(folder / "validation.json", json.dumps(result.as_dict(), indent=1) + "\n")
    steps = len(result.exposures) + 2
    for k, (f, t) in enumerate(zip(result.fitted, result._drawn, strict=True)):
        progress(f"drawing {f.exposure.name}", k / steps)
        draw_overlay(result.recording, f, t.stated, t.explained, folder)
    progress("drawing the residuals", (steps - 2) / steps)
    pictures.save(result.plot_residuals(), folder / "residuals.png")
    progress("drawing the traces", (steps - 1) / steps)
    pictures.save(result.plot_traces(), folder / "fig8.png")


def _beside_models(result: ValidationResult) -> list[pictures.Trace2D]:
    """Every trace beside its models, as the pictures want it."""
    traces = []
    screen = result.recording.screen
    for v, f in zip(result.exposures, result.fitted, strict=True):
        main = trace.only_ridge(f.trace, 0)
        before, after = v.bench.before, v.bench.after
        weights = v.binned.weights
        order = np.argsort(v.binned.s)
        traces.append(
            pictures.Trace2D(
                name=f"{f.exposure.setting} ({v.name})",
                points=main.points,
                s=main.s_mm,
                before=before,
                after=after,
                bin_s=v.binned.s[order],
                bin_before=(weights @ before)[order],
                bin_after=(weights @ after)[order],
                bin_sigma=np.sqrt(np.diag(v.binned.covariance))[order],
                mrad_per_mm=float(1 / np.median(v.mm_per_mrad)),
                stated=_on_board(v.stated, screen),
                explained=_on_board(v.bench.curve, screen),
                caption=_caption(v),
            )
        )
    return traces


def _on_board(curve: Curve, screen: Screen) -> Array:
    """Points of a model's curve within the board; the models run a little past it."""
    inside = (np.abs(curve.points) <= np.asarray(screen.size) / 2).all(axis=1)
    return curve.points[inside]


def _caption(v: ExposureValidation) -> str:
    agrees = {True: "agrees", False: "disagrees", None: "cannot tell"}[v.agrees]
    return f"χ² {v.bench.chi2_after:.0f} of {v.bench.dof}, p = {v.bench.p_after:.2f}, {agrees}"


def _cm(position: tuple[float, float, float]) -> str:
    return "(" + ", ".join(f"{x / 10:g}".replace("-", "−") for x in position) + ")"
