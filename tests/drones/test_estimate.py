"""The estimator: outlier test, coming to rest, and what its uncertainty is worth."""

import math

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.drones.estimate import axis_error, estimate, outliers, sigma_sys, turned
from benchsim.drones.flight import Errors, Sightings, camera_point, fly, pattern, read, seen, stand
from benchsim.drones.heliostat import axes, design_map, four_facets

DESIGN = four_facets()
# fmt: off
ROSNER = [
    -0.25, 0.68, 0.94, 1.15, 1.20, 1.26, 1.26, 1.34, 1.38, 1.43, 1.49, 1.49, 1.55, 1.56, 1.58, 1.65, 1.69, 1.70,
    1.76, 1.77, 1.81, 1.91, 1.94, 1.96, 1.99, 2.06, 2.09, 2.10, 2.14, 2.15, 2.23, 2.24, 2.26, 2.35, 2.37, 2.40,
    2.47, 2.54, 2.62, 2.64, 2.90, 2.92, 2.92, 2.93, 3.21, 3.26, 3.30, 3.59, 3.68, 4.30, 4.64, 5.34, 5.42, 6.01,
]
# fmt: on


def flown(errors, seed=21):
    rng = np.random.default_rng(seed)
    target = camera_point(150e3, 3.7, 0.25)
    flight = fly(target, pattern(target, (2800.0, 2400.0), 400.0), errors, rng)
    h = stand([[5e3, 8e3, 0.0]], DESIGN, target, errors, rng)[0]
    return flight, h, read(seen(h, flight), len(flight.cameras), DESIGN, errors, rng)


def test_outliers_of_rosners_data():
    """NIST/SEMATECH e-Handbook 1.3.5.17.3: of at most ten there are three, though no one of the first two passes."""
    np.testing.assert_array_equal(np.flatnonzero(outliers(ROSNER, 10)), [51, 52, 53])
    assert not outliers(ROSNER, 2).any()


def test_outliers_are_claimed_at_the_stated_rate():
    """2000 normal samples of 60: 5 %, ± 4 sigma (6e-5)."""
    rng = np.random.default_rng(5)
    claimed = sum(outliers(rng.standard_normal(60), 6).any() for _ in range(2000))
    assert abs(claimed - 100) < 4 * math.sqrt(2000 * 0.05 * 0.95)


def test_without_errors_the_axis_is_exact():
    flight, h, sightings = flown(Errors.none())
    p = estimate(sightings, flight.said_cameras, flight.said_lamps, h.said, design_map(DESIGN))
    assert np.abs(axis_error(p, h.mount, h.axis)).max() < 1e-8
    assert p.mount.azimuth == pytest.approx(h.mount.azimuth, abs=1e-8)
    assert p.mount.elevation == pytest.approx(h.mount.elevation, abs=1e-8)


def test_the_angles_come_to_rest_and_false_glints_go():
    """After two turns the mean difference is negligible, as the paper says; false glints are outliers."""
    errors = Errors()
    flight, h, sightings = flown(errors, 22)
    p = estimate(sightings, flight.said_cameras, flight.said_lamps, h.said, h.measured)
    assert np.abs(p.steps[0]).max() > 1e-3 and np.abs(p.steps[2]).max() < 1e-6
    true = seen(h, flight).points
    false = np.array([np.linalg.norm(true - q, axis=1).min() > 120 for q in sightings.points])
    far = false & (np.abs(p.differences).max(axis=1) > 1.5e-3)
    assert far.sum() >= 2 and not p.kept[far].any()
    assert (~p.kept[~false]).mean() < 0.1


def test_turning_the_angles_turns_the_mirror_about_its_own_axes():
    h = flown(Errors.none())[1]
    before, after = axes(h.said)[0], axes(turned(h.said, [1e-5, 2e-5]))[0]
    moved = before.T @ after[:, 2]
    np.testing.assert_allclose(moved[:2], [2e-5, -1e-5], atol=1e-9)


def test_too_few_glints_are_refused():
    flight, h, sightings = flown(Errors.none())
    few = Sightings(sightings.frame[:5], sightings.points[:5])
    with pytest.raises(BenchsimError, match="5 glints"):
        estimate(few, flight.said_cameras, flight.said_lamps, h.said, design_map(DESIGN))


def test_the_papers_sigma_sys():
    """10 mm and 30 mm at 150 m: 0.2 mrad, and with 0.2 mrad of σ_mean 0.3 in total."""
    assert sigma_sys(150e3, [10.0, 30.0]) == pytest.approx(0.21e-3, rel=0.01)
    assert math.hypot(0.2e-3, sigma_sys(150e3, [10.0, 30.0])) == pytest.approx(0.3e-3, abs=0.02e-3)


@pytest.mark.parametrize(("half", "shifts"), [(False, False), (True, True)], ids=["whole", "half"])
def test_falsely_canted_facets_shift_what_is_seen_of_half_the_mirror(half, shifts):
    """Table 1; twelve heliostats. A shift: the errors are beyond twice what σ_mean says."""
    errors, means = [], []
    for seed in range(41, 53):
        flight, h, s = flown(Errors.none(canting=0.4e-3), seed)
        kept = (s.points[:, 0] > 0) | (not half)
        s = Sightings(s.frame[kept], s.points[kept])
        p = estimate(s, flight.said_cameras, flight.said_lamps, h.said, design_map(DESIGN))
        errors.append(axis_error(p, h.mount, h.axis))
        means.append(p.sigma_mean)
    assert (np.mean(np.square(errors)) > 4 * np.mean(np.square(means))) == shifts


def test_glints_that_share_a_frame_are_no_more_than_one_draw():
    """Every glint read twice: σ_mean falls by √2 (1 − 1/n aside), σ_mean by frames stays."""
    flight, h, once = flown(Errors.none(slope=0.7e-3), 24)
    twice = Sightings(np.repeat(once.frame, 2), np.repeat(once.points, 2, axis=0))
    a, b = (
        estimate(s, flight.said_cameras, flight.said_lamps, h.said, design_map(DESIGN), most_outliers=0.0)
        for s in (once, twice)
    )
    np.testing.assert_allclose(b.sigma_mean_frames, a.sigma_mean_frames, rtol=1e-6)
    np.testing.assert_allclose(b.sigma_mean, a.sigma_mean / math.sqrt(2), rtol=0.01)
