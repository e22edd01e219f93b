"""A fit as plain JSON values, for ``conics.json``."""

from __future__ import annotations

import math
from typing import Any

from benchsim.conics.fit import ConicFit
from benchsim.conics.invariants import invariants
from benchsim.conics.section import SectionFit


def _number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def to_dict(fitted: ConicFit | SectionFit) -> dict[str, Any]:
    """A fit and its invariants as JSON values; what is not finite is null.

    Parameters
    ----------
    fitted : ConicFit or SectionFit

    Returns
    -------
    dict
        ``kind``; ``curve_sigma_mm`` (rms along the points) and ``curve_sigma_max_mm``; ``chi2``, ``dof``; ``points``,
        ``points_used``; ``sigma_mm`` (estimated, null if given); ``straight``, ``shallow``, ``converged``;
        ``coefficients`` A … F of the curve in x_n = ``frame.matrix_per_mm`` (x − ``frame.origin_mm``), with unit norm,
        and their ``covariance``; ``coefficients_mm`` of the same curve on the board; ``invariants``, each
        {value, low95, high95, determined}, where a null end is unbounded. A section fit adds ``parameters``
        {name: {value, sigma, pull}} and ``combinations`` [{remaining, of: {name: weight in prior sigmas}}], those that
        the trace fixes to better than 0.9 of their prior.
    """
    known = invariants(fitted)
    out: dict[str, Any] = {
        "kind": known["kind"].value,
        "curve_sigma_mm": _number(fitted.curve_rms),
        "curve_sigma_max_mm": _number(fitted.curve_sigma.max()),
        "chi2": _number(fitted.chi2),
        "dof": int(fitted.dof),
        "points": len(fitted.points),
        "points_used": int(fitted.used.sum()),
        "sigma_mm": _number(fitted.sigma) if isinstance(fitted, ConicFit) else None,
        "straight": fitted.straight,
        "shallow": fitted.shallow,
        "converged": fitted.converged,
        "frame": {"origin_mm": fitted.frame.origin.tolist(), "matrix_per_mm": fitted.frame.matrix.tolist()},
        "coefficients": fitted.coefficients.tolist(),
        "covariance": fitted.covariance.tolist(),
        "coefficients_mm": fitted.board_coefficients.tolist(),
        "invariants": {
            name: {"value": i.value, "low95": i.low, "high95": i.high, "determined": i.determined}
            for name, i in known.items()
        },
    }
    if isinstance(fitted, SectionFit):
        sigma = fitted.parameter_covariance.diagonal() ** 0.5
        rows = zip(fitted.names, fitted.parameters, sigma, fitted.pulls, strict=True)
        out["parameters"] = {n: {"value": float(v), "sigma": float(s), "pull": float(p)} for n, v, s, p in rows}
        out["combinations"] = [
            {"remaining": float(r), "of": {n: float(w) for n, w in zip(fitted.names, row, strict=True)}}
            for r, row in zip(fitted.remaining, fitted.combinations, strict=True)
            if r < 0.9
        ]
    return out
