"""Does the search find the fit that begins at the truth? Asked of every case of the study."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchsim.diagnosis import linear, screen
from benchsim.diagnosis.fits import Naming
from benchsim.diagnosis.fitting import RENEWALS, Start, fitted
from benchsim.diagnosis.hypothesis import Context, Hypothesis, Point, whitener
from benchsim.diagnosis.problem import Problem


def ahead(problem: Problem, found: Naming, effects: Mapping[str, Mapping[str, float]]) -> float:
    """By how much in ln Z the fit of the concealed effects that begins at them lies above the best that was found.

    Settings begin as stated; the noise is the search's.
    """
    h = Hypothesis(tuple(e for e in problem.catalogue if e.name in effects))
    at = {name: value for own in effects.values() for name, value in own.items()}
    context = Context(problem, whitener(found.noise.covariance), found.setting_scales, found.scale_weights)
    point = Point(
        np.zeros(len(problem.nuisances)),
        np.array([linear.fit_value(p, at.get(p.name, 0.0)) for p in h.amplitudes]),
        np.array([at[p.name] for p in h.shapes]),
    )
    columns = linear.columns(problem, at, problem.nuisances) * np.array([p.sigma for p in problem.nuisances])
    prior = screen.log_prior(h.names, [e.name for e in problem.catalogue])
    (end,) = fitted(context, [Start(h, point, context.whiten(columns))], {h.names: prior}, renewals=RENEWALS)
    return end.fit.log_evidence - found.fits[0].log_evidence
