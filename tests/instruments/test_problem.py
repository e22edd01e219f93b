"""The bench's problem: consistent with itself, with brute force, and with photographs whose truth is known."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Physics
from benchsim.diagnosis import linear
from benchsim.instruments.bench import board_coordinates, observables
from benchsim.instruments.bench.prediction import FAR
from benchsim.instruments.bench.problem import build, draw

ROOT = Path(__file__).parents[2]
OTHER = ROOT.parent / "shared" / "recordings" / "bench-other-code"


def two(**changes):
    """Two settings of the campaign, the second with the screen moved."""
    recording = read(ROOT / "scenes/campaign12.toml")
    first, second = recording.exposures[0], replace(recording.exposures[1], screen_roll=np.pi, time=3600.0)
    return replace(recording, exposures=(first, second), **changes)


@pytest.fixture(scope="module")
def made():
    recording = two()
    return recording, build(recording, observables.simulate(recording, seed=3))


def test_the_stated_bench_reproduces_its_own_data(made):
    _, problem = made
    for b in range(len(problem.names)):
        rows = problem.rows(b)
        left = problem.data[rows] - problem.predict({}, b)
        sigma = np.sqrt(np.diag(problem.covariance[b]))
        # Nominal data are of 96 samples, the prediction has 48, and widths behind a blur do not add in quadrature.
        kind = problem.kind[rows]
        assert np.abs(left[kind != "w"] / sigma[kind != "w"]).max() < 0.05
        assert np.abs(left[kind == "w"] / problem.data[rows][kind == "w"]).max() < 0.05


def test_blocks_groups_and_nuisances_are_those_of_the_file(made):
    recording, problem = made
    names = {p.name: p for p in problem.nuisances}
    assert problem.groups == tuple(e.setting for e in recording.exposures)
    s = recording.exposures[0].setting
    assert names[f"{s}.mirror_axis_1"].unit == "mrad" and names[f"{s}.mirror_axis_1"].sigma == pytest.approx(1.745)
    assert names[f"{s}.mirror_position_x"].blocks == (0,) and names[f"{s}.mirror_position_x"].scaled
    assert names["seat1.screen_angle_x"].blocks == (1,) and "seat0.screen_angle_x" not in names
    assert not names["beam_diameter"].scaled and names["beam_diameter"].sigma == 0.02
    assert len({p.name for p in (*problem.nuisances, *(p for e in problem.catalogue for p in e.parameters))}) == len(
        problem.nuisances
    ) + sum(len(e.parameters) for e in problem.catalogue)
    assert np.all(np.diff(problem.block) >= 0) and {"c", "w", "f", "m"} == set(problem.kind)
    for b, c in enumerate(problem.covariance):
        assert len(c) == len(problem.data[problem.rows(b)])
        np.linalg.cholesky(c)


TRUTHS = [
    {"bow_z": 0.05},
    {"k1": 0.02},
    {"pyr": 2.0, "gs": 3.0},
    {"rs_s": 2.0, "rs_period": 1000.0},
    {"sx": 5.0, "st_y": 6.0},
    {"dry": 0.5},
]


@pytest.mark.parametrize("truth", TRUTHS, ids=lambda t: "+".join(t))
def test_centre_line_is_where_the_pieces_put_it(made, truth):
    """rays for the light, `board_coordinates` for the camera (held against brute force elsewhere), joined by hand."""
    recording, problem = made
    table = {}
    for name, value in truth.items():
        owner = next(e.name for e in problem.catalogue for p in e.parameters if p.name == name)
        table.setdefault(owner, {})[name] = value
    true = replace(recording, effects={**recording.effects, **table})
    for b, o in enumerate(x.observed for x in problem.predict.blocks):
        response = problem.predict.blocks[b].response
        curve = rays.predict(true, recording.exposures[o.index], samples=96, blur=response.blur).at_centre()
        level = np.interp(np.linspace(0, 1, 96), np.linspace(0, 1, 48), problem.predict.blocks[b].level)
        points, residual = board_coordinates.measured(true, o.view, curve.points, level)
        d = signed_distance(Curve(points), o.points)[0]
        got = problem.predict(truth, b)
        kind = problem.kind[problem.rows(b)]
        base = signed_distance(rays.predict(recording, recording.exposures[o.index]), o.points)[0]
        assert np.abs(got[kind == "c"] - (base - d + response.aside)).max() < 2e-4
        assert np.abs(got[kind == "m"] - residual.ravel()).max() < 1e-9
        moved = got - problem.predict({}, b)
        assert np.abs(moved[np.isin(kind, ["c", "m"])]).max() > 0.02 or (b == 0 and "dry" in truth)


def test_light_is_as_bright_as_it_was_measured_and_brightest_where_it_was_seen(made):
    """Scenario: a trace is brighter toward its end than the stated bench has it, by what setting errors do; and its
    brightest part is saturated, so that no profile there is a datum."""
    recording, _ = made
    seen = observables.simulate(recording)
    s = seen[0].profile_s
    tilted = replace(seen[0], log_flux=seen[0].log_flux + 0.3 * (s - s.min()) / np.ptp(s))
    was, now = (build(recording, (o, seen[1])).predict.blocks[0].level for o in (seen[0], tilted))
    assert now.max() == pytest.approx(1.0, abs=0.02) and was.max() == pytest.approx(1.0, abs=0.02)
    ratio = (now / was)[[0, -1]]
    assert abs(np.log(ratio[1] / ratio[0])) == pytest.approx(0.3, abs=0.03)
    half = slice(0, len(s) // 2) if was[-1] > was[0] else slice(len(s) // 2, None)
    near = np.abs(seen[0].s - s[half].mean()) < np.ptp(s[half]) / 2
    cut = {k: getattr(seen[0], k)[half] for k in ("profile_points", "profile_s", "width2", "log_flux", "mm_per_px")}
    cut |= {k: getattr(seen[0], k)[half, half] for k in ("width2_covariance", "log_flux_covariance")}
    less = replace(
        seen[0],
        points=seen[0].points[near],
        s=seen[0].s[near],
        covariance=seen[0].covariance[np.ix_(near, near)],
        ends=seen[0].points[[0, -1]],
        **cut,
    )
    np.testing.assert_allclose(build(recording, (less, seen[1])).predict.blocks[0].level, was, rtol=0.02)
    blind = build(recording, (replace(less, ends=np.zeros((0, 2))), seen[1])).predict.blocks[0].level
    assert blind.max() > 1.05 * was.max()


def test_effects_are_added_to_what_the_file_states(made):
    recording, problem = made
    stated = replace(recording, effects={"canting": {"pyr": 1.5}})
    observed = tuple(b.observed for b in problem.predict.blocks)
    other = build(stated, observed)
    for b in range(2):
        assert np.allclose(other.predict({"pyr": 0.5}, b), problem.predict({"pyr": 2.0}, b), atol=1e-9)


def test_derivatives_do_not_depend_on_the_step(made):
    _, problem = made
    chosen = [p for p in problem.nuisances if p.name.endswith(("mirror_axis_1", "blur", "beam_diameter"))]
    chosen += [p for e in problem.catalogue for p in e.parameters if p.name in ("k1", "bow_z", "pyr", "az_enc", "gs")]
    coarse = linear.columns(problem, {}, tuple(chosen))
    fine = linear.columns(problem, {}, tuple(chosen), {p.name: 0.01 * p.sigma for p in chosen})
    size = np.linalg.norm(coarse, axis=0)
    assert (size > 0).all()
    assert (np.linalg.norm(coarse - fine, axis=0) < 2e-2 * size).all()


def test_prediction_is_pure_and_can_be_handed_to_another_process(made):
    _, problem = made
    first = problem.predict({"pyr": 1.0}, 0)
    problem.predict({"pyr": -1.0, "bow_y": 0.01}, 0)
    assert np.array_equal(first, problem.predict({"pyr": 1.0}, 0))
    assert np.array_equal(first, pickle.loads(pickle.dumps(problem.predict))({"pyr": 1.0}, 0))


def test_light_beside_the_board_is_far_away_and_no_exception(made):
    _, problem = made
    assert (problem.predict({"s1.laser_elevation": 9e2, f"{problem.groups[0]}.laser_elevation": 9e2}, 0) == FAR).all()


def test_unknown_gamma_leaves_positions_and_marks():
    recording = two()
    blind = replace(recording, cameras={k: replace(c, gamma="unknown") for k, c in recording.cameras.items()})
    problem = build(blind, observables.simulate(blind))
    assert {"c", "m"} == set(problem.kind)
    assert not any(p.name.endswith((".blur", ".gain")) for p in problem.nuisances)


def test_against_the_papers_model_the_switches_restore_the_bench():
    recording = two(physics=Physics(True, True, True))
    observed = observables.simulate(recording)
    bench, paper = build(recording, observed), build(recording, observed, against="vector")
    on = {"facets": 1.0, "beam": 1.0, "fresnel": 1.0}
    for b in range(2):
        kind, sigma = bench.kind[bench.rows(b)], np.sqrt(np.diag(bench.covariance[b]))
        left = paper.data[paper.rows(b)] - paper.predict(on, b)
        assert np.abs(left / sigma)[kind == "c"].max() < 0.2
        missing = paper.data[paper.rows(b)] - paper.predict({}, b)
        assert np.abs(missing / sigma)[kind == "c"].max() > 5
        assert np.abs(missing / sigma)[kind == "w"].max() > 20


def test_drawn_data_scatter_as_the_covariance_says(made):
    _, problem = made
    rng = np.random.default_rng(7)
    total = []
    for _ in range(20):
        drawn = draw(problem, {"pyr": 1.0}, rng)
        for b in range(2):
            left = drawn.data[problem.rows(b)] - problem.predict({"pyr": 1.0}, b)
            total.append(left @ np.linalg.solve(problem.covariance[b], left))
    dof = 20 * len(problem.data)
    # Two-sided, at a false alarm rate of 1e-3.
    assert chi2.ppf(5e-4, dof) < sum(total) < chi2.isf(5e-4, dof)


NAMES = {
    "n_cx": "mirror_position_x",
    "n_cy": "mirror_position_y",
    "n_cz": "mirror_position_z",
    "n_saz": "laser_azimuth",
    "n_sel": "laser_elevation",
    "n_a1": "mirror_axis_1",
    "n_a2": "mirror_axis_2",
}


def fitted(problem, amplitudes, iterations=3):
    """Most probable nuisances and amplitudes, and their posterior sigma."""
    at, sd = {}, np.zeros(0)
    every = (*problem.nuisances, *amplitudes)
    for _ in range(iterations):
        found = linear.linearise(problem, at, amplitudes)
        j = np.column_stack([found.nuisance, found.effect])
        scale = np.array([p.sigma for p in problem.nuisances] + [1.0] * len(amplitudes))
        prior = np.array([1.0] * len(problem.nuisances) + [p.sigma**-2.0 for p in amplitudes])
        hessian = j.T @ j + np.diag(prior)
        x = np.linalg.solve(hessian, j.T @ found.residual)
        at = {p.name: float(v) for p, v in zip(every, x * scale, strict=True)}
        sd = np.sqrt(np.diag(np.linalg.inv(hessian))) * scale
    return at, {p.name: float(s) for p, s in zip(every, sd, strict=True)}


def other_code(name):
    if not OTHER.is_dir():
        pytest.skip(f"photographs of other code are not at {OTHER.parent}")
    recording = read(OTHER / name / "recording.toml")
    observed, lost = observables.observe(recording)
    assert not lost
    return recording, build(recording, observed), json.loads((OTHER / "truth" / f"{name}.json").read_text())


def test_clean_photographs_of_other_code_are_as_their_covariance_says():
    _, problem, truth = other_code("clean-f7")
    at, sd = fitted(problem, ())
    for b in range(len(problem.names)):
        rows = problem.rows(b)
        left, kind = problem.data[rows] - problem.predict(at, b), problem.kind[rows]
        for k in "cwfm":
            mine = np.flatnonzero(kind == k)
            c = problem.covariance[b][np.ix_(mine, mine)]
            # Estimated noise is good to some 15 % of sigma: χ² per datum up to 1.35 beside its own scatter (4 σ).
            limit = 1.35 + 4 * np.sqrt(2 / len(mine))
            assert left[mine] @ np.linalg.solve(c, left[mine]) / len(mine) < limit, (b, k)
    pulls = [
        (at[f"{s}.{NAMES[k]}"] - v) / sd[f"{s}.{NAMES[k]}"]
        for s, errors in truth["setting_errors"].items()
        for k, v in errors.items()
    ]
    # At a false alarm rate of 1e-4; correlation between them only widens the sum's scatter.
    assert np.sum(np.square(pulls)) < chi2.isf(1e-4, len(pulls))


def test_bow_of_other_code_is_measured_within_three_sigma():
    _, problem, truth = other_code("known-six")
    bow = next(e for e in problem.catalogue if e.name == "screen-bow")
    at, sd = fitted(problem, bow.parameters, iterations=2)
    for name, given in truth["effects"][0]["parameters"].items():
        assert abs(at[name] - given["value"]) < 3 * sd[name]
        assert sd[name] < 1e-4


def test_what_could_be_recorded_next_shares_what_is_left_untouched(made):
    _, problem = made
    assert problem.next_recordings is not None
    found = {f.what.split()[0] + (" marks" if f.kind == "observable" else ""): f for f in problem.next_recordings()}
    assert {"repeat", "roll", "move", "photograph", "photograph marks"} <= found.keys()
    names = {p.name for p in problem.nuisances}
    last = problem.groups[-1]
    for f in found.values():
        n = len(f.covariance)
        assert all(c.shape == (n,) for c in (*f.nuisance.values(), *f.effect.values()))
        assert all(name in names or name in f.priors for name in f.nuisance)
        assert {p.name for e in problem.catalogue for p in e.parameters if not p.grid} == f.effect.keys()
    assert np.abs(found["repeat"].nuisance[f"{last}.mirror_axis_1"]).max() > 0
    assert np.abs(found["repeat"].effect["dry"]).max() > 0
    assert "seat2.screen_angle_x" in found["roll"].nuisance and "seat2.screen_angle_x" not in names
    assert not any("laser" in k or "mirror" in k for k, v in found["photograph marks"].nuisance.items() if v.any())
