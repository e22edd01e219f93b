"""The bench made by other code obeys closed forms, and agrees with recordings that a third code made."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import fresnel

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "recordings" / "bench-other-code"
sys.path.insert(0, str(ROOT / "analysis"))

import bench_other_code as bench_code  # noqa: E402
import other_optics as optics  # noqa: E402

NO_ERRORS = dict.fromkeys(["n_cx", "n_cy", "n_cz", "n_a1", "n_a2", "n_saz", "n_sel"], 0.0)
STILL = {
    "setting_errors": {"s": NO_ERRORS},
    "seats": [0],
    "seat_errors": {"0": {}},
    "camera_pose_errors": [np.zeros((2, 3))],
}


def bench(effects=None, diffraction=False, **laser):
    """One exposure in a vertical plane's geometry: light and mirror axis at right angles."""
    return {
        "laser": laser,
        "physics": {"diffraction": diffraction},
        "effects": effects or {},
        "cameras": {
            "A": {
                "resolution_px": [640, 480],
                "focal_px": 700.0,
                "principal_point_px": [320.0, 240.0],
                "position_mm": [1200.0, 350.0, -150.0],
            }
        },
        "exposure": [
            {
                "setting": "s",
                "camera": "A",
                "mirror_position_mm": [1500.0, 0.0, -1430.0],
                "laser_azimuth_deg": 180.0,
                "laser_elevation_deg": 50.0,
                "time_s": 0.0,
            }
        ],
    }


def stage(effects=None, **how):
    """Scene of that exposure without errors, and its effect parameters."""
    made = bench(effects, **how)
    values = bench_code.parameters(made, np.random.default_rng(0))
    return bench_code.scene(made, 0, values, STILL), values


def ray(scene, phase=0.0):
    """Board point (mm) of the light that meets the middle of a facet."""
    point, direction, *_ = scene.reflect(np.array([phase]), np.zeros(1), np.zeros(1), float(np.mean(scene.leans)))
    return scene.land(point, direction)[0]


def mirror_law(values, phase):
    """Where the laser's axis lands, by Eqs (11), (12) and (17) and the intersection of lines with planes alone."""
    radius, centre = 17.5 * np.cos(np.pi / 12), np.array([1500.0, 0.0, -1430.0])

    def source(azimuth, elevation):
        return np.array([np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])

    sun = source(np.pi, np.radians(50))
    normal = sun
    for _ in range(60):
        aim = centre + radius * normal
        normal = sun - aim / np.linalg.norm(aim)
        normal /= np.linalg.norm(normal)
    axis = np.cross([0, 0, 1], normal)
    axis /= np.linalg.norm(axis)
    angle = 1e-3 * values["az_enc"]
    about_z = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    axis, normal = about_z @ axis, about_z @ normal
    radial = np.cos(phase) * normal + np.sin(phase) * np.cross(axis, normal)
    lean = 1e-3 * values["pyr"]
    facing = np.cos(lean) * radial + np.sin(lean) * axis
    going = -source(np.pi + 1e-3 * values["saz"], np.radians(50) + 1e-3 * values["sel"])
    face = centre + (radius + values["dr"]) * radial
    hit = aim + going * ((face - aim) @ facing) / (going @ facing)
    out = going - 2 * (going @ facing) * facing
    across = np.array([1.0, -1e-3 * values["st_z"], -1e-3 * values["st_y"]])
    landed = hit + out * ((values["sx"] - hit @ across) / (out @ across))
    return landed - [values["sx"], 0, 0]


MECHANICAL = [
    {},
    {"pivot-offset": {"dr": 3.0}},
    {"canting": {"pyr": 4.0}},
    {"azimuth-offset": {"az_enc": 5.0}},
    {"beam-direction": {"saz": 4.0, "sel": -3.0}},
    {"screen-distance": {"sx": 8.0}},
    {"screen-tilt": {"st_y": 9.0}},
    {"screen-tilt": {"st_z": -9.0}},
]


@pytest.mark.parametrize("effects", MECHANICAL, ids=lambda e: next(iter(e), "clean"))
def test_a_thin_beam_lands_where_the_mirror_law_puts_its_axis(effects):
    scene, values = stage(effects, beam_diameter_mm=1.2, divergence_mrad=0.0)
    trace = optics.Trace(scene)
    for phase in (-0.05, 0.0, 0.04):
        want = mirror_law(values, phase)
        printed = scene.board.turn.T @ want  # a tilted board is measured along itself
        at = trace.chart(printed[None, 1:])[0]
        line = trace.line(at)
        off = (printed[1:] - line["yz"][0]) @ line["normal"][0]
        assert abs(printed[0]) < 1e-9
        assert abs(off) < 2e-3


def test_the_slit_diffracts_as_the_fresnel_integral_says():
    scene, _ = stage(diffraction=True, beam_diameter_mm=400.0, divergence_mrad=0.0)
    line = optics.Trace(scene).line(np.zeros(1))
    point, direction, *_ = scene.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    length = np.linalg.norm(scene.board.world(scene.land(point, direction)) - point)
    scale = np.sqrt(2 / (scene.wavelength * length))
    (s1, c1), (s0, c0) = fresnel(scale * (line["q"] + 1)), fresnel(scale * (line["q"] - 1))
    want = (c1 - c0) ** 2 + (s1 - s0) ** 2
    got = line["profile"][0]
    assert np.abs(got / got.sum() - want / want.sum()).max() < 0.015 * (want / want.sum()).max()


def test_a_facets_curvature_adds_twice_itself_to_the_wavefronts():
    plain, curved = stage()[0], stage({"facet-curvature": {"fcurv": 0.1}})[0]
    widths = [optics.Trace(one).line(np.zeros(1), step=0.01)["width"][0] for one in (plain, curved)]
    point, out, *_ = plain.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    length = np.linalg.norm(plain.board.world(plain.land(point, out)) - point)
    cosine = abs(out[0] @ plain.mirror.normal)
    want = (1 + length * (4e-4 + 2e-4 * cosine)) / (1 + length * 4e-4)
    assert widths[1] / widths[0] == pytest.approx(want, rel=0.003)


def test_astigmatism_widens_the_line_by_its_part_along_the_axis():
    widths = [
        optics.Trace(stage(e)[0]).line(np.zeros(1), step=0.01)["width"][0]
        for e in ({}, {"astigmatism": {"astig0": 0.1}})
    ]
    scene = stage()[0]
    point, out, *_ = scene.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    length = np.linalg.norm(scene.board.world(scene.land(point, out)) - point)
    assert widths[1] / widths[0] == pytest.approx((1 + length * 3e-4) / (1 + length * 4e-4), rel=0.003)


def test_a_window_shifts_light_by_snells_law():
    clean, glass = stage()[0], stage({"window": {"win": 6.0}})[0]
    _, out, *_ = clean.reflect(np.array([0.03]), np.zeros(1), np.zeros(1), 0.0)
    tangent = np.hypot(*out[0, 1:]) / abs(out[0, 0])
    inside = np.sin(np.arctan(tangent)) / 1.515
    want = -6.0 * (tangent - inside / np.sqrt(1 - inside**2)) * out[0, 1:] / np.hypot(*out[0, 1:])
    assert ray(glass, 0.03) - ray(clean, 0.03) == pytest.approx(want, abs=1e-6)


def test_warmer_air_above_bends_light_down():
    clean, warm = stage()[0], stage({"air-gradient": {"air": 200.0}})[0]
    point, out, *_ = clean.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    length = np.linalg.norm(clean.board.world(clean.land(point, out)) - point)
    want = -0.5 * 0.95e-6 * 0.2 * length**2 / out[0, 0] ** 2 * (1 - out[0, 2] ** 2)
    assert (ray(warm) - ray(clean))[1] == pytest.approx(want, rel=0.01)


def test_a_plume_kicks_light_at_its_own_place_only():
    clean = stage()[0]
    place = ray(clean)
    point, out, *_ = clean.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    half = point[0] + out[0] * (750.0 - point[0, 0]) / out[0, 0]
    one = {"plume": 1.0, "plume_y": half[1], "plume_z": half[2], "plume_width": 20.0}
    kicked = ray(stage({"plume": one})[0]) - place
    assert kicked[0] == pytest.approx(1e-3 * 750 / abs(out[0, 0]), rel=1e-3)
    assert ray(stage({"plume": one | {"plume_z": half[2] + 200}})[0]) == pytest.approx(place, abs=1e-9)


def test_second_surface_light_leaves_further_on():
    clean, plate = stage()[0], stage({"second-surface": {"glass": 1.0}})[0]
    nodes = np.zeros(1), np.zeros(1), np.zeros(1), 0.0
    first, second = clean.reflect(*nodes), plate.reflect(*nodes)
    going = clean.beam.at(first[0])[0][0]
    sine = np.linalg.norm(np.cross(going, clean.mirror.normal)) / 1.515
    step = (second[0] - first[0])[0]
    assert np.linalg.norm(step) == pytest.approx(2 * sine / np.sqrt(1 - sine**2), rel=1e-9)
    assert step @ going > 0 and second[1] == pytest.approx(first[1])
    both = [optics.Trace(plate, ghost).line(np.zeros(1))["flux"][0] for ghost in (False, True)]
    share = optics.fresnel(np.array([abs(going @ clean.mirror.normal)]))[0]
    assert both[1] / both[0] == pytest.approx(1 + share / (1 - share) ** 2, rel=2e-3)


def test_leaning_facets_widen_the_line_and_leave_its_centre():
    tilts = {f"tilt_{k}": 1.0 if k % 2 else -1.0 for k in range(12)}
    lines = [optics.Trace(stage(e)[0]).line(np.zeros(1)) for e in ({}, {"facet-tilts": tilts})]
    split = ray(stage({"canting": {"pyr": 1.0}})[0]) @ lines[0]["normal"][0]
    assert np.abs(lines[1]["yz"] - lines[0]["yz"]).max() < 5e-3
    assert lines[1]["width"][0] ** 2 - lines[0]["width"][0] ** 2 == pytest.approx(split**2, rel=0.01)


def test_drift_and_grid_move_what_they_say():
    scene, _ = stage({"drift": {"dry": 0.5, "drz": -0.2}, "grid-shear": {"gsh": 2.0}, "grid-aspect": {"ga": 3.0}})
    later = bench_code.stand(
        {}, bench_code.parameters(bench({"drift": {"dry": 0.5}}), np.random.default_rng(0)), {}, 2.0
    )
    assert later.drift == pytest.approx([0, 1.0, 0])
    assert scene.board.grid @ [100, 10] == pytest.approx([100.3 + 0.02, 9.97 + 0.2])


def test_spilt_charge_shifts_the_line_as_brightness_squared():
    row, column = np.mgrid[0:61, 0:5]
    for brightness in (1.0, 0.5):
        laser = np.where(column < 2, 1.0, brightness) * np.exp(-0.5 * ((row - 25.3) / 1.6) ** 2)
        spilt = bench_code.spill(laser, 1.2)
        centre = [(a[:, 4] * np.arange(61)).sum() / a[:, 4].sum() for a in (laser, spilt)]
        assert centre[1] - centre[0] == pytest.approx(1.2 * brightness**2, rel=0.02)
        assert spilt.sum() == pytest.approx(laser.sum()) and spilt.min() > -1e-12


def test_rows_read_later_see_a_shifted_picture_and_map_and_projection_agree():
    made = bench({"rolling-shutter": {"rs_s": 2.0, "rs_c": 1.0, "rs_period": 600.0}, "radial-distortion": {"k1": 0.05}})
    values = bench_code.parameters(made, np.random.default_rng(0))
    scene = bench_code.scene(made, 0, values, STILL)
    eye = bench_code.camera(made, 0, values, STILL)
    assert eye.sway(np.array([240.0, 390.0])) == pytest.approx([1.0, 2.0])
    places = np.array([[-200.0, 150.0], [0.0, 0.0], [250.0, -300.0]])
    pixels = eye.project(scene.board.world(places))
    maps = eye.board_map(scene.board)
    assert np.stack([m.ev(pixels[:, 1], pixels[:, 0]) for m in maps], -1) == pytest.approx(places, abs=1e-4)


def test_a_move_is_a_change_of_shift_or_roll_in_the_order_of_time():
    shifts = [(0, 0, 30), (5, 0, 10), (0, 0, 20), (5, 180, 40)]
    exposures = [{"screen_shift_mm": s, "screen_roll_deg": r, "time_s": t} for s, r, t in shifts]
    assert bench_code.moves(exposures) == [1, 0, 1, 2]


def test_the_program_writes_a_recording_that_says_nothing_of_what_it_hides(tmp_path):
    import tomlkit

    made = bench({"canting": {"pyr": 1.5}}) | {"render": {"speckle_px": 0.8}, "format": "benchsim-recording/1"}
    made["exposure"][0] |= {"image": "001.png", "dark": "001-dark.png"}
    made["cameras"]["A"] |= {"resolution_px": [1000, 750], "focal_px": 1050.0, "principal_point_px": [499.5, 374.5]}
    (tmp_path / "truth.toml").write_text(tomlkit.dumps(made))
    command = [sys.executable, ROOT / "analysis" / "bench_other_code.py", tmp_path / "truth.toml", tmp_path / "rec"]
    subprocess.run([*command, "--seed", "5", "--truth", tmp_path / "known.json"], check=True)
    left = tomllib.loads((tmp_path / "rec" / "recording.toml").read_text())
    assert "effects" not in left and "render" not in left and left["exposure"] == made["exposure"]
    known = json.loads((tmp_path / "known.json").read_text())
    assert known["parameters"]["pyr"] == 1.5 and set(known["setting_errors"]["s"]) == set(NO_ERRORS)
    dark = (cv2.imread(str(tmp_path / "rec" / "001-dark.png"), -1) / 65535 * 4 * 255).clip(0, 255).astype(np.uint8)
    finder = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    found, ids, _ = finder.detectMarkers(dark)
    true = np.load(tmp_path / "known.npz")["corners_0"]
    assert len(ids) >= 35
    miss = [np.abs(f[0].mean(0) - true[i].mean(0)).max() for f, i in zip(found, ids.ravel(), strict=True)]
    assert np.median(miss) < 0.3  # the detector's own corners are good to half a pixel


@pytest.mark.parametrize("name", ["clean-f7", "known-six", "tilt-rotation", "coma-tilt", "drift-rotation", "offset"])
def test_spots_are_where_a_third_code_put_them(name):
    if not SHARED.exists():
        pytest.skip("no recordings by other code beside this checkout")
    made = tomllib.loads((SHARED / name / "recording.toml").read_text())
    truth = json.loads((SHARED / "truth" / f"{name}.json").read_text())
    made["effects"] = {e["name"]: {k: v["value"] for k, v in e["parameters"].items()} for e in truth["effects"]}
    known = np.load(SHARED / "truth" / f"{name}.npz")
    values = bench_code.parameters(made, np.random.default_rng(0))
    marks = bench_code.read_marks(SHARED / name / "marks.csv")
    for number in range(len(made["exposure"])):
        scene = bench_code.scene(made, number, values, truth)
        want = known[f"trace_{number}"][:5, ::16]
        back = np.linalg.inv(scene.board.grid).T
        phase, slope = np.zeros(want.shape[1]), None
        for _ in range(12):
            mean, flux = spots(scene, phase)
            slope = (spots(scene, phase + 1e-5)[0] - mean) @ back / 1e-5
            phase = phase + ((want[:2].T - mean @ back) * slope).sum(1) / (slope**2).sum(1)
        across = optics.cross2(want[:2].T - mean @ back, slope) / np.linalg.norm(slope, axis=1)
        ratio = want[4] / flux
        assert np.abs(across).max() < 2e-3
        assert np.abs(ratio / ratio.mean() - 1).max() < 1e-3
        eye = bench_code.camera(made, number, values, truth)
        corners = bench_code.corners(marks).reshape(-1, 2) @ scene.board.grid.T
        seen = eye.project(scene.board.world(corners)).reshape(-1, 4, 2)
        assert np.abs(seen - known[f"corners_{number}"]).max() < 2e-3


def spots(scene, phase):
    """Mean board point (mm) and power of the light reflected at each phase by geometric optics."""
    (s, ws), (h, wh) = (
        (half * x, half * w)
        for half in (scene.mirror.half_width, scene.mirror.half_height)
        for x, w in [np.polynomial.legendre.leggauss(24)]
    )
    point, out, power, *_ = scene.reflect(phase[:, None, None], s[:, None], h, float(np.mean(scene.leans)))
    weight = power * ws[:, None] * wh
    flux = weight.sum((1, 2))
    return (weight[..., None] * scene.land(point, out)).sum((1, 2)) / flux[:, None], flux
