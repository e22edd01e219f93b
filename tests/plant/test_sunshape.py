"""The sun's shape as a sum of Gaussians, against its own closed forms."""

import numpy as np
import pytest

from benchsim.plant import sunshape


@pytest.mark.parametrize("shape", [sunshape.pillbox(), sunshape.buie(0.05), sunshape.buie(0.2)], ids=lambda s: s.name)
@pytest.mark.parametrize(("blur", "within"), [(1.5e-3, 0.007), (2e-3, 0.003), (3e-3, 0.003), (5e-3, 0.003)])
def test_gaussians_that_stand_for_a_sun_have_its_centre_once_mirrors_blur_it(shape, blur, within):
    """At the centre a shape that a Gaussian blurs has the mean of that Gaussian over its own light; of a disc of half
    angle R that is (1 − exp(−R²/2σ²))/(π R²)."""
    angle = np.unique(np.r_[shape.angle, np.linspace(0, shape.angle[-1], 20001)])
    light = np.interp(angle, shape.angle, shape.radiance) * angle
    true = np.trapezoid(light * np.exp(-0.5 * (angle / blur) ** 2), angle) / np.trapezoid(light, angle)
    true /= 2 * np.pi * blur**2
    if shape.name == "pillbox":
        half = shape.angle[-1]
        assert true == pytest.approx(-np.expm1(-0.5 * (half / blur) ** 2) / (np.pi * half**2), rel=1e-6)
    weight, sigma = shape.gaussians
    assert weight.sum() == pytest.approx(1)
    assert (weight / (2 * np.pi * (sigma**2 + blur**2))).sum() == pytest.approx(true, rel=within)


@pytest.mark.parametrize("shape", [sunshape.pillbox(), sunshape.buie(0.05), sunshape.buie(0.2)], ids=lambda s: s.name)
def test_gaussians_that_stand_for_a_sun_spill_as_much_light(shape):
    at = np.array([6, 8, 10, 15, 20, 30]) * 1e-3
    angle = np.unique(np.r_[shape.angle, np.linspace(0, max(shape.angle[-1], 0.05), 20001)])
    light = np.where(angle <= shape.angle[-1], np.interp(angle, shape.angle, shape.radiance), 0.0) * angle
    within = np.r_[0.0, np.cumsum(np.diff(angle) * (light[1:] + light[:-1]) / 2)]
    weight, sigma = shape.gaussians
    found = -weight @ np.expm1(-0.5 * (at / sigma[:, None]) ** 2)
    assert found == pytest.approx(np.interp(at, angle, within / within[-1]), abs=0.01)
