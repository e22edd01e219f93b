"""The measurement's forward model against the vector model and against closed forms."""

import numpy as np
import pytest

from benchsim import arrays
from benchsim.arrays.crossings import RANGE, family, zero
from benchsim.arrays.plant import beam
from benchsim.arrays.response import profile, response, sight
from benchsim.bench.errors import BenchsimError
from benchsim.vector import deviation, positions, project, reflect

BODIES = [(k, kind, (e, f)) for k, kind, e, f in [(0, 0, 0.0, 0.0), (1, 1, 4e-3, -6e-3), (3, 0, -5e-3, 3e-3), (5, 1,
1e-3, 9e-3)]]  # fmt: skip


@pytest.mark.parametrize(("k", "kind", "misalignment"), BODIES)
def test_the_crossing_lies_on_the_vector_models_trace(plant, k, kind, misalignment):
    """Expectation: a point of an array where u vanishes, read off linearly between two detectors (0.2 mm), is met by
    the reflected ray of the stated phase (Eqs (9)–(12)) but for u times the distance; and the trace itself crosses
    there.
    """
    body = arrays.prism(plant, k, kind, misalignment)
    crossed = 0
    for array in range(2):
        on = plant.member == array
        along = plant.along[on]
        place, _ = zero(along, sight(body, plant, plant.detectors[on])[0])
        if not along[0] < place < along[-1]:
            continue
        point = np.zeros((1, 3))
        point[0, 1 + array], point[0, 2 - array] = place, 9000.0
        miss, phase, _, _ = sight(body, plant, point)
        start, normal = positions(body, phase)
        landed, real = project(start, reflect(-plant.source, normal))
        assert real.all() and abs(miss[0]) < 1e-6
        assert np.abs(landed - point[:, 1:]).max() < 3 * abs(miss[0]) * np.linalg.norm(plant.heliostats[k]) + 1e-3
        points, _ = deviation(body, plant.source, np.linspace(phase[0] - 1e-3, phase[0] + 1e-3, 3))
        across = points[:, 1 - array] - 9000.0
        crossing = np.interp(0.0, *(v[np.argsort(across)] for v in (across, points[:, array])))
        assert crossing == pytest.approx(place, abs=5.0)
        crossed += 1
    assert crossed


def test_a_prism_tells_the_other_angle(plant):
    """Closed form: du = 2 φ cos θ / sin α for the other angle, nothing to first order for the prism's own."""
    angle = 1e-5
    for k in range(6):
        for kind in range(2):
            body = arrays.prism(plant, k, kind)
            target = np.zeros((1, 3))
            own, other = (
                sight(arrays.prism(plant, k, kind, angle * np.eye(2)[i]), plant, target)[0]
                - sight(body, plant, target)[0]
                for i in (kind, 1 - kind)
            )
            ray = -plant.heliostats[k] / np.linalg.norm(plant.heliostats[k])
            expected = 2 * angle * (ray @ body.normal) / np.sqrt(1 - (plant.source @ body.axis) ** 2)
            assert abs(other[0]) == pytest.approx(expected, rel=2e-3)
            assert abs(own[0]) < 1e-3 * expected


def test_the_beam_is_the_blurred_sun(assumptions):
    """Its flux is one, and its variance that of the limb-darkened disc plus twice the blur's."""
    b = beam(assumptions)
    theta = np.linspace(0, b.edge, 20001)
    radiance = b.radiance(theta**2)
    step = theta[1]
    assert 2 * np.pi * np.sum(radiance * theta) * step == pytest.approx(1, rel=1e-5)
    rho, u = assumptions.sun_radius, assumptions.limb_darkening
    ring = (np.arange(20000) + 0.5) / 20000
    disc = 1 - u * (1 - np.sqrt(1 - ring**2))
    variance = rho**2 * np.sum(disc * ring**3) / np.sum(disc * ring) + 2 * (2 * assumptions.facet_error) ** 2
    assert 2 * np.pi * np.sum(radiance * theta**3) * step == pytest.approx(variance, rel=1e-4)


def test_the_profile_is_the_beams_chord(plant):
    """Against a plain sum over ψ on the sphere."""
    alpha, u = 1.1, np.array([0.0, 2e-3, -4.5e-3, 6e-3])
    psi = np.linspace(-0.02, 0.02, 200001)
    beta = alpha + u[:, None]
    cosine = np.cos(alpha) * np.cos(beta) + np.sin(alpha) * np.sin(beta) * np.cos(psi)
    plain = np.sum(plant.beam.radiance(2 - 2 * cosine) * np.cos(plant.facets * psi / 2), axis=1) * (psi[1] - psi[0])
    assert np.allclose(profile(alpha, plant)(u), plain, rtol=0, atol=2e-5 * plain.max())


def test_the_family_is_the_exact_response(plant):
    """What the search for light interpolates over ±15 mrad is what the fit computes, up to a factor, within 1e-3."""
    light = family(plant, 2, 0)
    for angle in (-0.8 * RANGE, 0.3 * RANGE):
        exact = response(arrays.prism(plant, 2, 0, (0.0, angle)), plant)
        found = light.template(angle)
        factor = np.vdot(found, exact) / np.vdot(found, found).real
        assert np.abs(factor * found - exact).max() < 1e-3 * np.abs(exact).max()


def test_labels_are_dealt_once_and_far_apart(assumptions):
    for count in (1, 2, 7, 50, 100):
        rates = arrays.plant.labels(count, assumptions)
        assert len(np.unique(rates)) == 2 * count
        assert rates.min() == assumptions.rate_low and rates.max() == assumptions.rate_high
        if count > 5:
            assert np.abs(np.diff(rates, axis=1)).min() > 10


def test_what_cannot_be_is_refused(plant):
    with pytest.raises(BenchsimError, match="horizon"):
        arrays.build(plant.heliostats, (1.0, 0.0, -0.1))
    with pytest.raises(BenchsimError, match="rates: give two"):
        arrays.build(plant.heliostats, plant.source, rates=np.full((6, 2), 90.0))
