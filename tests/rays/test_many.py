"""Many predictions at once against single ones, and traces from few rays against dense nodes."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import field
from benchsim.bench.model import Physics
from benchsim.bench.settings import from_vector
from benchsim.rays import Case, curve, predict, predict_many, prediction
from benchsim.rays.batch import alike, groups, stacked
from benchsim.rays.bench import Bench
from benchsim.rays.curve import beam_profiles, trace
from benchsim.rays.ghost import ghost_of, ghosts
from benchsim.rays.phases import many_phases, sample_phases
from benchsim.rays.prediction import bench_of

PRIOR = np.array([1.0] * 3 + [1.745e-3] * 4 + [0.2] * 3 + [1e-3] * 3)
CAPS = {
    "pivot-offset": {"dr": 5.0},
    "canting": {"pyr": 10.0},
    "facet-tilts": {"tilt_rms": 1.5},
    "axis-wobble": {"wob_c": 2.0, "wob_s": -1.0},
    "axis-tilt": {"ped_x": 5.0, "ped_y": -5.0},
    "azimuth-offset": {"az_enc": 5.0},
    "second-surface": {"glass": 3.0},
    "facet-curvature": {"fcurv": 0.2},
    "beam-direction": {"saz": 5.0, "sel": 5.0},
    "beam-offset": {"bu": 1.5, "bv": -0.5},
    "wavefront-curvature": {"curv": 0.4},
    "astigmatism": {"astig0": 0.2, "astig45": -0.2},
    "coma": {"coma_u": 0.05, "coma_v": 0.05},
    "window": {"win": 10.0},
    "window-tilt": {"wty": 20.0, "wtz": -10.0},
    "air-gradient": {"air": 200.0, "airh": -200.0},
    "plume": {"plume": 2.0, "plume_y": 10.0, "plume_z": -700.0},
    "screen-distance": {"sx": 20.0},
    "screen-tilt": {"st_y": 20.0, "st_z": -20.0},
    "screen-bow": {"bow_y": 0.2, "bow_z": -0.1},
    "screen-rotation": {"srot": 20.0},
    "drift": {"dry": 1.0, "drz": -1.0},
    "vibration": {"amp": 0.7},
}


def equal(single, many, wide=1e-9):
    """To 1e-9 mm, widths to ``wide``, and as exactly in flux and phase."""
    assert np.abs(single.points - many.points).max() < 1e-9
    assert np.abs(single.width - many.width).max() < wide
    np.testing.assert_allclose(many.flux, single.flux, rtol=1e-9)
    np.testing.assert_allclose(many.phase, single.phase, atol=1e-11)


def cases_of(lab, seed, physics=None, exposure=None, names=tuple(CAPS)):
    """Every effect twice and none ten times, each with its own setting errors; some with a shape and another laser."""
    rng = np.random.default_rng(seed)
    out = []
    for effects in [{}] * 10 + [{n: CAPS[n]} for n in names for _ in range(2)]:
        scale = float(rng.uniform(0.05, 1.0))
        table = {n: {k: scale * v for k, v in t.items()} for n, t in effects.items()}
        recording = lab.bench(table, physics=physics)
        if rng.random() < 0.3:
            recording = replace(recording, laser=replace(recording.laser, beam_diameter=9.8, divergence=4.2e-3))
        shape = (0.02, 0.05, -0.03) if rng.random() < 0.3 else (0.0, 0.0, 0.0)
        out.append(Case(recording, exposure or lab.exposure, from_vector(PRIOR * rng.normal(size=13)), shape))
    return out


@pytest.mark.parametrize("physics", [Physics(), Physics(True, True, False), Physics(False, True, True)])
def test_many_equal_single_ones_with_every_effect(lab, physics, monkeypatch):
    cases = cases_of(lab, 11, physics)
    alone = []
    for module in (curve, prediction):
        monkeypatch.setattr(module, "_or_none", _counted(module._or_none, alone))
    found = predict_many(cases, 32)
    # What is worked out alone would be equal in any case.
    assert not alone
    for case, many in zip(cases, found, strict=True):
        equal(predict(*case[:3], 32, shape=case.shape), many)


@pytest.mark.parametrize("physics", [Physics(), Physics(False, True, True)])
def test_blurs_differ_from_case_to_case(lab, physics):
    """The widest of a company sets the quadrature of diffracted light for all: widths to what that leaves."""
    rng = np.random.default_rng(5)
    cases = [case._replace(blur=0.6 if rng.random() < 0.3 else 0.0) for case in cases_of(lab, 11, physics)]
    for case, many in zip(cases, predict_many(cases, 32), strict=True):
        equal(predict(*case[:3], 32, shape=case.shape, blur=case.blur), many, wide=1e-7)


def test_benches_that_differ_in_what_shifts_the_light_alone(lab):
    """All paths to the board are the same; only places on it differ."""
    late = replace(lab.exposure, time=7200.0)
    cases = [Case(lab.bench({"drift": {"dry": 0.1 * k, "drz": 0.05}}), late) for k in range(1, 4)]
    for case, many in zip(cases, predict_many(cases, 24), strict=True):
        equal(predict(*case[:3], 24), many)


def _counted(function, calls):
    def counting(bench, *a, **k):
        calls.append(bench)
        return function(bench, *a, **k)

    return counting


def test_what_cannot_be_stacked_is_worked_out_alone(lab):
    """Single rays, free fields and gated exposures among plain cases and a mixture of physics."""
    rng = np.random.default_rng(2)
    heights = field([np.linspace(-350, 350, 5)] * 2, 0.2 * rng.normal(size=(1, 5, 5)))
    gated = replace(lab.exposure, facet=3)
    tilted = lab.bench({"axis-wobble": {"wob_c": 1.0}})
    cases = [
        Case(lab.recording, lab.exposure, lab.off),
        Case(lab.bench(physics=lab.pencil), lab.exposure, lab.off),
        Case(lab.bench({"diffraction": {"fresnel": 0.4}}, physics=lab.geometric), lab.exposure, lab.off),
        Case(lab.bench(fields={"height": heights}), lab.exposure, lab.off),
        Case(tilted, gated, lab.off),
        Case(tilted, gated),
        Case(lab.recording, lab.exposure),
    ]
    for case, many in zip(cases, predict_many(cases, 24), strict=True):
        equal(predict(*case[:3], 24), many)


def test_mixtures_of_physics_are_sums_of_their_lights(lab):
    """Scenario: of what the physics leaves out amplitudes mix facets, beam and diffraction, as many together as alone,
    beside plain cases. Flux and squared width of each are those of its lights, each traced by itself, in their
    shares."""
    rng = np.random.default_rng(4)
    amounts = [(0.9, 1.05, 0.4), (1.0, 1.0, 1.0), (0.0, 0.7, 0.0), (0.3, 0.0, 1.0)]
    cases = [Case(lab.bench(physics=lab.pencil), lab.exposure)]
    for facets, beam, fresnel in amounts:
        effects = {"facets": {"facets": facets}, "finite-beam": {"beam": beam}, "diffraction": {"fresnel": fresnel}}
        errors = from_vector(0.3 * PRIOR * rng.normal(size=13))
        cases.append(Case(lab.bench(effects, physics=lab.pencil), lab.exposure, errors, blur=0.2))
    found = predict_many(cases, 32)
    for case, many in zip(cases, found, strict=True):
        equal(predict(*case[:3], 32, blur=case.blur), many, wide=1e-7)
    for case, many, own in zip(cases[1:], found[1:], amounts, strict=True):
        level, squares = 0.0, 0.0
        for corner in np.ndindex(2, 2, 2):
            share = float(np.prod([a if on else 1 - a for a, on in zip(own, corner, strict=True)]))
            light = predict(lab.bench(physics=Physics(*map(bool, corner))), *case[1:3], 32, blur=case.blur)
            level += share * light.flux.mean()
            squares += share * np.interp(0.5, np.linspace(0, 1, 32), light.width) ** 2
        assert many.flux.mean() == pytest.approx(level, rel=2e-3)
        assert np.interp(0.5, np.linspace(0, 1, 32), many.width) ** 2 == pytest.approx(squares, rel=2e-2)


def test_lights_of_a_mixture_may_have_traces_of_different_length(lab):
    """Scenario: the mirror misses a part of one light's beam, whose trace then has fewer points."""
    short, long = predict(lab.recording, lab.exposure, lab.off, 24), predict(lab.recording, lab.exposure, lab.off, 32)
    apart, alike = prediction._mixed([((0.5, 0.5), [long, short]), ((0.5, 0.5), [long, long])], width=True)
    assert np.abs(apart.points - long.points).max() < 1e-3
    np.testing.assert_allclose(alike.points, long.points, atol=1e-9)
    np.testing.assert_allclose(apart.phase, alike.phase, atol=1e-6)


def test_a_mixture_one_of_whose_lights_misses_the_board_is_none(lab):
    below = from_vector(np.array([0.0] * 6 + [-1.5] + [0.0] * 6))
    mixed = lab.bench({"finite-beam": {"beam": 0.5}}, physics=lab.pencil)
    found = predict_many([Case(mixed, lab.exposure, e) for e in (lab.off, below)], 24)
    assert found[0] is not None and found[1] is None
    with pytest.raises(BenchsimError, match="7a: "):
        predict(mixed, lab.exposure, below, 24)


@pytest.mark.parametrize("physics", [Physics(), Physics(False, True, True)])
def test_the_closed_form_says_what_the_rays_of_every_element_say(lab, physics, monkeypatch):
    """Of every effect that it covers, on disturbed settings: `plane` against the same benches without it."""
    cases = cases_of(lab, 17, physics)
    benches = [bench_of(*case) for case in cases]
    closed = [b.frame is not None for b in benches]
    kinds = {name for case, on in zip(cases, closed, strict=True) if on for name in case[0].effects}
    assert {"canting", "facet-tilts", "axis-tilt", "wavefront-curvature", "drift", "beam-offset"} <= kinds
    assert not kinds & {"second-surface", "facet-curvature", "astigmatism", "coma", "window", "plume", "screen-bow"}
    fast = predict_many(cases, 32)
    monkeypatch.setattr(Bench, "frame", None)
    for on, one, other in zip(closed, fast, predict_many(cases, 32), strict=True):
        assert one is not None and other is not None
        if not on:
            continue
        # Differences leave 1e-8 mm in the general rays.
        assert np.abs(one.points - other.points).max() < 5e-8
        assert np.abs(one.width / other.width - 1).max() < 1e-8
        np.testing.assert_allclose(one.flux, other.flux, rtol=1e-8)
        np.testing.assert_allclose(one.phase, other.phase, atol=1e-10)


def test_light_beside_the_board_is_none_and_leaves_the_others_alone(lab):
    far = from_vector(np.array([0.0] * 5 + [0.9, 0.9] + [0.0] * 6))
    below = from_vector(np.array([0.0] * 6 + [-1.5] + [0.0] * 6))
    cases = [Case(lab.recording, lab.exposure, e) for e in (lab.off, far, None, below)]
    found = predict_many(cases, 24, width=False)
    for bad in (1, 3):
        with pytest.raises(BenchsimError):
            predict(*cases[bad][:3], 24)
        assert found[bad] is None
    for good in (0, 2):
        assert np.abs(found[good].points - predict(*cases[good][:3], 24).points).max() < 1e-9
        assert found[good].width is None


def test_effects_that_do_not_exist_are_refused(lab):
    with pytest.raises(BenchsimError, match="no such effect"):
        predict_many([Case(lab.bench({"gremlins": {"n": 1.0}}), lab.exposure)] * 2)


def test_groups_hold_every_case_once_and_only_what_is_alike(lab):
    benches = [bench_of(*case) for case in cases_of(lab, 5)]
    found = groups(benches, 7)
    assert sorted(i for g in found for i in g) == list(range(len(benches)))
    for group in found:
        assert len(group) <= 7 and len({alike(benches[i]) for i in group}) == 1
        assert len(group) == 1 or alike(benches[group[0]]) is not None


def test_phases_of_a_stack_are_those_of_its_members(lab):
    benches = [bench_of(lab.recording, lab.exposure, c[2]) for c in cases_of(lab, 8)[:6]]
    expected = np.stack([sample_phases(b, 20) for b in benches])
    np.testing.assert_allclose(many_phases(stacked(benches), benches, 20), expected, atol=1e-13)


@pytest.mark.parametrize("name", [None, *CAPS])
def test_few_rays_say_what_dense_nodes_say(lab, name):
    """Traces by polynomials against `beam_profiles`, which assumes nothing of the kind, on disturbed settings."""
    rng = np.random.default_rng(3)
    for _ in range(2):
        errors = from_vector(PRIOR * rng.normal(size=13))
        bench = bench_of(lab.bench({name: CAPS[name]} if name else {}), lab.exposure, errors)
        few = trace(bench, 48)
        points, _, nodes = beam_profiles(bench, sample_phases(bench, 48))
        dense = Curve(points)
        distance, s = signed_distance(dense, few.points)
        assert np.abs(distance).max() < 2e-6
        assert np.abs(np.interp(s, dense.arc_length(), nodes.flux) / few.flux - 1)[1:-1].max() < 2e-6


def test_a_ghost_of_few_rays_is_that_of_all_nodes(lab):
    """Of thin and thick glass; asked for together, as the pull on traces needs it, and alone, as a ridge of its own."""
    rng = np.random.default_rng(4)
    benches = [
        bench_of(lab.bench({"second-surface": {"glass": g}}), lab.exposure, from_vector(PRIOR * rng.normal(size=13)))
        for g in (0.2, 1.0, 4.0)
    ]
    for bench, few in zip(benches, ghosts(benches, 48), strict=True):
        dense = ghost_of(bench, 48)
        distance, s = signed_distance(dense, few.points)
        assert np.abs(distance).max() < 2e-6
        assert np.abs(np.interp(s, dense.arc_length(), dense.flux) / few.flux - 1)[1:-1].max() < 2e-6
