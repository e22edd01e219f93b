"""By how much heliostats are to be turned, as detectors say it: applied to the true normals, and against its sigma."""

from datetime import datetime

import numpy as np
import pytest

from benchsim.arrays import Measurement
from benchsim.instruments.mount.records import toward
from benchsim.jobs.detector_station import estimates, watch
from benchsim.plant import days, files
from benchsim.plant.moment import normals

TEXT = """\
format = "benchsim-plant/1"
[site]
latitude_deg = 37.0
longitude_deg = -2.0
time_zone = "Europe/Madrid"
[[receiver]]
name = "receiver"
centre_m = [0.0, 0.0, 40.0]
width_m = 2.0
height_m = 2.0
azimuth_deg = {}
[optics]
slope_mrad = 1.0
reflectance = 0.9
[heliostats]
width_m = 4.0
height_m = 3.0
"""
ARRAY = '[[detector]]\nname = "{}"\nalong = "{}"\noffset_m = 3\nfrom_m = -8\nto_m = 8\npitch_m = 0.35\n'


def angles(vectors):
    """Azimuth from north through east, clockwise from above, and elevation [rad]."""
    return np.arctan2(vectors[:, 0], vectors[:, 1]), np.arcsin(vectors[:, 2])


@pytest.fixture(params=[0, 180], ids=["field-north", "field-south"])
def watched(request, tmp_path):
    """Forty heliostats before arrays that look there, at ten o'clock, with their ideal normals and some errors."""
    rng = np.random.default_rng(71)
    side = 1 if request.param == 0 else -1
    text = TEXT.format(request.param) + ARRAY.format("above", "horizontal") + ARRAY.format("left", "vertical")
    (tmp_path / "plant.toml").write_text(text)
    rows = [
        f"H{k},{e},{side * n},2"
        for k, (e, n) in enumerate((12 * i - 60, 60 + 20 * j) for i in range(8) for j in range(5))
    ]
    (tmp_path / "heliostats.csv").write_text("\n".join(["id,east_m,north_m,up_m", *rows]))
    plant = files.read(tmp_path)
    sun = days.suns([datetime(2026, 6, 21, 10, tzinfo=plant.site.zone)], plant.site)[0]
    errors = {k: 2e-3 * rng.standard_normal(40) for k in ("IA", "IE")}
    w = watch(plant)
    assert len(w.who) == 40
    return w, sun, errors, rng


def told(w, sun, angles, sigma):
    """As `estimates` says it of measured (n, 2) angles with sigmas [rad]."""
    cov = np.diag(np.square(sigma))
    found = [Measurement(k, "measured", a, cov, (), None, 1.0, 1, "") for k, a in enumerate(angles)]
    return estimates(w.scene(sun), list(w.plant.field.ids), found)


def test_the_stated_turn_takes_the_error_away(watched):
    w, sun, errors, _ = watched
    f = w.plant.field
    rows = told(w, sun, w.misaligned(sun, errors), (1e-5, 1e-5))
    azimuth, elevation = angles(normals(f, sun, errors))
    turned = toward(
        azimuth + 1e-3 * np.array([r["turn_azimuth_mrad"] for r in rows]),
        elevation + 1e-3 * np.array([r["raise_mrad"] for r in rows]),
    )
    off = [np.linalg.norm(x - normals(f, sun), axis=1) for x in (turned, normals(f, sun, errors))]
    assert off[0].max() < 2e-5 < 1e-3 < off[1].max()  # the rest is of second order


def test_errors_of_the_turn_are_as_large_as_its_sigma_says(watched):
    """Of 40 heliostats drawn 25 times: each rms of 1000 pulls is beyond these bounds with a chance below 1e-5."""
    w, sun, errors, rng = watched
    truth, sigma = w.misaligned(sun, errors), np.array([1e-4, 2e-4])
    exact = told(w, sun, truth, sigma)
    pulls = []
    for _ in range(25):
        for a, b in zip(told(w, sun, truth + sigma * rng.standard_normal(truth.shape), sigma), exact, strict=True):
            pulls.append([(a[n] - b[n]) / a["sigma_" + n] for n in ("turn_azimuth_mrad", "raise_mrad")])
    assert (np.abs(np.sqrt(np.mean(np.square(pulls), axis=0)) - 1) < 0.1).all()
