"""The map of irradiance: its light, its noise, its physics, its refusals."""

from dataclasses import replace

import numpy as np
import pytest
from light_settings import bench, world_trace

from benchsim.bench.errors import BenchsimError
from benchsim.bench.place import place
from benchsim.renderer.irradiance import irradiance


def lit_map(recording, **how):
    return irradiance(recording, recording.exposures[0], **({"seed": 1, "rays": 1 << 22} | how))


def small(recording):
    """The same with a board of 120 mm: a small map is quick."""
    return replace(recording, screen=replace(recording.screen, size=(120.0, 120.0), marks=None))


def total(light):
    return light.values.sum() * light.pitch**2


def test_the_board_gets_the_power_that_the_facets_send_it():
    """Rationale: absolute irradiance per laser power, not just its shape.

    Set-up: the power on the board by float64 quadrature over phase and facet, N facets, averaged over a revolution.
    Expectation: 1e-4, limited by the quadrature at the board's edges.
    """
    recording = bench(diffraction=False)
    placement = place(recording.mirror, recording.exposures[0])
    phase = np.linspace(-0.2, 0.2, 4001)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    p, t, h = np.meshgrid(phase, nodes, nodes)
    share = (weights[:, None, None] * weights / 4 * np.ones_like(p)).ravel()
    p, t, h = p.ravel(), t.ravel() * recording.mirror.facet_width / 2, h.ravel() * recording.mirror.height / 2
    y, z, density = world_trace(recording, placement, p, t, h)
    on = (np.abs(y) < 350) & (np.abs(z) < 350)
    area = recording.mirror.facet_width * recording.mirror.height
    expected = (density * share)[on].sum() * area * (phase[1] - phase[0]) / (2 * np.pi) * recording.mirror.facets
    assert total(lit_map(recording)) == pytest.approx(expected, rel=1e-4)


def test_bins_lie_where_they_say():
    """The centroid of a row of the map is where the float64 axis ray crosses it."""
    recording = bench(beam=False)
    light = lit_map(recording)
    placement = place(recording.mirror, recording.exposures[0])
    assert light.y[0] == pytest.approx(-light.y[-1]) and light.z[0] == pytest.approx(-light.z[-1])
    assert light.values.shape == (2800, 2800) and light.y[1] - light.y[0] == pytest.approx(0.25)
    phase = np.linspace(-0.1, 0.1, 20001)
    n = np.cos(phase)[:, None] * placement.normal + np.sin(phase)[:, None] * np.cross(placement.axis, placement.normal)
    d = placement.laser_direction
    s = (recording.mirror.radius - n @ (placement.laser_point - placement.centre)) / (n @ d)
    x = placement.laser_point + s[:, None] * d
    out = d - 2 * (n @ d)[:, None] * n
    board = x - (x[:, :1] / out[:, :1]) * out
    for i in (300, 1400, 2500):
        seen = (light.values[i] @ light.y) / light.values[i].sum()
        assert seen == pytest.approx(np.interp(light.z[i], *board[np.argsort(board[:, 2])][:, [2, 1]].T), abs=2e-3)


def test_a_gated_facet_gives_its_share():
    recording = bench()
    gated = replace(recording, exposures=(replace(recording.exposures[0], facet=3),))
    whole, one = lit_map(recording), lit_map(gated)
    np.testing.assert_allclose(one.values * recording.mirror.facets, whole.values, rtol=1e-3, atol=1e-9)


def test_noise_is_what_it_is_said_to_be():
    """Set-up: sixteen maps of different seeds. Expectation: their scatter is the stated noise.

    The stated noise is itself known from eight replicates a map; its mean over 16 maps and some 9000 correlated bins
    is good to a few per cent, the scatter of 16 maps likewise, so 15 % either way.
    """
    recording = small(bench())
    maps = [lit_map(recording, seed=s, rays=1 << 20) for s in range(16)]
    values = np.stack([m.values for m in maps])
    mean = values.mean(axis=0)
    lit = mean > 0.05 * mean.max()
    seen = np.sqrt(np.mean(values[:, lit].var(axis=0, ddof=1) / mean[lit] ** 2))
    stated = np.sqrt(np.mean([m.relative_error**2 for m in maps]))
    assert seen == pytest.approx(stated, rel=0.15)


def test_the_wanted_noise_is_reached_and_a_seed_repeats():
    recording = small(bench())
    light = lit_map(recording, rays=None, relative_error=0.02)
    assert 0.0 < light.relative_error <= 0.02
    again = lit_map(recording, rays=None, relative_error=0.02)
    np.testing.assert_allclose(again.values, light.values, rtol=1e-4, atol=1e-9)  # atomic sums differ in rounding
    other = lit_map(recording, rays=None, relative_error=0.02, seed=2)
    assert np.abs(other.values - light.values).max() > 1e-4 * light.values.max()


def across(light):
    """Variance of the map along y about the trace, mean over the middle rows [mm²]."""
    rows = light.values[1000:1800]
    y = light.y
    mean = rows @ y / rows.sum(axis=1)
    return np.mean(((y - mean[:, None]) ** 2 * rows).sum(axis=1) / rows.sum(axis=1))


def test_incoherent_divergence_widens_the_trace_by_its_variance():
    """Expectation: variance across grows by (σ × path)²; the blur is round, the path 2.1 m, the trace slanted on the
    board.

    On the board the blur is an ellipse, (σ D)² (1 + g gᵀ), g the ray's slope over the board's normal: what a row of the
    map sees of it is the variance of y − (dy/dz) z.
    """
    recording = bench(diffraction=False)
    blurred = replace(recording, laser=replace(recording.laser, incoherent_divergence=2e-3))
    sharp, wide = lit_map(recording, rays=1 << 24), lit_map(blurred, rays=1 << 24)
    rows = sharp.values[1000:1800]
    centre = rows @ sharp.y / rows.sum(axis=1)
    slope = np.polyfit(sharp.z[1000:1800], centre, 1)[0]
    ray = -np.array(recording.exposures[0].mirror_position)
    distance = np.linalg.norm(ray)
    g = ray[1:] / ray[0]
    ellipse = (2e-3 / 4 * distance) ** 2 * (np.eye(2) + np.outer(g, g))
    probe = np.array([1.0, -slope])
    assert across(wide) - across(sharp) == pytest.approx(probe @ ellipse @ probe, rel=0.05)


@pytest.mark.parametrize("physics", [{"facets": False}, {"facets": False, "beam": False}])
def test_a_cylinder_lights_the_board(physics):
    """The cylinder stands in the beam at all times; its light on the board is of the polygon's order."""
    recording = bench(**physics)
    recording = replace(recording, mirror=replace(recording.mirror, shape="cylinder"))
    light = lit_map(recording)
    assert 0.001 < total(light) < 0.2


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        ({"cantering": {"pyr": 1.5}}, "cantering"),
        ({"canting": {"pry": 1.5}}, "pry"),
        ({"canting": {"pyr": np.nan}}, "finite"),
        ({"facet-tilts": {"tilt_12": 1.0}}, "tilt_12"),
        ({"facet-tilts": {"tilt_rms": 1.0, "tilt_2": 1.0}}, "not both"),
        ({"second-surface": {"glass": -1.0}}, "glass"),
        ({"window": {"win": -1.0}}, "win"),
        ({"plume": {"plume": 1.0, "plume_width": 0.0}}, "plume_width"),
        ({"pivot-offset": {"dr": -17.5}}, "dr"),
    ],
    ids=str,
)
def test_effects_that_cannot_be_drawn_are_refused_by_name(effects, says):
    with pytest.raises(BenchsimError, match=says):
        lit_map(replace(bench(), effects=effects))


@pytest.mark.parametrize(
    "change",
    [
        {"laser_azimuth": np.radians(-60.0), "mirror_position": (-1500.0, -160.0, -1430.0)},
        {"screen_shift": 5000.0},
    ],
    ids=["mirror behind the board", "board behind the mirror"],
)
def test_no_light_is_said(change):
    recording = bench()
    exposure = replace(recording.exposures[0], **change)
    with pytest.raises(BenchsimError, match="reaches the board"):
        irradiance(recording, exposure, seed=1, rays=1 << 18)


def test_a_mirror_that_misses_the_beam_is_said():
    recording = bench()
    placement = place(recording.mirror, recording.exposures[0])
    missed = replace(placement, laser_point=placement.laser_point + np.array([0.0, 60.0, 0.0]))
    with pytest.raises(BenchsimError, match="board"):
        irradiance(recording, recording.exposures[0], placement=missed, seed=1, rays=1 << 18)
