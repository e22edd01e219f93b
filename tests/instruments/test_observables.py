"""Data and their noise: what photographs give, judged by their own truth, and what simulation gives in their place."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.settings import from_vector
from benchsim.instruments.bench import observables
from benchsim.instruments.bench.observables import _marks_scatter, _of_the_board
from benchsim.instruments.bench.observed import Aside, beside, smooth_floor

ROOT = Path(__file__).parents[2]
OTHER = ROOT.parent / "shared" / "recordings" / "bench-other-code"


@pytest.fixture(scope="module")
def bench():
    recording = read(ROOT / "scenes/campaign12.toml")
    return replace(recording, exposures=recording.exposures[:2])


def test_simulated_data_lie_on_the_stated_trace_in_view_of_the_camera(bench):
    for o, exposure in zip(observables.simulate(bench, seed=1), bench.exposures, strict=True):
        curve = rays.predict(bench, exposure, blur=float(o.blur * o.mm_per_px.mean())).at_centre()
        assert np.abs(signed_distance(curve, o.points)[0]).max() < 1e-4
        assert len(o.points) == 64 and len(o.width2) == len(o.log_flux) == 24
        assert len(o.marks) >= 3 and not o.marks.any()
        for c in (o.covariance, o.width2_covariance, o.log_flux_covariance, *o.marks_covariance):
            np.linalg.cholesky(c)


def test_points_beside_a_curve_are_undone_by_its_signed_distance():
    t = np.linspace(-1, 1, 60)
    curve = Curve(np.column_stack([40 * t**2 + 3 * t, 300 * t]))
    s, d = np.linspace(20, 550, 30), np.linspace(-4, 5, 30)
    found = signed_distance(curve, beside(curve, s, d))
    assert np.allclose(found[0], d, atol=1e-6) and np.allclose(found[1], s, atol=1e-4)


def test_a_board_without_marks_is_refused(bench):
    with pytest.raises(BenchsimError, match="lists no marks"):
        observables.simulate(replace(bench, screen=replace(bench.screen, marks=None)))


GRID = np.array([(y, z) for y in np.linspace(-320, 320, 7) for z in np.linspace(-320, 320, 7)])


def marks_residual(rng, sigma):
    y, z = GRID.T / 320
    # What a bow and a lens leave, fifty sigma large: none of it may count as noise.
    smooth = np.stack([0.3 * y * z**2 - 0.2 * y, 0.25 * z**2 - 0.1 * y**2 * z], axis=1)
    return smooth + sigma * rng.standard_normal(GRID.shape)


def test_scatter_of_marks_is_that_of_neighbours_and_not_a_bow():
    rng = np.random.default_rng(11)
    stated = np.tile(np.eye(2) * 0.004**2, (len(GRID), 1, 1))
    found = np.array([_marks_scatter(GRID, marks_residual(rng, 0.006), stated, np.ones(len(GRID), bool))[0]
                      for _ in range(100)])  # fmt: skip
    # Each has 2 (49 − 15) degrees of freedom; the mean of a hundred at four sigma, less the few marks left out.
    want = (0.006 / 0.004) ** 2
    assert abs(found.mean() / want - 1) < 4 * np.sqrt(2 / 68 / 100) + 0.01


def test_a_lone_bad_mark_is_left_out_and_a_dented_board_is_not():
    rng = np.random.default_rng(12)
    stated, whole = np.tile(np.eye(2) * 0.006**2, (len(GRID), 1, 1)), np.ones(len(GRID), bool)
    residual = marks_residual(rng, 0.006)
    residual[17] += 0.15
    scale, lone = _marks_scatter(GRID, residual, stated, whole)
    assert np.flatnonzero(lone).tolist() == [17] and scale < 2
    dent = np.exp(-((GRID - [40.0, -60.0]) ** 2).sum(axis=1) / 2 / 90**2)
    dented = marks_residual(rng, 0.006) + 0.15 * dent[:, None]
    lone = _marks_scatter(GRID, dented, stated, whole)[1]
    assert lone.sum() <= 3 and (dent[~lone] ** 2).sum() > 0.6 * (dent**2).sum()


def test_a_mark_that_is_off_in_every_photograph_is_the_board_s(bench):
    """Scenario. A dent under mark 7 throws it off its neighbours in all photographs, and nothing else sees the dent but
    the trace; mark 9 was scratched by the trace in one of them. Only the second is a fault of measurement."""
    seen = observables.simulate(bench)[:1] * 4
    off = [Aside(7, 3, np.array([0.5, -0.2]), f"{k}.png") for k in range(4)]
    scratch = Aside(9, 5, np.array([2.0, 0.0]), "0.png")
    marks = seen[0].marks.copy()
    marks[3] = np.nan
    observed = [replace(o, marks=marks, aside=(a,)) for o, a in zip(seen, off, strict=True)]
    marks = marks.copy()
    marks[5] = np.nan
    observed[0] = replace(observed[0], marks=marks, aside=(off[0], scratch))
    settled = _of_the_board(tuple(observed))
    for o in settled:
        np.testing.assert_array_equal(o.marks[3], [0.5, -0.2])
        assert not o.aside
    assert np.isnan(settled[0].marks[5]).all()
    assert settled[0].notes == ("0.png: mark 9 lies off its neighbours and is left out",)
    assert [o.notes for o in settled[1:]] == [()] * 3
    two = _of_the_board(tuple(observed[2:]))
    assert all(np.isnan(o.marks[3]).all() and o.notes for o in two)


def test_a_smooth_floor_is_shared_by_neighbours_only():
    c = smooth_floor(np.array([0.0, 10.0, 2000.0]), np.array([1.0, 2.0, 3.0]))
    assert np.allclose(np.diag(c), [1, 4, 9]) and c[0, 1] > 1.99 and abs(c[0, 2]) < 1e-6


def test_lost_exposures_are_named_and_the_others_kept(tmp_path, bench):
    lost = tuple(replace(e, image=f"{i}.png") for i, e in enumerate(bench.exposures))
    absent = replace(bench, exposures=lost, path=tmp_path / "recording.toml")
    with pytest.raises(BenchsimError, match=r"no exposure can be used: 0\.png"):
        observables.observe(absent)


def test_centre_line_and_marks_of_other_code_lie_where_their_covariance_says():
    if not OTHER.is_dir():
        pytest.skip(f"photographs of other code are not at {OTHER.parent}")
    recording = read(OTHER / "clean-six" / "recording.toml")
    truth = np.load(OTHER / "truth" / "clean-six.npz")
    off = json.loads((OTHER / "truth" / "clean-six.json").read_text())["setting_errors"]
    keys = {"n_cx": 1.0, "n_cy": 1.0, "n_cz": 1.0, "n_a1": 1e-3, "n_a2": 1e-3, "n_saz": 1e-3, "n_sel": 1e-3}
    observed, lost = observables.observe(recording)
    assert not lost
    # There the board stands as it first did: setting it down anew has errors of its own.
    for o in observed[:3]:
        exposure = recording.exposures[o.index]
        errors = from_vector(np.array([off[exposure.setting][k] * unit for k, unit in keys.items()] + [0.0] * 6))
        predicted = rays.predict(recording, exposure, errors, blur=float(o.blur * o.mm_per_px.mean()))
        means = truth[f"trace_{o.index}"][:2].T[5:-5]
        assert np.abs(signed_distance(predicted, means)[0]).max() < 2e-3
        d, s = signed_distance(predicted.at_centre(), o.points)
        inside = (s > 0) & (s < predicted.arc_length()[-1])
        c = o.covariance[np.ix_(inside, inside)]
        # σ is itself estimated to some 10 %: χ² may exceed its quantile at 1e-4 by a fifth.
        assert d[inside] @ np.linalg.solve(c, d[inside]) < 1.2 * chi2.isf(1e-4, inside.sum())
        kept = np.isfinite(o.marks).all(axis=1)
        pull = np.einsum("ni,nij,nj->n", o.marks[kept], np.linalg.inv(o.marks_covariance[kept]), o.marks[kept])
        assert 0.4 < pull.mean() / 2 < 1.5


def test_one_profile_whose_light_is_not_that_of_its_neighbours_does_not_speak_for_the_line(monkeypatch):
    """Scenario: of a clipped crest's profile all bright pixels are left out, and its flux comes out 3.6 times its
    neighbours', its width a quarter too small, and its error as the smallest of all."""
    if not OTHER.is_dir():
        pytest.skip(f"photographs of other code are not at {OTHER.parent}")
    recording, measure = read(OTHER / "clean-six" / "recording.toml"), observables.measure

    def spoilt(*given, **more):
        line = measure(*given, **more)
        one = np.arange(len(line.flux)) == len(line.flux) - 7
        wide = np.where(one, 0.75, 1.0)
        return replace(line, flux=line.flux * np.where(one, 3.6, 1.0), width_mm=line.width_mm * wide,
                       sigma_mm=line.sigma_mm * np.where(one, 0.4, 1.0))  # fmt: skip

    plain = observables.observe_one(recording, 0)
    monkeypatch.setattr(observables, "measure", spoilt)
    seen = observables.observe_one(recording, 0)
    for now, then, c in (
        (seen.log_flux, plain.log_flux, plain.log_flux_covariance),
        (seen.width2, plain.width2, plain.width2_covariance),
    ):
        assert np.abs(now - then).max() < 2 * np.sqrt(np.diag(c)).max()
