"""Cases of `diagnosis_study.py`: what is concealed in each, drawn from a seed, and how visible it is there.

Two tiers. *traces*: data drawn from the problem's own prediction, at drawn setting errors, with the covariance that
extraction has; simulator and fitter share their optics, so its rates are upper bounds. *photographs*: the other
realisation renders pictures, which are read back. Benches and effects are drawn as those of a concealed trial.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field
from benchsim.bench.model import Recording
from benchsim.diagnosis import evidence
from benchsim.diagnosis.levels import APART
from benchsim.diagnosis.linear import predict_all, whiten
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.trial.draws import (
    SNR,
    STRANGER_ELEMENT,
    STRANGERS,
    as_effects,
    bench,
    draw_effect,
    draw_stranger,
    possible,
)
from benchsim.trial.visibility import Sight, refitted, rival_refitted

__all__ = [
    "Sight",
    "Truth",
    "bench",
    "conceal",
    "element_of",
    "in_pixels",
    "noisy",
    "nuisances",
    "plain",
    "visible",
]

Array = NDArray[np.float64]

SEEN = 8.0
"""SNR from which an effect has to be named."""


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
        Truth over what is stated; the noise's for traces only, photographs state none.
    correlated : float
        Sigma of a correlated error along each trace over that of a datum, for traces; photographs have speckle.
    """

    effects: Mapping[str, Mapping[str, float]]
    fields: Mapping[str, Field]
    stranger: str = ""
    setting_scale: float = 1.0
    noise_scale: float = 1.0
    correlated: float = 0.0


COUNT = {"single": 1, "fig7": 1, "removed": 1, "pair": 2, "fig7-pair": 2, "beside": 2, "fig7-beside": 2}
"""Effects of the catalogue that a case of each row conceals; the other rows conceal none."""


def conceal(
    row: str, recording: Recording, sight: Sight, rng: np.random.Generator, snr: tuple[float, float] | None = None
) -> tuple[Truth, dict[str, float]]:
    """Draw what one case conceals; also the parameters of the catalogue's effects, by parameter name.

    Only effects that reach a given ``snr`` on this bench within their caps are drawn, and with one out of it.
    """
    catalogue, wanted = sight.problem.catalogue, COUNT.get(row, 0)
    values: dict[str, float] = {}
    effects: dict[str, dict[str, float]] = {}
    for i in rng.choice(len(catalogue), wanted if snr is None else len(catalogue), replace=False):
        if len(effects) == wanted:
            break
        effect = catalogue[int(i)]
        drawn = possible(draw_effect(sight, effect, rng, snr or SNR), recording)
        if snr is None or np.linalg.norm(sight.change(drawn)) >= snr[0]:
            values |= drawn
            effects |= as_effects(drawn, effect)
    stranger = STRANGERS[int(rng.integers(len(STRANGERS)))] if row == "stranger" else ""
    fields = draw_stranger(stranger, recording, rng) if stranger else {}
    truth = Truth(
        effects,
        fields,
        stranger,
        setting_scale=3.0 if row == "clean-settings" else 1.0,
        noise_scale=1.3 if row == "clean-noise" else 1.0,
        correlated=0.7 if row == "clean-correlated" else 0.0,
    )
    return truth, values


def in_pixels(
    truth: Truth, values: Mapping[str, float], catalogue: Collection[Effect], shrink: int
) -> tuple[Truth, dict[str, float]]:
    """The same on pictures of less resolution: charge that spills over three pixels spills over half as many of twice
    the size. Left at three, it would part a line of one pixel's width into the rungs of a ladder."""
    share = {p.name: 1 / shrink for e in catalogue for p in evidence.amplitudes(e) if p.unit == "px"}
    effects = {n: {k: v * share.get(k, 1.0) for k, v in own.items()} for n, own in truth.effects.items()}
    return replace(truth, effects=effects), {k: v * share.get(k, 1.0) for k, v in values.items()}


def visible(truth: Truth, sight: Sight, values: Mapping[str, float], true: Problem | None = None) -> dict[str, Any]:
    """How visible what is concealed is in the noise of the data that are judged.

    Parameters
    ----------
    truth : Truth
    sight : Sight
        On the problem of those data, the effects that the judge's catalogue lacks included.
    values : mapping
        Parameters of the concealed effects by name.
    true : Problem, optional
        Of the same data, with the fields of a stranger; where there is one.

    Returns
    -------
    dict
        ``snr`` of each concealed thing, settings marginalised to first order; ``refitted``, the same with settings
        fitted anew; ``reach``, the SNR of each effect at its cap; ``rival``, the nearest other single or pair of them
        all and its distance; ``rival_refitted``, the same with all of it fitted anew, where what is concealed can be
        seen and that says it is apart; ``alone``, how far they are from any one of them.
    """
    catalogue = {e.name: e for e in sight.problem.catalogue}
    nominal = sight.problem
    snr = {name: float(np.linalg.norm(sight.change(own))) for name, own in truth.effects.items()}
    anew = {name: refitted(nominal, predict_all(nominal, own)) for name, own in truth.effects.items()}
    if true is not None:
        stranger = predict_all(true, {}) - true.data + nominal.data
        bent = whiten(nominal, nominal.covariance, stranger - predict_all(nominal, {}))[0]
        snr[truth.stranger] = float(np.linalg.norm(sight.through(bent)))
        anew[truth.stranger] = refitted(nominal, stranger)
    rival, single = ("", float("inf")), float("inf")
    more: dict[str, Any] = {}
    if truth.effects:
        rival, single = sight.rival(values, tuple(truth.effects)), sight.alone(values, tuple(truth.effects))
        if min(snr.values()) >= SEEN and rival[1] >= APART:
            more["rival_refitted"] = rival_refitted(sight, values, tuple(truth.effects))
    at_cap = {name: reach(sight, catalogue[name], own) for name, own in truth.effects.items()}
    return {"snr": snr, "refitted": anew, "reach": at_cap, "rival": rival, "alone": single, **more}


def reach(sight: Sight, effect: Effect, own: Mapping[str, float]) -> float:
    """SNR of an effect at its cap: its amplitudes in the ratio that the case has, until the first is there."""
    many = evidence.amplitudes(effect)
    share = max(abs(own[p.name]) / (2 * p.sigma) for p in many)
    if share == 0:
        return 0.0
    try:
        size = float(np.linalg.norm(sight.change({**own, **{p.name: own[p.name] / share for p in many}})))
    except BenchsimError:  # light that misses the board is seen to do so
        return float("inf")
    return size if np.isfinite(size) else float("inf")


def element_of(problem: Problem, truth: Truth) -> str:
    """Where in the light's path the truth sits."""
    if truth.stranger:
        return STRANGER_ELEMENT[truth.stranger]
    return next((e.element for e in problem.catalogue if e.name in truth.effects), "")


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


def plain(truth: Truth) -> dict[str, Any]:
    """For the case's line."""
    return {
        "effects": {k: dict(v) for k, v in truth.effects.items()},
        "stranger": truth.stranger,
        "setting_scale": truth.setting_scale,
        "noise_scale": truth.noise_scale,
        "correlated": truth.correlated,
    }
