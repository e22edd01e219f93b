"""Noise estimated from residuals that hold signals: what it finds, and what it leaves alone.

Thresholds are three standard errors of the statistic over the stated number of data sets, unless they say otherwise.
"""

from dataclasses import replace

import lines
import numpy as np
import pytest

from benchsim.diagnosis import linear, noise
from benchsim.diagnosis.problem import Problem

AMPLITUDES = tuple(p for e in lines.CATALOGUE for p in e.parameters if not p.grid)
SETS = 12


def estimated(seed, truth=None, **how):
    """The noise from the residual at the stated settings, all of a catalogue's columns taken out."""
    problem, _ = lines.problem(truth, seed=seed, **how)
    parameters = (*problem.nuisances, *AMPLITUDES)
    columns = linear.columns(problem, {"period": 0.7}, parameters) * [4.5 * p.sigma**p.power for p in parameters]
    return problem, noise.estimate(problem, problem.data - linear.predict_all(problem, {}), columns)


def test_clean_data_are_left_alone():
    found = [estimated(seed)[1] for seed in range(SETS)]
    scales = np.array([[n.scale["c"], n.scale["w"]] for n in found])
    # 6 × 43 contrasts per kind: each scale is known to 4.4 %; shrinking leaves less.
    assert abs(scales.mean() - 1) < 3 * 0.044 / np.sqrt(2 * SETS)
    assert np.abs(scales - 1).max() < 4 * 0.044
    assert sum(n.correlation[k] > 0 for n in found for k in "cw") <= 1
    # Even the offset of a whole line, which nothing can judge, is widened by less than a tenth on average.
    offset = [np.mean(n.covariance[0][:48, :48]) / (lines.SIGMA**2 / 48) for n in found]
    assert np.mean(offset) < 1.2


@pytest.mark.parametrize("truth", [None, {"turn": 0.5, "blur": 0.1}], ids=["nothing else", "effects"])
def test_an_understated_sigma_is_found(truth):
    scales = [estimated(seed, truth, sigma=1.3)[1].scale[k] for seed in range(SETS) for k in "cw"]
    assert np.mean(scales) == pytest.approx(1.3, abs=0.04)
    assert min(scales) > 1.3 * (1 - 4 * 0.044)


def test_correlated_errors_are_found_and_widen_smooth_modes():
    wide, seen = [], 0
    for seed in range(SETS):
        _, found = estimated(seed, correlated=1.0)
        seen += found.correlation["c"] > 0
        wide.append(np.mean(found.covariance[0][:48, :48]))
    truth = lines.SIGMA**2 * (1 / 48 + np.mean(np.exp(-np.abs(lines.Y[:, None] - lines.Y) / 0.2)))
    assert seen >= 9
    # What is smooth along a line was not judged but extrapolated, and erring upward is the safe side.
    assert 0.7 * truth < np.median(wide) < 2.5 * truth


def test_a_strong_effect_is_not_taken_for_noise():
    _, found = estimated(3, {"turn": 0.3, "bow_1": 0.3, "tilt_0": 0.3})
    assert found.scale["c"] < 1.1 and found.correlation["c"] == 0


def test_only_the_white_part_is_scaled():
    """A shared part of the stated covariance (here a slope) stays what it was."""
    problem, _ = lines.problem(seed=1, sigma=1.4)
    slope = np.concatenate([lines.Y, 0 * lines.Y])
    stated = problem.covariance[0] + 0.05**2 * np.outer(slope, slope)
    made = replace(problem, covariance=(stated,) * 6)
    residual = made.data - linear.predict_all(made, {})
    remove = linear.columns(made, {}, made.nuisances) * [4.5 * p.sigma for p in made.nuisances]
    found = noise.estimate(made, residual, remove)
    gained = found.covariance[0] - stated
    np.testing.assert_allclose(np.diag(gained)[:48], (found.scale["c"] ** 2 - 1) * lines.SIGMA**2, rtol=0.1)
    assert found.scale["c"] == pytest.approx(1.4, rel=0.12)
    assert np.linalg.eigvalsh(found.covariance[0]).min() > 0


def test_overstated_noise_leaves_a_covariance_positive():
    problem, _ = lines.problem(seed=1, sigma=0.2)
    shape = np.exp(-np.abs(np.subtract.outer(np.tile(lines.Y, 2), np.tile(lines.Y, 2))) / 0.5)
    made = replace(problem, covariance=(problem.covariance[0] + 0.02**2 * shape,) * 6)
    remove = linear.columns(made, {}, made.nuisances) * [4.5 * p.sigma for p in made.nuisances]
    found = noise.estimate(made, made.data - linear.predict_all(made, {}), remove)
    assert found.scale["c"] < 0.8
    assert min(np.linalg.eigvalsh(c).min() for c in found.covariance) > 0


def test_only_the_blocks_asked_for_are_judged():
    problem, _ = lines.problem(seed=4)
    data = problem.data.copy()
    last = problem.block == 5
    data[last] += 10 * lines.SIGMA * np.random.default_rng(0).normal(size=last.sum())
    made = replace(problem, data=data)
    residual = made.data - linear.predict_all(made, {})
    remove = linear.columns(made, {}, made.nuisances) * [4.5 * p.sigma for p in made.nuisances]
    assert noise.estimate(made, residual, remove).scale["c"] > 2
    assert noise.estimate(made, residual, remove, ~last).scale["c"] < 1.1


def test_sigmas_that_go_with_the_data_leave_the_noise_as_it_is():
    """Scenario: widths whose stated sigma is 2 % of what was measured, and a gain, smooth along the lines, that could
    be wrong by hundreds of their sigmas. Taken out in units of those sigmas, the gain has the data's own scatter, and
    with it the noise would go."""
    rng = np.random.default_rng(11)
    n, blocks = 24, 6
    along = np.tile(np.linspace(-1, 1, n), blocks)
    data = 1 + 0.1 * along + 0.02 * rng.standard_normal(n * blocks)
    problem = Problem(
        data=data,
        block=np.repeat(np.arange(blocks), n),
        kind=np.full(n * blocks, "w"),
        position=along,
        stretch=np.repeat(np.arange(blocks), n),
        covariance=tuple(np.diag((0.02 * d) ** 2) for d in data.reshape(blocks, n)),
        names=tuple(f"line {b}" for b in range(blocks)),
        groups=tuple(f"line {b}" for b in range(blocks)),
        nuisances=(),
        catalogue=(),
        predict=lambda values, block: np.ones(n),
    )
    gains = np.column_stack([10.0 * (1 + t * along) for t in (0.0, 0.3)])
    found = noise.estimate(problem, data - 1, gains)
    # 6 × 19 contrasts: a scale is known to 6.6 %, and within four of those once in 16 000.
    assert abs(found.scale["w"] - 1) < 4 * 0.066
    assert found.freedom["w"] >= 6 * 19 - 2
