"""Heliostats that drift: the deviated normal against the paper's own equations, alignment, and what a map comes to."""

import math

import numpy as np
import pytest

from benchsim.fluxes.day import (
    Compensation,
    Errors,
    Moment,
    aligned,
    clear_sky,
    deviated_normals,
    flux_at,
    image_centres,
)
from benchsim.fluxes.heliostat import Heliostat, Target, ideal_normal
from benchsim.fluxes.table import sun_at

TARGET = Target((0.0, 0.0, 32_000.0), 8000.0, 8000.0)
PLACE = (60e3, 104e3, 0.0)
SUNS = np.array([sun_at(h) for h in (6.6, 9.0, 12.0, 15.0, 17.5)])


def printed(ideal, e: Errors):
    """Eqs (6) and (7) as printed, in the paper's frame: x west, y south; β from the zenith, γ from south, west > 0."""
    x, y, z = -ideal[0], -ideal[1], ideal[2]
    b, g, xi = math.acos(z) - e.elevation, math.atan2(x, y) + e.azimuth, e.canting
    sb, cb, sg, cg = math.sin(b), math.cos(b), math.sin(g), math.cos(g)
    n = [sb * sg * math.cos(xi) + cg * math.sin(xi), sb * cg * math.cos(xi) - sg * math.sin(xi), cb * math.cos(xi)]
    ce, se, ck, sk = math.cos(e.tilt), math.sin(e.tilt), math.cos(e.toward), math.sin(e.toward)
    m = [
        [ce * sk**2 + ck**2, (ce - 1) * ck * sk, se * sk],
        [(ce - 1) * ck * sk, ce * ck**2 + sk**2, se * ck],
        [-se * sk, -se * ck, ce],
    ]
    west, south, up = np.array(m) @ n
    return np.array([-west, -south, up])


@pytest.mark.parametrize("seed", range(5))
def test_deviated_normals_are_the_papers(seed):
    a, e, c, t, k = np.random.default_rng(seed).normal(0, [0.02, 0.02, 0.02, 0.02, 3])
    errors = Errors(a, e, c, abs(t), k)
    ideal = ideal_normal(PLACE, TARGET.centre, SUNS)
    np.testing.assert_allclose(
        deviated_normals(PLACE, TARGET, SUNS, errors), [printed(n, errors) for n in ideal], atol=1e-12
    )


def test_without_errors_the_image_stays_on_the_centre():
    np.testing.assert_allclose(image_centres(PLACE, TARGET, SUNS, Errors()), 0, atol=1e-6)


def test_a_raised_normal_raises_the_image():
    """By twice the angle times the distance, over the target's obliquity, where sun and target stand in one plane."""
    north = (0.0, 100e3, 0.0)
    noon = sun_at(12.0)[None]
    east, up = image_centres(north, TARGET, noon, Errors(elevation=1e-3))[0]
    distance = math.hypot(100e3, 32e3)
    assert up == pytest.approx(2e-3 * distance / (100e3 / distance), rel=2e-3)
    assert abs(east) < 1e-3


@pytest.mark.parametrize("by", ["aim", "offset"])
def test_what_is_aligned_in_the_morning_drifts_all_the_same(by):
    errors = Errors(1e-3, -2e-3, 1.5e-3, 2e-3, 0.7)
    constant = aligned(PLACE, TARGET, SUNS[0], errors, by)
    path = image_centres(PLACE, TARGET, SUNS, errors, constant)
    np.testing.assert_allclose(path[0], 0, atol=1e-6)
    assert np.linalg.norm(path[-1]) > 100


def test_a_constant_on_the_angles_takes_reference_offsets_altogether():
    errors = Errors(2e-3, -1e-3)
    constant = aligned(PLACE, TARGET, SUNS[0], errors, "offset")
    assert constant.aim == Compensation().aim
    np.testing.assert_allclose(constant.offset, [-2e-3, 1e-3], atol=1e-9)
    np.testing.assert_allclose(image_centres(PLACE, TARGET, SUNS, errors, constant), 0, atol=1e-5)
    shifted = aligned(PLACE, TARGET, SUNS[0], errors, "aim")
    assert np.abs(image_centres(PLACE, TARGET, SUNS, errors, shifted)).max() > 50


def test_what_a_map_comes_to():
    """A turned Gaussian off centre: its peak and centroid between the cells, its spread in closed form."""
    x, z = TARGET.grid(81)
    u, v = x[:, None] - 333.0, z[None, :] + 512.0
    values = 7.0 * np.exp(-(u**2 + v**2 + 0.8 * u * v) / 2 / 500**2)
    m = Moment(values, TARGET)
    np.testing.assert_allclose(m.brightest, [333, -512], atol=1.0)
    np.testing.assert_allclose(m.centroid, [333, -512], atol=0.1)
    assert m.peak == pytest.approx(7.0, rel=5e-3)
    integral = 7.0 * 2 * math.pi * 500**2 / math.sqrt(1 - 0.4**2)
    assert m.average == pytest.approx(integral / 64e6, rel=1e-6)
    square = 49.0 * math.pi * 500**2 / math.sqrt(1 - 0.4**2) / 64e6
    assert m.unevenness == pytest.approx(math.sqrt(square / m.average**2 - 1), rel=1e-6)


def test_heliostats_add_up_and_drift_lowers_their_peak():
    helios = [Heliostat((s * 60e3, 104e3, 0.0), 6000.0, 6000.0, 2.5e-3, 1e-3) for s in (-1, 1)]
    sun = SUNS[2]
    ideal = [deviated_normals(h.position, TARGET, sun, Errors())[0] for h in helios]
    both = flux_at(helios, TARGET, sun, ideal, 900.0)
    alone = [flux_at([h], TARGET, sun, [n], 900.0) for h, n in zip(helios, ideal, strict=True)]
    np.testing.assert_allclose(both.values, alone[0].values + alone[1].values)
    np.testing.assert_allclose(both.brightest, 0, atol=1)
    apart = [deviated_normals(helios[0].position, TARGET, sun, Errors(azimuth=16e-3))[0], ideal[1]]
    drifted = flux_at(helios, TARGET, sun, apart, 900.0)
    assert drifted.peak < 0.7 * both.peak
    assert np.linalg.norm(drifted.centroid - drifted.brightest) > 300, "two spots: the centroid lies between"


def test_the_clear_sky_is_brighter_at_noon_than_in_the_morning():
    dni = clear_sky(SUNS)
    assert dni.argmax() == 2
    assert 900 < dni[2] < 1100 and 300 < dni[0] < 800
