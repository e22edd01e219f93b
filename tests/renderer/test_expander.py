"""The beam expander: Mitsuba's lenses against Snell's law in float64, the table that feeds the emitter, the checks."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Laser, Marks, Mirror, Recording, RenderOptions, Screen, Surface
from benchsim.bench.place import place
from benchsim.renderer.beam_table import BeamTable, axes, onto_disc, polynomial, powers
from benchsim.renderer.expander import (
    INPUT_DIAMETER,
    ExpandedBeam,
    check_against_laser,
    elements,
    expand,
    refract,
    trace,
)
from benchsim.renderer.glass import index
from benchsim.renderer.irradiance import irradiance
from benchsim.renderer.recording import render_recording

study = runpy.run_path(str(Path(__file__).parents[2] / "analysis" / "expander.py"))
galilean, snell = study["galilean"], study["snell"]
WAVELENGTH = 632.8e-6
NONE = (0.0,) * len(powers())


@pytest.mark.parametrize(
    "changes", [{}, {"defocus": -1.0}, {"decentre": 0.5, "tilt": 0.01}], ids=["centred", "defocused", "decentred"]
)
def test_rays_obey_snell_to_a_tenth_of_a_microradian(changes):
    """Expectation: float32 in frames of the surfaces' own is 0.1 µrad and 0.02 µm off, ten times within the bar."""
    rays = trace(galilean(**changes), WAVELENGTH, 61)
    position, slope = snell(galilean(**changes), WAVELENGTH, rays.source)
    assert np.abs(rays.slope - slope).max() < 3e-7
    assert np.abs(rays.position - position).max() < 1e-4
    assert rays.lost == 0


def test_the_table_gives_the_rays_back():
    """Slopes to 0.3 µrad; the density times area is the power of every cell to 0.1 %."""
    expander = galilean(decentre=0.5, tilt=0.01)
    beam, rays = expand(expander, WAVELENGTH), trace(expander, WAVELENGTH)
    weight = rays.power / rays.power.sum()
    position, slope = rays.position - weight @ rays.position, rays.slope - weight @ rays.slope
    waist, curvature = beam.diameter / 2, beam.divergence / beam.diameter
    a, b = (position / (beam.table.reach * waist)).T
    for k, coefficients in enumerate((beam.table.slope_x, beam.table.slope_y)):
        miss = slope[:, k] - curvature * position[:, k] - polynomial(coefficients, a, b)
        assert np.abs(miss).max() < 3e-7
    # The cell of ray (i, j) at the mirror, from its neighbours' positions.
    side = round(np.sqrt(len(rays.source) / np.pi) * 2) + 1
    at = {(round(x * 1e6), round(y * 1e6)): i for i, (x, y) in enumerate(rays.source)}
    step = np.diff(np.unique(np.round(rays.source[:, 0], 9))).min()
    checked = 0
    for i, (x, y) in enumerate(rays.source):
        if np.hypot(x, y) > INPUT_DIAMETER or i % 17:
            continue
        e, w, n, s = (
            rays.position[at[(round((x + p * step) * 1e6), round((y + q * step) * 1e6))]]
            for p, q in ((1, 0), (-1, 0), (0, 1), (0, -1))
        )
        area = abs((e - w)[0] * (n - s)[1] - (e - w)[1] * (n - s)[0]) / 4
        ideal = 2 / (np.pi * waist**2) * np.exp(-2 * (position[i] ** 2).sum() / waist**2)
        density = ideal * np.exp(polynomial(beam.table.log_ratio, a[i : i + 1], b[i : i + 1])[0])
        assert density * area == pytest.approx(weight[i], rel=1e-3)
        checked += 1
    assert checked > 100 and side > 50


def test_the_beam_is_that_of_paraxial_optics():
    """Thick-lens matrices give magnification and curvature to the third order, some 1 % at these apertures."""
    expander = galilean()
    system, before = np.eye(2), 1.0
    for s in expander.surfaces:
        after = index(s.glass, WAVELENGTH)
        bend = np.array([[1, 0], [(before - after) / (s.radius * after), before / after]])
        system = np.array([[1, s.thickness], [0, 1]]) @ bend @ system
        before = after
    beam = expand(expander, WAVELENGTH)
    assert beam.diameter == pytest.approx(INPUT_DIAMETER * system[0, 0], rel=0.01)
    assert beam.divergence == pytest.approx(INPUT_DIAMETER * system[1, 0], rel=0.02)
    assert 0.8 < beam.transmission < (1 - 0.04) ** 4 + 0.01


def test_transmission_is_fresnels():
    """At normal incidence ((n − 1)/(n + 1))² is reflected; a miss transmits nothing."""
    n = 1.6
    position, direction = np.array([[0.0, 0, 0], [0, 4.0, 0]]), np.array([[0.0, 0, 1]] * 2)
    for radius in (20.0, -20.0, float("inf")):
        at, onward, part = refract(Surface(radius, 0.0, "air", 3.0), 1.0, n, position, direction)
        np.testing.assert_allclose(part, [1 - ((n - 1) / (n + 1)) ** 2, 0.0], rtol=1e-6)
        np.testing.assert_allclose(at[0], 0, atol=1e-6)
        np.testing.assert_allclose(onward[0], [0, 0, 1], atol=1e-7)


def test_indices_are_the_catalogues():
    """At 632.8 nm, as refractiveindex.info prints them."""
    for glass, n in {"BK7": 1.5151, "N-BK7": 1.5151, "F2": 1.6166, "N-SF11": 1.7786, "fused-silica": 1.4570}.items():
        assert index(glass, WAVELENGTH) == pytest.approx(n, abs=6e-5)
    assert index("air", WAVELENGTH) == 1 and index("1.7", WAVELENGTH) == 1.7
    with pytest.raises(BenchsimError, match="glass 'BK8' is not known"):
        index("BK8", WAVELENGTH)


def test_a_beam_unlike_the_files_is_told_and_then_refused():
    nothing = BeamTable(2.5, NONE, NONE, NONE)
    beam = ExpandedBeam(10.0, 4e-3, 0.0, 0.9, nothing)
    assert check_against_laser(beam, Laser()) is None
    told = check_against_laser(replace(beam, divergence=4.1e-3), Laser())
    assert told is not None and "4.100 mrad" in told and "+2.5%" in told
    with pytest.raises(BenchsimError, match=r"\[expander\].*\+6\.0%"):
        check_against_laser(replace(beam, diameter=10.6), Laser())
    # Without a stated divergence the diffraction limit, 0.08 mrad, is the measure.
    assert check_against_laser(replace(beam, divergence=1e-6), Laser(divergence=0.0)) is not None


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda s: (*s[:3], replace(s[3], glass="BK7")), r"surfaces\[4\]: the last surface must have \"air\""),
        (lambda s: (replace(s[0], semi_diameter=7.0), *s[1:]), r"surfaces\[1\]: the semi-diameter 7 mm"),
        (lambda s: (*s[:2], replace(s[2], semi_diameter=4.0), s[3]), "misses a lens"),
    ],
)
def test_lenses_that_make_no_sense_are_refused(change, message):
    e = galilean()
    with pytest.raises(BenchsimError, match=message):
        expand(replace(e, surfaces=change(e.surfaces)), WAVELENGTH)


def test_defocus_needs_an_air_gap():
    single = replace(galilean(), surfaces=galilean().surfaces[2:], defocus=1.0)
    assert elements(single.surfaces) == [slice(0, 2)]
    with pytest.raises(BenchsimError, match="no air gap"):
        trace(single, WAVELENGTH)
    with pytest.raises(BenchsimError, match="closes the air gap"):
        trace(galilean(defocus=-200.0), WAVELENGTH)


def test_polynomials_and_disc():
    a, b = np.array([0.3, -0.5]), np.array([0.2, 0.7])
    coefficients = tuple(np.random.default_rng(0).normal(size=len(powers())))
    want = sum(c * a**i * b**j for c, (i, j) in zip(coefficients, powers(), strict=True))
    np.testing.assert_allclose(polynomial(coefficients, a, b), want, rtol=1e-13)
    np.testing.assert_allclose(onto_disc(np.array([3.0, 0.1]), np.array([4.0, 0.2])), [[0.6, 0.1], [0.8, 0.2]])


BENCH = Recording(
    Laser(),
    Mirror(),
    Screen((200.0, 200.0)),
    {},
    (Exposure("A", "s", np.radians(101), np.radians(50), (1500.0, -160.0, -1430.0)),),
    render=RenderOptions(relative_error=0.1),
)


def centres(light, about):
    """Centroid of every row within 6 mm of ``about`` [mm], averaged over stretches of 10 mm."""
    near = np.abs(light.y - about[:, None]) < 6
    rows = (light.values * near @ light.y) / (light.values * near).sum(axis=1)
    return rows[40:-40].reshape(-1, 40).mean(axis=1)


@pytest.mark.parametrize("axis", [0, 1], ids=["x", "y"])
def test_a_constant_slope_is_a_turn_of_the_laser(axis):
    """Rationale: the table's axes and signs, through mirror and diffraction, down to the board.

    Set-up: a table that is nothing but a slope of 0.5 mrad along x or y, against a laser turned by as much.
    Expectation: the traces agree to 0.02 mm, five times the noise, and lie 0.1 mm or more from the unturned one.
    """
    e = BENCH.exposures[0]
    p = place(BENCH.mirror, e)
    slope = 5e-4
    turned = p.laser_direction + slope * axes(p.laser_direction)[axis]
    constant = (slope, *NONE[1:])
    table = BeamTable(2.5, *((constant, NONE) if axis == 0 else (NONE, constant)), NONE)
    options = {"seed": 1, "rays": 1 << 22}
    straight = irradiance(BENCH, e, placement=p, **options)
    about = straight.y[np.argmax(straight.values, axis=1)]
    by_table = irradiance(BENCH, e, placement=p, lenses=table, **options)
    by_laser = irradiance(BENCH, e, placement=replace(p, laser_direction=turned / np.linalg.norm(turned)), **options)
    unturned, one, other = (centres(light, about) for light in (straight, by_table, by_laser))
    assert np.abs(one - other).max() < 0.02
    assert np.abs(one - unturned).min() > 0.1


def test_shape_of_the_beam_scales_the_light():
    """A ratio of 3 everywhere trebles the light; an empty table changes nothing but float32's last bits."""
    e = BENCH.exposures[0]
    options = {"seed": 1, "rays": 1 << 20}
    plain = irradiance(BENCH, e, **options).values.sum()
    empty = irradiance(BENCH, e, lenses=BeamTable(2.5, NONE, NONE, NONE), **options).values.sum()
    threefold = BeamTable(2.5, NONE, NONE, (float(np.log(3)), *NONE[1:]))
    assert empty == pytest.approx(plain, rel=1e-5)
    assert irradiance(BENCH, e, lenses=threefold, **options).values.sum() == pytest.approx(3 * plain, rel=1e-5)


def test_a_bench_with_an_expander_is_rendered_with_its_beam(tmp_path):
    marks = Marks((0,), ((-80.0, 80.0),), (32.0,))
    camera = Camera("A", (160, 120), 500.0, (79.5, 59.5))
    bench = replace(
        BENCH, screen=Screen((200.0, 200.0), 0.8, marks), cameras={"A": camera}, expander=galilean(defocus=-0.1)
    )
    truth = render_recording(bench, tmp_path, setting_errors=False)
    assert truth.beam is not None and truth.laser.beam_diameter == truth.beam.diameter
    assert len(truth.notes) == 1 and "the expander makes a beam of" in truth.notes[0]
    assert "expander" not in (tmp_path / "recording.toml").read_text()
    with pytest.raises(BenchsimError, match=r"\[expander\]"):
        render_recording(replace(bench, expander=galilean(defocus=-2.0)), tmp_path)
