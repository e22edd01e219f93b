"""Conic fits with covariance: any conic through a trace, or the bench's own cone, and what of it is determined.

>>> import numpy as np
>>> t = np.linspace(0.0, 2.0, 50)  # of an ellipse of 20 mm by 10 mm
>>> points = np.column_stack([20 * np.cos(t), 10 * np.sin(t)])
>>> points += np.random.default_rng(1).normal(0, 0.01, points.shape)
>>> found = fit(points, np.tile(0.01**2 * np.eye(2), (50, 1, 1)))
>>> e = invariants(found)["eccentricity"]
>>> bool(e.low < np.sqrt(0.75) < e.high), e.determined
(True, True)

``fit_section`` fits the bench's own cone with priors, and ``to_dict`` is for ``conics.json``.
"""

from benchsim.conics.data import Frame
from benchsim.conics.fit import ConicFit, fit
from benchsim.conics.invariants import Invariant, invariants
from benchsim.conics.record import to_dict
from benchsim.conics.section import SectionFit, fit_section, section_of

__all__ = ["ConicFit", "Frame", "Invariant", "SectionFit", "fit", "fit_section", "invariants", "section_of", "to_dict"]
