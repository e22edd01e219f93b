"""Photographs against the same exposures rendered again, in units of the photographs' noise."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from benchsim.bench.files import read
from benchsim.instruments.bench import observables, problem
from benchsim.instruments.bench.probable import probable
from benchsim.jobs import comparing

CLEAN = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "bench-other-code" / "clean-f7"


@pytest.fixture(scope="module")
def clean():
    if not CLEAN.exists():
        pytest.skip("../shared/recordings/bench-other-code is not there")
    recording = read(CLEAN, images=True)
    observed, _ = observables.observe(recording)
    built = problem.build(recording, observed)
    return recording, built, probable(built, built.nuisances, {})


def test_a_photograph_of_other_code_is_rendered_to_its_noise(clean, tmp_path):
    """Rationale: with nothing missing, photograph less render is noise (the bar: z of 0.9 … 1.15).

    Set-up: geometric optics, settings fitted to the trace; before: the bow of a twentieth of its cap that is not there,
    settings fitted with it. Expectation: after within the bar, before larger.
    """
    recording, built, values = clean
    wrong = probable(built, built.nuisances, {"bow_y": 0.01, "bow_z": -0.01})
    done = comparing.compare(recording, built, [wrong] * 2, [values] * 2, blocks=[0])
    (found,) = done.exposures
    assert found.noise_std == pytest.approx(1, abs=0.05)
    assert 0.9 < found.after.z_std < 1.15
    assert found.before.z_std > found.after.z_std + 0.1
    assert found.pixels > 5000 and 0.3 < found.after.blur < 1.0
    assert done.pooled("after") == pytest.approx(found.after.z_std)
    comparing.draw(done, tmp_path / "pixels.png", "clean")
    assert cv2.imread(str(tmp_path / "pixels.png")).shape[1] > 500


def test_a_mirror_moved_in_the_beam_keeps_its_centre_line(clean):
    """The other errors follow: the centre line stays within half of its sigma, unlike that of the mirror alone."""
    _, built, values = clean
    rows = built.kind[built.rows(0)] == "c"
    sigma = np.sqrt(np.diag(built.covariance[0]))[rows]

    def off(v):
        return float(np.sqrt(np.mean(((built.predict(v, 0) - built.predict(values, 0))[rows] / sigma) ** 2)))

    there = comparing.moved(built, 0, values, 0.5)
    position = [f"s1.mirror_position_{k}" for k in "xyz"]
    step = np.array([there[k] - values.get(k, 0.0) for k in position])
    assert np.linalg.norm(step) == pytest.approx(0.5)
    assert off(there) < 0.5 < 5 < off({**values, **{k: there[k] for k in position}})
