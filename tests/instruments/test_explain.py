"""What the setting uncertainties explain of a trace: on traces of the vector model with known noise and known errors.

The predictions take a fixed stretch of phases of the vector model, wide enough to cover the board after every error, so
that a case costs milliseconds.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from benchsim import vector
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Physics
from benchsim.bench.place import place
from benchsim.bench.settings import NAMES, from_vector, prior_sigma
from benchsim.instruments.bench.explain import bin_trace, explain
from benchsim.instruments.bench.validation import MIN_BINS, normal_sensitivity, validate_trace

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SIGMA = 0.02
"""Noise of a profile across the curve [mm]."""


@pytest.fixture(scope="module")
def bench():
    return read(SCENES / "fig7a.toml")


@pytest.fixture(scope="module")
def predict(bench):
    exposure = bench.exposures[0]
    nominal = vector.trace(bench.mirror, exposure, screen=bench.screen, count=25)
    middle, half = nominal.phase.mean(), np.ptp(nominal.phase) / 2
    phases = np.linspace(middle - 1.3 * half, middle + 1.3 * half, 121)

    def model(errors):
        where = place(bench.mirror, exposure, errors)
        return Curve(vector.on_board(where, bench.mirror.radius, phases)[0], phase=phases)

    return model


def measured(predict, theta, shifts):
    """Points of the curve at setting errors ``theta``, each moved across it by its own shift [mm]; arc length [mm]."""
    curve = predict(from_vector(theta))
    # The middle of the stretch: the points stay within the curve that any setting predicts.
    points = curve.points[15:-15]
    s = np.linspace(0, 1, len(shifts)) * (len(points) - 1)
    fine = np.column_stack([np.interp(s, np.arange(len(points)), column) for column in points.T])
    distance, along = signed_distance(curve, fine)
    tangent = np.gradient(fine, along, axis=0)
    left = np.column_stack([-tangent[:, 1], tangent[:, 0]]) / np.linalg.norm(tangent, axis=1)[:, None]
    return fine + (np.asarray(shifts) - distance)[:, None] * left, along


def test_chi_squared_of_clean_traces_has_the_mean_and_the_spread_it_claims(bench, predict):
    """Rationale: p-values are worth something only if χ² follows its distribution where the model is right.

    Set-up: 60 traces of 160 points, noise of 20 µm, all seven setting errors drawn from their priors, which move the
    trace by up to tens of mm. Expectation: the sum of χ² lies within the central 99.8 % of its distribution and the
    p-values are uniform (Kolmogorov–Smirnov, 0.1 %): a false alarm in 0.3 % of seeds. Every fit converges.
    """
    rng = np.random.default_rng(11)
    prior = prior_sigma(bench.uncertainty, reseated=False)
    total, dof, p = 0.0, 0, []
    for _ in range(60):
        points, s = measured(predict, prior * rng.standard_normal(len(NAMES)), SIGMA * rng.standard_normal(160))
        found = explain(points, bin_trace(s, SIGMA**2 * np.eye(160)), predict, prior)
        assert found.converged
        total, dof = total + found.chi2_after, dof + found.dof
        p.append(found.p_after)
    assert chi2.ppf(0.001, dof) < total < chi2.ppf(0.999, dof)
    assert kstest(p, "uniform").pvalue > 0.001


def test_re_seating_errors_are_explained_too(bench, predict):
    """With the screen moved all 13 errors are free; sum of χ² of 15 traces within its central 99.8 %."""
    rng = np.random.default_rng(12)
    prior = prior_sigma(bench.uncertainty, reseated=True)
    total, dof = 0.0, 0
    for _ in range(15):
        points, s = measured(predict, prior * rng.standard_normal(len(NAMES)), SIGMA * rng.standard_normal(160))
        found = explain(points, bin_trace(s, SIGMA**2 * np.eye(160)), predict, prior)
        assert found.converged and len(found.pulls) == 13
        total, dof = total + found.chi2_after, dof + found.dof
    assert chi2.ppf(0.001, dof) < total < chi2.ppf(0.999, dof)


@pytest.mark.parametrize("name", ["mirror_position_x", "mirror_axis_1", "mirror_axis_2", "laser_elevation"])
def test_one_setting_error_of_three_sigma_is_recovered(name, bench, predict):
    """One error of 3 σ, alone free: the pull reads 3 within 4 of its own posterior sigmas (false alarm 6e-5 each)."""
    rng = np.random.default_rng(13)
    k = NAMES.index(name)
    full = prior_sigma(bench.uncertainty, reseated=False)
    prior = np.where(np.arange(len(NAMES)) == k, full, 0.0)
    points, s = measured(predict, 3 * prior, SIGMA * rng.standard_normal(160))
    found = explain(points, bin_trace(s, SIGMA**2 * np.eye(160)), predict, prior)
    assert list(found.pulls) == [name]
    assert 0 < found.sigma[k] < 0.2 * full[k], "the trace says more about it than the prior"
    # The prior draws the estimate to zero by (posterior/prior)² of it.
    drawn = (found.sigma[k] / full[k]) ** 2
    assert abs(found.pulls[name] - 3 * (1 - drawn)) < 4 * found.sigma[k] / full[k]
    assert np.all(found.theta[np.arange(len(NAMES)) != k] == 0)


def test_a_shift_of_three_sigma_is_explained_though_no_single_error_can_be_named(bench, predict):
    """All seven free: they are degenerate, but the curve is recovered far better than the 20 µm of a profile.

    The fitted curve has at most seven degrees of freedom: rms ≤ 3 · σ · sqrt(7/160), 13 µm, where the shift is mm.
    """
    rng = np.random.default_rng(14)
    prior = prior_sigma(bench.uncertainty, reseated=False)
    theta = np.zeros(len(NAMES))
    theta[NAMES.index("mirror_axis_2")] = 3 * prior[NAMES.index("mirror_axis_2")]
    points, s = measured(predict, theta, SIGMA * rng.standard_normal(160))
    found = explain(points, bin_trace(s, SIGMA**2 * np.eye(160)), predict, prior)
    exact = measured(predict, theta, np.zeros(160))[0]
    assert np.abs(found.before).min() > 1.0
    assert np.sqrt(np.mean(signed_distance(found.curve, exact)[0] ** 2)) < 3 * SIGMA * np.sqrt(7 / 160)
    assert found.p_before < 1e-10 and found.p_after > 1e-4


def test_a_prior_of_zero_holds_every_parameter(bench, predict):
    theta = np.zeros(len(NAMES))
    theta[0] = 2.0
    points, s = measured(predict, theta, np.zeros(160))
    found = explain(points, bin_trace(s, SIGMA**2 * np.eye(160)), predict, np.zeros(len(NAMES)))
    assert found.converged and found.pulls == {} and not found.theta.any() and not found.sigma.any()
    assert found.chi2_after == found.chi2_before and np.array_equal(found.before, found.after)
    assert found.p_after < 1e-10


def test_what_all_points_share_is_honoured(predict):
    """Rationale: a camera pose moves all points together; taken as independent noise it would condemn every model.

    Set-up: 100 traces, settings held, noise of 20 µm and a shift of 30 µm rms that all share. Expectation: with the
    shared factor in the covariance the sum of χ² is within the central 99.8 % of its distribution; without it, far off.
    """
    rng = np.random.default_rng(15)
    n, held = 160, np.zeros(len(NAMES))
    shared = 0.03 * np.linspace(0.8, 1.2, n)
    full = SIGMA**2 * np.eye(n) + np.outer(shared, shared)
    total, dof, wrong = 0.0, 0, 0.0
    for _ in range(100):
        points, s = measured(predict, held, SIGMA * rng.standard_normal(n) + shared * rng.standard_normal())
        found = explain(points, bin_trace(s, full), predict, held)
        total, dof = total + found.chi2_after, dof + found.dof
        wrong += explain(points, bin_trace(s, SIGMA**2 * np.eye(n)), predict, held).chi2_after
    assert chi2.ppf(0.001, dof) < total < chi2.ppf(0.999, dof)
    assert wrong > 2 * total


def test_a_model_that_is_wrong_is_not_explained_away(bench, predict):
    """A ripple of 60 µm along the trace is beyond what seven settings can do: p < 1e-6."""
    rng = np.random.default_rng(16)
    prior = prior_sigma(bench.uncertainty, reseated=False)
    ripple = 0.06 * np.sin(np.linspace(0, 6 * np.pi, 160))
    points, s = measured(predict, prior * rng.standard_normal(len(NAMES)), ripple + SIGMA * rng.standard_normal(160))
    assert explain(points, bin_trace(s, SIGMA**2 * np.eye(160)), predict, prior).p_after < 1e-6


@pytest.mark.parametrize("n, count", [(3, 1), (16, 4), (160, 40), (1000, 64)])
def test_bins_hold_at_least_four_points_and_average_their_noise(n, count):
    binned = bin_trace(np.linspace(0, 100, n), SIGMA**2 * np.eye(n))
    assert binned.weights.shape == (count, n)
    assert binned.weights.sum(axis=1) == pytest.approx(np.ones(count))
    members = np.count_nonzero(binned.weights, axis=1)
    assert np.diag(binned.covariance) == pytest.approx(SIGMA**2 / members)


def test_a_lean_of_the_normal_moves_the_trace_as_the_closed_form_says(bench, predict):
    """R = I − 2 (I·n) n, so a lean of n by δ toward the axis a turns R by −2 ((I·a) n + (I·n) a) δ, and the spot
    X = P + t R on the plane e·X = e·o moves by t (dR − R (e·dR)/(e·R)); across the trace that is ``mm_per_mrad``."""
    exposure, r = bench.exposures[0], bench.mirror.radius
    where = place(bench.mirror, exposure)
    curve = predict(from_vector(np.zeros(len(NAMES))))
    inner = slice(15, -15, 10)
    points, normals = vector.positions(vector.bench_cylinder(where, r), curve.phase)
    travel, e = where.laser_direction, where.screen_rotation[:, 0]
    reflected = travel - 2 * (normals @ travel)[:, None] * normals
    t = ((where.screen_origin - points) @ e) / (reflected @ e)
    turn = -2 * ((travel @ where.axis) * normals + (normals @ travel)[:, None] * where.axis)
    moved = t[:, None] * (turn - reflected * ((turn @ e) / (reflected @ e))[:, None])
    on_board = moved @ where.screen_rotation[:, 1:]
    tangent = np.gradient(curve.points, curve.phase, axis=0)
    across = np.abs(tangent[:, 0] * on_board[:, 1] - tangent[:, 1] * on_board[:, 0]) / np.linalg.norm(tangent, axis=1)
    found = normal_sensitivity(where, r, curve.points[inner], curve)
    assert found == pytest.approx(across[inner], rel=1e-3)
    assert np.all((found > 2e3) & (found < 6e3)), "twice the lever of 2.1 m, obliquely: about 4 mm per mrad"


def test_a_tiny_trace_cannot_tell(bench, predict):
    """Fewer bins than setting errors test nothing: neither yes nor no."""
    simple = replace(bench, physics=Physics(facets=False, beam=False, diffraction=False))
    n = 4 * (MIN_BINS - 1)
    points, s = measured(predict, np.zeros(len(NAMES)), np.zeros(n))
    found = validate_trace(
        simple, simple.exposures[0], reseated=False, points=points, s=s, covariance=SIGMA**2 * np.eye(n)
    )
    assert found.agrees is None and found.as_dict()["agrees"] is None
