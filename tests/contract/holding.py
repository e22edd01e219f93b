"""How a realisation is held against first principles: the benches, and what must agree by how much."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from first_principles import Errors, Tracer, adaptive, tangents

from benchsim.bench.files import read
from benchsim.bench.model import Physics
from benchsim.bench.place import SettingErrors
from benchsim.rays import predict

SCENES = Path(__file__).resolve().parents[2] / "scenes"
POSITION = 1e-3  # mm: what the contract's tests allow rays, perpendicular to the trace
LIGHT = 2e-4  # of the light per mm along one trace
WIDTH = 3e-3  # of the adaptive width
STATED = Errors()


def bench(letter, *, facets=True, beam=True, diffraction=False, stands_for="elevation", **exposure):
    """Fig. 7(a) or (b); without facets the mirror is the cylinder of the same diameter."""
    recording = read(SCENES / f"fig7{letter}.toml", images=False)
    return replace(
        recording,
        physics=Physics(facets=facets, beam=beam, diffraction=diffraction),
        mirror=replace(recording.mirror, shape="polygon" if facets else "cylinder", stands_for=stands_for),
        exposures=(replace(recording.exposures[0], **exposure),),
    )


def setting_errors(errors):
    return SettingErrors(
        *(np.array(x, float) for x in (errors.centre, errors.axis, errors.dials, errors.screen, errors.screen_turn))
    )


def differences(curve, tracer, *, every=6, along=16, across=6):
    """Of a predicted curve from first principles: offset [mm], relative light along the trace, relative width."""
    tangent = tangents(curve.points)
    which = slice(2, -2, every)
    offset, light, width = tracer.centre_line(curve.points[which], tangent[which], along=along, across=across)
    ratio = curve.flux[which] / light
    sizes = curve.width[which] / width - 1.0 if tracer.recording.physics.beam else np.zeros_like(width)
    return offset, ratio / ratio.mean() - 1.0, sizes


def hold(recording, effects=None, *, errors=STATED, index=0, noticed=True, width=WIDTH, **nodes):
    """`rays` against first principles for effects {name: {parameter: value}} in one exposure.

    ``noticed``: the same trace without the effects lies outside what is allowed, so that the test could fail.
    """
    effects = effects or {}
    bent = replace(recording, effects=effects)
    exposure = recording.exposures[index]
    curve = predict(bent, exposure, setting_errors(errors), samples=49)
    flat = {key: value for table in effects.values() for key, value in table.items()}
    offset, light, sizes = differences(curve, Tracer(recording, exposure, errors, flat), **nodes)
    assert np.abs(offset).max() < POSITION, f"{1e3 * np.abs(offset).max():.2f} µm off"
    assert np.abs(light).max() < LIGHT
    assert np.abs(sizes).max() < width
    if noticed and (effects or errors != STATED):
        offset, light, sizes = differences(curve, Tracer(recording, exposure), **nodes)
        allowed = 5.0 * np.array([POSITION, LIGHT, width])
        assert (np.array([np.abs(x).max() for x in (offset, light, sizes)]) > allowed).any()


def shaken(tracer, curve, amplitude, every=6):
    """Adaptive width of a trace's profile spread by a Gaussian of rms ``amplitude``, and those of the curve there."""
    which = slice(2, -2, every)
    q, light = tracer.profiles(curve.points[which], tangents(curve.points)[which])
    x, w = np.polynomial.hermite_e.hermegauss(31)
    q, light = (a.swapaxes(0, 1).reshape(a.shape[1], -1) for a in (q, light))
    q = q - ((q * light).sum(1) / light.sum(1))[:, None]
    spread = (q[..., None] + amplitude * x).reshape(len(q), -1)
    return adaptive(spread, (light[..., None] * w).reshape(len(q), -1)), curve.width[which]
