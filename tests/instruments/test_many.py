"""Predictions of the bench in lists: the same numbers, for every parameter and of mixed blocks, in workers too."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.files import read
from benchsim.diagnosis import linear
from benchsim.instruments.bench import observables
from benchsim.instruments.bench.prediction import FAR
from benchsim.instruments.bench.problem import build

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def problem():
    recording = read(ROOT / "scenes/campaign12.toml")
    recording = replace(recording, exposures=recording.exposures[:2])
    return build(recording, observables.simulate(recording, seed=3), attached=False)


def many_values(problem):
    """Every nuisance and every effect's amplitude, on top of random settings."""
    rng = np.random.default_rng(4)
    at = {n.name: float(0.3 * n.sigma * rng.normal()) for n in problem.nuisances}
    shapes = {p.name: p.grid[0] for e in problem.catalogue for p in e.parameters if p.grid}
    amplitudes = [p for e in problem.catalogue for p in e.parameters if not p.grid]
    steps = {p.name: abs(0.2 * p.sigma) for p in (*problem.nuisances, *amplitudes)}
    return [{**at, **shapes, name: at.get(name, 0.0) + step} for name, step in steps.items()]


def test_lists_give_what_single_values_give(problem):
    values = many_values(problem)
    for b in range(len(problem.names)):
        found = problem.predict.many(values, b)
        for v, many in zip(values, found, strict=True):
            np.testing.assert_allclose(many, problem.predict(v, b), atol=1e-9)


def test_a_list_may_hold_values_without_light_and_values_that_no_element_takes(problem):
    values = [{}, {f"{problem.groups[0]}.laser_elevation": 9e2}, {"glass": -1.0}, {"p1": 0.5, "p2": 0.5}, {"pyr": 1.0}]
    plain, beside, impossible, lens, canted = problem.predict(values, 0)
    # With such a lens lines of sight turn away from the board.
    assert (beside == FAR).all() and (impossible == FAR).all() and (lens == FAR).all()
    np.testing.assert_allclose(plain, problem.predict({}, 0), atol=1e-9)
    np.testing.assert_allclose(canted, problem.predict({"pyr": 1.0}, 0), atol=1e-9)


def test_lists_of_mixed_blocks_give_what_single_values_give(problem):
    values = [v for v in many_values(problem)[::4] for _ in problem.names]
    blocks = list(range(len(problem.names))) * (len(values) // len(problem.names))
    for v, b, many in zip(values, blocks, problem.predict(values, blocks), strict=True):
        np.testing.assert_allclose(many, problem.predict(v, b), atol=1e-9)


def test_what_a_short_list_has_found_is_kept_for_what_does_not_bear_on_the_light(problem):
    problem.predict.cache.clear()
    blocks = range(len(problem.names))
    linear.predict_all(problem, {"pyr": 1.0})
    found = [problem.predict.light({"pyr": 1.0, "k1": 0.1}, b, problem.predict.truth({"pyr": 1.0})) for b in blocks]
    assert all(curve is kept for curve, kept in zip(found, problem.predict.cache.values(), strict=True))


def test_columns_are_shared_out_evenly_and_can_be_sent_to_workers(problem, monkeypatch):
    """`linear.columns` hands lists of mixed blocks to `spread`, whose function and arguments travel as pickles."""
    asked = []

    def spread(function, *arguments):
        sent = pickle.loads(pickle.dumps(function))
        tasks = list(zip(*arguments, strict=True))
        asked.extend(len(values) for values, _ in tasks)
        return [sent(*pickle.loads(pickle.dumps(task))) for task in tasks]

    monkeypatch.setattr(linear, "TOGETHER", 5)
    parameters = problem.nuisances[:9]
    want = linear.columns(replace(problem, predict=lambda v, b: problem.predict(v, b)), {}, parameters)
    got = linear.columns(replace(problem, spread=spread), {}, parameters)
    size = np.abs(want).max(axis=0)
    assert (size > 0).all()
    # Predictions agree to 1e-9 mm, and are divided by the steps.
    steps = np.array([0.1 * p.sigma for p in parameters])
    assert (np.abs(got - want) < 3e-9 / steps).all()
    blocks = sum(2 * (2 if p.blocks is None else len(p.blocks)) for p in parameters)
    assert sum(asked) == blocks > 5
    assert max(asked) <= 5 and max(asked) - min(asked) <= 1
