"""What naming hands on: hypotheses fitted, their evidence, and the problem linearised about the best of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.linear import Linear

Array = NDArray[np.float64]
Effects = tuple[str, ...]
"""Names of the effects that a hypothesis holds, in the catalogue's order; () is the null."""

LARGEST = 4
"""Effects in one hypothesis."""


@dataclass(frozen=True)
class Noise:
    """Noise as the data themselves show it.

    Attributes
    ----------
    scale : mapping of str to float
        By kind of datum: by how much the problem's sigma had to be multiplied.
    correlation : mapping of str to float
        By kind: length over which neighbours' errors are correlated beyond the problem's covariance, in the units of
        ``Problem.position``; 0: none found.
    covariance : tuple of (n_b, n_b)
        Of the blocks, with both put in.
    freedom : mapping of str to float
        By kind: numbers that the scale was estimated from; a kind that is not here is known.
    """

    scale: Mapping[str, float]
    correlation: Mapping[str, float]
    covariance: tuple[Array, ...]
    freedom: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Fit:
    """One hypothesis, refitted until nothing moves.

    Attributes
    ----------
    effects : Effects
    log_evidence : float
        ln Z, the prior of its effects' presence included; setting scale and other hyper-parameters are integrated.
    values : mapping
        Most probable value of every nuisance and of its own parameters, in their units.
    sigma : mapping
        Posterior 1 sigma of the same, hyper-parameters included.
    covariance : (k, k)
        Of its own parameters, in the catalogue's order.
    setting_scale : float
        Most probable.
    chi2 : float
        Of the data alone at ``values``.
    converged : bool
        False: nothing may be claimed from it.
    linear : Linear
        About ``values``: nuisances and its own amplitudes.
    log_scales : (m,)
        ln Z at every setting scale of the grid; ``log_evidence`` is of their sum.
    """

    effects: Effects
    log_evidence: float
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    covariance: Array
    setting_scale: float
    chi2: float
    converged: bool
    linear: Linear
    log_scales: Array


@dataclass(frozen=True)
class Naming:
    """All hypotheses of the catalogue weighed.

    Attributes
    ----------
    null : Fit
    fits : tuple of Fit
        Everything refitted, the null included, most probable first; unconverged ones last.
    screened : tuple of (Effects, float, Effects)
        Every single and pair, and what grew from them, with ln Z (on the scale of ``Fit.log_evidence``) and the effects
        of the fit about which it was weighed, most probable first.
    linear : Linear
        About the null's fit: nuisances, and the amplitudes of the whole catalogue.
    noise : Noise
    setting_scales, scale_weights : (m,)
        Grid of the setting scale, and its prior weights (their sum is 1).
    """

    null: Fit
    fits: tuple[Fit, ...]
    screened: tuple[tuple[Effects, float, Effects], ...]
    linear: Linear
    noise: Noise
    setting_scales: Array
    scale_weights: Array
