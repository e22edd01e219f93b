"""Which hypotheses the data cannot tell apart, and what may be claimed of them.

Two hypotheses are as far apart as what is left of the one's signal once the other's amplitudes, within their caps,
and the nuisances are refitted to it, in the noise: a whitened norm in sigma. All of it follows from the Gram matrix
of the whole catalogue in the marginal space of `linear`. No method names right more often than Φ(d/2) at distance d,
so nothing closer than `levels.APART` is told apart, however probable it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from benchsim.diagnosis import settings
from benchsim.diagnosis.discrepancy import amplitudes
from benchsim.diagnosis.hypothesis import Effects, Fit, Naming
from benchsim.diagnosis.levels import APART, COST, LIKELY, MEMBERS, MISSING, SUSPECTED
from benchsim.diagnosis.linear import Linear, marginal
from benchsim.diagnosis.problem import Parameter, Problem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Space:
    """The catalogue's amplitudes as vectors, in units of value**power, with the metric of the data.

    Attributes
    ----------
    gram : (k, k)
        In the marginal space: aᵀ G a is the squared SNR of amplitudes a.
    projection : (k,)
        Of the residual.
    sigma, low, high : (k,)
        Prior sigma and the bounds that cap and sign set.
    index : mapping of str to (m,) int
        Places of every effect's amplitudes.
    """

    gram: Array
    projection: Array
    sigma: Array
    low: Array
    high: Array
    index: Mapping[str, NDArray[np.intp]]

    def places(self, effects: Iterable[str]) -> NDArray[np.intp]:
        """Places of a hypothesis' amplitudes; setting errors have none."""
        parts = [self.index[e] for e in effects if e != settings.NAME]
        return np.concatenate(parts) if parts else np.zeros(0, np.intp)


def bounds(parameter: Parameter) -> tuple[float, float]:
    """Smallest and largest value**power within the cap, which is twice the prior sigma."""
    cap = (2 * parameter.sigma) ** parameter.power
    return (0.0 if parameter.one_sided or parameter.power > 1 else -cap), cap


def space(problem: Problem, linear: Linear, scale: float) -> Space:
    """The space of a linearisation that holds the whole catalogue's amplitudes."""
    m = marginal(linear, linear.effect, scale)
    many = amplitudes(problem, linear.names)
    place = {n: i for i, n in enumerate(linear.names)}
    index = {
        e.name: np.array([place[p.name] for p in e.parameters if p.name in place], np.intp) for e in problem.catalogue
    }
    limits = np.array([bounds(p) for p in many]).reshape(-1, 2)
    sigma = np.array([p.sigma**p.power for p in many])
    return Space(m.gram, m.projection, sigma, limits[:, 0], limits[:, 1], index)


def about(whole: Linear, fit: Fit) -> Linear:
    """The whole catalogue's columns, those of a fit's own effects and of the nuisances taken about the fit.

    The other columns stay where ``whole`` (`Naming.linear`) has them, at the null: they are wanted for rivals, to first
    order.
    """
    columns = whole.effect.copy()
    for k, name in enumerate(fit.linear.names):
        if name in whole.names:
            columns[:, whole.names.index(name)] = fit.linear.effect[:, k]
    return replace(fit.linear, effect=columns, names=whole.names)


def amplitude_vector(problem: Problem, names: Sequence[str], fit: Fit) -> Array:
    """The fit's amplitudes, value**power, at the places of ``names``; 0 elsewhere."""
    own = {p.name: p for e in problem.catalogue if e.name in fit.effects for p in e.parameters}
    return np.array([fit.values.get(n, 0.0) ** own[n].power if n in own else 0.0 for n in names])


def estimate(within: Space, effects: Effects) -> Array:
    """Most probable amplitudes of a hypothesis by linear algebra, within bounds, 0 elsewhere."""
    places = within.places(effects)
    out = np.zeros(len(within.sigma))
    if not len(places):
        return out
    inner = within.gram[np.ix_(places, places)] + np.diag(within.sigma[places] ** -2.0)
    out[places], _ = _bounded(inner, within.projection[places], within.low[places], within.high[places])
    return out


def separation(within: Space, signal: Array, rival: Effects, gram: Array | None = None) -> float:
    """Distance in sigma of a signal from the nearest that a rival can produce.

    Parameters
    ----------
    within : Space
    signal : (k,)
        Amplitudes, value**power.
    rival : Effects
    gram : (k, k), optional
        Another metric, for instance with a further recording; default the data's.
    """
    g = within.gram if gram is None else gram
    places = within.places(rival)
    whole = float(signal @ g @ signal)
    if not len(places):
        return float(np.sqrt(max(0.0, whole)))
    inner, cross = g[places[:, None], places], g[places] @ signal
    _, gain = _bounded(inner, cross, within.low[places], within.high[places])
    return float(np.sqrt(max(0.0, whole - gain)))


def _bounded(inner: Array, cross: Array, low: Array, high: Array) -> tuple[Array, float]:
    """Largest of 2 xᵀc − xᵀ G x within bounds: where, and how much."""
    unit = np.sqrt(np.maximum(inner.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(inner / (unit[:, None] * unit))
    keep = values > 1e-10 * values[-1]
    vectors, size = vectors[:, keep], np.sqrt(values[keep])
    target = (vectors.T @ (cross / unit)) / size
    x = (vectors / size) @ target / unit
    if ((x < low) | (x > high)).any():
        root = (vectors * size).T * unit
        x = lsq_linear(root, target, bounds=(low, high), method="bvls" if len(x) < 20 else "trf").x
    return x, float(2 * x @ cross - x @ inner @ x)


@dataclass(frozen=True)
class Weighed:
    """Every hypothesis of the catalogue with its ln Z: of the refit where there is one, else the linear one.

    ``refitted`` are those of which it is the refit's.
    """

    log_evidence: Mapping[Effects, float]
    refitted: frozenset[Effects] = frozenset()

    def probability(self, sets: Iterable[Effects]) -> float:
        """That at least one of the sets is there, as a whole."""
        wanted = [frozenset(s) for s in sets]
        top = max(self.log_evidence.values())
        z = {h: np.exp(v - top) for h, v in self.log_evidence.items()}
        return float(sum(p for h, p in z.items() if any(w <= set(h) for w in wanted)) / sum(z.values()))

    def present(self, names: Iterable[str]) -> dict[str, float]:
        """Of each effect, that it is there."""
        return {n: self.probability([(n,)]) for n in names}


def weighed(naming: Naming, stated: bool) -> Weighed:
    """Gather the evidence; an unconverged fit is left out together with its linear value: nothing may rest on it.

    Where somebody stated the setting errors, every hypothesis is there twice: as it is, and with `settings.NAME`. What
    was not refitted is divided as the fit about which it was weighed.
    """
    fits = {f.effects: f for f in (naming.null, *naming.fits)}
    listed = [(e, z, fits.get(source, naming.null)) for e, z, source in naming.screened if e not in fits]
    listed += [(e, f.log_evidence, f) for e, f in fits.items() if f.converged or not e]
    found: dict[Effects, float] = {}
    for effects, z, fit in listed:
        if stated:
            near, far = settings.parted(naming.setting_scales, fit.log_scales)
            total = np.logaddexp(near, far)
            found[effects] = float(z + near - total)
            found[(*effects, settings.NAME)] = float(z + far - total)
        else:
            found[effects] = z
    done = [e for e, f in fits.items() if f.converged]
    return Weighed(found, frozenset([*done, *((*e, settings.NAME) for e in done if stated)]))


def _close(hypotheses: Weighed, best: Effects, other: Effects, signal: Array, within: Space) -> bool:
    """Whether the data cannot tell two hypotheses apart.

    Between an effect and setting errors there is no distance that holds at the scale of both: ln Z decides.
    """
    if (settings.NAME in best) != (settings.NAME in other):
        return hypotheses.log_evidence[best] - hypotheses.log_evidence[other] < COST
    return separation(within, signal, other) < APART


@dataclass(frozen=True)
class Claim:
    """What the catalogue claims.

    Attributes
    ----------
    best : Effects
    lone : tuple of str
        Its effects that nothing close can replace.
    classes : tuple of tuple of Effects
        Members of each open alternative, the most probable first.
    """

    best: Effects
    lone: tuple[str, ...]
    classes: tuple[tuple[Effects, ...], ...]


@dataclass(frozen=True)
class Best:
    """The hypothesis that the catalogue stands by: its fit, its claim, and the space about it.

    ``effects`` are the fit's, with `settings.NAME` where its settings are further off than stated.
    """

    fit: Fit
    effects: Effects
    claim: Claim | None
    hypotheses: Weighed
    linear: Linear
    space: Space
    signal: Array


def claim(hypotheses: Weighed, best: Effects, signal: Array, within: Space) -> Claim:
    """Compare the best hypothesis with every other set that was weighed.

    A rival within `APART` counts, however improbable its prior makes it: a rarer explanation that the data cannot
    refute is still open. So does one whose refit comes as near in ln Z, whatever the distance about the best's point
    says: what goes with a square looks farther from there than it is. Where the best is not likely by itself, what
    makes it so counts too.

    Parameters
    ----------
    hypotheses : Weighed
    best : Effects
        Most probable set, not the null; all of its effects likely (`likely`). Or the one that predicts best: where it
        was not weighed, it counts as no less probable than any other.
    signal : (k,)
        Its amplitudes.
    within : Space
        About its fit.
    """
    z = hypotheses.log_evidence
    mine, own = frozenset(best), z.get(best, max(z.values()))
    others = [h for h in z if h and not (mine <= set(h) or set(h) <= mine)]
    apart = {h: separation(within, signal, h) for h in others if (settings.NAME in h) == (settings.NAME in mine)}
    near = {h for h in others if h in apart and apart[h] < APART}
    near |= {h for h in others if h in hypotheses.refitted and own - z[h] < COST}
    if hypotheses.probability([best]) < LIKELY:
        near |= {h for h in others if own - z[h] < MISSING}
    rivals = [h for h in near if not any(set(o) < set(h) and z[o] >= z[h] for o in near)]
    rivals.sort(key=lambda h: -z[h])
    swaps = {e: [_less(r, mine - {e}) for r in rivals if mine - {e} < set(r)] for e in best}
    together = {frozenset(n for part in parts for n in part) for parts in product(*([(e,), *swaps[e]] for e in best))}
    if all(frozenset(r) in together for r in rivals):
        classes = tuple(((e,), *swaps[e])[:MEMBERS] for e in best if swaps[e])
        return Claim(best, tuple(e for e in best if not swaps[e]), classes)
    common = mine.intersection(*rivals)
    members = tuple(_less(h, common) for h in (best, *rivals)[:MEMBERS])
    return Claim(best, tuple(e for e in best if e in common), (members,))


def _less(effects: Effects, dropped: frozenset[str]) -> Effects:
    return tuple(e for e in effects if e not in dropped)


def likely(hypotheses: Weighed, best: Effects, signal: Array, within: Space) -> Effects:
    """The best hypothesis without the effects that are not likely to be there, nor anything close in their place.

    An effect stays where the sets that hold it, or something within `APART` in its place, outweigh the set without it
    by the odds of `LIKELY`. Those that matter least are asked first.
    """
    z = hypotheses.log_evidence
    kept = best
    for e in sorted(best, key=lambda e: -z.get(_less(best, frozenset([e])), -np.inf)):
        rest = _less(kept, frozenset([e]))
        instead = [h for h in z if set(rest) < set(h) and e not in h and len(h) == len(kept)]
        filled = [z[kept], *(z[h] for h in instead if _close(hypotheses, best, h, signal, within))]
        if np.logaddexp.reduce(filled) - z.get(rest, -np.inf) < np.log(LIKELY / (1 - LIKELY)):
            kept = rest
    return kept


def best(problem: Problem, naming: Naming, weighed: Weighed, notes: list[str]) -> Best:
    """The most probable converged hypothesis, without the effects that are not likely."""
    z = weighed.log_evidence
    fits = {f.effects: f for f in naming.fits if f.converged and f.effects} | {(): naming.null}
    within = space(problem, naming.linear, naming.null.setting_scale)
    nothing = np.zeros(len(naming.linear.names))
    null = Best(naming.null, (), None, weighed, naming.linear, within, nothing)
    effects = max((h for h in z if h and fitted(h) in fits), key=lambda h: z[h], default=())
    while effects:
        fit = fits[fitted(effects)]
        at = about(naming.linear, fit)
        within = space(problem, at, fit.setting_scale)
        signal = amplitude_vector(problem, naming.linear.names, fit)
        kept = likely(weighed, effects, signal, within)
        if kept and (kept == effects or fitted(kept) not in fits):
            # What was never refitted supports no claim: the larger set keeps its place.
            stands = claim(weighed, effects, signal, within)
            return Best(fit, effects, stands, weighed, at, within, signal)
        # What is more likely than not is said of what is open (`_besides`).
        dropped = [e for e in effects if e not in kept and weighed.probability([(e,)]) < SUSPECTED]
        if kept and dropped:
            notes.append(f"{' and '.join(dropped)}: hinted at, not likely enough to be said.")
        effects = kept
    return null


def fitted(effects: Effects) -> Effects:
    """The effects of a hypothesis' fit: setting errors have none of their own."""
    return tuple(e for e in effects if e != settings.NAME)
