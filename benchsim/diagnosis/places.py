"""Where an effect might begin beside a fit, and whether it is seen where it has a place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from benchsim.diagnosis import evidence, linear
from benchsim.diagnosis.discrepancy import absorb
from benchsim.diagnosis.hypothesis import Hypothesis, Solved
from benchsim.diagnosis.linear import Linear
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.screen import Catalogue

Array = NDArray[np.float64]

AMPLITUDES = np.concatenate([-np.geomspace(2.5, 0.02, 12), [0.0], np.geomspace(0.02, 2.5, 12)])
"""Prior sigmas at which that curve is looked at, before `POLISHED` steps to each of its minima."""

POLISHED = 6

SEEN = 6.0
"""Sigma from 0, at its place, from which on Laplace's method holds for an effect with a place. Of the best of many
places chance makes four."""


@dataclass(frozen=True)
class Place:
    """Where an effect might begin beside a fit: its amplitudes and shapes, and the gain in ln Z foretold."""

    gain: float
    amplitude: Array
    shape: Array


def valleys(effect: Effect, gram: Array, projection: Array) -> list[tuple[float, Array]]:
    """Gain and amplitudes (fit space) of an effect's minima beside a fit."""
    own = evidence.amplitudes(effect)
    k = len(own)
    if effect.whole:
        return [(0.0, np.asarray(np.ones(k)))]
    sigma, power = np.array([a.sigma for a in own]), np.array([a.power for a in own])
    unit = sigma**power
    if k > 2:
        q = np.linalg.solve(gram[:k, :k] + np.diag(unit**-2.0), projection[:k])
        q = np.array([max(x, 0.1 * u) if evidence.kind(a) else x for x, a, u in zip(q, own, unit, strict=True)])
        return [(float(0.5 * projection[:k] @ q), np.asarray(q, float))]
    axes = [AMPLITUDES[AMPLITUDES >= 0] if evidence.kind(a) else AMPLITUDES for a in own]
    low = np.array([0.0 if evidence.kind(a) else -np.inf for a in own])

    def answer(value: Array) -> Array:
        q = (value * sigma) ** power
        return np.concatenate([q, 0.5 * q**2], axis=-1)

    def cost(value: Array) -> Array:
        w = answer(value)
        return np.asarray(0.5 * np.einsum("...i,ij,...j", w, gram, w) - w @ projection + 0.5 * (value**2).sum(axis=-1))

    def slopes(value: Array) -> Array:
        rise: Array = np.vstack([np.eye(k), np.diag((value * sigma) ** power)])
        return np.asarray(rise * (unit * np.where(power == 2, 2 * value, 1.0)))

    mesh = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    height = cost(mesh)
    out: list[tuple[float, Array]] = []
    for i in np.argwhere(height == minimum_filter(height, 3, mode="nearest")):
        value = mesh[tuple(i)]
        for _ in range(POLISHED):
            slope = slopes(value)
            force = slope.T @ (projection - gram @ answer(value)) - value
            step = np.linalg.solve(slope.T @ gram @ slope + np.eye(k), force)
            tried = [np.maximum(value + part * step, low) for part in (1.0, 0.3, 0.1)]
            best = min(tried, key=lambda v: float(cost(v)))
            if not cost(best) < cost(value):
                break
            value = best
        slope = slopes(value)
        gain = -float(cost(value)) - 0.5 * float(np.linalg.slogdet(slope.T @ gram @ slope + np.eye(k))[1])
        # One-sided effects begin off their boundary, where a derivative may be of the other side.
        start = np.where(low == 0, np.maximum(value, 0.1), value) * sigma
        out.append((gain, start**power))
    return sorted(out, key=lambda x: -x[0])


def unseen(h: Hypothesis, solved: Solved) -> set[str]:
    """Effects with shapes whose amplitudes, at the place that was found, are not `SEEN` away from 0.

    The sigma of an amplitude over all places says nothing of that: a plume of 13 sigma that may be wide and weak or
    narrow and strong has one of a quarter of its size.
    """
    lin = solved.fit.linear
    gram = linear.marginal(lin, lin.effect, solved.fit.setting_scale).gram
    place = {a.name: i for i, a in enumerate(h.amplitudes)}
    sigma = np.array([a.sigma**a.power for a in h.amplitudes])
    found = set()
    for e in h.effects:
        if not evidence.shapes(e):
            continue
        own = np.array([place[a.name] for a in evidence.amplitudes(e)])
        rest = np.array([i for i in range(len(sigma)) if i not in own], int)
        inner = gram[np.ix_(rest, rest)] + np.diag(sigma[rest] ** -2.0)
        left = gram[np.ix_(own, own)] - gram[np.ix_(own, rest)] @ np.linalg.solve(inner, gram[np.ix_(rest, own)])
        if float(solved.point.amplitude[own] @ left @ solved.point.amplitude[own]) < SEEN**2:
            found.add(e.name)
    return found


def whole(problem: Problem, catalogue: Catalogue, white: Array, solved: Solved) -> Linear:
    """About a fit: the amplitudes of the whole catalogue (its columns whitened), shapes at their most probable node."""
    names: list[str] = []
    columns: list[int] = []
    m = linear.marginal(absorb(problem, solved.fit.linear), white, solved.fit.setting_scale)
    for effect in problem.catalogue:
        prior = np.diag([p.sigma ** (-2.0 * p.power) for p in evidence.amplitudes(effect)])
        gains = []
        for at in (list(n.columns) for n in catalogue.nodes[effect.name]):
            inner = m.gram[np.ix_(at, at)] + prior
            gains.append(float(m.projection[at] @ np.linalg.solve(inner, m.projection[at])))
        node = catalogue.nodes[effect.name][int(np.argmax(gains))]
        names += [p.name for p in evidence.amplitudes(effect)]
        columns += node.columns
    return replace(solved.fit.linear, effect=white[:, columns], names=tuple(names))
