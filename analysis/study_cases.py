"""Cases of `diagnosis_study.py`: what is concealed in each, drawn from a seed, and how visible it is there.

Two tiers. *traces*: data drawn from the problem's own prediction, at drawn setting errors, with the covariance that
extraction has; simulator and fitter share their optics, so its rates are upper bounds. *photographs*: the other
realisation renders pictures, which are read back. Benches and effects are drawn as those of a concealed trial.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.fields import Field
from benchsim.diagnosis.linear import whiten
from benchsim.diagnosis.problem import Problem
from benchsim.trial.draws import (
    SNR,
    STRANGER_ELEMENT,
    STRANGERS,
    Sight,
    amplitudes,
    as_effects,
    bench,
    draw_effect,
    draw_stranger,
)

__all__ = [
    "SNR", "STRANGERS", "STRANGER_ELEMENT", "Sight", "Truth", "alone", "as_effects", "bench", "draw_effect",
    "draw_stranger", "noisy", "nuisances", "plain", "whiten",
]  # fmt: skip

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """What one case conceals.

    Attributes
    ----------
    effects : mapping of effect → parameter → value
        Of the catalogue, in its units.
    fields : mapping of str to Field
        Of a cause without a name.
    stranger : str
        Its name among `STRANGERS`, or "".
    setting_scale, noise_scale : float
        Truth over what is stated.
    correlated : float
        Sigma of a correlated error along each trace over that of a datum.
    """

    effects: Mapping[str, Mapping[str, float]]
    fields: Mapping[str, Field]
    stranger: str = ""
    setting_scale: float = 1.0
    noise_scale: float = 1.0
    correlated: float = 0.0


def noisy(problem: Problem, prediction: Array, truth: Truth, rng: np.random.Generator) -> Array:
    """Data: the prediction with the covariance's noise, scaled and correlated as the case has it."""
    out = prediction.copy()
    for b, c in enumerate(problem.covariance):
        rows = problem.rows(b)
        draw = np.linalg.cholesky(c) @ rng.standard_normal(len(c))
        out[rows] += truth.noise_scale * draw
        if truth.correlated > 0:
            sigma = np.sqrt(np.diag(c))
            at, line = problem.position[rows], problem.stretch[rows]
            for number in np.unique(line[line >= 0]):
                here = line == number
                far = np.abs(at[here][:, None] - at[here][None, :])
                kernel = np.exp(-far / 25.0) + 1e-9 * np.eye(here.sum())
                extra = np.linalg.cholesky(kernel) @ rng.standard_normal(int(here.sum()))
                out[np.flatnonzero(here) + rows.start] += truth.correlated * sigma[here] * extra
    return out


def nuisances(problem: Problem, truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """A draw of the nuisances from their priors, setting errors scaled as the case has it."""
    return {
        p.name: float(p.sigma * (truth.setting_scale if p.scaled else 1.0) * rng.standard_normal())
        for p in problem.nuisances
    }


def alone(sight: Sight, delta: Array, values: Mapping[str, float], concealed: Collection[str]) -> float:
    """Distance [sigma] of what several effects change together from what the nearest of them, refitted, does alone.

    Below 3 the data do not show that there are several, whatever the SNR of each by itself. Linear, caps aside;
    infinite for fewer than two effects.
    """
    if len(concealed) < 2:
        return float("inf")
    left = []
    for effect in sight.problem.catalogue:
        if effect.name in concealed:
            own = np.stack([sight.column(p, values) for p in amplitudes(effect)], axis=1)
            left.append(float(np.linalg.norm(delta - own @ np.linalg.lstsq(own, delta, rcond=1e-9)[0])))
    return min(left)


def plain(truth: Truth) -> dict[str, Any]:
    """For the case's line."""
    return {
        "effects": {k: dict(v) for k, v in truth.effects.items()},
        "stranger": truth.stranger,
        "setting_scale": truth.setting_scale,
        "noise_scale": truth.noise_scale,
        "correlated": truth.correlated,
    }
