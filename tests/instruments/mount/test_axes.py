"""Mounts point where their parts say: TPOINT to first order, the drift model exactly, and joints in their place."""

import numpy as np
import pytest

from benchsim.instruments.mount import axes, sky
from benchsim.instruments.mount.records import UNITS, Actuator, Mount, angles, toward

ARCSEC = UNITS["arcsec"]
TELESCOPE = Mount("az-el", "sky", latitude=np.radians(31.7))


def sky_grid():
    azimuth, elevation = np.meshgrid(np.radians(np.arange(7, 360, 40)), np.radians([15, 35, 55, 75]), indexing="ij")
    return azimuth.ravel(), elevation.ravel()


def shift(**errors):
    """(ΔA, ΔE) [arcsec] of the pointing by errors [arcsec], and (A, E)."""
    azimuth, elevation = sky_grid()
    x = {k: np.full(len(azimuth), v * ARCSEC) for k, v in errors.items()}
    a, e = angles(axes.pointing(TELESCOPE, np.column_stack([azimuth, elevation]), x)[0])
    return np.angle(np.exp(1j * (a - azimuth))) / ARCSEC, (e - elevation) / ARCSEC, azimuth, elevation


TERMS = {
    "IA": lambda a, e: (1 + 0 * a, 0 * a),
    "IE": lambda a, e: (0 * a, 1 + 0 * a),
    "CA": lambda a, e: (1 / np.cos(e), 0 * a),
    "NPAE": lambda a, e: (np.tan(e), 0 * a),
    "AN": lambda a, e: (np.sin(a) * np.tan(e), np.cos(a)),
    "AW": lambda a, e: (-np.cos(a) * np.tan(e), np.sin(a)),
    "TF": lambda a, e: (0 * a, -np.cos(e)),
    "TX": lambda a, e: (0 * a, -1 / np.tan(e)),
}
"""TPOINT's forms for true less raw, azimuth from north through east."""


@pytest.mark.parametrize("term", TERMS)
def test_terms_are_those_of_tpoint(term):
    da, de, a, e = shift(**{term: 2.0})
    want_a, want_e = TERMS[term](a, e)
    # Second order in 2 arcsec is 1e-5 arcsec, times tan E at most 4.
    np.testing.assert_allclose(da, 2 * want_a, atol=3e-4)
    np.testing.assert_allclose(de, 2 * want_e, atol=3e-4)


def test_az_el_is_the_drift_model_of_lara_cerecedo():
    """Eqs (5)-(7), (5) with its sign mended; the paper has x west, y south, z up, β from the zenith, γ from south."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        beta, gamma = rng.uniform(0.2, 1.3), rng.uniform(-2, 2)
        d_beta, d_gamma, xi, epsilon = rng.normal(0, 5e-3, 4)
        kappa = rng.uniform(0, 2 * np.pi)
        b, g = beta + d_beta, gamma + d_gamma
        canted = np.array(
            [
                np.sin(b) * np.sin(g) * np.cos(xi) + np.cos(g) * np.sin(xi),
                np.sin(b) * np.cos(g) * np.cos(xi) - np.sin(g) * np.sin(xi),
                np.cos(b) * np.cos(xi),
            ]
        )
        s, c, sk, ck = np.sin(epsilon), np.cos(epsilon), np.sin(kappa), np.cos(kappa)
        m = np.array(
            [
                [c * sk**2 + ck**2, (c - 1) * ck * sk, s * sk],
                [(c - 1) * ck * sk, c * ck**2 + sk**2, s * ck],
                [-s * sk, -s * ck, c],
            ]
        )
        west, south, up = m @ canted
        reading = np.array([[np.pi + gamma, np.pi / 2 - beta]])
        x = {
            "IA": np.array([d_gamma]),
            "IE": np.array([-d_beta]),
            "CA": np.array([xi]),
            "AN": np.array([epsilon * ck]),
            "AW": np.array([epsilon * sk]),
        }
        normal, _ = axes.pointing(Mount("az-el", "spot"), reading, x)
        np.testing.assert_allclose(normal[0], [-west, -south, up], atol=1e-12)


def east_west(**errors):
    actuators = (
        Actuator(77.4, 335.3, 338.1, 154.1667, 0.039 - np.pi / 2, False),
        Actuator(77.5, 340.8, 319.1, 154.1667, 0.944, True),
    )
    mount = Mount("east-west", "spot", actuators=actuators, joints=np.diag([0.0, 0.0, 0.0]))
    reading = np.array([[24000.0, 52000.0], [16000.0, 70000.0], [41000.0, 53000.0]])
    return axes.pointing(mount, reading, {k: np.full(3, v) for k, v in errors.items()})[0]


def test_a_first_axis_along_east_tilts_about_up_and_north():
    plain = east_west()
    for name, about in (("tilt_u", [0, 0, 1]), ("tilt_n", [0, 1, 0]), ("IE", [1, 0, 0])):
        turned = east_west(**{name: 1e-6})
        np.testing.assert_allclose((turned - plain) / 1e-6, np.cross(about, plain), atol=1e-5)


def test_growing_steps_raise_the_first_axis_and_turn_the_second():
    mirror = Mount(
        "east-west",
        "spot",
        actuators=(
            Actuator(77.4, 335.3, 338.1, 154.1667, 0.039 - np.pi / 2, False),
            Actuator(77.5, 340.8, 319.1, 154.1667, 0.944, True),
        ),
    )
    start = axes.pointing(mirror, np.array([[0.0, 52000.0]]), {})[0][0]
    later = axes.pointing(mirror, np.array([[20000.0, 52000.0]]), {})[0][0]
    # The mirror lies on its back at step 0 and is erected from there: its normal sinks from the zenith to the south.
    assert start[2] > 0.98
    assert later[2] < start[2]
    assert later[1] < start[1]


def test_a_triangle_that_does_not_close_is_not_a_number():
    actuator = Actuator(77.4, 335.3, 338.1, 154.1667, 0.0, False)
    out = axes.actuator_angle(actuator, np.array([0.0, 2e5]), np.zeros(1), np.zeros(1), np.zeros(1))
    assert np.isfinite(out[0])
    assert np.isnan(out[1])


def test_a_clock_turns_the_sun_about_the_pole():
    latitude = np.radians(50.0)
    mount = Mount("az-el", "spot", latitude=latitude)
    noon = toward(np.array([np.pi]), np.array([np.radians(40.0)]))
    hour = sky.seen(mount, noon, {"dt": np.array([3600.0])})
    azimuth, _ = angles(hour)
    assert np.pi < azimuth[0] < 1.4 * np.pi  # an hour later the sun is past south, toward west
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    np.testing.assert_allclose(hour @ pole, noon @ pole, atol=1e-12)
    assert np.degrees(np.arccos(np.clip((hour * noon).sum(), -1, 1))) == pytest.approx(
        2 * np.degrees(np.arcsin(np.sin(np.radians(7.5)) * np.sqrt(1 - (noon[0] @ pole) ** 2))), abs=1e-6
    )


def test_refraction_lifts_the_light():
    low = toward(np.array([2.0]), np.array([np.radians(10.0)]))
    lifted = sky.seen(Mount("az-el", "spot"), low, {"refr": np.ones(1)})
    rise = np.degrees(angles(lifted)[1] - angles(low)[1])[0] * 60
    assert rise == pytest.approx(5.3, abs=0.2)  # arc minutes at 10 deg, any table of refraction
    np.testing.assert_allclose(angles(lifted)[0], angles(low)[0], atol=1e-12)


def test_what_is_carried_stays_attached():
    """The mirror's centre follows the normal at its distance, and turns with a tilted pedestal."""
    mount = Mount("east-west", "spot", joints=np.array([[0, 0, 0], [0, 0, 0], [0, 175.0, 0]]), actuators=())
    mount = Mount(
        "east-west",
        "spot",
        joints=mount.joints,
        actuators=(
            Actuator(77.4, 335.3, 338.1, 154.1667, 0.039 - np.pi / 2, False),
            Actuator(77.5, 340.8, 319.1, 154.1667, 0.944, True),
        ),
    )
    normal, centre = axes.pointing(mount, np.array([[24000.0, 52000.0]]), {"tilt_u": np.array([0.01])})
    np.testing.assert_allclose(centre, 175.0 * normal, atol=1e-9)
