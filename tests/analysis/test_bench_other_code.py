"""The bench made by other code obeys closed forms, and agrees with recordings that a third code made."""

import json
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import fresnel

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "recordings" / "bench-other-code"
sys.path.insert(0, str(ROOT / "analysis"))

import bench_other_code as bench_code  # noqa: E402
import other_camera  # noqa: E402
import other_light  # noqa: E402
import other_optics as optics  # noqa: E402

NO_ERRORS = dict.fromkeys(["n_cx", "n_cy", "n_cz", "n_a1", "n_a2", "n_saz", "n_sel"], 0.0)
STILL = {
    "setting_errors": {"s": NO_ERRORS},
    "seats": [0],
    "seat_errors": {"0": {}},
    "camera_pose_errors": [np.zeros((2, 3))],
}
CAMERA = {"resolution_px": [640, 480], "focal_px": 700.0, "principal_point_px": [320.0, 240.0]}
CAMERA["position_mm"] = [1200.0, 350.0, -150.0]
EXPOSURE = {"setting": "s", "camera": "A", "mirror_position_mm": [1500.0, 0.0, -1430.0], "laser_elevation_deg": 50.0}
EXPOSURE["time_s"] = 0.0


def bench(effects=None, diffraction=False, azimuth=180.0, facet=None, **laser):
    """One exposure; at azimuth 180° in a vertical plane's geometry: light and mirror axis at right angles."""
    return {
        "laser": laser,
        "physics": {"diffraction": diffraction},
        "effects": effects or {},
        "cameras": {"A": CAMERA.copy()},
        "exposure": [EXPOSURE | {"laser_azimuth_deg": azimuth} | ({} if facet is None else {"facet": facet})],
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


def about(axis, angle):
    """Matrix that turns by angle (rad), right-handed about world axis 0, 1 or 2."""
    a, b, matrix = (axis + 1) % 3, (axis + 2) % 3, np.eye(3)
    matrix[[a, b, a, b], [a, b, b, a]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return matrix


def source(azimuth, elevation):
    """Direction toward the laser at dial angles (rad)."""
    return np.array([np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def aimed():
    """Centre, point P, facet 0's normal and axis of the mirror by Eq. (17), the laser at 140°."""
    radius, centre = 17.5 * np.cos(np.pi / 12), np.array([1500.0, 0.0, -1430.0])
    normal = sun = source(np.radians(140), np.radians(50))
    for _ in range(60):
        aim = centre + radius * normal
        normal = sun - aim / np.linalg.norm(aim)
        normal /= np.linalg.norm(normal)
    axis = np.cross([0, 0, 1], normal)
    return centre, aim, normal, axis / np.linalg.norm(axis)


def mirror_law(values, phase, facet):
    """Where the laser's axis lands, by Eqs (11), (12) and (17) and the intersection of lines with planes alone."""
    centre, aim, normal, axis = aimed()
    turn = about(0, 1e-3 * values["ped_x"]) @ about(1, 1e-3 * values["ped_y"]) @ about(2, 1e-3 * values["az_enc"])
    axis, normal = turn @ axis, turn @ normal
    radial = np.cos(phase) * normal + np.sin(phase) * np.cross(axis, normal)
    place = 2 * np.pi * facet / 12
    lean = 1e-3 * (values["pyr"] + values["wob_c"] * np.cos(place) + values["wob_s"] * np.sin(place))
    facing = np.cos(lean) * radial + np.sin(lean) * axis
    going = -source(np.radians(140) + 1e-3 * values["saz"], np.radians(50) + 1e-3 * values["sel"])
    face = centre + (17.5 * np.cos(np.pi / 12) + values["dr"]) * radial
    hit = aim + going * ((face - aim) @ facing) / (going @ facing)
    out = going - 2 * (going @ facing) * facing
    across = np.array([1.0, -1e-3 * values["st_z"], -1e-3 * values["st_y"]])
    landed = hit + out * ((values["sx"] - hit @ across) / (out @ across))
    return landed - [values["sx"], 0, 0]


CASES = [({}, None)]
for case in """pivot-offset dr 0.3, canting pyr 4, azimuth-offset az_enc 5, beam-direction saz 4, beam-direction sel -3,
    screen-distance sx 8, screen-tilt st_y 9, screen-tilt st_z -9, axis-tilt ped_x 6, axis-tilt ped_y -6""".split(","):
    name, key, value = case.split()
    CASES.append(({name: {key: float(value)}}, None))
CASES += [({"axis-wobble": {"wob_c": 2.0, "wob_s": -1.5}}, facet) for facet in (2, 7)]


@pytest.mark.parametrize("effects, facet", CASES, ids=str)
def test_a_thin_beam_lands_where_the_mirror_law_puts_its_axis(effects, facet):
    scene, values = stage(effects, azimuth=140.0, facet=facet, beam_diameter_mm=1.2, divergence_mrad=0.0)
    trace = other_light.Trace(scene)
    for phase in (-0.05, 0.0, 0.04):
        want = mirror_law(values, phase, facet or 0)
        printed = scene.board.turn.T @ want  # a tilted board is measured along itself
        at = trace.chart(printed[None, 1:])[0]
        line = trace.line(at)
        off = (printed[1:] - line["yz"][0]) @ line["normal"][0]
        assert abs(printed[0]) < 1e-9
        assert abs(off) < 2e-3


BEAMS = [{"astigmatism": {"astig45": 0.3}}, {"astigmatism": {"astig0": -0.2, "astig45": -0.1}}]
BEAMS += [{"wavefront-curvature": {"curv": 0.4}}, {"coma": {"coma_u": 0.1, "coma_v": -0.06}}]
BEAMS += [{"beam-offset": {"bu": 2.0, "bv": -1.0}}]


@pytest.mark.parametrize("effects", BEAMS, ids=lambda e: next(iter(e)))
def test_a_ray_of_the_beam_goes_as_its_place_in_the_section_says(effects):
    scene, one = stage(effects, azimuth=140.0)
    centre, aim, normal, axis = aimed()
    d = -source(np.radians(140), np.radians(50))
    v = axis - (axis @ d) * d
    v /= np.linalg.norm(v)
    u = np.cross(v, d)
    a0, a45, cu, cv = (1e-3 * one[key] for key in ("astig0", "astig45", "coma_u", "coma_v"))
    c = 4e-4 + 1e-3 * one["curv"]  # 4 mrad over 10 mm
    for at_u, at_v, phase in ((2.0, 0.5, 0.1), (-3.0, -0.7, -0.05)):
        coma_u = cu * (3 * at_u**2 + at_v**2) + 2 * cv * at_u * at_v
        coma_v = 2 * cu * at_u * at_v + cv * (at_u**2 + 3 * at_v**2)
        going = d + ((c + a0) * at_u + a45 * at_v + coma_u) * u + (a45 * at_u + (c - a0) * at_v + coma_v) * v
        start = aim + (at_u + one["bu"]) * u + (at_v + one["bv"]) * v
        tangent = -np.sin(phase) * normal + np.cos(phase) * np.cross(axis, normal)
        radial = np.cos(phase) * normal + np.sin(phase) * np.cross(axis, normal)
        face = centre + 17.5 * np.cos(np.pi / 12) * radial
        hit = start + going * ((face - start) @ radial) / (going @ radial)
        out = going - 2 * (going @ radial) * radial
        want = hit - out * hit[0] / out[0]
        s, h = (hit - face) @ tangent, (hit - face) @ axis
        point, direction, *_ = scene.reflect(np.array([phase]), np.array([s]), np.array([h]), 0.0)
        assert scene.land(point, direction)[0] == pytest.approx(want[1:], abs=2e-4)


def test_the_slit_diffracts_as_the_fresnel_integral_says():
    scene, _ = stage(diffraction=True, beam_diameter_mm=400.0, divergence_mrad=0.0)
    line = other_light.Trace(scene).line(np.zeros(1))
    point, direction, *_ = scene.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    length = np.linalg.norm(scene.board.world(scene.land(point, direction)) - point)
    scale = np.sqrt(2 / (scene.wavelength * length))
    (s1, c1), (s0, c0) = fresnel(scale * (line["q"] + 1)), fresnel(scale * (line["q"] - 1))
    want = (c1 - c0) ** 2 + (s1 - s0) ** 2
    got = line["profile"][0]
    assert np.abs(got / got.sum() - want / want.sum()).max() < 0.015 * (want / want.sum()).max()


def test_a_facets_curvature_adds_twice_itself_to_the_wavefronts():
    plain, curved = stage()[0], stage({"facet-curvature": {"fcurv": 0.1}})[0]
    widths = [other_light.Trace(one).line(np.zeros(1), step=0.01)["width"][0] for one in (plain, curved)]
    point, out, *_ = plain.reflect(np.zeros(1), np.zeros(1), np.zeros(1), 0.0)
    length = np.linalg.norm(plain.board.world(plain.land(point, out)) - point)
    cosine = abs(out[0] @ plain.mirror.normal)
    want = (1 + length * (4e-4 + 2e-4 * cosine)) / (1 + length * 4e-4)
    assert widths[1] / widths[0] == pytest.approx(want, rel=0.003)


def test_astigmatism_widens_the_line_by_its_part_along_the_axis():
    widths = [
        other_light.Trace(stage(e)[0]).line(np.zeros(1), step=0.01)["width"][0]
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


def test_light_in_a_turned_window_bends_toward_the_windows_normal():
    along = np.array([[900.0, 0.0, 0.0]]), np.array([[-1.0, 0.0, 0.0]])
    for key, want in (("wtz", [0, -1, 0]), ("wty", [0, 0, 1])):  # +x turns toward +y about z, toward -z about y
        leaves, out = stage({"window-tilt": {key: 0.5}})[0].air.cross(*along)
        step = 4.0 * (1 - 1 / 1.515) * np.radians(0.5)  # 4 mm thick where no thickness is given
        assert (leaves - along[0])[0, 1:] == pytest.approx(step * np.array(want)[1:], rel=1e-3, abs=1e-9)
        assert out == pytest.approx(along[1])


@pytest.mark.parametrize("turns", [{"wty": 15.0}, {"wtz": 15.0}, {"wty": 20.0, "wtz": -20.0}], ids=str)
def test_a_turned_window_shifts_light_as_two_planes_do(turns):
    clean, glass = stage()[0], stage({"window-tilt": {"win": 10.0} | turns})[0]
    ahead = -(about(2, np.radians(turns.get("wtz", 0))) @ about(1, np.radians(turns.get("wty", 0))))[:, 0]
    point, out, *_ = (a[0] for a in clean.reflect(np.array([0.03]), np.zeros(1), np.zeros(1), 0.0))
    cosine = out @ ahead
    inside = out / 1.515 + (np.sqrt(1 - (1 - cosine**2) / 1.515**2) - cosine / 1.515) * ahead  # Snell
    enters = point + 400.0 * out
    leaves = enters + inside * 10.0 / (inside @ ahead)
    assert ray(glass, 0.03) == pytest.approx((leaves - out * leaves[0] / out[0])[1:], abs=1e-6)


@pytest.mark.parametrize("gradient", [{"air": 200.0}, {"airh": 200.0}, {"air": -50.0, "airh": -150.0}], ids=str)
def test_warmer_air_bends_light_away_from_it(gradient):
    clean, warm = (stage(e, azimuth=140.0)[0] for e in ({}, {"air-gradient": gradient}))
    point, out, *_ = clean.reflect(np.array([0.03]), np.zeros(1), np.zeros(1), 0.0)
    length = point[0, 0] / -out[0, 0]
    bend = -0.95e-6 * 1e-3 * np.array([gradient.get("airh", 0.0), gradient.get("air", 0.0)])
    want = 0.5 * bend * length**2  # a parabola: the plane x = 0 lies along the gradient
    assert ray(warm, 0.03) - ray(clean, 0.03) == pytest.approx(want, rel=1e-3, abs=1e-6)


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
    both = [other_light.Trace(plate, ghost).line(np.zeros(1))["flux"][0] for ghost in (False, True)]
    share = optics.fresnel(np.array([abs(going @ clean.mirror.normal)]))[0]
    assert both[1] / both[0] == pytest.approx(1 + share / (1 - share) ** 2, rel=2e-3)


def test_diffraction_leaves_second_surface_light_where_rays_land():
    scene = stage({"second-surface": {"glass": 2.0}}, diffraction=True, azimuth=110.0)[0]
    both = scene, replace(scene, diffraction=False)
    lines = [other_light.Trace(one, ghost=False).line(np.zeros(1)) for one in both]
    assert np.abs(lines[1]["yz"] - lines[0]["yz"]).max() < 2e-3


def test_no_light_is_lost_from_facets_that_lean_far():
    scene = stage()[0]
    light = [other_light.Trace(replace(scene, leans=leans)).table.sum(1) for leans in ((0.0,), (-8e-3, 8e-3))]
    assert light[1] == pytest.approx(light[0], rel=3e-3)


def test_leaning_facets_widen_the_line_and_leave_its_centre():
    tilts = {f"tilt_{k}": 1.0 if k % 2 else -1.0 for k in range(12)}
    scenes = stage()[0], stage({"facet-tilts": tilts})[0]
    assert scenes[1].leans == pytest.approx([-1e-3, 1e-3] * 6)
    pair = replace(scenes[1], leans=scenes[1].leans[:2])  # the others repeat it
    lines = [other_light.Trace(one).line(np.zeros(1)) for one in (scenes[0], pair)]
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
        spilt = other_camera.spill(laser, 1.2)
        centre = [(a[:, 4] * np.arange(61)).sum() / a[:, 4].sum() for a in (laser, spilt)]
        assert centre[1] - centre[0] == pytest.approx(1.2 * brightness**2, rel=0.02)
        assert spilt.sum() == pytest.approx(laser.sum()) and spilt.min() > -1e-12


def test_rows_read_later_see_a_shifted_picture_and_map_and_projection_agree():
    made = bench({"rolling-shutter": {"rs_s": 2.0, "rs_c": 1.0, "rs_period": 600.0}, "radial-distortion": {"k1": 0.05}})
    values = bench_code.parameters(made, np.random.default_rng(0))
    scene = bench_code.scene(made, 0, values, STILL)
    eye = other_camera.camera(made, 0, values, STILL)
    assert eye.sway(np.array([240.0, 390.0])) == pytest.approx([1.0, 2.0])
    places = np.array([[-200.0, 150.0], [0.0, 0.0], [250.0, -300.0]])
    pixels = eye.project(scene.board.world(places))
    maps = eye.board_map(scene.board)
    assert np.stack([m.ev(pixels[:, 1], pixels[:, 0]) for m in maps], -1) == pytest.approx(places, abs=1e-4)


@pytest.mark.parametrize("order, key", [*enumerate(["k1", "k2", "p1", "p2"])])
def test_lens_errors_add_to_the_files_as_opencvs_do(order, key):
    amount = [0.08, -0.1, 0.015, -0.02][order]
    made = bench({"radial-distortion" if key[0] == "k" else "tangential-distortion": {key: amount}})
    made["cameras"]["A"]["distortion"] = [0.02, -0.01, 1e-3, 2e-3, 5e-3]
    values = bench_code.parameters(made, np.random.default_rng(0))
    lens = np.array([0.02, -0.01, 1e-3, 2e-3, 5e-3])
    lens[order] += amount
    forward = -np.array([1200.0, 350.0, -150.0])
    right = np.cross(forward, [0, 0, 1.0])
    turn = np.array([a / np.linalg.norm(a) for a in (right, np.cross(forward, right), forward)])
    points = np.array([[0, -200.0, 150.0], [0, 250.0, -300.0], [0, 320.0, 320.0]])
    matrix = np.array([[700.0, 0, 320.0], [0, 700.0, 240.0], [0, 0, 1]])
    want = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], turn @ forward, matrix, lens)[0][:, 0]
    eye = other_camera.camera(made, 0, values, STILL)
    assert eye.project(points) == pytest.approx(want, abs=1e-6)
    maps = eye.board_map(stage()[0].board)
    assert np.stack([m.ev(want[:, 1], want[:, 0]) for m in maps], -1) == pytest.approx(points[:, 1:], abs=1e-3)


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
    marks = other_camera.read_marks(SHARED / name / "marks.csv")
    for number in range(len(made["exposure"])):
        scene = bench_code.scene(made, number, values, truth)
        want = known[f"trace_{number}"][:5, ::16]
        back = np.linalg.inv(scene.board.grid).T
        phase, slope = np.zeros(want.shape[1]), None
        for _ in range(5):
            mean, flux = spots(scene, phase)
            slope = (spots(scene, phase + 1e-5)[0] - mean) @ back / 1e-5
            phase = phase + ((want[:2].T - mean @ back) * slope).sum(1) / (slope**2).sum(1)
        across = optics.cross2(want[:2].T - mean @ back, slope) / np.linalg.norm(slope, axis=1)
        ratio = want[4] / flux
        assert np.abs(across).max() < 2e-3
        assert np.abs(ratio / ratio.mean() - 1).max() < 1e-3
        eye = other_camera.camera(made, number, values, truth)
        corners = other_camera.corners(marks).reshape(-1, 2) @ scene.board.grid.T
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
