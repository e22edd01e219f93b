"""The bench on which effects are tried: Fig. 7a with setting errors, and how far one trace lies from another."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchsim.bench.curve import signed_distance
from benchsim.bench.files import read
from benchsim.bench.model import Physics
from benchsim.bench.place import SettingErrors, place
from benchsim.rays import predict

RECORDING = read(Path(__file__).parents[2] / "scenes" / "fig7a.toml", images=False)
EXPOSURE = RECORDING.exposures[0]
OFF = SettingErrors(np.array([0.7, -0.9, 0.5]), np.array([1e-3, -2e-3]), np.array([-1e-3, 1.5e-3]))
PENCIL = Physics(False, False, False)
GEOMETRIC = Physics(True, True, False)


def bench(effects=None, fields=None, physics=None, **more):
    return replace(RECORDING, effects=effects or {}, fields=fields or {}, physics=physics or Physics(), **more)


def trace(effects=None, fields=None, physics=None, *, exposure=EXPOSURE, samples=24, errors=OFF, **more):
    return predict(bench(effects, fields, physics), exposure, errors, samples, **more)


def apart(curve, other, inner=20.0):
    """Distances [mm] of the other curve's points from the curve, its ends left out, with their places along it."""
    d, s = signed_distance(curve, other.points)
    keep = (s > inner) & (s < curve.arc_length()[-1] - inner)
    return d[keep], s[keep]


def same(a, b, atol):
    """Points, width, flux and phase agree."""
    np.testing.assert_allclose(a.points, b.points, atol=atol)
    np.testing.assert_allclose(a.width, b.width, atol=atol)
    np.testing.assert_allclose(a.flux, b.flux, rtol=max(atol, 1e-12))
    np.testing.assert_allclose(a.phase, b.phase, atol=max(atol, 1e-12))


@pytest.fixture
def lab():
    """The bench and the functions above, for the tests of effects."""
    return SimpleNamespace(
        recording=RECORDING,
        exposure=EXPOSURE,
        off=OFF,
        pencil=PENCIL,
        geometric=GEOMETRIC,
        placement=place(RECORDING.mirror, EXPOSURE, OFF),
        bench=bench,
        trace=trace,
        apart=apart,
        same=same,
    )
