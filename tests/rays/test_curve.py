"""The predicted trace: against closed forms and an integral taken another way."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from benchsim.bench.curve import signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import Exposure, Laser, Mirror, Physics, Screen
from benchsim.bench.place import SettingErrors, place
from benchsim.rays import irradiance_profiles, mirror, predict, screen, trace_curve
from benchsim.rays.curve import beam_profiles, sample_phases
from benchsim.rays.profile import adaptive
from benchsim.rays.sweep import Bench

FIG7A = Exposure("A", "7a", np.radians(101.0), np.radians(50.0), (1500.0, -160.0, -1430.0))
FIG7B = Exposure("A", "7b", np.radians(260.0), np.radians(48.0), (1500.0, -450.0, -1430.0))
GEOMETRIC = Physics(True, True, False)
OFF = SettingErrors(np.array([0.7, -0.9, 0.5]), np.array([1e-3, -2e-3]), np.array([-1e-3, 1.5e-3]))


def curve_of(exposure=FIG7A, physics=GEOMETRIC, laser=None, mirror=None, screen=None, errors=None, **more):
    m = mirror or Mirror()
    return trace_curve(laser or Laser(), m, physics, screen or Screen(), place(m, exposure, errors), **more)


def arc_tangents(curve):
    g = np.gradient(curve.points, curve.arc_length(), axis=0)
    return g / np.linalg.norm(g, axis=1, keepdims=True)


@pytest.mark.parametrize("exposure", [FIG7A, FIG7B])
def test_without_beam_and_facets_it_is_the_pencil(exposure):
    """Householder reflection of one direction at P(ε), met with x = 0, written out (Carretero 2019, Eqs (9)-(12))."""
    m = Mirror()
    p = place(m, exposure)
    curve = curve_of(exposure, Physics(False, False, False))
    for (y, z), e in zip(curve.points[::10], curve.phase[::10], strict=True):
        n = np.cos(e) * p.normal + np.sin(e) * np.cross(p.axis, p.normal)
        x = p.centre + m.radius * n
        out = (np.eye(3) - 2 * np.outer(n, n)) @ p.laser_direction
        hit = x - x[0] / out[0] * out
        np.testing.assert_allclose([y, z], hit[1:], atol=1e-10)


def test_single_ray_on_facets_keeps_its_axis_component():
    """A fixed ray on a turning polygon: reflected directions keep their component along the axis."""
    m = Mirror()
    p = place(m, FIG7A)
    curve = curve_of(physics=Physics(True, False, False))
    n = np.cos(curve.phase)[:, None] * p.normal + np.sin(curve.phase)[:, None] * np.cross(p.axis, p.normal)
    path = (m.radius - n @ (p.laser_point - p.centre)) / (n @ p.laser_direction)
    x = p.laser_point + path[:, None] * p.laser_direction
    out = np.concatenate([np.zeros((len(x), 1)), curve.points], axis=1) - x
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    np.testing.assert_allclose(out @ p.axis, p.laser_direction @ p.axis, atol=1e-12)
    # Through P itself at phase 0, where both single rays coincide.
    pencil = curve_of(physics=Physics(False, False, False))
    assert abs(signed_distance(curve, np.zeros((1, 2)))[0][0]) < 1e-6
    assert abs(signed_distance(pencil, np.zeros((1, 2)))[0][0]) < 1e-6


def test_polygon_differs_from_the_cylinder_as_the_design_says():
    """Polygon against cylinder of the same r: about 0.2 mm within ±300 mm of Fig. 7a."""
    polygon, cylinder = (curve_of(physics=Physics(f, False, False), samples=200) for f in (True, False))
    near = cylinder.points[np.abs(cylinder.points).max(axis=1) < 300]
    worst = np.abs(signed_distance(polygon, near)[0]).max()
    assert 0.05 < worst < 0.4


@pytest.mark.parametrize("physics", [Physics(*(bool(i & k) for k in (1, 2, 4))) for i in range(8)])
def test_a_symmetric_bench_draws_a_straight_symmetric_line(physics):
    """Laser, mirror and screen's centre in the plane y = 0, axis along y: the trace is the line y = 0."""
    exposure = Exposure("A", "s", 0.0, np.radians(50.0), (1500.0, 0.0, -1000.0))
    curve = curve_of(exposure, physics)
    assert np.abs(curve.points[:, 0]).max() < 1e-9
    assert np.abs(curve.points[[0, -1], 1]).min() > 345


def test_azimuth_mirror_is_symmetric_in_y():
    exposure = Exposure("A", "s", 0.0, np.radians(50.0), (1500.0, 0.0, -1000.0))
    curve = curve_of(exposure, mirror=Mirror(stands_for="azimuth"))
    np.testing.assert_allclose(curve.points[:, 0], -curve.points[::-1, 0], atol=1e-4)
    mirrored = curve.points * [-1, 1]
    assert np.abs(signed_distance(curve, mirrored)[0]).max() < 1e-7
    np.testing.assert_allclose(curve.flux, curve.flux[::-1], rtol=1e-6)


@pytest.mark.parametrize("physics", [GEOMETRIC, Physics(False, True, False)])
@pytest.mark.parametrize("exposure", [FIG7A, FIG7B])
def test_light_is_conserved(exposure, physics):
    """Flux and centre against an integral that solves for no phase.

    Rationale: what the profiles say in sum must be what the mirror sends. Set-up: the light that arrives, weighted with
    a Gaussian window along the curve, integrated over phase by the trapezoid rule and over the facet by Gauss–Legendre.
    Expectation: ∫ flux g ds to 1e-7; the first moment is −∫ κ flux (rms)² g ds, because an area element off a bent
    curve is (1 − κ q) ds dq.
    """
    bench = Bench(Laser(), Mirror(), physics, Screen(), place(Mirror(), exposure, OFF))
    points, _, nodes = beam_profiles(bench, sample_phases(bench, 160))
    curve = curve_of(exposure, physics, errors=OFF, samples=160)
    assert np.abs(signed_distance(curve, points)[0]).max() < 1e-8
    s = curve.arc_length()
    middle, sigma = 0.5 * s[-1], 50.0

    phase = np.linspace(curve.phase[0], curve.phase[-1], 400)
    v, w = np.polynomial.legendre.leggauss(12)
    facets = physics.facets
    t = v * Mirror().facet_width / 2 if facets else np.zeros(1)
    wt = w * Mirror().facet_width / 2 if facets else np.full(1, Mirror().radius)
    e, tt, hh = np.meshgrid(phase, t, v * Mirror().height / 2, indexing="ij")
    p = bench.placement
    x, normal, _ = mirror.surface(p, bench.radius, 0.0, e, 0.0, tt, hh)
    incoming, _ = bench.beam.light(x)
    board, _ = screen.meet(p, x, mirror.reflect(incoming, normal))
    d = p.laser_direction
    offset = x - p.laser_point
    rho2 = (np.cross(offset, d) ** 2).sum(-1) / (1 + Laser().curvature * (offset @ d)) ** 2
    power = 2 / (np.pi * 25) * np.exp(-2 * rho2 / 25) * -(incoming * normal).sum(-1)
    power = power / (1 + Laser().curvature * (offset @ d)) ** 3 * wt[:, None] * (w * Mirror().height / 2)
    power = power * (phase[1] - phase[0]) * (12 / (2 * np.pi) if facets else 1.0)
    q, foot = signed_distance(curve, board.reshape(-1, 2))
    seen = power.ravel() * np.exp(-0.5 * ((foot - middle) / sigma) ** 2)

    fine = np.linspace(0, s[-1], 4000)
    window = np.exp(-0.5 * ((fine - middle) / sigma) ** 2)
    flux = CubicSpline(s, curve.flux)(fine)
    expected = np.trapezoid(flux * window, fine)
    # Chord length against arc length of the samples: 1e-8 relative here.
    assert seen.sum() == pytest.approx(expected, rel=1e-6)
    bend = CubicSpline(s, curve.points)
    kappa = bend(fine, 1)[:, 0] * bend(fine, 2)[:, 1] - bend(fine, 1)[:, 1] * bend(fine, 2)[:, 0]
    rms2 = CubicSpline(s, nodes.mean(nodes.q**2))(fine)
    first = -np.trapezoid(kappa * flux * rms2 * window, fine)
    assert (seen * q).sum() / expected == pytest.approx(first / expected, abs=2e-7)


def test_converges_with_nodes():
    bench = Bench(Laser(), Mirror(), GEOMETRIC, Screen(), place(Mirror(), FIG7A))
    phase = sample_phases(bench, 40)
    (a, _, na), (b, tangent, nb) = beam_profiles(bench, phase), beam_profiles(bench, phase, 24, 12)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    assert np.abs(((a - b) * left).sum(1)).max() < 1e-7
    np.testing.assert_allclose(na.flux, nb.flux, rtol=1e-6)


def test_is_smooth_in_the_samples_and_in_the_curvature():
    """The centre line does not depend on where it is sampled, and a nearly parallel beam is a parallel one."""
    coarse, fine = curve_of(samples=48), curve_of(samples=131)
    inner = fine.points[3:-3]
    assert np.abs(signed_distance(coarse, inner)[0]).max() < 1e-6
    parallel, nearly = curve_of(laser=Laser(divergence=0.0)), curve_of(laser=Laser(divergence=1e-12))
    np.testing.assert_allclose(parallel.points, nearly.points, atol=1e-9)
    converging = curve_of(laser=Laser(divergence=-2e-3))
    assert converging.width.max() < parallel.width.max() < curve_of().width.max()


def test_small_beam_gives_the_single_ray():
    """A narrow parallel beam on facets follows the ray along the laser's axis; on the cylinder it would not."""
    thin = Laser(beam_diameter=0.4, divergence=0.0)
    beam, ray = curve_of(laser=thin), curve_of(laser=thin, physics=Physics(True, False, False))
    assert np.abs(signed_distance(ray, beam.points)[0]).max() < 1e-3
    np.testing.assert_allclose(beam.flux[20:76], np.interp(beam.phase, ray.phase, ray.flux)[20:76], rtol=2e-3)


def test_gated_facet_gives_its_share():
    whole, gated = curve_of(), curve_of(facet=3)
    np.testing.assert_allclose(gated.points, whole.points, atol=1e-12)
    np.testing.assert_allclose(gated.flux * 12, whole.flux, rtol=1e-10)


def test_adaptive_moments():
    """Exact on a Gaussian; 0.714 b on a box; free of the tails of sinc²."""
    q = np.linspace(-60, 60, 24001)[None]
    centre, width = adaptive(q, np.exp(-0.5 * ((q - 0.3) / 0.8) ** 2))
    assert centre[0] == pytest.approx(0.3, abs=1e-9) and width[0] == pytest.approx(0.8, abs=1e-9)
    _, box = adaptive(q, (np.abs(q) <= 1.5).astype(float))
    assert box[0] == pytest.approx(0.7143 * 1.5, rel=2e-3)
    near, far = (adaptive(q[:, k], np.sinc(q[:, k]) ** 2)[1][0] for k in (slice(8000, 16001), slice(None)))
    assert near == pytest.approx(far, abs=1e-6)


def test_a_moved_board_moves_the_trace_back():
    """Moving the board by δ moves the trace on it by −δ; turning it about x turns the trace back."""
    nominal, delta = curve_of(samples=64), 0.05
    moved = curve_of(samples=64, errors=SettingErrors(screen_position=np.array([0.0, delta, -delta])))
    d, _ = signed_distance(nominal, moved.points[5:-5] + np.array([delta, -delta]))
    np.testing.assert_allclose(d, 0, atol=1e-6)
    turned = curve_of(samples=64, errors=SettingErrors(screen_angle=np.array([1e-3, 0.0, 0.0])))
    c, s = np.cos(1e-3), np.sin(1e-3)
    d, _ = signed_distance(nominal, turned.points[5:-5] @ np.array([[c, -s], [s, c]]).T)
    np.testing.assert_allclose(d, 0, atol=1e-6)


def test_predict_reads_a_bench():
    recording = read(Path(__file__).parents[2] / "scenes" / "fig7a.toml", images=False)
    exposure = recording.exposures[0]
    curve = predict(recording, exposure)
    assert len(curve.points) == 96 and curve.flux.min() > 0 and curve.width.min() > 0
    with pytest.raises(BenchsimError, match="7a: the laser is below the horizon"):
        predict(recording, replace(exposure, laser_elevation=-0.2))


def test_errors_name_what_is_wrong():
    m = Mirror()
    good = place(m, FIG7A)
    args = (Laser(), m, GEOMETRIC, Screen())
    with pytest.raises(BenchsimError, match="behind the mirror"):
        trace_curve(*args, replace(good, normal=-good.normal))
    with pytest.raises(BenchsimError, match="misses the beam"):
        trace_curve(*args, replace(good, centre=good.centre + 60 * good.axis))
    away = place(m, FIG7A, SettingErrors(mirror_axis=np.array([0.0, 0.4])))
    with pytest.raises(BenchsimError, match="beside the board"):
        trace_curve(*args, away)
    with pytest.raises(BenchsimError, match="misses the beam"):
        beside = replace(good, centre=good.centre + 60 * np.cross(good.axis, good.laser_direction))
        trace_curve(Laser(), m, Physics(True, False, False), Screen(), beside)
    with pytest.raises(BenchsimError, match=r"physics\.beam"):
        irradiance_profiles(Laser(), m, Physics(True, False, False), Screen(), good, np.linspace(-5, 5, 11))
