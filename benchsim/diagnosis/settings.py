"""The scale of the setting errors: a hyper-parameter of every hypothesis, and a hypothesis of its own.

If the setting errors are twice what is stated, a tool that takes the statement at its word names an effect in a third
to half of clean data sets. The scale s multiplies the prior sigma of all scaled nuisances; ln s has a normal prior of
sigma `SPREAD` about 0, on a grid from 1 up, and every hypothesis is summed over it, the null included. What of a
hypothesis lies beyond `BEYOND` is the same hypothesis with *setting errors*, a finding like any effect's: so the
evidence itself weighs whether something is missing or whether settings are further off than stated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis import evidence
from benchsim.diagnosis.evidence import Term
from benchsim.diagnosis.linear import Linear, marginals
from benchsim.diagnosis.problem import Effect, Parameter

Array = NDArray[np.float64]

NAME, SCALE = "setting-errors", "scale"

SPREAD = 0.3
"""Prior sigma of ln s. Hands are known to a third: 18 % of them are taken to be worse than `BEYOND` before any data."""

BEYOND = 1.5
"""Scale from which on setting errors are something that is missing from the statement."""

LARGEST = 4.5

EFFECT = Effect(
    NAME,
    "settings",
    (Parameter(SCALE, "1", LARGEST / 2, one_sided=True),),
    "Mirror, laser and screen were set less exactly than the file states.",
    "State the uncertainty that the settings have, or set them again with more care.",
)
"""As it is told; it has no column in the data."""


def grid(scaled: bool = True) -> tuple[Array, Array]:
    """Scales (m,), evenly spaced in their logarithm from 1, and prior weights whose sum is 1; 1 alone where no nuisance
    is ``scaled``."""
    scales = np.geomspace(1.0, LARGEST, 9 if scaled else 1)
    weights = np.exp(-0.5 * (np.log(scales) / SPREAD) ** 2)
    return scales, weights / weights.sum()


def size(scales: Array, log_scales: Array) -> tuple[float, float]:
    """Mean and sigma of the scale, from ln Z at every one of the grid."""
    share = np.exp(log_scales - np.logaddexp.reduce(log_scales))
    mean = float(share @ scales)
    return mean, float(np.sqrt(share @ (scales - mean) ** 2))


def parted(scales: Array, log_scales: Array) -> tuple[float, float]:
    """ln Z of a hypothesis with settings about as stated, and of the same with setting errors beyond `BEYOND`."""
    far = scales > BEYOND
    return float(np.logaddexp.reduce(log_scales[~far])), float(np.logaddexp.reduce(log_scales[far]))


def log_cells(linear: Linear, columns: Array, scales: Array, weights: Array, terms: Sequence[Term]) -> Array:
    """ln Z of every (setting scale, term), (m, T), without the prior of presence.

    Parameters
    ----------
    linear : Linear
    columns : (n, k) array
        Whitened; what the terms' column numbers mean.
    scales, weights : (m,) array
    terms : sequence of T terms
    """
    many = marginals(linear, columns, scales)
    null = np.array([-0.5 * (m.chi2 + m.logdet + m.n * np.log(2 * np.pi)) for m in many]) + np.log(weights)
    gram, projection = np.stack([m.gram for m in many]), np.stack([m.projection for m in many])
    cells = evidence.log_factors(gram, projection, terms) + np.array([t.log_weight for t in terms])
    return np.asarray(cells + null[:, None])
