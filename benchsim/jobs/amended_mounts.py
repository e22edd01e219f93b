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
from benchsim.instruments.mount.prediction import Predict
from benchsim.instruments.mount.problem import Built
from benchsim.instruments.mount.records import UNITS, Learnt, Mount, Session

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


def learnt(built: Built, d: Diagnosis, found: Mapping[str, object]) -> Learnt:
    """What predictions rest on: errors of a record, and the covariance of everything that is fitted beside ``found``.

    The errors are those about what was put in, by which later records are predicted: 68.27 % of the residuals lie
    within, so that wrong days do not widen them, and what the fit has used up is given back. (Hypotheses are weighed
    with an estimate of their own.) A telescope's drift through a night is another one's on the next: to a later record
    it is scatter. The uncertainty of functions without a name is not in it.
    """
    problem, mount = built.problem, built.session.mount
    own = tuple(p for e in problem.catalogue if e.name in found for p in e.parameters if not p.grid)
    known = (*problem.nuisances, *own)
    size = np.array([p.sigma for p in known])
    prior = np.where([p.scaled for p in known], d.setting_scale, 1.0)
    slopes = linear.columns(problem, d.values, known) * size
    rest = np.abs(d.residuals.after.reshape(-1, 2))
    bulk = np.maximum(np.quantile(rest, misses.SIGMA, axis=0), mount_problem.FAINTEST[mount.unit])
    sigma = bulk
    for _ in range(2):
        spread = linear.posterior(slopes / np.tile(sigma, len(rest))[:, None], prior)
        used = len(known) - float((np.diag(spread) / prior**2).sum())
        sigma = bulk * np.sqrt(rest.size / max(rest.size - used, 1.0))
    predict = problem.predict
    assert isinstance(predict, Predict)
    drift = d.setting_scale**2 * float((predict.drift**2).sum(axis=1).mean())
    zeros = None
    if mount.observes == "sky":
        zeros = mount.zero + np.array([d.values.get(k, 0.0) for k in ("IA", "IE")]) * UNITS["arcsec"]
    keep = [k for k, p in enumerate(known) if not p.name.startswith(DRIFT)]
    return Learnt(
        np.sqrt(sigma**2 + drift) * mount.of_normal,
        tuple(known[k].name for k in keep),
        (spread * size[:, None] * size)[np.ix_(keep, keep)],
        zeros,
    )
