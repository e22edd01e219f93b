"""What an element could do without a name: one unknown function per element, in that element's own coordinate.

The mount turns its axes by a function of where they stand, the sky moves the light by a function of where it is, a
target moves the spots by a function of their place on it, time turns the axes by a function of when. Each is pushed
through the prediction's own derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchsim.diagnosis import linear
from benchsim.diagnosis.problem import Attachment, Parameter, Problem
from benchsim.instruments.mount import axes
from benchsim.instruments.mount.prediction import Predict
from benchsim.instruments.mount.records import Array

RMS = {"arcsec": 300.0, "mrad": 10.0, "mm": 1000.0}
"""Largest plausible rms of a function: of a telescope half the cap of its terms, so that names and functions pay alike
for being able to be large; of a heliostat less, since a dozen records cannot tell a function as large as a tilted
pedestal from the pedestal."""


@dataclass(frozen=True)
class Form:
    """One function: its name, where it acts, and the inputs of the prediction that it moves.

    ``where`` (n, d) are the records' places in its coordinate, along directions that are called ``axes``; ``lengths``
    are those over which it may vary.
    """

    name: str
    element: str
    coordinate: str
    inputs: tuple[str, ...]
    unit: str
    where: Array
    lengths: tuple[float, ...]
    axes: tuple[str, ...]


SECOND_ORDER = 1e-4
"""Part of an input's largest effect below which one is none."""


def attachments(problem: Problem, predict: Predict) -> tuple[Attachment, ...]:
    """The attachments of a problem's records."""
    return tuple(_attach(problem, form) for form in forms(predict))


def forms(predict: Predict) -> list[Form]:
    """Every function that a mount's records may show."""
    mount, records = predict.mount, predict.records
    n = len(records.names)
    x = {k: np.full(n, v) for k, v in predict.stated.items()}
    normal = axes.pointing(mount, records.reading, x)[0]
    angle, wide = mount.unit, (0.25, 0.5, 1.0)
    raised, turn = np.arcsin(np.clip(normal[:, 2:], -1, 1)), ("sin(azimuth)", "cos(azimuth)")
    around = normal[:, :2] / np.maximum(np.linalg.norm(normal[:, :2], axis=1, keepdims=True), 1e-9)
    when = np.arange(n, dtype=float)[:, None]
    both, world, height = ("IA", "IE"), ("east", "north", "up"), ("elevation",)
    found = [
        Form("mount.direction", "mount", "where the mount points", both, angle, normal, wide, world),
        Form("mount.elevation", "mount", "elevation of the normal", both, angle, raised, wide, height),
        Form("mount.azimuth", "mount", "azimuth of the normal", both, angle, around, wide, turn),
        Form("time.order", "time", "number of the record", both, angle, when, (n / 16, n / 8, n / 3), ("record",)),
    ]
    if mount.observes == "sky":
        high = np.arcsin(np.clip(records.source[:, 2:], -1, 1))
        # A tube that sinks and air that lifts are one function of the elevation: neither is claimed over the other.
        found.append(Form("mount.sinking", "mount", "elevation of the tube", ("IE",), angle, high, wide, height))
        return [*found, Form("sky.elevation", "sky", "elevation of the light", ("sun_up",), angle, high, wide, height)]
    sun = records.source
    found.append(Form("sky.direction", "sky", "place of the sun", ("sun_across", "sun_up"), angle, sun, wide, world))
    # Of the target alone: a spot's own place on it is what is measured, so that every error would look like a function
    # of that place.
    of = np.array(records.target)
    spots = np.stack([records.spot[of == t].mean(axis=0) for t in of])
    lengths = (1000.0, 3000.0, 10000.0)
    inputs = ("spot_across", "spot_up")
    return [*found, Form("target.which", "target", "which target it is", inputs, "mm", spots, lengths, world)]


def _attach(problem: Problem, form: Form) -> Attachment:
    n, k = len(problem.names), len(form.inputs)
    inputs = tuple(Parameter(name, form.unit, 20.0) for name in form.inputs)
    slopes = linear.columns(problem, {}, inputs)
    # A sinking tube moves a star sideways by 1e-5 of what it sinks, in second order. The smooth modes of what is left
    # are levelled kind by kind: they would take this for something that shows, where there is nothing.
    slopes = np.where(np.abs(slopes) < SECOND_ORDER * np.abs(slopes).max(axis=0), 0.0, slopes)
    basis = np.zeros((2 * n, n * k))
    for j in range(k):
        for i in range(n):
            basis[2 * i : 2 * i + 2, j * n + i] = slopes[2 * i : 2 * i + 2, j]
    return Attachment(
        name=form.name,
        element=form.element,
        coordinate=form.coordinate,
        unit=form.unit,
        basis=basis,
        knots=np.tile(form.where, (k, 1)),
        component=np.repeat(np.arange(k), n),
        sigma=RMS[form.unit],
        lengths=form.lengths,
        position=np.repeat(form.where, 2, axis=0),
        axes=form.axes,
        parts=form.inputs if k > 1 else (),
    )
