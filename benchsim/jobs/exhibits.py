"""What the report page shows beyond the results: photographs for a screen, curves in their pixels, residuals.

Written beside the results as ``page.json`` and ``photographs/``, so that ``benchsim report`` needs no recording.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from benchsim import rays, trace
from benchsim.bench.model import Camera, Exposure, Recording
from benchsim.bench.settings import NAMES
from benchsim.bench.writing import write_bytes, write_text
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Diagnosis, Size
from benchsim.instruments.bench.board_coordinates import View
from benchsim.instruments.bench.prediction import UNITS, Predict
from benchsim.instruments.bench.validation import ExposureValidation
from benchsim.jobs.effect_sizes import Moves
from benchsim.jobs.fitting import FittedExposure
from benchsim.jobs.output import label
from benchsim.reports.diagnosis_text import STANDS_OUT
from benchsim.reports.page import FORMAT
from benchsim.reports.pictures import _tone

Array = NDArray[np.float64]

WIDE = 1200
"""Pixels of the longer side of a photograph in a page: a desktop's column, twice a phone's."""

QUALITY = 78
"""Of the JPEG; a photograph of a board is then some 100 kB."""

SMOOTH = 12
"""Terms of the misfit that is drawn over a photograph: as many smooth modes as a trace is tested for."""


def write_diagnosis(
    recording: Recording, problem: Problem, d: Diagnosis, moves: Moves, folder: Path, photographs: bool
) -> None:
    """Write ``page.json`` of a diagnosis, and with ``photographs`` those.

    Parameters
    ----------
    recording : Recording
    problem : Problem
        Of the bench: its prediction knows where every trace lies in its photograph.
    d : Diagnosis
    moves : mapping
        What the effects that were found move.
    folder : Path
        Of ``diagnosis.json``.
    photographs : bool
    """
    predict, r = problem.predict, d.residuals
    assert isinstance(predict, Predict)
    shown = most(d) if most(d) != "c" else None
    used, rows = [], []
    for number, block in enumerate(predict.blocks):
        observed = block.observed
        here = problem.rows(number)
        # Of marks: those that the data have.
        marks = observed.view.flat.reshape(-1, 4, 2).mean(axis=1)[block.kept]
        # Centre-line data are the first of a block, one for each of its points.
        order = np.argsort(observed.s, kind="stable")
        at = here.start + order
        points, view = observed.points[order], observed.view
        travel = predict.light({}, number, predict.recording).points
        drawn = _Drawn(points, _left(points, travel), r.before[at], r.after[at])
        own = np.sqrt(np.diag(problem.covariance[number]) * np.diag(np.linalg.inv(problem.covariance[number])))
        used.append(recording.exposures[observed.index])
        rows.append(
            _row(
                used[-1],
                view.camera,
                drawn,
                [_pixels(view, line) for line in drawn.lines()],
                observed.s[order],
                (r.held_out_before[at], r.held_out_after[at]),
                r.sigma[at],
                r.sigma[at] / own[order],
            )
        )
        if shown is not None:
            rows[-1]["most"] = _of_kind(problem, d, number, shown, marks, own)
    found = d.verdict != "nothing-missing"
    extra = {
        "format": FORMAT,
        "title": label(recording),
        "settings": len(set(problem.groups)),
        "states": {
            "before": "the simulation as stated, settings fitted",
            "after": f"{'with what was found' if found else 'the simulation as stated'}, settings fitted",
        },
        "catalogue": [{"name": e.name, "element": e.element, "says": e.says} for e in problem.catalogue],
        "exposures": rows,
        "moves": {name: {**_size(size), "how": how} for name, (size, how) in moves.items()},
        "priors": {p.name: {"sigma": p.sigma, "unit": p.unit} for p in problem.nuisances},
        "most": shown,
    }
    _write(extra, recording, used, folder, photographs)


def most(d: Diagnosis) -> str:
    """Kind of datum that shows most of what was found: the centre line where none stands out."""
    by_kind = d.location.by_kind if d.location is not None else {}
    best = max(by_kind, key=lambda k: by_kind[k], default="c")
    return best if by_kind.get(best, 0.0) >= STANDS_OUT else "c"


def _of_kind(problem: Problem, d: Diagnosis, block: int, kind: str, marks: Array, own: Array) -> dict[str, Any] | None:
    """Residuals of one kind of datum of a block: along the trace, or those of ``marks`` (k, 2) [px].

    ``own`` (n_b,) is sigma over that of a datum given its neighbours.
    """
    r, rows = d.residuals, problem.rows(block)
    at = rows.start + np.flatnonzero(problem.kind[rows] == kind)
    if not len(at):
        return None
    if kind == "m":
        before, after = r.before[at].reshape(-1, 2), r.after[at].reshape(-1, 2)
        return {"at_px": _list(marks, 2), "before_px": _list(before, 4), "after_px": _list(after, 4)}
    at = at[np.argsort(problem.position[at], kind="stable")]
    named = {key: getattr(r, key) for key in ("before", "after", "held_out_before", "held_out_after", "sigma")}
    return {
        "s_mm": _list(problem.position[at], 2),
        **{key: _list(values[at]) for key, values in named.items()},
        "sigma_alone": _list(r.sigma[at] / own[at - rows.start]),
    }


def write_validation(
    recording: Recording, fitted: Sequence[FittedExposure], validated: Sequence[ExposureValidation], folder: Path
) -> None:
    """Write ``page.json`` and the photographs of a validation.

    Parameters
    ----------
    recording : Recording
    fitted : sequence of FittedExposure
    validated : sequence of ExposureValidation
        In the same order.
    folder : Path
    """
    rows = []
    for f, v in zip(fitted, validated, strict=True):
        main, pose = trace.only_ridge(f.trace, 0), f.trace.pose
        assert pose is not None
        order = np.argsort(v.binned.s)
        weights, covariance = v.binned.weights[order], v.binned.covariance[np.ix_(order, order)]
        points = weights @ main.points
        drawn = _Drawn(points, _left(points, v.bench.curve.points), weights @ v.bench.before, weights @ v.bench.after)
        none = np.full(len(order), np.nan)
        rows.append(
            _row(
                f.exposure,
                recording.cameras[f.exposure.camera],
                drawn,
                [trace.to_pixels(pose, line) for line in drawn.lines()],
                v.binned.s[order],
                (none, none),
                np.sqrt(np.diag(covariance)),
                1 / np.sqrt(np.diag(np.linalg.inv(covariance))),
            )
            | {"profiles": len(main.points), "departures": _departures(v)}
        )
    extra = {
        "format": FORMAT,
        "title": recording.title or recording.folder.name,
        "settings": len({f.exposure.setting for f in fitted}),
        "states": {"before": "the model at the stated setting", "after": "the model, settings fitted"},
        "catalogue": [],
        "exposures": rows,
    }
    _write(extra, recording, [f.exposure for f in fitted], folder, photographs=True)


def _departures(v: ExposureValidation) -> dict[str, Any]:
    """Fitted setting errors of an exposure, in mm and mrad."""
    per = np.array([1.0 if unit == "mm" else 1e3 for unit in UNITS])
    rows = zip(NAMES, UNITS, (per * v.bench.theta).tolist(), (per * v.bench.sigma).tolist(), strict=True)
    return {name: _size(Size(value, sigma, unit)) for name, unit, value, sigma in rows if name in v.bench.pulls}


def _size(size: Size) -> dict[str, Any]:
    return {"value": size.value, "sigma": size.sigma if np.isfinite(size.sigma) else None, "unit": size.unit}


@dataclass(frozen=True)
class _Drawn:
    """A trace on the board (n, 2) [mm], its unit normals, and its distances from two predictions (n,) [mm].

    A prediction is smooth; its distance from single points is not, and enlarged it would show their noise.
    """

    points: Array
    across: Array
    before: Array
    after: Array

    def lines(self) -> tuple[Array, Array, Array]:
        """The trace, the prediction before, the prediction after."""
        return (
            self.points,
            self.points - _smooth(self.before)[:, None] * self.across,
            self.points - _smooth(self.after)[:, None] * self.across,
        )


def _smooth(distance: Array) -> Array:
    """The smooth part of distances along a trace: a polynomial of `SMOOTH` terms."""
    x = np.linspace(-1, 1, len(distance))
    terms = min(SMOOTH, len(distance))
    return np.asarray(legendre.legval(x, legendre.legfit(x, distance, terms - 1)))


def _left(points: Array, travel: Array) -> Array:
    """Unit normals of a trace, to the left of the way that a curve beside it takes: there distances are positive."""
    tangent = np.gradient(points, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    along = np.sign((points[-1] - points[0]) @ (travel[-1] - travel[0]))
    return along * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)


def _pixels(view: View, on_board: Array) -> Array:
    flat = np.column_stack([np.zeros(len(on_board)), on_board])
    return rays.project(view.camera, view.rotation, view.translation, flat)


def _row(
    exposure: Exposure,
    camera: Camera,
    drawn: _Drawn,
    lines: Sequence[Array],
    s: Array,
    held_out: tuple[Array, Array],
    sigma: Array,
    alone: Array,
) -> dict[str, Any]:
    """One of ``exposures`` of ``page.json``; ``lines`` are those of ``drawn`` in pixels."""
    measured, before, after = lines
    return {
        "exposure": exposure.name,
        "setting": exposure.setting,
        "photograph": None,
        "size_px": [int(x) for x in camera.resolution],
        "same": bool(np.array_equal(drawn.before, drawn.after)),
        "measured_px": _list(measured, 3),
        "before_px": _list(before, 4),
        "after_px": _list(after, 4),
        "s_mm": _list(s, 2),
        "residual_mm": {
            "before": _list(drawn.before),
            "after": _list(drawn.after),
            "held_out_before": _list(held_out[0]),
            "held_out_after": _list(held_out[1]),
        },
        "sigma_mm": _list(sigma),
        "sigma_alone_mm": _list(alone),
    }


def _write(
    extra: dict[str, Any], recording: Recording, exposures: Sequence[Exposure], folder: Path, photographs: bool
) -> None:
    if photographs:
        into = folder / "photographs"
        into.mkdir(exist_ok=True)
        for number, (row, exposure) in enumerate(zip(extra["exposures"], exposures, strict=True), 1):
            assert exposure.image is not None
            row["photograph"] = f"photographs/{number}.jpg"
            light = trace.read_image(recording.folder / exposure.image, recording.cameras[exposure.camera]).light
            write_bytes(folder / row["photograph"], jpeg(np.asarray(light, float)))
    write_text(folder / "page.json", json.dumps(extra, allow_nan=False) + "\n")


def jpeg(light: Array) -> bytes:
    """A photograph of a size and a brightness for a screen, as JPEG.

    Parameters
    ----------
    light : (h, w)
        Any scale.
    """
    height, width = light.shape
    scale = min(1.0, WIDE / max(height, width))
    small = cv2.resize(light.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = np.rint(255 * _tone(np.asarray(small, float))).astype(np.uint8)
    done, data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    return data.tobytes()


def _list(values: Array, digits: int = 6) -> list[Any]:
    """Rounded plain numbers; null where there is none."""
    rounded = np.round(values, digits)
    return [_list(v, digits) if np.ndim(v) else float(v) if np.isfinite(v) else None for v in rounded]
