"""Where: in which element of the path, and along which stretch of which line.

An element is claimed where its best explanation, a free function in the element's own coordinate or names of that
element alone, beats that of every other element by `CLAIM` in ln Z and leaves nothing (`remainder`); or, where it
leaves something of a large misfit, as linear functions of finite resolution must, by all that more. Stretches are
scanned with every window of a line's data as matched filter: z = ⟨w, r⟩ / √⟨w, w⟩ in the space where the nuisances
are integrated, which is N(0, 1) exactly where nothing is missing; the family-wise rate over all windows is held by
Bonferroni's bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.stats import norm

from benchsim.diagnosis.linear import Linear, precision
from benchsim.diagnosis.problem import Problem
from benchsim.diagnosis.result import Location, Stretch

Array = NDArray[np.float64]

CLAIM = 8.0
"""Δ ln Z over every other element at which one is claimed: how long and how rough functions are is only guessed, which
makes some of it."""

FAMILY_WISE = 0.01
"""Rate at which a recording without anything missing shows a stretch at all."""

_SHORTEST = 3


@dataclass(frozen=True)
class Explanation:
    """One way to explain the data.

    Attributes
    ----------
    element, coordinate : str
    log_evidence : float
    left : float
        Largest gain in ln Z that a better function of the same element could still bring: 0 where nothing smooth is
        left, half of the excess χ² otherwise, infinite where it does not explain most of the misfit.
    """

    element: str
    coordinate: str
    log_evidence: float
    left: float


def locate(explanations: Sequence[Explanation], stretches: tuple[Stretch, ...] = ()) -> Location | None:
    """The element of the best explanation, claimed or not; None where there is no explanation.

    ``margin`` is ln Z over the best explanation of any other element; infinite where there is no other element, and
    then nothing is claimed: with one candidate nothing was decided.
    """
    if not explanations:
        return None
    best = max(explanations, key=lambda e: e.log_evidence)
    others = [e.log_evidence for e in explanations if e.element != best.element]
    margin = best.log_evidence - max(others) if others else float("inf")
    claimed = bool(others) and margin > CLAIM + best.left
    return Location(best.element, best.coordinate, claimed, float(margin), stretches)


def scan(problem: Problem, linear: Linear, covariance: tuple[Array, ...], scale: float) -> tuple[Stretch, ...]:
    """Stretches where the residual of a hypothesis departs from 0.

    Parameters
    ----------
    problem : Problem
    linear : Linear
        Of the hypothesis, usually the null; its amplitudes among the nuisances.
    covariance : tuple of (n_b, n_b)
    scale : float
        Setting scale.

    Returns
    -------
    tuple of Stretch
        The strongest first, disjoint along each line; ``z`` is two-sided and corrected for every window tried.
    """
    windows = list(_windows(problem))
    if not windows:
        return ()
    s = np.where(linear.scaled, scale, 1.0)
    factor = precision(linear.nuisance, s)
    pull = cho_solve(factor, linear.nuisance.T @ linear.residual)
    cleaned = linear.residual - linear.nuisance @ pull
    z = np.empty(len(windows))
    first = 0
    for b in range(len(problem.names)):
        rows = problem.rows(b)
        mine = [w for w in windows if w[0] == b]
        if not mine:
            continue
        filters = np.zeros((rows.stop - rows.start, len(mine)))
        for k, (_, members) in enumerate(mine):
            filters[members - rows.start, k] = 1.0
        white = solve_triangular(np.linalg.cholesky(covariance[b]), filters, lower=True)
        cross = linear.nuisance[rows].T @ white
        variance = (white**2).sum(axis=0) - np.einsum("ij,ij->j", cross, cho_solve(factor, cross))
        # A window that the nuisances take up altogether says nothing.
        good = variance > 1e-6 * (white**2).sum(axis=0)
        z[first : first + len(mine)] = np.where(
            good, (white.T @ cleaned[rows]) / np.sqrt(np.where(good, variance, 1)), 0
        )
        first += len(mine)
    chance = np.minimum(1.0, len(windows) * 2 * norm.sf(np.abs(z)))
    found: list[Stretch] = []
    taken = np.zeros(len(problem.data), bool)
    for k in np.argsort(-np.abs(z)):
        b, members = windows[k]
        if chance[k] > FAMILY_WISE:
            break
        if taken[members].any():
            continue
        taken[members] = True
        where = problem.position[members]
        corrected = float(norm.isf(chance[k] / 2)) if chance[k] > 0 else _large(float(abs(z[k])), len(windows))
        found.append(Stretch(problem.names[b], float(where.min()), float(where.max()), corrected))
    return tuple(found)


def _large(z: float, windows: int) -> float:
    """Corrected z where the tail underflows: ln P ≈ −z²/2 − ln z, to which ln of the number of windows is added."""
    return float(np.sqrt(max(0.0, z**2 - 2 * np.log(windows))))


def _windows(problem: Problem) -> list[tuple[int, NDArray[np.intp]]]:
    """Windows of each line of neighbours: lengths double from 3 data on, each moved by half its length."""
    out: list[tuple[int, NDArray[np.intp]]] = []
    for b in range(len(problem.names)):
        rows = problem.rows(b)
        index = np.arange(rows.start, rows.stop)
        for kind in np.unique(problem.kind[rows]):
            for line in np.unique(problem.stretch[rows]):
                members = index[(problem.kind[rows] == kind) & (problem.stretch[rows] == line)]
                if line < 0 or len(members) < _SHORTEST:
                    continue
                members = members[np.argsort(problem.position[members], kind="stable")]
                length = _SHORTEST
                while length <= len(members):
                    for start in range(0, len(members) - length + 1, max(1, length // 2)):
                        out.append((b, members[start : start + length]))
                    length *= 2
    return out
