"""Laws without a name in a mount's file: tabulated functions of where it points, of the sky, of the target or of time.

    [fields."mount.direction"]
    knots = [[0.1, -0.8, 0.6], [0.2, -0.7, 0.7], …]     # its coordinates, as `attachments` has them
    IA_mrad = [0.4, 0.5, …]                             # one list per input, a value for each knot
    IE_mrad = [-1.1, -0.9, …]

Between knots, which are records and lie scattered, they are interpolated by a sum of distances from them, linearly
along a line of knots; far from all of them they stay level. Knots over time are the records' numbers where their names
are numbers, so that a file holds of any records of its mount.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.interpolate import RBFInterpolator

from benchsim.diagnosis.result import Law
from benchsim.instruments.mount.attachments import Form
from benchsim.instruments.mount.records import UNITS, Array, Function, Records, numbers


def key(name: str, form: Form) -> str:
    """An input as a file names it."""
    return f"{name}_{form.unit}"


def coordinate(form: Form, records: Records) -> Array:
    """Where every record lies in a function's coordinate, as a file counts it, (n, d)."""
    counted = numbers(records) if form.element == "time" else None
    return form.where if counted is None else counted[:, None]


def evaluated(function: Function, where: Array) -> dict[str, Array]:
    """Every input's values at some places (n, d)."""
    # Records that lie on each other are one knot, with the mean of what they have.
    knots, of = np.unique(function.knots, axis=0, return_inverse=True)
    table = np.column_stack(list(function.values.values()))
    mean = np.stack([table[of.ravel() == k].mean(axis=0) for k in range(len(knots))])
    found = RBFInterpolator(knots, mean, kernel="linear", degree=0)(where) if len(knots) > 1 else mean[[0] * len(where)]
    return dict(zip(function.values, found.T, strict=True))


def of_law(law: Law, form: Form, records: Records) -> Function:
    """A law that was found from some records, as the function that a file states."""
    return Function(
        coordinate(form, records),
        {key(name, form): law.coefficients[law.component == k] for k, name in enumerate(form.inputs)},
    )


def summed(one: Function, other: Function) -> Function:
    """Both at once, exact at the knots of either."""
    knots = np.unique(np.vstack([one.knots, other.knots]), axis=0)
    first, second = evaluated(one, knots), evaluated(other, knots)
    return Function(knots, {name: first[name] + second[name] for name in first})


def inputs(functions: Mapping[str, Function], forms: Sequence[Form], records: Records) -> dict[str, Array]:
    """What the functions of a file add to every input of the prediction, inside's units, (n,) each."""
    out: dict[str, Array] = {}
    for form in (f for f in forms if f.name in functions):
        found = evaluated(functions[form.name], coordinate(form, records))
        for name in form.inputs:
            out[name] = out.get(name, 0.0) + found[key(name, form)] * UNITS[form.unit]
    return out
