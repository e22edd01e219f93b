"""A mount with what was found in it: what ``diagnose`` writes of it for predictions, and how these read it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.diagnosis import linear
from benchsim.diagnosis.result import Diagnosis
from benchsim.instruments.mount import misses, paint, stated
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.problem import Built
from benchsim.instruments.mount.records import UNITS, Function, Learnt, Mount, Session
from benchsim.instruments.mount.small_terms import SmallTerms

CHANGE = 0.6
"""By which a heliostat's mount changes from one part of its records to the next, rms in each component [mrad of the
normal]. Of sixteen heliostats learnt from the first half of their first 70 % of records 68 % of the other half are then
within the predicted sigma, each heliostat counted alike (without it 34 % of all records); of the last 30 %, which had
no part in that, 70 % of 254 (30 %). What it trades: misses of a mount that stays as it is are stated too large."""

DRIFT = "drift."
"""Begins the names of what every telescope does beside its terms (`prediction`)."""


def read(path: Path, tower: Path | None = None) -> Session:
    """Read a mount and the records that it was learnt from; a heliostat's bare properties have none.

    Parameters
    ----------
    path : Path
        An ``amended.toml``, a pointing file, a PAINT folder, or the file of a heliostat's properties.
    tower : Path, optional
        Tower file; default that which the file names, or the one beside or above it.

    Returns
    -------
    Session
        A heliostat's file and its tower are the last of its files.

    Raises
    ------
    BenchsimError
        If it is nothing of the kind, or cannot be used.
    """
    if path.suffix == ".json" and path.is_file() and not any(path.match(c) for c in paint.CALIBRATION):
        return paint.bare(path, tower)
    if not stated.recognises(path) or path.suffix == ".json":
        raise BenchsimError(
            f"{path}: is neither an amended.toml of a mount nor a heliostat's properties in the PAINT format; name "
            "what benchsim diagnose wrote"
        )
    if path.is_dir() and not paint.holds_recordings(path):
        return paint.bare(path, tower)
    session = stated.read(path, tower)
    return session if session.learnt is not None else replace(session, mount=as_stated(session))


def as_stated(session: Session) -> Mount:
    """The mount without what was found; a telescope's with the encoder zeros that its records show, which nobody
    states."""
    if session.mount.observes != "sky":
        return session.mount
    bare = replace(session.mount, zero=np.zeros(2))
    return replace(bare, zero=mount_problem.zeros(bare, session.records))


def learnt(
    built: Built,
    d: Diagnosis,
    put: Mapping[str, Mapping[str, float]],
    fields: Mapping[str, Function],
    small: SmallTerms,
) -> Learnt:
    """What predictions rest on: errors of a record on a day that was not learnt, and the covariance of what was fitted.

    Measured are the residuals of the records that were used, about the mount as it is put in: by effects, functions and
    a telescope's zeros alone, what their days (a telescope: its drift) have in common not taken off. A later record has
    another day's error beside its own, so that these are √(record² + day²). Of each component 68.27 % of them are
    within, whereby wrong days do not widen it; that is divided by the part of such errors that the fit leaves,
    tr((I − H) R (I − H)ᵀ) / n, R being how records of a day, or of a drift, correlate (`problem.shared`), H the fit:
    n − k of n were they independent. A fit to k parameters takes up more of what few days share than of n errors.

    Hypotheses are weighed with an estimate of their own, which is of single records beside what their days share. The
    uncertainty of functions without a name is not in the covariance.

    Parameters
    ----------
    built : Built
    d : Diagnosis
    put, fields
        All effects and functions that the amended mount states.
    small : SmallTerms
        What it states besides.
    """
    problem, session = built.problem, built.session
    mount, sky = session.mount, session.mount.observes == "sky"
    own = tuple(p for e in problem.catalogue if e.name in put for p in e.parameters if not p.grid)
    known = (*(p for p in problem.nuisances if not p.name.startswith(DRIFT)), *own)
    narrow = {p.name: p.sigma for p in small.parameters}
    size = np.array([narrow.get(p.name, p.sigma) for p in known])
    more = {k: v for terms in small.values.values() for k, v in terms.items()}
    at = {**d.values, **{k: d.values.get(k, 0.0) + v for k, v in more.items()}}
    slopes = linear.columns(problem, at, known) * size
    zeros = None
    if sky:
        zeros = mount.zero + np.array([d.values.get(k, 0.0) for k in ("IA", "IE")]) * UNITS["arcsec"]
        mount = replace(mount, zero=zeros)
    n = len(session.records.names)
    stated = mount_problem.predicted(
        replace(session, mount=mount, effects={n: dict(terms) for n, terms in put.items()}, fields=fields), ()
    )
    rest = np.abs(stated.at([{}] * n, np.arange(n)))
    bulk = np.maximum(np.quantile(rest, misses.SIGMA, axis=0), mount_problem.faintest(session))
    common = mount_problem.shared(mount, session.records) * (d.setting_scale if sky else 1.0)
    alike = np.eye(n) + common @ common.T
    alike = np.kron(alike / np.diag(alike).mean(), np.eye(2))
    # A heliostat's position is fitted within its survey, and stays in the file as surveyed.
    stays = np.array([p in problem.nuisances and not sky for p in known])
    sigma = bulk
    for _ in range(2):
        each = np.tile(sigma, n)
        errors = alike * np.outer(each, each)
        spread = linear.posterior(np.linalg.solve(np.linalg.cholesky(errors), slopes), np.ones(len(known)))
        fit = np.linalg.solve(errors, slopes @ spread).T
        left = np.eye(2 * n) - slopes[:, ~stays] @ fit[~stays]
        part = np.diag(left @ errors @ left.T).reshape(-1, 2).mean(axis=0) / sigma**2
        sigma = bulk / np.sqrt(np.maximum(part, 1 / n))
    covariance = spread * size[:, None] * size
    return Learnt(sigma * mount.of_normal, tuple(p.name for p in known), covariance, zeros, 0.0 if sky else CHANGE)
