"""Millimetres on the trace: of an effect that is there as a whole or not, and of what is left beside what was found.

A share of facets, beam or diffraction says that they are there; how much they matter is what they move. Diffraction
changes the trace's width and leaves the mean of its light where it is; the centre of lopsided light it moves by
micrometres, so that its size is small however surely it is there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchsim.diagnosis.linear import predict_all
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Diagnosis, Found, Left, Size
from benchsim.instruments.bench.effects import BY_NAME, PHYSICS_OF, SIZE
from benchsim.instruments.bench.prediction import FAR, Predict

NOTHING = 1e-6
"""Of the mean shift [mm]: a nanometre is what the ray model's own iterations leave."""


def sized(problem: Problem, d: Diagnosis) -> Diagnosis:
    """The diagnosis with ``size_mm`` among the parameters of every switch that was found, ``rms_mm`` in what is left.

    Parameters
    ----------
    problem : Problem
        Of the bench, by whose prediction ``d`` was made.
    d : Diagnosis

    Returns
    -------
    Diagnosis
        ``size_mm`` is the rms, over the centre line's data, of what the effect changes in their prediction, all else as
        fitted; its sigma is in proportion to that of the share. What is left of marks is taken to millimetres by the
        pictures' scale, of squares of widths by the width; of flux it is no length.
    """
    left = tuple(replace(x, rms_mm=_millimetres(problem, x)) for x in d.left)
    return replace(d, effects=tuple(_sized(problem, d, f) for f in d.effects), left=left)


def _millimetres(problem: Problem, x: Left) -> float:
    assert isinstance(problem.predict, Predict)
    if x.family == "c":
        return x.rms
    if x.family == "m":
        views = [b.observed.view for b in problem.predict.blocks]
        return x.rms * float(np.mean([v.translation[2] / v.camera.focal for v in views]))
    if x.family in ("w", "g"):
        return x.rms / (2 * float(np.sqrt(np.median(np.abs(problem.data[problem.kind == x.family])))))
    return float("nan")


def _sized(problem: Problem, d: Diagnosis, f: Found) -> Found:
    if f.name not in PHYSICS_OF:
        return f
    name = BY_NAME[f.name].terms[0].name
    share = f.parameters[name]
    # Of a share of 0 the proportion is that of the whole effect.
    at = share.value or 1.0
    there, without = (predict_all(problem, {**d.values, name: amount}) for amount in (at, 0.0))
    lit = (problem.kind == "c") & (there != FAR) & (without != FAR)
    rms = float(np.sqrt(np.mean((there - without)[lit] ** 2))) if lit.any() else float("nan")
    rms = 0.0 if rms < NOTHING else rms
    size = Size(rms * abs(share.value / at), rms * abs(share.sigma / at), SIZE.unit)
    return replace(f, parameters={**f.parameters, SIZE.name: size})
