"""The report page: one HTML file of a finished run, diagnosis or trial, for a person to read.

The file holds everything it shows, photographs and drawings included; it fetches nothing, and without JavaScript only
the slider over the photographs is lost: the two pictures then stand side by side.

Beside the results (``diagnosis.json``, ``validation.json``, a trial's score) the page of a recording takes what those
do not hold, the mapping in ``page.json``::

    {"format": "benchsim-page/1",
     "title": "known-six", "settings": 5,
     "instrument": "bench", "unit": "mm",                      # optional; "mount" with "arcsec" or "mrad"
     "states": {"before": "without what was found", "after": "with what was found"},   # ends of the slider
     "catalogue": [{"name": "screen-bow", "element": "screen", "says": "The board is bent …"}],
     "exposures": [{"exposure": "001.png", "setting": "s1",
                    "photograph": "photographs/1.jpg",        # or null
                    "size_px": [2000, 1500],                  # of the photograph as it was taken
                    "same": false,                            # whether nothing was put in
                    "measured_px": [[u, v], …], "before_px": [[u, v], …], "after_px": [[u, v], …],
                    "s_mm": […],                              # along the trace, growing, for all that follows
                    "residual_mm": {"before": […], "after": […], "held_out_before": […], "held_out_after": […]},
                    "sigma_mm": […], "sigma_alone_mm": […],    # with and without what neighbours have in common
                    "profiles": 1101,                          # optional: of the trace; each point is the mean of some
                    "departures": {"laser_azimuth": {"value": −0.4, "sigma": 0.2, "unit": "mrad"}},  # optional
                    "most": {"s_mm": […], "before": […], "after": […], "held_out_before": […],  # optional, see below
                             "held_out_after": […], "sigma": […], "sigma_alone": […]}}],
     "most": "f",                                              # optional: kind of datum that shows most, if not "c";
                                                               # of "m" an exposure has "at_px", "before_px", "after_px"
     "moves": {"screen-bow": {"value": 0.8, "sigma": 0.01, "unit": "mm", "how": "rms"}}, # optional: effect, parameter
     "priors": {"s1.laser_azimuth": {"sigma": 1.0, "unit": "mrad"}}} # optional: of what is fitted in every hypothesis
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from functools import cache
from math import hypot, isfinite
from typing import Any

import jinja2
from markupsafe import Markup

from benchsim.bench.complaints import UNFILLED
from benchsim.reports import page_field, page_plots, page_trial, page_words, vocabulary

FORMAT = "benchsim-page/1"

MOST_SHOWN = 12
"""Photographs in a page, those of the largest misfit: more would make the file slow to open on a phone."""

APART = 0.05
"""Largest distance of trace and prediction in the drawing, as a part of the picture's diagonal."""

LEAST_ENLARGED, MOST_ENLARGED = 5.0, 1000.0
"""What is seen without is drawn to scale; a trace that fits to some µm is not blown up until its noise looks like a
misfit."""


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("benchsim.reports"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters.update(page_words.FILTERS)
    return environment


def diagnosis_page(
    diagnosis: Mapping[str, Any],
    extra: Mapping[str, Any],
    photographs: Mapping[str, bytes],
    stamp: Mapping[str, Any],
    pixels: Mapping[str, Any] | None = None,
) -> str:
    """HTML of a diagnosis.

    Parameters
    ----------
    diagnosis : mapping
        ``diagnosis.json``.
    extra : mapping
        ``page.json``.
    photographs : mapping
        JPEG by the name that ``extra`` gives it.
    stamp : mapping
        ``benchsim.json``.
    pixels : mapping, optional
        ``pixels.json``.
    """
    return _environment().get_template("diagnosis.html.j2").render(
        d=diagnosis,
        pixels=pixels,
        words=page_words.diagnosis(diagnosis, extra),
        elements=page_words.probabilities(diagnosis, extra),
        most=_most(extra),
        **_recording(extra, photographs, stamp, strongest=_strongest(diagnosis)),
    )  # fmt: skip


def validation_page(
    validation: Mapping[str, Any],
    conics: Mapping[str, Any],
    extra: Mapping[str, Any],
    photographs: Mapping[str, bytes],
    stamp: Mapping[str, Any],
) -> str:
    """HTML of a run or a validation: the traces against the vector model, and their conics.

    Parameters
    ----------
    validation, conics : mapping
        ``validation.json`` and ``conics.json``.
    extra, photographs, stamp
        As in `diagnosis_page`.
    """
    return _environment().get_template("validation.html.j2").render(
        v=validation,
        conics=conics,
        words=page_words.validation(validation, extra),
        **_recording(extra, photographs, stamp, before=False),
    )  # fmt: skip


def trial_page(score: Mapping[str, Any], stamp: Mapping[str, Any]) -> str:
    """HTML of a concealed trial that was opened.

    Parameters
    ----------
    score : mapping
        In the form of `page_trial`.
    stamp : mapping
        ``benchsim.json``, or an empty mapping.
    """
    return _environment().get_template("trial.html.j2").render(stamp=stamp, **page_trial.shown(score))


def field_page(field: Mapping[str, Any], title: str, shared: Sequence[str]) -> str:
    """HTML of a field of heliostats.

    Parameters
    ----------
    field : mapping
        ``field.json``.
    title : str
    shared : sequence of str
        What all share, a sentence each.
    """
    return (
        _environment()
        .get_template("field.html.j2")
        .render(title=title, shared=shared, stamp={}, **page_field.shown(field))
    )


def plant_page(shown: Mapping[str, Any]) -> str:
    """HTML of a plant's flux, detectors or drone, of what `page_plant.shown` gives."""
    return _environment().get_template("plant.html.j2").render(**shown)


def form_page(title: str, folder: str, file: str, form: Mapping[str, Any], column: int) -> str:
    """HTML in which a recording that was begun is filled in; it writes the file's text.

    Parameters
    ----------
    title, folder, file : str
        The recording's name, and where its file lies.
    form : mapping
        As `intake.form.shown` has it.
    column : int
        In which comments begin.
    """
    return _environment().get_template("form.html.j2").render(
        title=title, folder=folder, file=file, column=column, open=UNFILLED, **form
    )  # fmt: skip


def _strongest(diagnosis: Mapping[str, Any]) -> dict[str, float]:
    """Exposure → sigma of its strongest stretch: the photographs come in the order in which stretches are listed."""
    out: dict[str, float] = {}
    for s in (diagnosis["location"] or {}).get("along_trace", ()):
        out[s["exposure"]] = max(s["z"], out.get(s["exposure"], 0.0))
    return out


def _most(extra: Mapping[str, Any]) -> dict[str, Any] | None:
    """Drawings of the kind of datum that shows most of what was found; None where that is the trace's own place."""
    kind = extra.get("most")
    shown = [x for x in extra["exposures"] if x.get("most")]
    if kind is None or not shown:
        return None
    if kind == "m":
        factor = page_plots.enlarged_marks(shown)
        figures = [page_plots.marks(x, factor) for x in shown]
    else:
        factor, words = None, vocabulary.BENCH.of_kind(kind)
        rows = [
            {
                **{key: x[key] for key in ("exposure", "setting", "same")},
                "s_mm": x["most"]["s_mm"],
                "residual_mm": x["most"],
                "sigma_mm": x["most"]["sigma"],
                "sigma_alone_mm": x["most"]["sigma_alone"],
            }
            for x in shown
        ]
        reach = page_plots.reach(rows)
        figures = [page_plots.residuals(row, reach, words=words) for row in rows]
    named = zip(shown, figures, strict=True)
    return {
        "factor": factor,
        "figures": [{"name": x["exposure"], "setting": x["setting"], "figure": figure} for x, figure in named],
    }


def _recording(
    extra: Mapping[str, Any],
    photographs: Mapping[str, bytes],
    stamp: Mapping[str, Any],
    before: bool = True,
    strongest: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """What every page of a recording shows: pictures with curves, and residuals, those before only where wanted."""
    exposures = extra["exposures"]
    factor = enlarged(exposures)
    pictures = [_picture(x, photographs[x["photograph"]], factor) for x in exposures if x["photograph"] in photographs]
    pictures.sort(key=lambda p: (-(strongest or {}).get(p["name"], 0.0), -p["worst"]))
    reach = page_plots.reach(exposures, before)
    return {
        "extra": extra,
        "stamp": stamp,
        "factor": factor,
        "left_away": max(0, len(pictures) - MOST_SHOWN),
        "pictures": pictures[:MOST_SHOWN],
        "residuals": [
            {
                "name": x["exposure"],
                "setting": x["setting"],
                "same": x["same"],
                "figure": page_plots.residuals(x, reach, before, vocabulary.of(extra)),
            }
            for x in exposures
        ],
        "held_out": any(v is not None for x in exposures for v in x["residual_mm"]["held_out_after"]),
    }


def enlarged(exposures: Sequence[Mapping[str, Any]]) -> float:
    """Round factor by which distances of trace and prediction are drawn too large, one for all pictures of a page."""
    widest = max((_worst(x) / hypot(*x["size_px"]) for x in exposures), default=0.0)
    factor = page_plots.nice(APART / widest) if widest > 0 else 1.0
    return min(factor, MOST_ENLARGED) if factor >= LEAST_ENLARGED else 1.0


def _worst(exposure: Mapping[str, Any]) -> float:
    """Largest distance of trace and prediction [px]."""
    measured = exposure["measured_px"]
    away = (
        hypot(u - a, v - b)
        for which in ("before_px", "after_px")
        for (u, v), (a, b) in zip(exposure[which], measured, strict=True)
    )
    return max(away, default=0.0)


def _picture(exposure: Mapping[str, Any], jpeg: bytes, factor: float) -> dict[str, Any]:
    """Paths over a photograph, in its own pixels, distances from the measured trace drawn ``factor`` times."""
    measured = exposure["measured_px"]

    def away(points: Sequence[Sequence[float]]) -> str:
        moved = [(a + factor * (u - a), b + factor * (v - b)) for (u, v), (a, b) in zip(points, measured, strict=True)]
        return page_plots.polyline(p for p in moved if all(map(isfinite, p)))

    return {
        "name": exposure["exposure"],
        "setting": exposure["setting"],
        "width": exposure["size_px"][0],
        "height": exposure["size_px"][1],
        "same": exposure["same"],
        "worst": _worst(exposure),
        "jpeg": Markup("data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")),
        "measured": page_plots.polyline(measured),
        "before": away(exposure["before_px"]),
        "after": away(exposure["after_px"]),
    }
