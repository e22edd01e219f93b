"""The scale of the setting errors: a hyper-parameter that every hypothesis is integrated over, the null included.

If the setting errors are twice what is stated, a tool that takes the statement at its word names an effect in a third
to half of clean data sets. The scale multiplies the prior sigma of all scaled nuisances; its prior falls as its inverse
square, so data that say nothing leave it near 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.linear import Linear, Marginal, precision, through

Array = NDArray[np.float64]


def grid(largest: float = 4.5, count: int = 7) -> tuple[Array, Array]:
    """Scales (m,), evenly spaced in their logarithm from 1, and prior weights whose sum is 1."""
    scales = np.geomspace(1.0, largest, count)
    weights = scales**-2.0
    return scales, weights / weights.sum()


def marginals(linear: Linear, columns: Array, scales: Array) -> tuple[Marginal, ...]:
    """`linear.marginal` at every scale, the products of long arrays taken once.

    Parameters
    ----------
    linear : Linear
    columns : (n, k) array
        Whitened.
    scales : (m,) array
    """
    both = np.column_stack([linear.residual, columns])
    own, cross, square = linear.nuisance.T @ linear.nuisance, linear.nuisance.T @ both, both.T @ both
    out = []
    for scale in scales:
        s = np.where(linear.scaled, scale, 1.0)
        factor = precision(linear.nuisance, s, own)
        product = through(linear.nuisance, s, both, factor, cross, square)
        logdet = 2 * float(np.log(np.diag(factor[0])).sum()) + 2 * float(np.log(s).sum()) + linear.logdet
        out.append(Marginal(product[1:, 1:], product[1:, 0], float(product[0, 0]), logdet, len(both)))
    return tuple(out)


def log_null(many: tuple[Marginal, ...], weights: Array) -> Array:
    """ln of weight × likelihood of the data without amplitudes, at every scale, (m,)."""
    return np.array([-0.5 * (m.chi2 + m.logdet + m.n * np.log(2 * np.pi)) for m in many]) + np.log(weights)
