"""What to record next: that which best tells apart the hypotheses still alive, Σ P_A P_B Δ(separation²)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.degeneracy import Space, separation
from benchsim.diagnosis.hypothesis import Effects
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import NextRecording, Problem
from benchsim.diagnosis.result import SplitBy

Array = NDArray[np.float64]

DECIDES = 0.1
"""Σ P_A P_B Δ(separation²) below which a further recording decides nothing worth its while."""


@dataclass(frozen=True)
class Alive:
    """A hypothesis that is still possible: its probability and its amplitudes, value**power, (k,)."""

    effects: Effects
    probability: float
    signal: Array


def gram_with(problem: Problem, linear: Linear, scale: float, further: NextRecording) -> Array:
    """Gram matrix of the catalogue's amplitudes with a further recording, nuisances marginalised, (k, k).

    Nuisances that both know are shared; those that the recording brings have their own priors.
    """
    known = {p.name: i for i, p in enumerate(problem.nuisances)}
    new = [n for n in further.nuisance if n not in known]
    p, k = linear.nuisance.shape[1], linear.effect.shape[1]
    total = p + len(new) + k
    current = np.zeros((len(linear.residual), total))
    current[:, :p], current[:, total - k :] = linear.nuisance, linear.effect
    later = np.zeros((further.covariance.shape[0], total))
    prior = np.ones(total)
    prior[:p] = np.where(linear.scaled, scale, 1.0) ** -2.0
    for name, column in further.nuisance.items():
        if name in known:
            later[:, known[name]] = column * problem.nuisances[known[name]].sigma
        else:
            at = p + new.index(name)
            later[:, at] = column * further.priors[name].sigma
            prior[at] = scale**-2.0 if further.priors[name].scaled else 1.0
    for i, name in enumerate(linear.names):
        if name in further.effect:
            later[:, total - k + i] = further.effect[name]
    white = np.linalg.solve(np.linalg.cholesky(further.covariance), later)
    information = current.T @ current + white.T @ white
    q = total - k
    inner = information[:q, :q] + np.diag(prior[:q])
    gram: Array = information[q:, q:] - information[q:, :q] @ np.linalg.solve(inner, information[:q, q:])
    return gram


def rank(
    problem: Problem,
    linear: Linear,
    scale: float,
    within: Space,
    alive: Sequence[Alive],
    further: Sequence[NextRecording],
) -> tuple[SplitBy, ...]:
    """Further recordings and observables by what they would decide, the best first.

    Parameters
    ----------
    problem : Problem
    linear : Linear
        With the whole catalogue's amplitudes.
    scale : float
        Setting scale.
    within : Space
        Of ``linear``.
    alive : sequence of Alive
        At least two, else nothing is left to tell apart.
    further : sequence of NextRecording

    Returns
    -------
    tuple of SplitBy
        ``separation_sigma``: of the most probable pair, with the recording. What decides nothing is left out.
    """
    pairs = [(a, b) for a in alive for b in alive if a is not b and not set(a.effects) <= set(b.effects)]
    if not pairs:
        return ()
    likeliest = int(np.argmax([a.probability * b.probability for a, b in pairs]))
    now = [separation(within, a.signal, b.effects) for a, b in pairs]
    found = []
    for candidate in further:
        gram = gram_with(problem, linear, scale, candidate)
        then = [separation(within, a.signal, b.effects, gram) for a, b in pairs]
        gain = sum(a.probability * b.probability * (t**2 - n**2) for (a, b), n, t in zip(pairs, now, then, strict=True))
        if gain > DECIDES and then[likeliest] > 1:
            found.append((gain, SplitBy(candidate.kind, candidate.what, float(then[likeliest]))))
    found.sort(key=lambda f: -f[0])
    return tuple(s for _, s in found)
