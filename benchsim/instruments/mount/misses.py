"""By how much beams miss, and by how much they are expected to.

The miss is half the angle between the predicted beam and the direction of the recorded spot: by that much the mirror's
normal is off. Of a telescope it is the angle itself. Where errors across and up are normal with covariance C, a miss is
below r with probability ::

    P(r) = 1 − (1/π) ∫₀^π exp(−r² / 2 s²(φ)) dφ,    s²(φ) = a² cos² φ + b² sin² φ

with a², b² the eigenvalues of C: divided each by its sigma, the two errors have a uniform direction φ and a Rayleigh
length (the distribution of Hoyt 1947, Bell System Technical Journal 26, 318). The predicted sigma of a miss is the r of
P = 68.27 %: 1.515 sigma of one component where both are alike, 1 sigma where there is only one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.optimize import brentq

from benchsim.diagnosis import linear
from benchsim.instruments.mount import effects
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.posing import problem_of
from benchsim.instruments.mount.records import UNITS, Array, Learnt, Session

SIGMA = 0.6827
"""Probability of a miss below its predicted sigma."""

_PHI = (np.arange(180) + 0.5) * np.pi / 180


def misses(session: Session, planes: Mapping[str, Array]) -> tuple[Array, Array]:
    """Misses of a session's records by its mount as it stands, effects and functions included.

    Parameters
    ----------
    session : Session
    planes : mapping of str to (3,) array
        Normals of the targets, by their names.

    Returns
    -------
    angle : (n,) array
        [mrad of the normal]; nan where the mount cannot reach the readings.
    distance : (n,) array
        From the recorded spot to where the beam meets the target's plane [mm]; nan where it does not, or no plane is
        known.
    """
    predicted, seen = directions(session)
    length = np.linalg.norm(seen, axis=1, keepdims=True)
    angle = 2 * np.arcsin(np.clip(np.linalg.norm(predicted - seen / length, axis=1) / 2, 0, 1))
    none = np.full(3, np.nan)
    plane = np.array([planes.get(t, none) for t in session.records.target]).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (seen * plane).sum(axis=1) / (predicted * plane).sum(axis=1)
    distance = np.linalg.norm(along[:, None] * predicted - seen, axis=1)
    unit = session.mount.of_normal / UNITS[session.mount.unit]
    return angle * unit, np.where(along > 0, distance, np.nan)


def directions(session: Session) -> tuple[Array, Array]:
    """`Predict.directions` of all records, with what the session states."""
    predict = mount_problem.predicted(session, ())
    stated = {name: np.full(1, value) for name, value in predict.stated.items()}
    return predict.directions(stated, np.arange(len(session.records.names)))


def covariances(session: Session, learnt: Learnt, *, single: bool = True) -> Array:
    """How uncertain the predicted direction of each record is, across and up, (n, 2, 2) [mrad² of the normal].

    Parameters
    ----------
    session : Session
    learnt : Learnt
    single : bool
        Whether the errors of a record count, its day's among them, and the mount's change until then, beside those of
        what was fitted.
    """
    known = {p.name: p for p in mount_problem.fitted(session)}
    own = tuple(known[name] for name in learnt.parameters)
    every = effects.candidates(session.mount, session.records, every=True)
    problem = problem_of(mount_problem.predicted(session, every), (), 1.0)
    slopes = linear.columns(problem, {}, own).reshape(-1, 2, len(own)) * session.mount.of_normal
    fitted = slopes @ learnt.covariance @ slopes.transpose(0, 2, 1)
    return np.asarray(fitted + np.diag(learnt.sigma**2 + learnt.change**2) if single else fitted)


def radius(covariance: Array, probability: float = SIGMA) -> float:
    """The miss below which lies this part of the distribution of a covariance (2, 2); see the module."""
    low, high = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    if high == 0:
        return 0.0
    square = (low * np.sin(_PHI) ** 2 + high * np.cos(_PHI) ** 2) / high
    # In units of the longer axis; a fine grid of angles is exact to 1e-6 for axes that differ by less than fifty times.
    found = brentq(lambda r: np.exp(-(r**2) / (2 * square)).mean() - (1 - probability), 0.0, 10.0)
    return float(found * np.sqrt(high))
