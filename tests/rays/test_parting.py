"""Scenario: two facets of twelve lean apart. Each facet's own trace is predicted as a gated exposure; the ungated one's
parting has to be the flux-weighted mean square distance of those twelve from their mean."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.curve import signed_distance
from benchsim.bench.model import Physics
from benchsim.rays import Case, predict, predict_many

TILTS = {"facet-tilts": {"tilt_1": 2.0, "tilt_4": -1.0}}


@pytest.mark.parametrize("physics", [Physics(), Physics(True, False, False)])
def test_parting_is_that_of_the_gated_traces(lab, physics):
    truth = lab.bench(TILTS, physics=physics)
    whole = predict(truth, lab.exposure, lab.off, 24, width=False)
    inner = slice(4, -4)
    off, light = [], []
    for facet in range(12):
        curve = predict(truth, replace(lab.exposure, facet=facet), lab.off, 96, width=False)
        d, s = signed_distance(curve, whole.points[inner])
        off.append(-d)
        light.append(np.interp(s, curve.arc_length(), curve.flux))
    off, share = np.array(off), np.array(light) / np.sum(light, axis=0)
    mean = (share * off).sum(axis=0)
    assert np.abs(mean).max() < 2e-3
    np.testing.assert_allclose(whole.parting[inner], (share * (off - mean) ** 2).sum(axis=0), rtol=2e-3)


def test_shaking_adds_and_facets_that_agree_add_nothing(lab):
    assert predict(lab.bench({"canting": {"pyr": 2.0}}), lab.exposure, lab.off, 24).parting is None
    shaken = predict(lab.bench({"vibration": {"amp": 0.7}}), lab.exposure, lab.off, 24)
    np.testing.assert_allclose(shaken.parting, 0.7**2)
    both = predict(lab.bench({"vibration": {"amp": 0.7}, **TILTS}), lab.exposure, lab.off, 24)
    alone = predict(lab.bench(TILTS), lab.exposure, lab.off, 24)
    np.testing.assert_allclose(both.parting - alone.parting, 0.7**2, rtol=1e-6)


def test_many_at_once_part_as_one_alone(lab):
    effects = [{"facet-tilts": {"tilt_rms": r}, "vibration": {"amp": 0.1 * r}} for r in (0.5, 1.0, 2.0)]
    cases = [Case(lab.bench(e), lab.exposure, lab.off) for e in effects]
    for curve, case in zip(predict_many(cases, 24), cases, strict=True):
        np.testing.assert_allclose(curve.parting, predict(*case[:3], 24).parting, rtol=1e-9)
