"""Conic fits with covariance: any conic through a trace, or the bench's own cone, and what of it is determined.

>>> found = fit(points, sigma)          # maximum likelihood, any kind
>>> invariants(found)["eccentricity"]   # value, 95 % interval, determined or not
>>> cone = fit_section(points, sigma, section, prior_mean, prior_sigma)
>>> to_dict(found)                      # for conics.json
"""

from benchsim.conics.data import Frame
from benchsim.conics.fit import ConicFit, fit
from benchsim.conics.invariants import Invariant, invariants
from benchsim.conics.record import to_dict
from benchsim.conics.section import SectionFit, fit_section, section_of

__all__ = ["ConicFit", "Frame", "Invariant", "SectionFit", "fit", "fit_section", "invariants", "section_of", "to_dict"]
