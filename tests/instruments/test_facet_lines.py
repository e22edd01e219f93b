"""Scenario: facets lean by different angles, so that each draws a line of its own, some widths apart. What photographs
then show across the trace is made here of the ray model's irradiance, one facet's line beside the other; the lines'
parting has to be read from it, a line that is merely broad has to be left alone, and on four settings of the bench the
diagnosis has to take the parting for what it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim import rays
from benchsim.bench.curve import signed_distance
from benchsim.bench.files import read
from benchsim.diagnosis import degeneracy
from benchsim.diagnosis.naming import name
from benchsim.instruments.bench import facet_lines, next_recordings, observables
from benchsim.instruments.bench.observed import beside
from benchsim.instruments.bench.problem import build, draw
from benchsim.instruments.bench.simulation import simulate_one
from benchsim.trace.pose import Pose
from benchsim.trace.side_lines import Across
from benchsim.trace.table import Trace

ROOT = Path(__file__).parents[2]
RECORDING = read(ROOT / "scenes/campaign12.toml", images=False)
RECORDING = replace(RECORDING, exposures=RECORDING.exposures[:4])
TILTS = np.array([0.35, 0.8, 0.3, -1.3, 0.9, 0.45, -0.5, 0.6, 0.4, 0.3, 0.0, 0.5])
"""Of twelve facets [mrad]; their lines lie within 10 mm, some beside and some over each other."""


def shown(exposure, tilts, rng, bent=0.0, shaken=0.0, bench=RECORDING):
    """What an exposure shows across its trace; tilts [mrad], bent [mrad] and shaken [mm] as `facet_lines._shapes`."""
    observed = simulate_one(RECORDING, RECORDING.exposures.index(exposure))
    curve = rays.predict(RECORDING, exposure, width=False)
    s = np.linspace(0.05, 0.95, 16) * curve.arc_length()[-1]
    at, ends = (parting_points(curve, s, d) for d in (0.0, 1.0))
    q = np.tile(np.arange(-45.0, 45.0, 0.6), (16, 1))
    blank = Across(s, at, ends - at, q, np.zeros_like(q), np.full_like(q, 0.004))
    view = observed.view
    solved = np.zeros((6, 6)), np.zeros((0, 4, 2)), 1.0, np.zeros(0, bool), (), 0.0
    pose = Pose(view.rotation, view.translation, view.camera, *solved)
    blur = 0.7 * facet_lines.mm_per_px(pose, blank.points, blank.normal)
    places, (line,) = facet_lines._shapes(bench, exposure, blank, blur, 1e-3 * bent, (shaken,))
    lever = lever_of(exposure, blank.points)
    lines = zip(q, lever, line, strict=True)
    light = np.array([np.mean([np.interp(x - t * u, places, y) for t in tilts], axis=0) for x, u, y in lines])
    light = light / light.max() + blank.sigma * rng.standard_normal(q.shape)
    none = np.zeros(16)
    ridge = Trace("x", none.astype(int), s, *(none,) * 9, normal=blank.normal, pose_mm=np.zeros((16, 6)))
    return replace(blank, light=light), pose, ridge, lever


def lever_of(exposure, points):
    """How far a facet's line lies off for its lean [mm/mrad], by the ray model."""
    leant = (replace(RECORDING, effects={"canting": {"pyr": lean}}) for lean in (-0.5, 0.5))
    less, more = (signed_distance(rays.predict(r, exposure, width=False), points)[0] for r in leant)
    return less - more


def parting_points(curve, s, distance):
    return beside(curve, s, np.full(len(s), distance))


def test_the_parting_of_many_lines_is_their_mean_square_lean_times_the_levers_square():
    rng = np.random.default_rng(5)
    for exposure in RECORDING.exposures[:2]:
        across, pose, ridge, lever = shown(exposure, TILTS, rng)
        found = facet_lines.parted(RECORDING, exposure, across, pose, 0.7, ridge)
        assert found is not None and len(found.s) == 16
        sigma = np.sqrt(np.diag(found.parting_covariance))
        assert np.abs((found.parting - TILTS.var() * lever**2) / sigma).max() < 4
        off = signed_distance(rays.predict(RECORDING, exposure, width=False), found.points)[0]
        assert np.abs((off - TILTS.mean() * lever) / np.sqrt(np.diag(found.covariance))).max() < 4


@pytest.mark.parametrize(("bent", "shaken"), [(0.0, 0.0), (3.5, 0.0), (-7.0, 0.0), (0.0, 1.5)])
def test_a_single_line_however_broad_is_left_alone(bent, shaken):
    exposure = RECORDING.exposures[0]
    across, pose, ridge, _ = shown(exposure, np.zeros(1), np.random.default_rng(6), bent, shaken)
    assert facet_lines.parted(RECORDING, exposure, across, pose, 0.7, ridge) is None
    gated = replace(exposure, facet=3)
    assert facet_lines.parted(RECORDING, gated, across, pose, 0.7, ridge) is None


@pytest.mark.parametrize(
    "coma", [(-0.034, -0.029), *(pytest.param(c, marks=pytest.mark.slow) for c in ((0.062, 0.017), (-0.011, 0.095)))]
)
def test_a_single_line_of_a_beam_with_coma_is_left_alone(coma):
    """Its light lies to one side with a tail on the other, as that of two lines may."""
    bench = replace(RECORDING, effects={"coma": dict(zip(("coma_u", "coma_v"), coma, strict=True))})
    for exposure in RECORDING.exposures[:2]:
        across, pose, ridge, _ = shown(exposure, np.zeros(1), np.random.default_rng(13), bench=bench)
        assert facet_lines.parted(RECORDING, exposure, across, pose, 0.7, ridge) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coma", "bent", "shaken"),
    [((0.023, 0.082), 3.7, 0.0), ((-0.033, -0.076), 3.1, 1.0), ((0.021, -0.094), 4.0, 0.0)],
)
def test_a_single_line_of_a_beam_with_coma_and_bent_besides_is_left_alone(coma, bent, shaken):
    """As of a beam with coma and astigmatism: no coma alone has its line, nor any curvature."""
    bench = replace(RECORDING, effects={"coma": dict(zip(("coma_u", "coma_v"), coma, strict=True))})
    for exposure in RECORDING.exposures[:2]:
        across, pose, ridge, _ = shown(exposure, np.zeros(1), np.random.default_rng(13), bent, shaken, bench)
        assert facet_lines.parted(RECORDING, exposure, across, pose, 0.7, ridge) is None


@pytest.fixture(scope="module")
def parted_problem():
    seen = observables.simulate(RECORDING, seed=2)
    like = replace(
        seen[0],
        covariance=np.eye(16) * 0.03**2,
        parting=np.full(16, 20.0),
        parting_covariance=np.eye(16) * 0.6**2,
    )
    return build(RECORDING, tuple(facet_lines.as_parted(o, (like,)) for o in seen), attached=False)


def test_the_prediction_is_the_ray_models_parting(parted_problem):
    problem = parted_problem
    assert set(problem.kind) == {"c", "g", "m"}
    tilted = replace(RECORDING, effects={"facet-tilts": {"tilt_rms": 2.0}})
    for b, exposure in enumerate(RECORDING.exposures[:2]):
        here = problem.kind[problem.rows(b)] == "g"
        assert not problem.predict({}, b)[here].any()
        curve = rays.predict(tilted, exposure, width=False)
        o = problem.predict.blocks[b].observed
        wanted = np.interp(signed_distance(curve, o.points)[1], curve.arc_length(), curve.parting)
        assert np.allclose(problem.predict({"tilt_rms": 2.0}, b)[here], wanted, rtol=1e-3)


def test_parted_lines_are_named_for_the_facets_and_shaking_is_not(parted_problem):
    rng = np.random.default_rng(11)
    found = name(draw(parted_problem, {"tilt_rms": 1.5}, rng))
    best = max((f for f in found.fits if f.converged), key=lambda f: f.log_evidence)
    assert set(best.effects) <= {"facet-tilts", "axis-wobble"} and best.effects
    # 1.5 mrad rms are a wobble of √2 as much.
    size = best.values.get("tilt_rms", 0.0) + best.values.get("wob_c", 0.0) / np.sqrt(2)
    assert size == pytest.approx(1.5, rel=0.05)
    p = degeneracy.weighed(found, True).present(["vibration", "astigmatism"])
    assert max(p.values()) < 0.05


def test_a_halo_about_a_single_line_is_no_line():
    exposure = RECORDING.exposures[0]
    across, pose, ridge, _ = shown(exposure, np.zeros(1), np.random.default_rng(12))
    halo = 0.012 * np.exp(-0.5 * (across.q / 12.0) ** 2)
    glaring = replace(across, light=across.light + halo)
    assert facet_lines.parted(RECORDING, exposure, glaring, pose, 0.7, ridge) is None


def test_lines_apart_are_facets_only_where_all_exposures_show_the_same_leans():
    """Two of four exposures show lines apart: as 1.5 mrad of leans lay them, which the other two would show as well; by
    leans that differ; or all four do by the same, as only facets can."""
    seen = observables.simulate(RECORDING, seed=2)

    def apart(o, lean):
        return replace(o, parting=(lean * lever_of(RECORDING.exposures[o.index], o.points)) ** 2)

    assert not facet_lines.follow_facets(RECORDING, [apart(o, 1.5) for o in seen[:2]], seen[2:])
    assert not facet_lines.follow_facets(RECORDING, [apart(o, 1.0 + 0.15 * o.index) for o in seen], [])
    assert facet_lines.follow_facets(RECORDING, [apart(o, 1.5) for o in seen], [])


def test_gated_exposures_tell_random_leans_from_a_wobble_and_both_from_a_beam(monkeypatch):
    seen = observables.simulate(RECORDING, seed=2)
    problem = build(RECORDING, seen, attached=False)
    assert isinstance(problem.next_recordings, next_recordings.Next)
    gated = [c for c in next_recordings.candidates(RECORDING) if c.exposures[0].facet is not None]
    assert len(gated) == 1 and "gated to one facet" in gated[0].what
    assert [e.facet for e in gated[0].exposures] == [0, 6]
    with monkeypatch.context() as alone:
        alone.setattr(next_recordings, "candidates", lambda _: gated)
        (found,) = problem.next_recordings()
    tilts, wobble, beam = (found.effect[name] for name in ("tilt_rms", "wob_c", "astig0"))
    half = len(tilts) // 2
    # A lean of 1 mrad moves a line by some 4 mm; opposite facets that wobble move to opposite sides.
    assert np.median(np.abs(tilts[:64])) > 2.0 and np.allclose(wobble[:64], 0.7 * tilts[:64])
    assert np.allclose(wobble[half : half + 64], -0.7 * tilts[half : half + 64])
    assert not tilts[64:half].any() and np.abs(beam[64:half]).max() > 0
    assert np.linalg.eigvalsh(found.covariance)[0] > 0 and found.covariance.shape == (2 * half, 2 * half)
    already = replace(RECORDING, exposures=(replace(RECORDING.exposures[0], facet=2), *RECORDING.exposures[1:]))
    assert not [c for c in next_recordings.candidates(already) if "gated" in c.what]
