"""What the heliostats of a field have in common: causes of one target, of the tower, the clock, the sun's model.

One heliostat cannot tell whether its mirror or the target stands elsewhere; many can. About a robust fit of all that a
heliostat's own catalogue and the shared causes s could do together (`diagnosis.forward`), its records are linear in
both. With the nuisances, and the amplitudes of a set i of its own effects, integrated (`diagnosis.linear`), they say

    ln Z_i(s) = z_i + b_iᵀ s − ½ sᵀ G_i s ,

for every set of up to three effects, their prior of presence included. A heliostat whose days went wrong is a witness
of nothing: with the prior probability `OWN` (`field_likelihood`) what it shows is its own, explained as well as the
best cause would explain it if it were this heliostat's alone, O. The field's likelihood is the product over heliostats

    L(s) = Π [ (1 − OWN) Σ_i Z_i(s) + OWN · O ] ,

so that no heliostat moves ln L by more than ln 1/`OWN`, and what is said to be shared is borne out by most. Each set of
causes has its evidence, sizes and sigmas by importance sampling from about the largest L(s) p(s); causes are added,
dropped and exchanged until nothing gains. What is then found is found once more, every heliostat's records linear from
its likeliest set beside it.

Not for causes that act on a heliostat by its square: all is to first order about the fit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, pairwise, zip_longest

import numpy as np
from scipy.special import logsumexp

from benchsim.diagnosis import forward, linear
from benchsim.diagnosis.evidence import amplitudes, log_prior, shapes
from benchsim.diagnosis.levels import LIKELY, MISSING
from benchsim.diagnosis.problem import Parameter, Problem
from benchsim.instruments.mount import effects
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.field_likelihood import Likelihood, Witness
from benchsim.instruments.mount.records import Array, Mount, Records, Session, added

TOGETHER, NEAR, MOST = 3, 20.0, 32
"""Own effects in a heliostat's set; ln Z behind its best, with whatever causes, up to which sets are kept; how many."""

FEWEST = 3
"""Heliostats below which a field says nothing of what they share."""

OF_THE_FIELD = ("target-position", "refraction", "clock")
"""Effects of the catalogue that are no single heliostat's."""

ACTUATORS = ("actuator-length", "actuator-offset", "actuator-radius")
"""Effects that a batch of actuators brings to all heliostats alike."""

MOST_OF_THEM = 2 / 3
"""Part of the heliostats expected to bear a cause out, did it exist, that have to: by chance some agree on anything. Of
sixteen real heliostats eight agreed on a tower 1.3 m beside its place, where their targets agree to 0.1 m."""

FELT, SEES = 1.0, 1e-9
"""Sigma of its own records by which every other heliostat that sees a cause at all has to feel it. A thousand agree on
less, too, but also on what the first order leaves of their own errors: on a clock of 4 s that was right."""


@dataclass(frozen=True)
class Cause:
    """What heliostats may share: its parameters' names, and how a heliostat's file states it.

    Attributes
    ----------
    name, says : str
    terms : tuple of (str, str, str, float)
        Of each parameter its own name, and effect, term and factor by which it is stated.
    """

    name: str
    says: str
    terms: tuple[tuple[str, str, str, float], ...]


@dataclass(frozen=True)
class Shared:
    """A cause that the field shows.

    Attributes
    ----------
    cause : Cause
    probability : float
        That it is there, of all sets of causes that were weighed.
    values, sigma, units : mapping
        By parameter.
    witnesses : int
        Heliostats whose records are more probable with it than without.
    """

    cause: Cause
    probability: float
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    units: Mapping[str, str]
    witnesses: int


def causes(mount: Mount, records: Records) -> tuple[Cause, ...]:
    """What the heliostats of a plant may share; mount and records are any one's of them."""
    targets = effects.targets(mount, records)
    hang = tuple(
        Cause(
            f"target {t}",
            f"The target {t} hangs elsewhere than stated, for every heliostat.",
            tuple((f"target_{a}_{k}", "target-position", f"target_{a}_{k}", 1.0) for a in "eu"),
        )
        for k, t in enumerate(targets, 1)
    )
    # Targets that all move by d are heliostats that all move by −d.
    tower = tuple((f"tower_{a}", "mirror-position", f"mirror_{a}", -1.0) for a in "enu")
    batch = tuple(
        Cause(
            f"batch {e.name}",
            f"All heliostats have this alike: {e.says[0].lower()}{e.says[1:]}",
            tuple((p.name, e.name, p.name, 1.0) for p in amplitudes(e)),
        )
        for e in effects.candidates(mount, records, every=True)
        if e.name in ACTUATORS
    )
    return (
        *hang,
        Cause("tower", "The tower with all its targets stands elsewhere than stated, for every heliostat.", tower),
        Cause("clock", "One clock is wrong for every heliostat.", (("dt", "clock", "dt", 1.0),)),
        Cause(
            "camera",
            "The camera that measures the spots has another scale, for every heliostat.",
            (("spot_scale", "spot-scale", "spot_scale", 1.0),),
        ),
        Cause("refraction", "The sun's model is wrong for every heliostat.", (("refr", "refraction", "refr", 1.0),)),
        *batch,
    )


def parameters(session: Session, many: Sequence[Cause]) -> tuple[Parameter, ...]:
    """The causes' parameters with prior sigma and unit, in their order."""
    known = {
        (e.name, p.name): p
        for e in effects.candidates(session.mount, session.records, every=True)
        for p in e.parameters
    }
    return tuple(replace(known[effect, term], name=name) for c in many for name, effect, term, _ in c.terms)


@dataclass(frozen=True)
class About:
    """Where a heliostat's records are linear from.

    Attributes
    ----------
    shared : mapping
        What its field shares, by the parameters that state it [mm, s, parts].
    own : tuple of str
        Its own likeliest set beside that.
    """

    shared: Mapping[str, float]
    own: tuple[str, ...]


def linear_from(heard: Witness, found: Joint, many: Sequence[Cause], own: Sequence[Parameter]) -> About:
    """Where to hear a heliostat again, once its field has spoken."""
    sizes = {name: v for s in found.shared for name, v in s.values.items()}
    shared: dict[str, float] = {}
    for name, _, term, factor in chain.from_iterable(c.terms for c in many):
        shared[term] = shared.get(term, 0.0) + factor * sizes.get(name, 0.0)
    at = np.array([sizes.get(p.name, 0.0) / p.sigma for p in own])
    return About(shared, heard.sets[int(np.argmax(Likelihood.of([heard]).sets(at)[0]))])


def witness(name: str, session: Session, many: Sequence[Cause], about: About | None = None) -> Witness:
    """What a heliostat's records say of causes.

    Parameters
    ----------
    name : str
    session : Session
    many : sequence of Cause
    about : About, optional
        Once the field has spoken. Before, records are taken as linear from a robust fit of all that the heliostat's
        own catalogue and the causes could do together. It lies as far off as priors reach where records do not tell,
        and sizes come out wrong by some sigma of a large field: a target's place by 3 %.

    Raises
    ------
    BenchsimError
        As `problem.build`.
    """
    known = {e.name: e for e in effects.candidates(session.mount, session.records, every=True)}
    terms = [(next(p for p in known[e].parameters if p.name == t), f) for c in many for _, e, t, f in c.terms]
    catalogue = [e for e in effects.candidates(session.mount, session.records) if not shapes(e)]
    wanted = dict.fromkeys(e for c in many for _, e, _, _ in c.terms)
    every = [*(e for e in catalogue if e.name not in wanted), *(known[n] for n in wanted)]
    problem = mount_problem.build(session, attached=False, catalogue=every).problem
    own = [e for e in catalogue if e.name not in OF_THE_FIELD]
    parts = [problem.nuisances, *(amplitudes(e) for e in own), [p for p, _ in terms]]
    first = np.cumsum([0, *(len(part) for part in parts)])
    common = np.arange(first[-2], first[-1]) - first[1]
    numbers = list(chain.from_iterable(combinations(range(len(own)), n) for n in range(TOGETHER + 1)))
    sets = [tuple(own[i].name for i in chosen) for chosen in numbers]
    whole, factors = list(chain.from_iterable(parts)), np.array([f for _, f in terms])
    if about is None:
        m = _marginal(problem, whole, factors, whole, {})
    else:
        likely = chain.from_iterable(amplitudes(e) for e in own if e.name in about.own)
        m = _marginal(problem, whole, factors, [*problem.nuisances, *likely], about.shared)
    # All sets at once, small ones filled up with an amplitude of nothing.
    gram, projection = np.pad(m.gram, (0, 1)), np.pad(m.projection, (0, 1))
    places = [[k - first[1] for i in chosen for k in range(first[i + 1], first[i + 2])] for chosen in numbers]
    at = np.array(list(zip_longest(*places, fillvalue=len(m.gram))), int).reshape(-1, len(sets)).T
    inner = gram[at[:, :, None], at[:, None, :]] + np.eye(at.shape[1])
    sides = np.concatenate([projection[at][:, :, None], gram[at[:, :, None], common]], axis=2)
    taken = np.swapaxes(sides, 1, 2) @ np.linalg.solve(inner, sides)
    prior = [log_prior(names, [e.name for e in own]) for names in sets]
    z = 0.5 * taken[:, 0, 0] - 0.5 * np.linalg.slogdet(inner)[1] + prior
    b, g = projection[common] - taken[:, 0, 1:], gram[common[:, None], common] - taken[:, 1:, 1:]
    alone = max(float((z + _integrated(b, g, at)).max()) for at in ([], *_places(many)))
    reach = z + _integrated(b, g, range(len(terms)))
    keep = np.argsort(-reach)[:MOST]
    keep = np.union1d(keep[reach[keep] > reach.max() - NEAR], np.argmax(z))
    return Witness(name, tuple(sets[i] for i in keep), z[keep], b[keep], g[keep], alone)


def _marginal(
    problem: Problem,
    many: Sequence[Parameter],
    factors: Array,
    some: Sequence[Parameter],
    shared: Mapping[str, float],
) -> linear.Marginal:
    """Products of amplitudes' columns, the last of them times ``factors``, about a robust fit of some beside what is
    ``shared``; the problem's nuisances, which come first in ``many``, integrated, and data weighted as that fit weighs
    them."""
    distinct = list({p.name: p for p in many}.values())
    lower, place = linear.factors(problem.covariance), {p.name: i for i, p in enumerate(distinct)}
    at = forward.fitted(problem, list({p.name: p for p in some}.values()), lower, shared)
    columns = linear.columns(problem, at, tuple(distinct))
    white = linear.lowered(lower, problem.data - linear.predict_all(problem, at))
    root = (1 + white**2) ** -0.25
    target = root * (white + linear.lowered(lower, columns @ [at.get(p.name, 0.0) for p in distinct]))
    own = columns[:, [place[p.name] for p in many]] * [p.sigma for p in many]
    own = root[:, None] * linear.lowered(lower, own)
    own[:, len(many) - len(factors) :] *= factors
    p = len(problem.nuisances)
    ground = linear.Linear(target, own[:, :p], np.zeros(p, bool), own[:, :0], (), problem.block, 0.0)
    return linear.marginal(ground, own[:, p:])


def _integrated(projection: Array, gram: Array, places: Sequence[int]) -> Array:
    """ln of what some causes add to the evidence of every set, integrated over their unit priors, (m,)."""
    b, inner = projection[:, places], gram[:, places][:, :, places] + np.eye(len(places))
    solved = np.linalg.solve(inner, b[:, :, None])[:, :, 0]
    return np.asarray(0.5 * (b * solved).sum(axis=1) - 0.5 * np.linalg.slogdet(inner)[1])


def _places(many: Sequence[Cause]) -> list[list[int]]:
    """Numbers of every cause's parameters."""
    first = np.cumsum([0, *(len(c.terms) for c in many)])
    return [list(range(a, b)) for a, b in pairwise(first.tolist())]


@dataclass(frozen=True)
class Joint:
    """What a field shows.

    Attributes
    ----------
    shared : tuple of Shared
        Of the best set of causes, those at `LIKELY` or above.
    rivals : tuple of (tuple of str, float)
        Sets of causes within `MISSING` in ln Z of the best, and how far behind each is.
    """

    shared: tuple[Shared, ...]
    rivals: tuple[tuple[tuple[str, ...], float], ...]


def joint(witnesses: Sequence[Witness], many: Sequence[Cause], own: Sequence[Parameter]) -> Joint:
    """The causes that heliostats share.

    Parameters
    ----------
    witnesses : sequence of Witness
    many : sequence of Cause
    own : sequence of Parameter
        Of the causes, in their order (`parameters`).
    """
    if len(witnesses) < FEWEST:
        return Joint((), ())
    field, places, names = Likelihood.of(witnesses), _places(many), [c.name for c in many]
    known: dict[tuple[int, ...], tuple[float, Array, Array]] = {}

    def weigh(chosen: tuple[int, ...]) -> float:
        if chosen not in known:
            known[chosen] = field.peak([i for c in chosen for i in places[c]])
        return known[chosen][0] + log_prior([names[c] for c in chosen], names)

    best: tuple[int, ...] = ()
    while True:
        added = [tuple(sorted({*best, c})) for c in range(len(many)) if c not in best]
        dropped = [tuple(x for x in best if x != c) for c in best]
        swapped = [tuple(sorted({*d, c})) for d in dropped for c in range(len(many)) if c not in best]
        top = max([best, *added, *dropped, *swapped], key=weigh)
        if top == best:
            break
        best = top
    z = {chosen: weigh(chosen) for chosen in known}
    total = float(logsumexp(list(z.values())))
    chance = {c: float(np.exp(logsumexp([v for s, v in z.items() if c in s]) - total)) for c in best}
    # What is not said is not left in the sizes of what is: those are of the causes that are stated, by themselves.
    said = best
    while True:
        weigh(said)
        at, sigma = np.zeros(field.projection.shape[2]), np.zeros(field.projection.shape[2])
        where = [i for c in said for i in places[c]]
        at[where], sigma[where] = known[said][1:]
        bears = {c: field.bears(at, places[c]) for c in said}
        signals = {c: field.signal(at, places[c]) for c in said}
        felt = {c: float(np.sqrt(np.median(q[q > SEES]))) for c, q in signals.items()}
        holds = tuple(
            c
            for c in said
            if chance[c] >= LIKELY and felt[c] >= FELT and bears[c] >= MOST_OF_THEM * field.expected(at, places[c])
        )
        if holds == said:
            break
        said = holds
    shared = []
    for c in said:
        values, sizes = ({own[i].name: float(x[i] * own[i].sigma) for i in places[c]} for x in (at, sigma))
        units = {own[i].name: own[i].unit for i in places[c]}
        shared.append(Shared(many[c], chance[c], values, sizes, units, bears[c]))
    rivals = sorted(((tuple(names[c] for c in s), z[best] - v) for s, v in z.items()), key=lambda x: x[1])
    return Joint(tuple(shared), tuple(r for r in rivals[1:] if r[1] < MISSING))


def applied(session: Session, shared: Sequence[Shared]) -> Session:
    """A session whose file states what its field shares."""
    out = session.effects
    for cause in shared:
        for name, effect, term, factor in cause.cause.terms:
            out = added(out, {effect: {term: factor * cause.values[name]}})
    return replace(session, effects=out)
