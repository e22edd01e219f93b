"""The bench without effects, as the contract states it: aim, setting errors, re-seating, gate, `[physics]`."""

from dataclasses import replace

import numpy as np
import pytest
from first_principles import Errors, Tracer, adaptive, tangents, turn, unit
from holding import bench, differences, hold, setting_errors

from benchsim.bench.curve import signed_distance
from benchsim.bench.place import place
from benchsim.rays import predict

both = pytest.mark.parametrize("letter", ["a", "b"])


@both
@pytest.mark.parametrize("facets", [True, False], ids=["polygon", "cylinder"])
@pytest.mark.parametrize("beam", [True, False], ids=["beam", "ray"])
@pytest.mark.parametrize("stands_for", ["elevation", "azimuth"])
def test_stated_bench(letter, facets, beam, stands_for):
    """Expects the trace of every `[physics]` within 1 µm: "`beam = false`: a single ray; with facets it is fixed along
    the laser's axis, without facets it is the pencil's ray through P(ε)"; "`beam = true, facets = false`: that pencil
    weighted with the beam's density at P(ε), widened by its local direction and height"; axis z × n or n × (z × n)."""
    hold(bench(letter, facets=facets, beam=beam, stands_for=stands_for))


@both
def test_aim(letter):
    """Expects the axis' ray, at phase 0, on the screen's centre: "n = n(0,0) bisects the direction to the source and
    that from P = C + r·n to the screen's centre, iterated to convergence (Eq. (17))"; "bisecting at C instead turns the
    axis 2-3 mrad"."""
    tracer = Tracer(bench(letter), bench(letter).exposures[0])
    centre, place_ = tracer.single(np.zeros(1))
    assert np.abs(centre).max() < 1e-9
    assert np.abs(np.array(place_)).max() < 1e-9
    curve = predict(bench(letter, beam=False), bench(letter, beam=False).exposures[0], samples=401)
    assert (
        np.linalg.norm(curve.points, axis=1).min() < 0.5 * np.linalg.norm(np.diff(curve.points, axis=0), axis=1).max()
    )
    at_c = unit(np.cross([0.0, 0.0, 1.0], -tracer.d - unit(tracer.centre)))
    assert 1.5e-3 < np.arccos(at_c @ tracer.axis) < 3.5e-3


KINDS = {
    "centre-x": Errors(centre=(2.0, 0.0, 0.0)),
    "centre-y": Errors(centre=(0.0, -2.0, 0.0)),
    "centre-z": Errors(centre=(0.0, 0.0, 2.0)),
    "axis-about-n": Errors(axis=(4e-3, 0.0)),
    "axis-about-n-cross-axis": Errors(axis=(0.0, -4e-3)),
    "azimuth-dial": Errors(dials=(4e-3, 0.0)),
    "elevation-dial": Errors(dials=(0.0, -4e-3)),
    "screen-position": Errors(screen=(0.5, -0.4, 0.3)),
    "screen-about-x": Errors(screen_turn=(3e-3, 0.0, 0.0)),
    "screen-about-y": Errors(screen_turn=(0.0, 3e-3, 0.0)),
    "screen-about-z": Errors(screen_turn=(0.0, 0.0, -3e-3)),
    "all": Errors((1.0, -2.0, 1.5), (2e-3, -3e-3), (3e-3, -2e-3), (0.3, 0.2, -0.4), (1e-3, -2e-3, 2e-3)),
}


@both
@pytest.mark.parametrize("facets", [True, False], ids=["polygon", "cylinder"])
@pytest.mark.parametrize("kind", KINDS)
def test_setting_errors(letter, facets, kind):
    """Expects every setting error within 1 µm: "C in x, y, z; the axis about n and about n × axis; the laser's azimuth
    and elevation dials"; "the laser's axis is aimed at that nominal P once; setting errors and effects do not re-aim
    it"; re-seating "x, y and z each", "about x, y and z each"."""
    hold(bench(letter, facets=facets), errors=KINDS[kind])


@both
@pytest.mark.parametrize("shift, roll", [(100.0, 0.0), (0.0, np.pi), (-50.0, 0.5 * np.pi)])
def test_known_shift_and_roll(letter, shift, roll):
    """Expects the trace on the moved board within 1 µm: `screen_shift_mm` "known, along x", `screen_roll_deg` "known,
    right-handed about +x", re-seating errors on top."""
    moved = bench(letter, screen_shift=shift, screen_roll=roll)
    hold(moved)
    hold(moved, errors=KINDS["all"])


@both
def test_roll_turns_coordinates(letter):
    """Expects a board rolled by +90° about +x to read a point at world (y, z) as (z, −y)."""
    exposure = bench(letter, screen_roll=0.5 * np.pi).exposures[0]
    at = place(bench(letter).mirror, exposure, setting_errors(Errors())).screen_rotation
    assert np.allclose(at, turn([0.5 * np.pi, 0.0, 0.0]), atol=1e-12)
    assert np.allclose(at.T @ [0.0, 3.0, 5.0], [0.0, 5.0, -3.0], atol=1e-9)


@both
@pytest.mark.parametrize("facet", [0, 5, 7])
def test_gated_facet(letter, facet):
    """Expects the line of the one facet: "exposure gated to one facet"; "facet k's normal is at 2πk/facets from facet
    0's", which the wobble's phase shows."""
    gated = bench(letter, facet=facet)
    hold(gated, {"axis-wobble": {"wob_c": 2.0, "wob_s": -1.0}}, noticed=facet != 5)
    hold(gated, {"facet-tilts": {"tilt_0": 3.0, "tilt_5": -2.0, "tilt_1": -1.0}}, noticed=False)


@both
@pytest.mark.parametrize("shape", [(0.04, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, -0.1)], ids=["c4", "e+", "ex"])
def test_true_profile(letter, shape):
    """Expects the density times "exp(c4 (q² − 2 q) + (e₊ (u² − v²) + 2 e× u v)/w²), q = 2 (u² + v²)/w²"."""
    recording = bench(letter)
    exposure = recording.exposures[0]
    curve = predict(recording, exposure, samples=49, shape=shape)
    offset, light, width = differences(curve, Tracer(recording, exposure, shape=shape))
    assert np.abs(offset).max() < 1e-3
    assert np.abs(light).max() < 2e-4
    assert np.abs(width).max() < 3e-3
    plain = differences(curve, Tracer(recording, exposure))
    assert max(np.abs(plain[0]).max() / 1e-3, np.abs(plain[1]).max() / 2e-4) > 3.0


@both
@pytest.mark.parametrize(
    "angle",
    [
        pytest.param(1e-3, id="1-mrad", marks=pytest.mark.slow),
        pytest.param(4e-3, id="4-mrad"),
        pytest.param(
            6e-3,
            id="6-mrad",
            marks=[
                pytest.mark.slow,
                pytest.mark.xfail(strict=True, reason="the blur's second order moves the mean 1.6 µm, left out"),
            ],
        ),
    ],
)
def test_incoherent_divergence(letter, angle):
    """Expects every ray spread by a Gaussian of rms angle/4 along u and v: "full 1/e² angle of a blur that is the same
    at every point of the beam"."""
    recording = bench(letter)
    recording = replace(recording, laser=replace(recording.laser, incoherent_divergence=angle))
    exposure = recording.exposures[0]
    curve = predict(recording, exposure, samples=49)
    points, tangent = curve.points[4:-4:10], tangents(curve.points)[4:-4:10]
    x, w = np.polynomial.hermite_e.hermegauss(9)
    x, w = 0.25 * angle * x, w / w.sum()
    parts = []
    for a, wa in zip(x, w, strict=True):
        for b, wb in zip(x, w, strict=True):
            q, light = Tracer(recording, exposure, tip=(a, b)).profiles(points, tangent, along=12, across=6)
            parts.append((q[0].reshape(len(points), -1), wa * wb * light[0].reshape(len(points), -1)))
    q, light = (np.concatenate(x, axis=1) for x in zip(*parts, strict=True))
    mean = (q * light).sum(1) / light.sum(1)
    assert np.abs(mean).max() < 1e-3
    assert np.abs(curve.width[4:-4:10] / adaptive(q - mean[:, None], light) - 1.0).max() < 3e-3


@both
@pytest.mark.parametrize("name, key", [("facets", "facets"), ("finite-beam", "beam")])
def test_amplitudes_of_left_out_physics(letter, name, key):
    """Expects amplitude 1 to be the bench with that physics, and 1/2 half way: "amplitude 0 … 1 … only where
    `[physics]` has it false"; "`facets = false`: a cylinder of the same r"."""
    full = bench(letter)
    lacking = replace(full, physics=replace(full.physics, **{key: False}))
    exposure = lacking.exposures[0]
    plain, whole = predict(lacking, exposure, samples=49), predict(full, exposure, samples=49)
    for amount in (0.5, 1.0):
        curve = predict(replace(lacking, effects={name: {key: amount}}), exposure, samples=49)
        to_whole, _ = signed_distance(whole, curve.points[2:-2])
        to_plain, _ = signed_distance(plain, curve.points[2:-2])
        assert np.abs((1.0 - amount) * to_plain + amount * to_whole).max() < 1e-3
    assert np.abs(differences(curve, Tracer(full, exposure))[0]).max() < 1e-3
    assert np.abs(differences(plain, Tracer(lacking, exposure))[0]).max() < 1e-3
