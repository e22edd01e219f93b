"""A session as the problem that the diagnosis is handed.

Every record is a block of two data, across and up, and a setting of its own. A telescope's encoder zeros are nuisances,
always fitted and never ranked; a heliostat's position is known to what a survey gives. How large the errors of a record
are nobody states: `outlying` estimates them, and the diagnosis estimates them again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.diagnosis import linear
from benchsim.diagnosis.evidence import amplitudes
from benchsim.diagnosis.problem import Effect, Parameter, Problem, Values
from benchsim.instruments.mount import effects, functions, sky
from benchsim.instruments.mount.attachments import Form, attachments, forms
from benchsim.instruments.mount.next_recordings import Next
from benchsim.instruments.mount.outlying import MOST, Outlying, outlying
from benchsim.instruments.mount.posing import nuisances, problem_of
from benchsim.instruments.mount.prediction import LOST, Predict
from benchsim.instruments.mount.records import UNITS, Array, Mount, Records, Session, angles, numbers

FEWEST = 3
"""Records below which nothing is fitted."""

DRIFT = 0.3
"""Drift of a telescope's pointing through a night, rms, in errors of a single record. A prior: its scale is fitted in
every hypothesis (`diagnosis.settings`), so that some four times as much is taken for it too. Without it neighbours that
err together pass for many witnesses, and terms that differ by less than the drift would be told apart."""

OF_A_DAY = 0.75
"""What the records of a heliostat's day share, in errors of a single record: beside six terms of the mount they
correlate by 0.36 in the median of sixteen heliostats (-0.1 to 0.9), those of neighbouring days by 0."""

FEWEST_DAYS = 3
"""Days below which what a day's records share is not told from the mount's own errors."""

DRIFT_LENGTH = 5.0
"""Records over which neighbours err alike."""

DRIFT_MODES = 12

SLOWEST = 6
"""Modes of a drift that are fitted where outlying records are looked for: with all of them forty records would have so
few numbers left that chance alone sets one aside in every fifth night."""

WIDE = 100.0
"""Drift that is fitted where outlying records are looked for, in the mount's unit: as much as there is."""

FEWEST_TO_DRIFT = 32
"""Records below which a drift is not told from the errors of single records."""

FAINTEST = {"arcsec": 0.05, "mrad": 0.02}
"""Errors of a record are not believed to be below this: what is seen through air, or centred on a sunlit target."""


@dataclass(frozen=True)
class Built:
    """A problem with what was decided on the way.

    Attributes
    ----------
    problem : Problem
    session : Session
        With the encoder zeros put in, and the records that are used.
    aside : tuple of str
        Names of the records that were set aside, in their order.
    sigma : float
        Errors of a record, per component, in the mount's unit.
    remarks : tuple of str
    """

    problem: Problem
    session: Session
    aside: tuple[str, ...]
    sigma: float
    remarks: tuple[str, ...]


def build(session: Session, *, attached: bool = True, catalogue: Sequence[Effect] | None = None) -> Built:
    """The problem of a session.

    Parameters
    ----------
    session : Session
    attached : bool
        Whether to compute the attachments.
    catalogue : sequence of Effect, optional
        Default `effects.candidates`.

    Raises
    ------
    BenchsimError
        If there are fewer than three records, or the simulation cannot be evaluated as stated.
    """
    mount, records = session.mount, session.records
    if len(records.names) < FEWEST:
        count = len(records.names)
        raise BenchsimError(
            f"{session.path}: {count} record{'s' if count != 1 else ''}; a mount is judged from {FEWEST} or more at "
            "different positions of the sky, so add recordings"
        )
    if mount.observes == "sky":
        mount = replace(mount, zero=mount.zero + zeros(mount, records))
    known = list(effects.candidates(mount, records)) if catalogue is None else list(catalogue)
    predict = predicted(replace(session, mount=mount), known)
    whole = problem_of(predict, known, 1.0)
    stated = linear.predict_all(whole, {})
    lost = np.abs(stated).reshape(-1, 2).max(axis=1) >= LOST
    if lost.any():
        names = ", ".join(n for n, bad in zip(records.names, lost, strict=True) if bad)
        raise BenchsimError(
            f"{session.path}: the stated mount cannot reach the readings of {names} (no triangle of an actuator closes "
            "there); check the actuators' constants and their units"
        )
    judged = look(whole)
    return _finish(replace(session, mount=mount), known, judged, attached)


def again(built: Built, values: dict[str, float]) -> Built | None:
    """Judge the records anew about a fit that was found; None where the same ones are set aside."""
    session, catalogue = built.session, list(built.problem.catalogue)
    judged = look(built.problem, values, everything=built.sigma)
    whole = len(session.records.names) + len(built.aside)
    if not judged.aside or len(judged.aside) + len(built.aside) > MOST * whole:
        return None
    more = _finish(session, catalogue, judged, True)
    return replace(more, aside=(*built.aside, *more.aside), remarks=(*built.remarks, *more.remarks))


def look(problem: Problem, at: dict[str, float] | None = None, *, everything: float | None = None) -> Outlying:
    """Which records lie apart, about a point of the parameters; errors are at least ``everything``."""
    # What acts on some records alone, the error of their day, is eliminated before all else.
    nuisances = tuple(p for p in problem.nuisances if p.blocks is None)
    days = tuple(p for p in problem.nuisances if p.blocks is not None)
    values = at or {}
    residual = problem.data - linear.predict_all(problem, values)
    own = {e.name: amplitudes(e) for e in problem.catalogue}
    many = [p for e in problem.catalogue if e.name != "change-point" for p in own[e.name]]
    columns = linear.columns(problem, values, (*nuisances, *many))
    p = len(nuisances)
    size = np.array([q.sigma for q in (*nuisances, *many)])
    columns = columns * size
    predict = problem.predict
    assert isinstance(predict, Predict)
    modes = drift(predict.mount, len(problem.names))[:, :SLOWEST]
    # Of any size: what neighbours share is no error of a single record.
    slow = WIDE * np.kron(modes, np.eye(2))
    last = columns.shape[1]
    columns = np.column_stack([columns, slow])
    place = {q.name: p + k for k, q in enumerate(many)}
    sets = [[place[q.name] for q in own[e.name]] for e in problem.catalogue if e.name != "change-point"]
    always = [*range(p), *range(last, last + slow.shape[1])]
    stepped, steps = _steps(problem, values, columns.shape[1])
    local = linear.columns(problem, values, days) * np.array([q.sigma for q in days])
    columns = np.column_stack([columns, stepped])
    return outlying(residual.reshape(-1, 2), columns, always, sets, everything, steps, local)


def _steps(problem: Problem, values: dict[str, float], first: int) -> tuple[Array, list[list[int]]]:
    """Columns of a change of the mount at every place of its grid, and their numbers, which begin at ``first``."""
    change = next((e for e in problem.catalogue if e.name == "change-point"), None)
    n = len(problem.names)
    if change is None:
        return np.zeros((2 * n, 0)), []
    own = amplitudes(change)
    # As if it had been before all records; the records before each place do not have it.
    whole = linear.columns(problem, {**values, "change": -5.0}, own) * np.array([q.sigma for q in own])
    number = np.repeat(np.arange(n), 2)[:, None]
    grid = next(p.grid for p in change.parameters if p.grid)
    parts = [whole * (number > place) for place in grid]
    numbers = [[first + k * len(own) + j for j in range(len(own))] for k in range(len(grid))]
    return np.column_stack(parts) if parts else np.zeros((2 * n, 0)), numbers


def _finish(session: Session, catalogue: list[Effect], judged: Outlying, attached: bool) -> Built:
    names = session.records.names
    keep = [k for k in range(len(names)) if k not in judged.aside]
    kept = replace(session, records=session.records.chosen(keep))
    if judged.aside and any(e.name == "change-point" for e in catalogue):
        catalogue = [e if e.name != "change-point" else _fewer(e, len(keep)) for e in catalogue]
    sigma = max(judged.sigma, faintest(session))
    predict = predicted(kept, catalogue)
    predict = replace(predict, drift=sigma * shared(session.mount, kept.records))
    problem = problem_of(predict, catalogue, sigma)
    problem = replace(problem, groups=tuple(f"day {d + 1}" for d in days(session.mount, kept.records)))
    if attached:
        problem = replace(problem, attachments=attachments(problem, predict))
    problem = replace(problem, next_recordings=Next(problem, predict, sigma))
    return Built(problem, kept, tuple(names[k] for k in judged.aside), sigma, ())


def faintest(session: Session) -> float:
    """Errors of a record, per component, that are not believed to be smaller, in the mount's unit: `FAINTEST`, or what
    two ways of finding a spot show."""
    mount, records = session.mount, session.records
    if mount.observes == "sky":
        return FAINTEST[mount.unit]
    distance = float(np.median(np.linalg.norm(records.spot - mount.position, axis=1)))
    return max(FAINTEST[mount.unit], records.spot_sigma / distance / UNITS[mount.unit])


def _fewer(effect: Effect, count: int) -> Effect:
    grid = effects.changes(count)
    return replace(effect, parameters=tuple(replace(p, grid=grid) if p.grid else p for p in effect.parameters))


def predicted(session: Session, catalogue: Sequence[Effect]) -> Predict:
    """The prediction of a session's records."""
    mount, records = session.mount, session.records
    units = {p.name: UNITS[p.unit] for e in catalogue for p in e.parameters}
    units |= {p.name: UNITS[p.unit] for p in nuisances(mount)}
    angle = UNITS[mount.unit]
    units |= {"IA": angle, "IE": angle, "sun_across": angle, "sun_up": angle, "spot_across": 1.0, "spot_up": 1.0}
    stated: dict[str, float] = {}
    for name, terms in session.effects.items():
        for term, value in terms.items():
            stated[term] = value * UNITS[_unit_of(mount, records, name, term)]
    if "change" in stated:
        stated["change"] = place_of(records, stated["change"])
    order = {t: k for k, t in enumerate(effects.targets(mount, records))}
    out = Predict(mount, records, units, stated, np.array([order[t] for t in records.target], np.intp))
    return replace(out, moved=functions.inputs(session.fields, forms(out), records)) if session.fields else out


def functions_of(session: Session) -> list[Form]:
    """The functions that a mount's file may state, with its records' places in their coordinates."""
    plain = replace(session, fields={})
    return forms(predicted(plain, effects.candidates(plain.mount, plain.records)))


def fitted(session: Session) -> tuple[Parameter, ...]:
    """All that a diagnosis may fit to a mount, whatever its records: nuisances, and the amplitudes of effects."""
    known = effects.candidates(session.mount, session.records, every=True)
    return (*nuisances(session.mount), *(p for e in known for p in e.parameters if not p.grid))


def _unit_of(mount: Mount, records: Records, effect: str, term: str) -> str:
    return next(
        p.unit
        for e in (*effects.candidates(mount, records, every=True), *_never(mount))
        for p in e.parameters
        if e.name == effect and p.name == term
    )


def place_of(records: Records, change: float) -> float:
    """Place among the records of a change that a file states."""
    counted = numbers(records)
    if counted is None:
        return change
    after = int(np.searchsorted(counted, change))
    # Far enough from the first and from the last record that nothing of the change's own width is left there.
    return {0: -5.0, len(counted): len(counted) + 5.0}.get(after, after - 0.5)


def change_of(records: Records, place: float) -> float:
    """How a file states a change at a place among these records."""
    counted = numbers(records)
    if counted is None:
        return place
    after = int(np.clip(np.ceil(place), 1, len(counted) - 1))
    return float(counted[after - 1] + counted[after]) / 2


def _never(mount: Mount) -> tuple[Effect, ...]:
    """Effects that a file may state though they are no candidates: a telescope's encoder zeros."""
    return (Effect("encoder-offset", "mount", nuisances(mount)),)


def shared(mount: Mount, records: Records) -> Array:
    """What records share beside their mount's terms, in errors of a single record: columns (n, m) of unit prior
    variance, the modes of a telescope's drift, or the days on which several of a heliostat's lie."""
    if mount.observes == "sky":
        return DRIFT * drift(mount, len(records.names))
    day = days(mount, records)
    several = [day == d for d in np.unique(day) if (day == d).sum() > 1]
    return OF_A_DAY * np.array(several, float).reshape(-1, len(day)).T


def in_common(built: Built, values: Values) -> float:
    """What records share (`shared`) as a diagnosis' values have it: rms of either coordinate, in the mount's unit."""
    modes = built.sigma * shared(built.session.mount, built.session.records)
    mode = range(1, modes.shape[1] + 1)
    both = [modes @ np.array([values.get(f"drift.{w}_{k}", 0.0) for k in mode]) for w in ("across", "up")]
    return float(np.sqrt(np.mean(np.square(both))))


def days(mount: Mount, records: Records) -> NDArray[np.intp]:
    """The day of every record of a heliostat (`sky.days`), (n,); each has its own where there are too few."""
    day = sky.days(mount, records.source, records.when) if mount.observes == "spot" else np.arange(len(records.names))
    return day if day.max(initial=0) + 1 >= FEWEST_DAYS else np.arange(len(day))


def drift(mount: Mount, count: int) -> Array:
    """The leading modes of a Gaussian process of unit rms over the number of the record, (n, m)."""
    if mount.observes != "sky" or count < FEWEST_TO_DRIFT:
        return np.zeros((count, 0))
    k = np.arange(count, dtype=float)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * ((k[:, None] - k) / DRIFT_LENGTH) ** 2))
    lead = slice(None, -1 - DRIFT_MODES, -1)
    return np.asarray(vectors[:, lead] * np.sqrt(np.maximum(values[lead], 0.0)))


def zeros(mount: Mount, records: Records) -> Array:
    """Robust estimate of a telescope's encoder zeros [rad]: medians of true less read, azimuths around the circle."""
    azimuth, elevation = angles(records.source)
    apart = azimuth - records.reading[:, 0] - mount.zero[0]
    # Near the zenith azimuths say little.
    weight = np.cos(elevation) > 0.3
    use = weight if weight.sum() >= FEWEST else np.ones(len(weight), bool)
    middle = np.angle(np.exp(1j * apart[use]).sum())
    return np.array(
        [
            middle + np.median(np.angle(np.exp(1j * (apart[use] - middle)))),
            np.median(elevation - records.reading[:, 1] - mount.zero[1]),
        ]
    )
