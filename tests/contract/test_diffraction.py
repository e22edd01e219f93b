"""Diffraction at the facet's height: `rays` against the Fresnel integral over true path lengths."""

from dataclasses import replace

import numpy as np
import pytest
from first_principles import Tracer, adaptive, tangents
from holding import bench, differences

from benchsim.bench.place import place
from benchsim.rays import irradiance_profiles, predict

both = pytest.mark.parametrize("letter", ["a", "b"])
Q = np.linspace(-6.0, 6.0, 401)


@both
@pytest.mark.parametrize("divergence, height", [(4e-3, 2.0), (1e-3, 1.2)], ids=["stated", "narrow"])
def test_profile(letter, divergence, height):
    """Expects profile, width, peak and light of the Fresnel integral "with the beam's amplitude across the facet",
    within 0.1 % of the peak (`[physics] diffraction = true`)."""
    recording = bench(letter, diffraction=True)
    recording = replace(
        recording,
        laser=replace(recording.laser, divergence=divergence),
        mirror=replace(recording.mirror, height=height),
    )
    exposure = recording.exposures[0]
    placed = place(recording.mirror, exposure)
    curve, light = irradiance_profiles(
        recording.laser, recording.mirror, recording.physics, recording.screen, placed, Q, samples=13
    )
    which = [8]
    expected = Tracer(recording, exposure).fresnel(
        curve.points[which], tangents(curve.points)[which], Q, along=16, across=48
    )
    peak = expected.max()
    assert np.abs(light[which] - expected).max() < 1e-3 * peak
    assert abs(light[which].sum() / expected.sum() - 1.0) < 2e-4
    at = np.broadcast_to(Q, expected.shape)
    middle = (expected * Q).sum() / expected.sum()
    assert abs(middle) < 1e-3
    assert abs(curve.width[8] / adaptive(at - middle, expected)[0] - 1.0) < 2e-3


@both
def test_centre_stays(letter):
    """Expects the centre line of geometric optics: the pattern's mean over symmetric windows is the geometric mean."""
    geometric, wave = bench(letter), bench(letter, diffraction=True)
    curve = predict(wave, wave.exposures[0], samples=49)
    assert np.abs(differences(curve, Tracer(geometric, geometric.exposures[0]))[0]).max() < 1e-3


@both
@pytest.mark.parametrize("share", [0.1, 1.0], ids=["small", "cap"])
def test_amplitude(letter, share):
    """Expects 1 to be the bench with diffraction and a share its mixture of squared widths: "amplitude 0 … 1 … only
    where `[physics]` has it false"."""
    without, whole = bench(letter), bench(letter, diffraction=True)
    exposure = without.exposures[0]
    curve = predict(replace(without, effects={"diffraction": {"fresnel": share}}), exposure, samples=49)
    plain, full = (predict(r, exposure, samples=49) for r in (without, whole))
    expected = (1.0 - share) * plain.width**2 + share * full.width**2
    assert np.abs(curve.width / np.sqrt(expected) - 1.0).max() < 1e-4
    assert np.abs(full.width / plain.width - 1.0).min() > 0.1
    assert np.abs(differences(curve, Tracer(without, exposure))[0]).max() < 1e-3


@pytest.mark.slow
@both
@pytest.mark.parametrize(
    "effects",
    [{"wavefront-curvature": {"curv": 0.4}}, {"beam-offset": {"bu": 1.0, "bv": 3.0}}, {"pivot-offset": {"dr": 5.0}}],
    ids=lambda x: next(iter(x)),
)
def test_width_with_effects(letter, effects):
    """Expects the Fresnel integral's width where the amplitude across the facet is lopsided or the wavefront strongly
    curved, and the geometric mean as the centre."""
    recording = bench(letter, diffraction=True)
    exposure = recording.exposures[0]
    curve = predict(replace(recording, effects=effects), exposure, samples=49)
    flat = {key: value for table in effects.values() for key, value in table.items()}
    q = np.linspace(-9.0, 9.0, 721)
    which = [12, 36]
    profile = Tracer(recording, exposure, effects=flat).fresnel(
        curve.points[which], tangents(curve.points)[which], q, along=24, across=96
    )
    width = adaptive(np.broadcast_to(q, profile.shape), profile)
    assert np.abs(curve.width[which] / width - 1.0).max() < 2e-3
