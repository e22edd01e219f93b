"""The recording's file with what was found put in: what `render`, `validate` and `diagnose` go on from."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchsim.bench.fields import FORMS, Field, evaluate, field
from benchsim.bench.model import Recording
from benchsim.bench.writing import write
from benchsim.diagnosis import settings
from benchsim.diagnosis.result import Diagnosis, Law, chosen
from benchsim.instruments.bench.candidates import simulated
from benchsim.instruments.bench.effects import PHYSICS_OF, SIZE, Term, terms


def amended(recording: Recording, d: Diagnosis, against: str = "bench") -> Recording:
    """The recording with what was found in its ``[effects]``, and a law in its ``[fields]``.

    Amplitudes are added to what the file has, shapes replace it, as `prediction.Predict.truth` has them.
    Of a class that is claimed the most probable member is put in. Against "vector" the file's ``[physics]`` are all
    false, as the simulation in doubt had them, and its switches appear as effects with the amplitude that was found.

    Parameters
    ----------
    recording : Recording
    d : Diagnosis
    against : {"bench", "vector"}

    Returns
    -------
    Recording
    """
    found = {f.name: {k: s.value for k, s in f.parameters.items()} for f in d.effects}
    for name in chosen(d):
        own = {t.name for t in terms(name, recording.mirror.facets)}
        values = {k: v for k, v in d.values.items() if k in own}
        if name == settings.NAME:
            values = {settings.SCALE: d.setting_scale}
        if values:
            found.setdefault(name, values)
    effects = {name: dict(values) for name, values in recording.effects.items()}
    for name, values in found.items():
        effects[name] = combined(name, effects.get(name, {}), values, recording.mirror.facets)
    fields = dict(recording.fields)
    if d.law is not None:
        name, new = law_field(d.law)
        fields[name] = new if name not in fields else summed(fields[name], new)
    return replace(recording, physics=simulated(recording, against), effects=effects, fields=fields)


def combined(name: str, old: Mapping[str, float], found: Mapping[str, float], facets: int) -> dict[str, float]:
    """An effect's parameters with what was found on top of what the file had, held to what is physical.

    A switch's size on the trace is left out: it follows from the share, and a file's was of the share that it had.
    """
    known: dict[str, Term] = {t.name: t for t in terms(name, facets)}
    out = {key: value for key, value in old.items() if key != SIZE.name}
    for key, value in found.items():
        if key == SIZE.name:
            continue
        term = known[key]
        if name == settings.NAME:
            out[key] = old.get(key, 1.0) * value
        elif term.grid or key not in old:
            out[key] = value
        else:
            out[key] = old[key] + value
        if term.one_sided:
            out[key] = max(out[key], 0.0)
        if name in PHYSICS_OF:
            out[key] = min(out[key], 1.0)
    return out


def law_field(law: Law) -> tuple[str, Field]:
    """A law's function as the free field of its attachment: the field's name, and its values on a grid of knots.

    The attachment is named ``element.FIELD``; its knots lie on a grid in the coordinates of `fields.FORMS`, in the
    file's units, and its components are the field's.
    """
    name = law.attachment.split(".")[-1]
    form = FORMS[name]
    places = np.atleast_2d(np.asarray(law.knots, float))
    if places.shape[0] != len(law.coefficients):
        places = places.T
    axes = [np.unique(places[:, k]) for k in range(places.shape[1])]
    shape = tuple(len(a) for a in axes)
    table = np.zeros((len(form.components), *shape))
    for place, component, value in zip(places, law.component, law.coefficients, strict=True):
        at = tuple(int(np.searchsorted(a, x)) for a, x in zip(axes, place, strict=True))
        table[(int(component), *at)] += value
    knots = [a * factor for a, (_, factor) in zip(axes, form.coordinates, strict=True)]
    # A field has at least two knots a coordinate; one alone is a constant.
    for k, a in enumerate(knots):
        if len(a) == 1:
            knots[k] = np.array([a[0], a[0] + form.coordinates[k][1]])
            table = np.repeat(table, 2, axis=k + 1)
    factors = np.array([factor for _, factor in form.components]).reshape(-1, *[1] * len(shape))
    return name, field(knots, table * factors)


def summed(a: Field, b: Field) -> Field:
    """Sum of two fields of one name, exact at the knots of both."""
    knots = [np.union1d(x, y) for x, y in zip(a.knots, b.knots, strict=True)]
    grid = np.meshgrid(*knots, indexing="ij")
    return field(knots, evaluate(a, *grid) + evaluate(b, *grid))


def write_amended(recording: Recording, path: Path, target: Path) -> None:
    """Write an amended recording (and its marks) so that it stands where it will lie.

    Parameters
    ----------
    recording : Recording
    path : Path
        The file to write.
    target : Path
        The folder that it will lie in: images are named relative to it.
    """

    def named(image: str | None) -> str | None:
        if image is None:
            return None
        at = (recording.folder / image).resolve()
        try:
            return Path(os.path.relpath(at, target.resolve())).as_posix()
        except ValueError:  # another drive
            return at.as_posix()

    exposures = tuple(replace(e, image=named(e.image), dark=named(e.dark)) for e in recording.exposures)
    write(replace(recording, exposures=exposures), path)


def put_in(before: Recording, after: Recording) -> tuple[str, ...]:
    """Names of the effects and fields that `amended` put in."""
    effects = [n for n, values in after.effects.items() if values != before.effects.get(n)]
    return (*effects, *(f"field {n}" for n, f in after.fields.items() if f != before.fields.get(n)))
