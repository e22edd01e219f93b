"""``benchsim fit``: photographs → marks → trace with error bars → conics."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchsim import conics, trace, vector
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import given, sources
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.names import file_name
from benchsim.bench.place import place
from benchsim.bench.settings import NAMES, from_vector, prior_sigma, screen_seats, uncertainty_of
from benchsim.bench.writing import write_csv, write_text
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.reports import pictures
from benchsim.trace import likeness

Array = NDArray[np.float64]

IMAGE_SUFFIXES = {".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp"}


@dataclass(frozen=True, repr=False)
class FittedExposure(Shown):
    """One exposure: its trace, a free conic through each ridge, and the bench's own cone through the main one."""

    exposure: Exposure
    index: int
    trace: trace.Trace
    free: dict[int, conics.ConicFit]
    cone: conics.SectionFit | None

    def summary(self) -> str:
        """What a person wants to know of it."""
        return "\n".join(_describe(self))

    def figures(self) -> list[Figure]:
        """Its trace on the board."""
        figure = Figure(layout="constrained")
        self.trace.plot(figure.add_subplot())
        return [figure]


@dataclass(frozen=True, repr=False)
class FitResult(Shown, Sequence[FittedExposure]):
    """What ``fit`` found, a sequence of its exposures: ``lost`` holds one sentence for each that gave no trace."""

    recording: Recording
    fitted: tuple[FittedExposure, ...]
    lost: tuple[str, ...]
    folder: Path | None = None

    def __len__(self) -> int:
        return len(self.fitted)

    @overload
    def __getitem__(self, index: int) -> FittedExposure: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[FittedExposure, ...]: ...
    def __getitem__(self, index: int | slice) -> FittedExposure | tuple[FittedExposure, ...]:
        return self.fitted[index]

    def conics_as_dict(self) -> dict[str, Any]:
        """Plain values for ``conics.json``."""
        rows = []
        for f in self.fitted:
            for ridge, found in f.free.items():
                row = {"exposure": f.exposure.name, "ridge": ridge, **conics.to_dict(found)}
                if ridge == 0 and f.cone is not None:
                    row["cone"] = conics.to_dict(f.cone)
                rows.append(row)
        return {"format": "benchsim-conics/1", "conics": rows, "lost": list(self.lost)}

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return self.conics_as_dict()

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        lines = [f.summary() for f in self]
        lines += [f"lost: {sentence}" for sentence in self.lost]
        return "\n".join(lines) + written(self.folder)


def _describe(f: FittedExposure) -> list[str]:
    t, main = f.trace, f.free[0]
    sigma = np.median(t.sigma_mm[t.ridge == 0])
    assert t.pose is not None
    marks = float(np.sqrt(np.nanmean(t.pose.residuals[t.pose.used] ** 2)))
    known = conics.invariants(main)
    lines = [
        f"{f.exposure.name}: {np.sum(t.ridge == 0)} profiles, each ±{1e3 * sigma:.1f} µm; "
        f"curve known to ±{1e3 * main.curve_rms:.1f} µm",
        f"  marks: the pose leaves {marks:.2g} px rms of their corners",
        f"  free conic: {known['kind'].value}, eccentricity {_interval(known['eccentricity'])}",
    ]
    if f.cone is not None:
        cone = conics.invariants(f.cone)
        lines.append(f"  the bench's cone: {cone['kind'].value}, eccentricity {_interval(cone['eccentricity'])}")
    return lines


def _interval(i: conics.Invariant) -> str:
    if i.value is None or not i.determined:
        return "not determined by this arc"
    return f"{i.value:.4g} (95 %: {i.low:.4g} … {i.high:.4g})"


@dataclass(frozen=True, repr=False)
class PixelFit(Shown):
    """The ridge of a single picture and its conic, both in pixels."""

    trace: trace.PixelTrace
    conic: conics.ConicFit
    folder: Path | None = None

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``conics.json``; lengths are in pixels."""
        renamed = _in_pixels(conics.to_dict(self.conic))
        return {
            "format": "benchsim-conics/1",
            "unit": "px",
            "likeness": self.trace.likeness.as_dict(),
            "conics": [{"exposure": self.trace.name, "ridge": 0, **renamed}],
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        known = conics.invariants(self.conic)
        return (
            f"{self.trace.name}: {len(self.trace.s_px)} profiles, each ±{np.median(self.trace.sigma_px):.3f} px; "
            f"curve known to ±{self.conic.curve_rms:.4f} px\n"
            f"  looks like a line: {self.trace.likeness.words()}\n"
            f"  free conic in pixels: {known['kind'].value}, eccentricity {_interval(known['eccentricity'])}\n"
            "  pixels are not a plane: without marks nothing is said in mm" + written(self.folder)
        )


def _in_pixels(value: Any) -> Any:
    """JSON values whose keys say mm, for a fit whose lengths are pixels."""
    if isinstance(value, dict):
        return {re.sub(r"_mm(?=_|$)", "_px", key): _in_pixels(v) for key, v in value.items()}
    return [_in_pixels(v) for v in value] if isinstance(value, list) else value


def fit(
    source: Recording | Path | str,
    output: Path | str | None = None,
    *,
    pixels: bool = False,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> FitResult | PixelFit:
    """Extract the traces of a recording and fit conics; or, with ``pixels``, the ridge of one picture.

    Parameters
    ----------
    source : Recording or path
        A recording, its folder or file; with ``pixels`` an image.
    output : path, optional
        Folder to write; by default nothing is written.
    pixels : bool
        Fit a single image without a recording, in pixels.
    allow_outside : bool
        Whether marks and images may lie outside of the file's folder, see `paths.inside`.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    FitResult or PixelFit

    Raises
    ------
    BenchsimError
        If the input or the folder cannot be used, or no exposure gives a trace.
    """
    folder = None if output is None else Path(output)
    if pixels:
        if isinstance(source, Recording):
            raise BenchsimError(f"{source.path.name}: pixels takes one image; leave it out to fit a recording")
        return _fit_pixels(Path(source), folder)
    if not isinstance(source, Recording) and Path(source).suffix.lower() in IMAGE_SUFFIXES:
        raise BenchsimError(
            f"{Path(source).name}: one photograph alone has no scale and no lens; put it into a folder with a "
            "recording.toml (camera, laser, mirror position) and marks.csv, or fit it in pixels with --pixels"
        )
    recording = given(source, images=True, allow_outside=allow_outside)
    with wanted_folder(folder, "fit", sources(recording), {}, recording.defaults_used) as staging:
        result = replace(fit_recording(recording, progress=progress), folder=folder)
        if staging is not None:
            write_fit(result, staging)
            for f in result.fitted:
                draw_overlay(recording, f, None, None, staging)
    return result


def _fit_pixels(path: Path, folder: Path | None) -> PixelFit:
    if path.is_dir() or path.suffix.lower() == ".toml":
        raise BenchsimError(f"{path}: --pixels takes one image; leave it out to fit a recording")
    if not path.is_file():
        raise BenchsimError(f"{path}: no such image; check the path")
    with wanted_folder(folder, "fit", [path], {"pixels": True}) as staging:
        t = trace.extract_pixels(path)
        if not t.likeness.score >= likeness.LIMIT:
            raise BenchsimError(
                f"{path.name}: what stands out most does not look like a laser's line, {t.likeness.words()}; give a "
                "picture in which the line is the brightest, or a recording with its marks and dark picture"
            )
        shared = t.shape_px[:, None, :] * t.normal[:, :, None]
        found = conics.fit(np.column_stack([t.u_px, t.v_px]), t.sigma_px * _swell(t.correlation), common=shared)
        result = PixelFit(t, found, folder)
        if staging is None:
            return result
        header = "ridge s_px u_px v_px sigma_px width_px flux skewness saturated".split()
        columns = (t.s_px, t.u_px, t.v_px, t.sigma_px, t.width_px, t.flux, t.skewness, t.saturated)
        write_csv(staging / "trace.csv", header, ((0, *map(float, row)) for row in zip(*columns, strict=True)), 9)
        write_text(staging / "conics.json", json.dumps(result.as_dict(), indent=1) + "\n")
        pictures.overlay(
            staging / f"overlay-{file_name(path.stem)}.png",
            np.asarray(t.light, float),
            np.zeros((0, 4, 2)),
            found.points,
            None,
            None,
            path.name,
        )
    return result


def fit_recording(recording: Recording, *, progress: Progress = silent) -> FitResult:
    """Traces and conics of every exposure; an exposure without a trace is lost and said, none left is an error."""
    fitted, lost = [], []
    seats = screen_seats(recording.exposures)
    count = len(recording.exposures)
    for i, exposure in enumerate(recording.exposures):
        progress(f"fitting {exposure.name}", i / count)
        try:
            fitted.append(_fit_exposure(recording, exposure, i, seats[i] > 0))
        except BenchsimError as error:
            if count == 1:
                raise
            lost.append(str(error))
    if not fitted:
        raise BenchsimError(f"{recording.path.name}: no exposure gives a trace; the first: {lost[0]}")
    progress("fitted", 1.0)
    return FitResult(recording, tuple(fitted), tuple(lost))


def _fit_exposure(recording: Recording, exposure: Exposure, index: int, reseated: bool) -> FittedExposure:
    measured = trace.extract(recording, exposure)
    found = {}
    for ridge in np.unique(measured.ridge):
        part = trace.only_ridge(measured, int(ridge))
        noise = measured.noise[int(ridge)]
        shared = np.concatenate([part.pose_mm, part.shape_mm], axis=1)[:, None, :] * part.normal[:, :, None]
        found[int(ridge)] = conics.fit(part.points, part.sigma_mm * _swell(noise.correlation), common=shared)
    main = trace.only_ridge(measured, 0)
    shared = np.concatenate([main.pose_mm, main.shape_mm], axis=1)[:, None, :] * main.normal[:, :, None]
    sigma = main.sigma_mm * _swell(measured.noise[0].correlation)
    return FittedExposure(
        exposure, index, measured, found, _fit_cone(recording, exposure, reseated, main.points, sigma, shared)
    )


def _swell(correlation: Array) -> float:
    """By how much correlated neighbours swell the sigma of a mean over that of independent ones."""
    return float(np.sqrt(max(1.0, 1.0 + 2.0 * float(np.sum(correlation[1:])))))


def _fit_cone(
    recording: Recording, exposure: Exposure, reseated: bool, points: Array, sigma: Array, shared: Array
) -> conics.SectionFit | None:
    """The bench's own cone through a trace, its setting errors within their priors; None where none may vary."""
    prior = prior_sigma(uncertainty_of(recording), reseated=reseated)
    free = np.flatnonzero(prior > 0)
    if not len(free):
        return None
    mirror = recording.mirror
    # The stretch of phases that the nominal trace spends on the board: enough to fix the conic to its last digits.
    phases = vector.trace(mirror, exposure, screen=recording.screen, count=25).phase
    assert phases is not None

    def predicted(theta: Array) -> Array:
        errors = np.zeros(len(NAMES))
        errors[free] = theta
        where = place(mirror, exposure, from_vector(errors))
        return vector.on_board(where, mirror.radius, phases)[0]

    names = [NAMES[i] for i in free]
    section = conics.section_of(predicted)
    return conics.fit_section(points, sigma, section, np.zeros(len(free)), prior[free], names, common=shared)


def write_fit(result: FitResult, folder: Path) -> None:
    """Write ``trace.csv`` and ``conics.json``."""
    trace.write_table(folder / "trace.csv", [f.trace for f in result.fitted])
    write_text(folder / "conics.json", json.dumps(result.conics_as_dict(), indent=1) + "\n")


def draw_overlay(
    recording: Recording, f: FittedExposure, stated: Array | None, explained: Array | None, folder: Path
) -> None:
    """Draw the photograph with marks, ridges and predicted curves (board coordinates, mm) over it."""
    pose = f.trace.pose
    assert pose is not None and recording.screen.marks is not None and f.exposure.image is not None
    photograph = trace.read_image(recording.folder / f.exposure.image, recording.cameras[f.exposure.camera])
    main = trace.only_ridge(f.trace, 0)
    setting = f"setting {f.exposure.setting}, camera {f.exposure.camera}"
    pictures.overlay(
        folder / f"overlay-{file_name(Path(f.exposure.image).stem)}.png",
        np.asarray(photograph.light, float),
        trace.to_pixels(pose, trace.board_corners(recording.screen.marks)),
        np.column_stack([main.u_px, main.v_px]),
        None if stated is None else trace.to_pixels(pose, stated),
        None if explained is None else trace.to_pixels(pose, explained),
        f"{recording.title or recording.folder.name}: {f.exposure.name}, {setting}",
    )
