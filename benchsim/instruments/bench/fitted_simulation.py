"""The simulation as it is most probable: nuisances for given effects, those of settings left out, and what they mean.

What `diagnosis` fits with all care (evidence, boundaries, hyper-parameters) is taken here as found: this is plain
Gauss-Newton, to lay two states of the simulation over the photographs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from benchsim.bench.model import Camera, Recording
from benchsim.bench.place import SettingErrors
from benchsim.diagnosis.linear import columns
from benchsim.diagnosis.problem import Parameter, Problem
from benchsim.instruments.bench import board_coordinates
from benchsim.instruments.bench.effects import PHYSICS_OF
from benchsim.instruments.bench.prediction import Predict, beam_shape, errors

Array = NDArray[np.float64]
Values = Mapping[str, float]

STEPS = 8
STILL = 1e-3
"""Fall of the objective below which the fit is at rest."""


@dataclass(frozen=True)
class State:
    """The simulation of one exposure, with the nuisances that are most probable in it.

    Attributes
    ----------
    recording : Recording
        With the effects and fields of this state, and the beam diameter and divergence that were fitted.
    errors : SettingErrors
    camera : Camera
        With its intrinsics as found.
    rotation, translation : (3, 3), (3,) mm
        Of the board as its marks define it, solved with this state's board, print and lens.
    shape : (c4, e_plus, e_cross)
        Of the beam's profile.
    """

    recording: Recording
    errors: SettingErrors
    camera: Camera
    rotation: Array
    translation: Array
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0)


def state(predict: Predict, block: int, values: Values) -> State:
    """State of a block of the bench's problem, from values of its nuisances and effects.

    A switch of the physics is held between off and on: a fit may leave 1.01 of diffraction, a bench cannot.
    """
    b = predict.blocks[block]
    switches = {p for p, owner in predict.owners.items() if owner in PHYSICS_OF}
    truth = predict.truth({k: min(max(v, 0.0), 1.0) if k in switches else v for k, v in values.items()})
    seen, camera = b.observed.view, predict.intrinsics(values, b)
    rotation, translation = seen.rotation, seen.translation
    if board_coordinates.active(truth) or camera is not None:
        rotation, translation, _ = board_coordinates.true_pose(truth, seen, camera)
    return State(truth, errors(values, b.setting), camera or seen.camera, rotation, translation, beam_shape(values))


def probable(
    problem: Problem,
    parameters: Sequence[Parameter],
    at: Values,
    blocks: Sequence[int] | None = None,
    setting_scale: float = 1.0,
) -> dict[str, float]:
    """Most probable values of some parameters, all others held.

    Parameters
    ----------
    problem : Problem
    parameters : sequence of Parameter
        Free: nuisances, amplitudes of effects; each about 0 with its prior. Not for amplitudes of power 2 near 0.
    at : mapping
        Where to begin, and what is held.
    blocks : sequence of int, optional
        Whose data count; default all.
    setting_scale : float
        Of the prior sigma of setting errors, as the diagnosis found it.

    Returns
    -------
    dict
        ``at`` with the free values put in.
    """
    used = range(len(problem.names)) if blocks is None else sorted(blocks)
    free = [p for p in parameters if p.blocks is None or any(b in p.blocks for b in used)]
    lower = {b: np.linalg.cholesky(problem.covariance[b]) for b in used}
    rows = np.concatenate([np.arange(len(problem.data))[problem.rows(b)] for b in used])
    sigma = np.array([p.sigma * (setting_scale if p.scaled else 1.0) for p in free])

    def whitened(x: Array) -> Array:
        return np.concatenate(
            [
                solve_triangular(lower[b], part, lower=True)
                for b, part in zip(
                    used, np.split(x, np.cumsum([len(problem.covariance[b]) for b in used])[:-1]), strict=True
                )
            ]
        )

    def misfit(values: Values) -> tuple[Array, float]:
        r = whitened(np.concatenate([problem.data[problem.rows(b)] - problem.predict(values, b) for b in used]))
        x = np.array([values.get(p.name, 0.0) for p in free]) / sigma
        return r, float(r @ r + x @ x)

    values = dict(at)
    residual, objective = misfit(values)
    for _ in range(STEPS):
        j = whitened(columns(problem, values, tuple(free))[rows]) * sigma
        x = np.array([values.get(p.name, 0.0) for p in free]) / sigma
        step = np.linalg.solve(j.T @ j + np.eye(len(free)), j.T @ residual - x)
        for shorter in (1.0, 0.5, 0.25, 0.1):
            trial = values | {p.name: float(v) for p, v in zip(free, (x + shorter * step) * sigma, strict=True)}
            new, value = misfit(trial)
            if value < objective:
                break
        else:
            return values
        gained, values, residual, objective = objective - value, trial, new, value
        if gained < STILL:
            break
    return values


def left_out(problem: Problem, effects: Sequence[str], at: Values) -> list[dict[str, float]]:
    """Values for every block, the amplitudes of given effects fitted to the other settings alone.

    Beam and blur, which settings share, come from the other settings too; what belongs to the block's own setting is
    then fitted to it, as nobody can know it beforehand.

    Parameters
    ----------
    problem : Problem
    effects : sequence of str
        Names; () gives the simulation in doubt.
    at : mapping
        Where to begin; values of other effects are kept.

    Returns
    -------
    list of dict
        One per block.
    """
    own = [p for e in problem.catalogue if e.name in effects for p in e.parameters if not p.grid]
    out: list[dict[str, float]] = [{} for _ in problem.names]
    for group in dict.fromkeys(problem.groups):
        test = [b for b, g in enumerate(problem.groups) if g == group]
        train = [b for b, g in enumerate(problem.groups) if g != group]
        values = probable(problem, [*problem.nuisances, *own], at, train) if train else dict(at)
        rest = [p for p in problem.nuisances if p.blocks is not None and set(p.blocks) <= set(test)]
        values = probable(problem, rest, values, test)
        for b in test:
            out[b] = values
    return out
