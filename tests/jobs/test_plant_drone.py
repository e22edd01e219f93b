"""``benchsim drone``: planned, flown virtually, and pictures with EXIF GPS read back by the command alone."""

import csv
import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import stats
from typer.testing import CliRunner

import benchsim as bs
from benchsim.bench.errors import BenchsimError
from benchsim.cli import app
from benchsim.drones.estimate import FEWEST
from benchsim.drones.flight import fly, seen, stand
from benchsim.jobs import drone_photos
from benchsim.jobs.drone_cluster import ENU, clusters
from benchsim.plant import files

TEXT = """\
format = "benchsim-plant/1"
title = "Three"
[site]
latitude_deg = 37.0
longitude_deg = -2.0
elevation_m = 500.0
[[receiver]]
name = "receiver"
centre_m = [0.0, 0.0, 40.0]
width_m = 6.0
height_m = 6.0
[optics]
slope_mrad = 0.7
reflectance = 0.9
[heliostats]
width_m = 3.22
height_m = 2.56
facets = [2, 2]
[errors]
IA_sigma_mrad = 1.0
IE_sigma_mrad = 1.0
[drone]
pitch_m = 0.7
"""
PLACES = ((-8, 150), (0, 155), (9, 150))
SHIPPED = Path(__file__).resolve().parents[2] / "scenes" / "plants"


def run(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.fixture
def plant(tmp_path):
    folder = tmp_path / "plant"
    folder.mkdir()
    (folder / "plant.toml").write_text(TEXT)
    rows = [f"H{k},{e},{n},2" for k, (e, n) in enumerate(PLACES, 1)]
    (folder / "heliostats.csv").write_text("\n".join(["id,east_m,north_m,up_m", *rows]))
    return folder


def rational(value, digits):
    return (round(value * 10**digits), 10**digits)


def tagged(latitude, longitude, height):
    """EXIF with a place, as a drone with RTK writes it: to 1e-6 of an arc second, and to a millimetre."""
    exif, place = Image.Exif(), {}
    for tag, value, words in ((1, latitude, "NS"), (3, longitude, "EW")):
        d, rest = divmod(abs(value), 1)
        m, rest = divmod(60 * rest, 1)
        place[tag] = words[int(value < 0)]
        place[tag + 1] = (d, m, Fraction6(60 * rest))
    place[5], place[6] = b"\0", Fraction6(height)
    exif[0x8825] = place
    return exif


def Fraction6(value):
    from PIL.TiffImagePlugin import IFDRational

    return IFDRational(*rational(value, 6))


def camera_file(path, resolution, focal):
    """As `benchsim calibrate` writes it."""
    from benchsim.bench.model import Camera
    from benchsim.calibration.record import write_camera

    middle = tuple((n - 1) / 2 for n in resolution)
    camera = Camera("A", resolution, focal, middle, bit_depth=8, gamma="srgb", saturation_level=255.0)
    write_camera(path, camera, (1e-4, 0.1, 1e-3), 1e-4 * np.eye(8), photographs=12, marks=300, rms=0.05, board="m.csv")


def test_a_flight_is_planned_and_flown(plant, tmp_path):
    file = plant / "plant.toml"
    file.write_text(file.read_text().replace("pitch_m = 0.7", "pitch_m = 0.45"))
    done = run("drone", plant, "--fly", "--seed", 2, "-o", tmp_path / "o")
    assert done.exit_code == 0 and "flown virtually, seed 2" in done.output, done.output
    plain = json.loads((tmp_path / "o" / "drone.json").read_text())
    rows = list(csv.DictReader((tmp_path / "o" / "heliostats.csv").open()))
    assert plain["flown"]["estimated"] == len(rows) == 3
    # Six angles: an rms beyond 2.2 of the stated sigma has a chance below 1e-4.
    assert plain["flown"]["pulls_rms"] < 2.2
    flown, expected = (sum(float(r[k]) for r in rows) for k in ("flown_glints", "glints"))
    assert flown == pytest.approx(expected, rel=0.4)  # some 80 of them, in bunches
    points = list(csv.DictReader((tmp_path / "o" / "waypoints.csv").open()))
    assert len(points) == plain["pictures"]
    line = ET.parse(tmp_path / "o" / "flight.kml").find(".//{*}coordinates").text.split()
    assert len(line) == len(points) and line[0].startswith(points[0]["longitude_deg"].lstrip("'"))


def test_both_axes_carry_their_own_sigma_and_few_glints_are_told(plant):
    result = bs.drone(plant, virtual=True, seed=2)
    f = result.flown[0]
    row = f.row()
    assert [row[f"flown_sigma_{a}_mrad"] for a in "xy"] == pytest.approx((1e3 * f.sigma).tolist())
    assert row["error_x_mrad"] / row["flown_sigma_x_mrad"] == pytest.approx(f.pull[0]) and f.sigma[0] != f.sigma[1]
    few = sum(r["glints"] < 2 * FEWEST for r in result.rows())
    who = "1 heliostat shows" if few == 1 else f"{few} heliostats show"
    assert few and f"  {who} fewer than {2 * FEWEST} glints; make drone.pitch_m smaller" in result.text()


def test_a_sigma_of_zero_is_kept_where_it_is_stated(plant):
    file = plant / "plant.toml"
    text = file.read_text()
    assert clusters(files.read(plant))[0].tracking > 0 and clusters(files.read(plant))[0].tilt == 2e-3
    file.write_text(
        text.replace("_sigma_mrad = 1.0", "_sigma_mrad = 0").replace("[drone]", "AN_sigma_mrad = 0\n[drone]")
    )
    c = clusters(files.read(plant))[0]
    assert c.tracking == c.tilt == 0.0


def test_waypoints_are_where_the_camera_point_is(plant):
    c = clusters(files.read(plant))[0]
    points = c.route[0][::7]
    np.testing.assert_allclose(c.local(c.geographic(points)), points, atol=0.01)
    toward = c.target @ ENU
    assert np.linalg.norm(c.target) == pytest.approx(150e3) and toward[1] > 0


def test_large_fields_are_cut_into_clusters():
    parts = clusters(files.read(SHIPPED / "radial100"))
    assert sorted(np.concatenate([c.who for c in parts])) == list(range(100))
    assert max(len(c.who) for c in parts) <= 12


@pytest.fixture(scope="module")
def heliopoint():
    """The paper's plant, flown twice with either surface: 24 heliostats."""
    plant = files.read(SHIPPED / "heliopoint")
    return {s: [bs.drone(plant, virtual=True, surface=s, seed=k) for k in (31, 32)] for s in ("design", "measured")}


def flown_of(results):
    return [x for r in results for x in r.flown.values()]


def test_the_shipped_plant_looks_where_the_papers_does(heliopoint):
    """Tables 4 and 5: azimuth 214, elevation 14 deg; twelve in one cluster, none behind another."""
    result = heliopoint["design"][0]
    (c,) = result.clusters
    north, west, up = c.target / 150e3
    assert np.degrees(math.atan2(-west, north)) % 360 == pytest.approx(214) and np.degrees(math.asin(up)) == (
        pytest.approx(14)
    )
    assert len(result.flown) == 12 and not any(result.hidden.values())


def test_the_budget_is_the_papers(heliopoint):
    """Widths of about 1 and 0.2 mrad; σ_mean ≤ 0.2 and ≤ 0.1 of Table 2; σ_tot about 0.3 and below."""
    for surface, low, high, mean in (("design", 0.6e-3, 1.1e-3, 0.2e-3), ("measured", 0.1e-3, 0.3e-3, 0.1e-3)):
        flown = flown_of(heliopoint[surface])
        assert low < np.median([x.pointing.sigma_ad for x in flown]) < high
        assert max(x.pointing.sigma_mean.max() for x in flown) < mean
        assert max(x.sigma.max() for x in flown) < 0.3e-3
        rows = [r for one in heliopoint[surface] for r in one.rows()]
        assert [r["flown_sigma_mean_x_mrad"] for r in rows] == [1e3 * x.pointing.sigma_mean[0] for x in flown]
        # The width of 24 heliostats' differences is known to 2 %, that of folds drawn to 3 %; outliers cut tails.
        expected = np.median([r["sigma_ad_mrad"] for r in rows])
        assert 1e3 * np.median([x.pointing.sigma_ad for x in flown]) == pytest.approx(expected, rel=0.15)


def test_the_stated_uncertainty_covers_the_truth(heliopoint):
    """24 heliostats, 48 pulls: χ² beyond its 1e-4 quantile fails; an unstated shift of 0.4 mrad must fail."""
    low, limit = stats.chi2.ppf([1e-4, 1 - 1e-4], 48)
    for results in heliopoint.values():
        flown = flown_of(results)
        square = sum((x.pull**2).sum() for x in flown)
        assert low / 1.5 < square < limit
        assert sum((((x.error + 0.4e-3) / x.sigma) ** 2).sum() for x in flown) > limit


ERRORS = ("relative", "absolute", "detection", "position", "kinematics", "tilt", "canting", "false_glints")


@pytest.mark.parametrize(
    ("drone", "slope", "broadens", "shifts"),
    [
        ({"relative": 10.0}, 0.0, True, False),
        ({"absolute": 10.0}, 0.0, False, True),
        ({"detection": 20.0}, 0.0, True, False),
        ({"position": 10.0}, 0.0, False, True),
        ({"kinematics": 30.0, "tilt": 2e-3}, 0.0, True, True),
        ({}, 0.7e-3, True, False),
        ({"canting": 0.4e-3}, 0.0, True, False),
    ],
    ids=["rtk", "rtk-absolute", "detection", "position", "kinematics", "surface", "canting"],
)
def test_each_source_broadens_or_shifts(drone, slope, broadens, shifts):
    """Table 1, but for canting: unequal facets make a mixture, which is wider. Twelve heliostats; widths above 0.002
    mrad, errors beyond twice what σ_mean says."""
    plant = files.read(SHIPPED / "heliopoint")
    plant = replace(
        plant, optics=replace(plant.optics, slope=slope),
        drone=replace(plant.drone, **dict.fromkeys(ERRORS, 0.0) | drone),
    )  # fmt: skip
    flown = bs.drone(plant, virtual=True, seed=41).flown.values()
    width, mean = (np.mean([np.square(getattr(x.pointing, n)) for x in flown]) for n in ("sigma_ad", "sigma_mean"))
    assert (math.sqrt(width) > 2e-6) == broadens
    assert (np.mean([x.error**2 for x in flown]) > 4 * mean) == shifts


def test_a_surface_that_is_none_is_told(plant):
    with pytest.raises(BenchsimError, match="none of design, measured"):
        bs.drone(plant, surface="both")


def test_the_map_errs_as_the_plant_states_it(plant, tmp_path):
    """A map that is 1 mrad wrong makes the differences as wide; rms of six, each of some 25 glints in bunches."""
    file = plant / "plant.toml"
    file.write_text(file.read_text().replace("pitch_m = 0.7", "pitch_m = 0.45\nmap_mrad = 1.0\nfalse_glints = 0"))
    done = run("drone", plant, "--fly", "--surface", "measured", "-o", tmp_path / "o")
    assert done.exit_code == 0 and "with a measured map of each mirror" in done.output, done.output
    plain = json.loads((tmp_path / "o" / "drone.json").read_text())
    assert plain["surface"] == "measured"
    rows = plain["heliostats"]
    assert [r["sigma_ad_mrad"] for r in rows] == pytest.approx([1.0] * 3, rel=0.05)
    widths = [r[f"flown_sigma_ad_{axis}_mrad"] for r in rows for axis in "xy"]
    assert np.sqrt(np.mean(np.square(widths))) == pytest.approx(1.0, rel=0.3)


def test_something_else_is_taken_for_a_glint_as_often_as_stated(plant):
    file, glints = plant / "plant.toml", []
    text = file.read_text()
    for share in (0, 1):
        file.write_text(text + f"false_glints = {share}\n")
        (c,) = clusters(files.read(plant))
        _, flight, h, sightings = next(c.fly(np.random.default_rng(3)))
        glints.append(len(sightings.frame) - len(seen(h, flight).frame))
    assert glints == [0, len(c.route[0])]


@pytest.mark.parametrize(
    ("errors", "drone", "tilt"),
    [("", "", 2.0), ("AN_sigma_mrad = 0.6\nAW_sigma_mrad = 0.8\n", "", math.sqrt(0.5)), ("AN_sigma_mrad = 0.6\n",
     "tilt_mrad = 0\n", 0.0)], ids=["not stated", "of the mounts", "of the drone"],
)  # fmt: skip
def test_pylons_lean_as_the_plant_states_it(plant, errors, drone, tilt):
    file = plant / "plant.toml"
    file.write_text(file.read_text().replace("[drone]\n", f"{errors}[drone]\n{drone}"))
    (c,) = clusters(files.read(plant))
    assert c.errors().tilt == pytest.approx(1e-3 * tilt)


@pytest.mark.parametrize(
    ("exif", "says"),
    [
        (None, "EXIF does not say where it was taken"),
        ((37.001, -2.0), "all taken at one place"),
        ((0.0, 0.0), "GPS had no fix"),
        ((37.001, 2.0), "a sign, or the plant's site, is wrong"),
    ],
)
def test_pictures_that_cannot_be_used_are_told_in_a_sentence(plant, tmp_path, exif, says):
    camera_file(tmp_path / "camera.toml", (64, 48), 100.0)
    (tmp_path / "photos").mkdir()
    for k in range(3):
        picture = Image.fromarray(np.full((48, 64), 90, np.uint8))
        more = {"exif": tagged(*exif, 590.0)} if exif else {}
        picture.save(tmp_path / "photos" / f"{k}.jpg", **more)
    done = run("drone", "read", tmp_path / "photos", plant, "--camera", tmp_path / "camera.toml", "-o", tmp_path / "o")
    assert done.exit_code == 1 and says in done.output and not (tmp_path / "o").exists()


def test_pictures_from_elsewhere_contradict_the_plan(plant, tmp_path):
    """Grey pictures taken far from the planned point: nothing is found, and it is said why."""
    camera_file(tmp_path / "camera.toml", (64, 48), 100.0)
    (tmp_path / "photos").mkdir()
    rows = ["name,east_m,north_m,up_m"]
    for k in range(3):
        Image.fromarray(np.full((48, 64), 90, np.uint8)).save(tmp_path / "photos" / f"{k}.jpg")
        rows.append(f"{k}.jpg,{k},400,90")
    (tmp_path / "p.csv").write_text("\n".join(rows))
    result = bs.drone_read(tmp_path / "photos", plant, camera=tmp_path / "camera.toml", positions=tmp_path / "p.csv")
    said = result.summary()
    assert "beside the planned pattern" in said and "No heliostat shows" in said
    assert "of H1, H2, H3: the mirror is not found in 3 of 3 pictures" in said and "looks beside" not in said
    assert "fly again" not in said


def test_what_many_heliostats_lack_alike_is_said_once(plant, tmp_path):
    rows = [f"H{k},{9 * k - 45},150,2" for k in range(1, 11)]
    (plant / "heliostats.csv").write_text("\n".join(["id,east_m,north_m,up_m", *rows]))
    camera_file(tmp_path / "camera.toml", (64, 48), 100.0)
    (tmp_path / "photos").mkdir()
    for k in range(3):
        picture = Image.fromarray(np.full((48, 64), 90, np.uint8))
        picture.save(tmp_path / "photos" / f"{k}.jpg", exif=tagged(37.001 + 1e-5 * k, -2.0, 590.0))
    said = bs.drone_read(tmp_path / "photos", plant, camera=tmp_path / "camera.toml").summary()
    assert "of 10 heliostats (H1, H2, H3, …): the mirror" in said and said.count("is not found") == 1


def test_a_plant_of_one_heliostat_is_said_so(tmp_path):
    assert "a plant of 1 heliostat in" in run("new", tmp_path / "one", "--plant", "--heliostats", 1).output
    assert "1 heliostat in 1 cluster, " in bs.drone(tmp_path / "one").summary()
    assert "1 heliostat, " in bs.detectors(tmp_path / "one", at="2026-06-21T12:00").summary()
    assert "1 heliostat, " in run("check", tmp_path / "one").output


def test_azimuths_err_by_their_sigma_also_high_up(plant):
    """Six looked at from 75 deg up, where one sigma of the axis is 3.9 of azimuth; glints computed, seed 72.

    A chance below 1e-4 for either rms to lie beyond 2.2, were the pulls independent and normal.
    """
    file = plant / "plant.toml"
    file.write_text(file.read_text().replace("pitch_m = 0.7", "pitch_m = 0.6\nelevation_deg = 75"))
    table = plant / "heliostats.csv"
    table.write_text("\n".join(["id,east_m,north_m,up_m", *(f"H{k},{9 * k - 23},150,2" for k in range(6))]))
    (c,) = clusters(files.read(plant))
    pulls, rows = [], []
    for k, flight, h, sightings in c.fly(np.random.default_rng(72)):
        row = drone_photos._row(c, k, sightings, flight.said_cameras, 0, len(flight.cameras))
        x, y, z = h.axis
        off = 1e3 * np.array([np.arctan2(-y, x) - h.said.azimuth, np.arcsin(z) - h.said.elevation])
        kinds = ("azimuth", "elevation")
        pulls.append([(row[f"{n}_off_mrad"] - o) / row[f"sigma_{n}_off_mrad"] for n, o in zip(kinds, off, strict=True)])
        rows.append(row)
    assert (np.sqrt(np.mean(np.square(pulls), axis=0)) < 2.2).all()
    # 1.5 of six equal sigmas are no contradiction, 4/√6 = 1.63 are one.
    beside = [r | {"azimuth_off_mrad": 1.5 * r["sigma_azimuth_off_mrad"], "elevation_off_mrad": 0.0} for r in rows]
    assert "beside on average" not in " ".join(drone_photos._contradictions(beside))


def test_a_reading_does_not_replace_a_plan(plant, tmp_path):
    camera_file(tmp_path / "camera.toml", (64, 48), 100.0)
    (tmp_path / "photos").mkdir()
    for k in range(3):
        picture = Image.fromarray(np.full((48, 64), 90, np.uint8))
        picture.save(tmp_path / "photos" / f"{k}.jpg", exif=tagged(37.001 + 1e-5 * k, -2.0, 590.0))
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "benchsim.json").write_text('{"command": "drone"}')
    done = run("drone", "read", tmp_path / "photos", plant, "--camera", tmp_path / "camera.toml", "-o", tmp_path / "o")
    assert done.exit_code == 1 and "not written by 'benchsim drone read'" in done.output, done.output


def test_the_lamp_flies_where_the_plant_states_it(plant):
    """Beside the camera and over it, also as the drone says: 200 mm to the right and 50 up, square to its axis."""
    file = plant / "plant.toml"
    file.write_text(file.read_text() + "lamp_right_mm = 200.0\nlamp_up_mm = 50.0\n")
    (c,) = clusters(files.read(plant))
    flight = fly(c.target, c.route, c.errors(), np.random.default_rng(1), c.lamps)
    for lamps, cameras in ((flight.lamps, flight.cameras), (flight.said_lamps, flight.said_cameras)):
        beside = lamps - cameras
        np.testing.assert_allclose(np.linalg.norm(beside, axis=1), np.hypot(200, 50), rtol=1e-9)
        np.testing.assert_allclose(beside @ c.target, 0, atol=1e-3)
        np.testing.assert_allclose(beside @ np.cross(-c.target, [0, 0, 1]) > 0, True)


@pytest.mark.slow
def test_pictures_of_mitsuba_are_read_by_the_command_alone(plant, tmp_path):
    """Rendered, written as JPEG with EXIF GPS, read back: axes within 4 of the stated sigma, as the truth has them."""
    from benchsim.drones import picture
    from benchsim.drones.estimate import estimate
    from benchsim.drones.flight import Sightings
    from benchsim.drones.heliostat import axes, design_map, mean_normal, measured_map

    file = plant / "plant.toml"
    file.write_text(file.read_text().replace("pitch_m = 0.7", "pitch_m = 0.4"))
    table = plant / "heliostats.csv"
    table.write_text("\n".join(table.read_text().splitlines()[:3]))
    rng = np.random.default_rng(7)
    camera = picture.Camera((2048, 1024), 7970.0)
    camera_file(tmp_path / "camera.toml", camera.resolution, camera.focal)
    c = clusters(files.read(plant))[0]
    flight = fly(c.target, c.route, c.errors(), rng, c.lamps)
    truth = [stand([c.place(k)], c.design(k), c.target, c.errors(), rng)[0] for k in range(2)]
    (tmp_path / "photos").mkdir()
    shapes = picture.mirrors(truth, np.zeros(3))
    whole = np.concatenate([picture.outline(axes(h.mount), h.surface.design.outline) for h in truth])
    for f, (eye, lamp) in enumerate(zip(flight.cameras, flight.lamps, strict=True)):
        view = picture.looking(eye, np.zeros(3), picture.GIMBAL * rng.standard_normal(2))
        rows, columns = picture.window_of(picture.project(camera, view, whole), 30)
        light = np.full(camera.resolution[::-1], picture.GROUND)
        light[rows, columns] = picture.radiance(shapes, np.zeros(3), camera, view, lamp, (rows, columns), 16, f)
        x = picture.photograph(light, rng)
        coded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
        said = c.geographic(flight.said_cameras[f][None])[0]
        photo = tmp_path / "photos" / f"{f:04d}.jpg"
        Image.fromarray(np.round(255 * coded).astype(np.uint8)).save(photo, quality=97, exif=tagged(*said))
    done = run("drone", "read", tmp_path / "photos", plant, "--camera", tmp_path / "camera.toml", "-o", tmp_path / "o")
    assert done.exit_code == 0, done.output
    table = {r["id"]: r for r in csv.DictReader((tmp_path / "o" / "axes.csv").open())}
    for k, h in enumerate(truth):
        r = table[f"H{k + 1}"]
        assert not r["says"] and int(r["glints"]) >= 8
        axis = ENU @ np.array([float(r[n]) for n in ("axis_east", "axis_north", "axis_up")])
        real = axes(h.mount)[0] @ mean_normal(measured_map(h.surface))
        off = 1e3 * np.linalg.norm(axis - real)
        assert off < 4 * float(r["sigma_mrad"])
        glints = seen(h, flight)
        computed = estimate(
            Sightings(glints.frame, glints.points), flight.said_cameras, flight.said_lamps, h.said,
            design_map(c.design(k)),
        )  # fmt: skip
        assert np.linalg.norm(axis - computed.axis) < 0.15e-3  # what pictures alone add
