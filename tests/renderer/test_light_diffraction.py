"""The Fresnel pattern that the kernel samples."""

from dataclasses import replace

import numpy as np
import pytest
from light_settings import bench

from benchsim.bench.place import place
from benchsim.rays import irradiance as ray_model
from benchsim.renderer.diffraction import amplitude, bent, pattern
from benchsim.renderer.irradiance import irradiance

NODES, WEIGHTS = np.polynomial.legendre.leggauss(600)


@pytest.mark.parametrize("half", [0.3, 1.0, 4.0])
def test_the_closed_form_is_the_fresnel_integral(half):
    """Against 600-point quadrature of the integral: inside, at the edge, in the shadow, with a tilted amplitude."""
    h = half * NODES
    for nu in (0.4, 1.4):
        for beta in (0.0, 0.15):
            places = np.array([0.0, 0.4, -0.9, 1.0, -1.0, 2.5, -7.0]) * half
            terms = np.exp(-0.03 * h**2 + beta * h + 1j * np.pi * nu * (places[:, None] - h) ** 2)
            expected = np.abs(half * terms @ WEIGHTS)
            got = np.abs(amplitude(places, half, 0.03, np.array(beta), np.array(nu)))
            np.testing.assert_allclose(got, expected, atol=1e-10)


@pytest.mark.parametrize("height", [0.5, 2.0, 10.0])
def test_the_table_keeps_light_and_mean(height):
    """Diffraction moves light apart but neither loses it nor shifts its mean: both equal the geometric ones.

    Expectation: light within 0.1 % (the part beyond the table's reach), mean within 1 µm, over the whole range of ν
    and of the amplitude's tilt β.
    """
    table = pattern(height, 0.03, (1.1, 1.4), (-0.2, 0.2))
    middle = (table.edges[1:] + table.edges[:-1]) / 2
    h = height / 2 * NODES
    for x in (-1.0, -0.3, 0.0, 0.8):
        light = (table.weights @ x ** np.arange(table.weights.shape[2])) / len(middle)
        amplitude2 = np.exp(2 * (-0.03 * h**2 + 0.2 * x * h)) * WEIGHTS / 2
        np.testing.assert_allclose(light.sum(axis=1), amplitude2.sum(), rtol=1e-3)
        mean = (light * middle).sum(axis=1) / light.sum(axis=1)
        np.testing.assert_allclose(mean, (amplitude2 * h).sum() / amplitude2.sum(), atol=1e-3)


def test_a_bent_phase_moves_the_mean_by_ehrenfest_s_theorem():
    """Rationale: a phase 2πγ h³/3 turns the ray from h by γ h²/ν in units of h': the light's mean moves by γ/ν times
    the mean of h² over the mirror's amplitude, whatever diffraction does.

    Expectation: light within 0.2 %, mean within 3 µm at every node of γ; without a bend the quadrature is the closed
    form.
    """
    half, alpha, beta, nu = 1.0, 0.03, np.array([-0.1, 0.0, 0.2]), np.array([1.1, 1.4])
    places = np.linspace(-6.0, 6.0, 25)
    flat = np.abs(bent(places, half, alpha, beta, nu, np.zeros(1)))[:, 0]
    closed = np.abs(amplitude(places, half, alpha, beta[:, None], nu[:, None, None]))
    np.testing.assert_allclose(flat, closed, atol=1e-10)

    table = pattern(2 * half, alpha, (1.1, 1.4), (-0.2, 0.2), gamma_range=(-0.2, 0.4))
    middle = (table.edges[1:] + table.edges[:-1]) / 2
    h = half * NODES
    power = np.exp(-2 * alpha * h**2) * WEIGHTS / 2
    light = table.weights[:, :, 0] / len(middle)  # β = 0
    means = (light * middle).sum(axis=1) / light.sum(axis=1)
    bends = np.tile(table.gamma, len(table.nu)) / np.repeat(table.nu, len(table.gamma))
    np.testing.assert_allclose(light.sum(axis=1), power.sum(), rtol=2e-3)
    np.testing.assert_allclose(means, bends * (power * h**2).sum() / power.sum(), atol=3e-3)
    assert np.ptp(bends) > 0.3


def width(x, light):
    """Full width at half maximum."""
    above = x[light > light.max() / 2]
    return above[-1] - above[0]


def test_the_known_width_head_on():
    """2 mm of mirror, 2 m away, a wavefront of 4 m radius: 1.99 mm at half maximum; geometric optics says 3.0 mm."""
    h = np.linspace(-3, 3, 12001)
    nu = (1 / 4000 + 1 / 2000) / 632.8e-6
    light = np.abs(amplitude(h, 1.0, 0.04, np.array(0.0), np.array(nu))) ** 2
    assert width(1.5 * h, light) == pytest.approx(1.99, abs=0.01)


@pytest.mark.parametrize("diffraction", [True, False])
def test_the_pattern_lands_on_the_board_as_the_ray_model_says(diffraction):
    """Rationale: the virtual height must put the pattern where the Fresnel integral along the real path does.

    Set-up: a board of 60 mm in fine bins, the map cut along y at the middle row against the ray model's irradiance at
    the same points. Expectation: 1 % of the peak; 5 % in geometric optics, for its sharp edges.
    """
    recording = bench(diffraction=diffraction)
    recording = replace(recording, screen=replace(recording.screen, size=(60.0, 60.0), marks=None))
    light = irradiance(recording, recording.exposures[0], seed=4, rays=1 << 24, pitch=0.1)
    row = light.values.shape[0] // 2
    near = np.abs(light.y - np.average(light.y, weights=light.values[row] ** 2)) < 8.0
    points = np.column_stack([light.y[near], np.full(near.sum(), light.z[row])])
    placement = place(recording.mirror, recording.exposures[0])
    expected = ray_model(
        recording.laser, recording.mirror, recording.physics, recording.screen, placement, points, step=0.01
    )
    seen = light.values[row, near]
    tolerance = 0.01 if diffraction else 0.05
    np.testing.assert_allclose(seen, expected, atol=tolerance * expected.max())
    fraction = width(points[:, 0], seen) / 3.7
    assert (fraction < 0.75) == diffraction


def test_diffraction_takes_no_light_off_the_board():
    """Light on the whole board with and without diffraction differs by what is thrown over the edges only."""
    with_, without = (
        irradiance(r, r.exposures[0], seed=2, rays=1 << 22).values.sum() for r in (bench(), bench(diffraction=False))
    )
    assert with_ == pytest.approx(without, rel=1e-3)
