"""Where: in which element of the path, and along which stretch of which line.

An element is claimed where its best explanation, a free function in the element's own coordinate or names of that
element alone, beats that of every other element by `CLAIM` in ln Z and leaves nothing (`remainder`); or, where it
leaves something of a large misfit, as linear functions of finite resolution must, by all that more. Stretches are
scanned with every window of a line's data as matched filter: z = ⟨w, r⟩ / √⟨w, w⟩ in the space where the nuisances
are integrated, which is N(0, 1) exactly where nothing is missing; the family-wise rate over all windows is held by
Bonferroni's bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.stats import norm

from benchsim.diagnosis import degeneracy, discrepancy, evidence, remainder, settings
from benchsim.diagnosis.degeneracy import Best, Weighed
from benchsim.diagnosis.discrepancy import Attached
from benchsim.diagnosis.hypothesis import Fit, Naming
from benchsim.diagnosis.levels import ALARM, CLAIM, LEFT
from benchsim.diagnosis.linear import Linear, marginal, precision, predict_all, whiten
from benchsim.diagnosis.problem import Attachment, Problem
from benchsim.diagnosis.result import Location, Stretch
from benchsim.diagnosis.verdict import Findings

Array = NDArray[np.float64]

_SHORTEST = 3

_SEEN = 1e-11
"""Part of a filter's square that nuisances have to leave of it, far above rounding: one that they take up altogether
says nothing. An effect of ten thousand sigma of which ten stand out, beside settings, leaves 1e-6."""


@dataclass(frozen=True)
class Explanation:
    """One way to explain the data.

    Attributes
    ----------
    element, coordinate : str
    log_evidence : float
    left : callable
        Largest gain in ln Z that a better function of the same element could still bring: 0 where nothing smooth is
        left, half of the excess χ² otherwise, infinite where it does not explain most of the misfit. Asked of the best
        explanation alone.
    """

    element: str
    coordinate: str
    log_evidence: float
    left: Callable[[], float]


def locate(explanations: Sequence[Explanation]) -> Location | None:
    """The element of the best explanation, claimed or not; None where there is no explanation.

    ``margin`` is ln Z over the best explanation of any other element; infinite where there is no other element, and
    then nothing is claimed: with one candidate nothing was decided.
    """
    if not explanations:
        return None
    best = max(explanations, key=lambda e: e.log_evidence)
    others = [e.log_evidence for e in explanations if e.element != best.element]
    margin = best.log_evidence - max(others) if others else float("inf")
    claimed = bool(others and margin > CLAIM and margin > CLAIM + best.left())
    return Location(best.element, best.coordinate, claimed, float(margin), ())


def scan(
    problem: Problem, linear: Linear, covariance: tuple[Array, ...], scale: float, signal: Array | None = None
) -> tuple[Stretch, ...]:
    """Stretches where the residual of a hypothesis departs from 0.

    Parameters
    ----------
    problem : Problem
    linear : Linear
        Of the hypothesis, usually the null; its amplitudes among the nuisances.
    covariance : tuple of (n_b, n_b)
    scale : float
        Setting scale.
    signal : (n,) array, optional
        What was found, in the data's units: every window is then looked through with its form, too, since a constant
        does not see what bends both ways within a window. Only for what was found beforehand: its form comes from
        these data.

    Returns
    -------
    tuple of Stretch
        The strongest first, disjoint along each line; ``z`` is two-sided and corrected for every window tried.
    """
    windows = [(b, members, np.ones(len(members))) for b, members in _windows(problem)]
    if signal is not None:
        windows += [(b, members, signal[members]) for b, members, _ in windows]
    if not windows:
        return ()
    z = _matched(problem, linear, covariance, scale, windows)
    chance = np.minimum(1.0, len(windows) * 2 * norm.sf(np.abs(z)))
    found: list[Stretch] = []
    taken = np.zeros(len(problem.data), bool)
    for k in np.argsort(-np.abs(z)):
        b, members, _ = windows[k]
        if chance[k] > ALARM:
            break
        if taken[members].any():
            continue
        taken[members] = True
        where = problem.position[members]
        corrected = float(norm.isf(chance[k] / 2)) if chance[k] > 0 else _large(float(abs(z[k])), len(windows))
        kind = str(problem.kind[members[0]])
        found.append(Stretch(problem.names[b], float(where.min()), float(where.max()), corrected, kind))
    return tuple(found)


def by_kind(
    problem: Problem, linear: Linear, covariance: tuple[Array, ...], scale: float, signal: Array
) -> dict[str, float]:
    """By how many sigma each kind of datum, taken alone, follows what was found; arguments as in `scan`."""
    kinds = np.unique(problem.kind)
    columns = whiten(problem, covariance, np.where(problem.kind[:, None] == kinds, signal[:, None], 0.0))[0]
    m = marginal(linear, columns, scale)
    power = np.diag(m.gram)
    good = power > _SEEN * (columns**2).sum(axis=0)
    z = np.where(good, m.projection / np.sqrt(np.where(good, power, 1)), 0.0)
    return {str(k): float(v) for k, v in zip(kinds, z, strict=True)}


def _matched(
    problem: Problem,
    linear: Linear,
    covariance: tuple[Array, ...],
    scale: float,
    windows: Sequence[tuple[int, NDArray[np.intp], Array]],
) -> Array:
    """z of every window (block, data, filter over them), in their order."""
    s = np.where(linear.scaled, scale, 1.0)
    factor = precision(linear.nuisance, s)
    pull = cho_solve(factor, linear.nuisance.T @ linear.residual)
    cleaned = linear.residual - linear.nuisance @ pull
    z = np.zeros(len(windows))
    for b in range(len(problem.names)):
        rows = problem.rows(b)
        mine = [k for k, w in enumerate(windows) if w[0] == b]
        if not mine:
            continue
        filters = np.zeros((rows.stop - rows.start, len(mine)))
        for column, k in enumerate(mine):
            filters[windows[k][1] - rows.start, column] = windows[k][2]
        white = solve_triangular(np.linalg.cholesky(covariance[b]), filters, lower=True)
        cross = linear.nuisance[rows].T @ white
        variance = (white**2).sum(axis=0) - np.einsum("ij,ij->j", cross, cho_solve(factor, cross))
        good = variance > _SEEN * (white**2).sum(axis=0)
        z[mine] = np.where(good, (white.T @ cleaned[rows]) / np.sqrt(np.where(good, variance, 1)), 0)
    return z


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


def place(
    problem: Problem, naming: Naming, alone: Weighed, best: Best, findings: Findings, modes: remainder.Modes
) -> Location | None:
    """The element: of what is left if names stand and something is left, else of the whole misfit, which a set of names
    of one element explains ``alone`` or not; and where along the lines."""
    covariance, on = naming.noise.covariance, best.fit if findings.stands else naming.null
    rest = findings.stands and findings.something_left
    base = on if rest else naming.null
    ground = discrepancy.absorb(problem, base.linear)
    explanations = []
    coordinate: dict[str, str] = {}
    for laid in findings.more if rest else findings.free:
        a = laid.attachment
        coordinate.setdefault(a.element, a.coordinate)

        def of_function(laid: Attached = laid) -> float:
            if anew(problem, laid.attachment):
                return np.inf
            with_it, rest_of_it = remainder.beside(problem, naming, laid, modes)
            return 0.0 if rest_of_it.acceptable else _unexplained(with_it, laid.scale, ground, base.setting_scale)

        explanations.append(Explanation(a.element, a.coordinate, laid.log_evidence, of_function))
    if not rest:
        element = {e.name: e.element for e in problem.catalogue}
        fits = {f.effects: f for f in naming.fits if f.converged}
        for effects, value in alone.log_evidence.items():
            of = {element.get(e, settings.EFFECT.element) for e in effects}
            if len(of) != 1:
                continue
            only = of.pop()

            def of_names(effects: tuple[str, ...] = effects) -> float:
                fit = fits.get(degeneracy.fitted(effects))
                nothing = fit is not None and remainder.left(problem, naming, fit, modes).acceptable
                return 0.0 if nothing else np.inf

            explanations.append(Explanation(only, coordinate.get(only, ""), value, of_names))
    elements = {e.element: None for e in problem.catalogue if e.name in on.effects}
    if findings.stands and not rest and len(elements) > 1:
        there: Location | None = Location(" + ".join(elements), "", False, 0.0, ())
    else:
        there = locate(explanations)
    if there is None:
        return None
    signal = _signal(problem, findings, rest, on)
    # Beside names that stand, settings are as far off as with them: alone they took up what they could.
    seen = (problem, ground, covariance, on.setting_scale)
    shown = {} if signal is None else by_kind(*seen, signal)
    return replace(there, along_trace=scan(*seen, signal), by_kind=shown)


def anew(problem: Problem, a: Attachment) -> bool:
    """Whether every independent part of a function acts on one block alone.

    Nothing else that was recorded could contradict it, so that it imitates whatever moves: it may be what is there, but
    no place is claimed for it.
    """
    acts = np.array([(a.basis[problem.rows(b)] != 0).any(axis=0) for b in range(len(problem.names))])
    parts = np.array([acts[:, a.component == c].any(axis=1) for c in np.unique(a.component)])
    return len(problem.names) > 1 and bool((parts.sum(axis=1) <= 1).all())


def _signal(problem: Problem, findings: Findings, rest: bool, on: Fit) -> Array | None:
    """What was found, in the data's units: the names' part of the prediction, or the best function's."""
    if findings.stands and not rest:
        own = {p.name: 0.0 for e in problem.catalogue if e.name in on.effects for p in evidence.amplitudes(e)}
        return predict_all(problem, on.values) - predict_all(problem, {**on.values, **own})
    laid = findings.more if rest else findings.free
    return laid[0].attachment.basis @ laid[0].coefficients if laid else None


def _unexplained(with_it: Linear, scale: float, base: Linear, base_scale: float) -> float:
    """Half of the excess χ² that a function leaves, if that is little of what there was; else infinity."""

    def excess(lin: Linear, s: float) -> float:
        m = marginal(lin, np.zeros((len(lin.residual), 0)), s)
        return m.chi2 - m.n

    before, after = excess(base, base_scale), max(excess(with_it, scale), 0.0)
    return 0.5 * after if after < LEFT * before else np.inf


def winner(findings: Findings, place: Location | None) -> Attached | None:
    """The best attachment of the element that was claimed."""
    laid = findings.more if findings.stands else findings.free
    return next((a for a in laid if place is not None and a.attachment.element == place.element), None)
