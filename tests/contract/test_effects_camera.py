"""Every effect between board and pixel, `rays` and the marks' pose against first principles: ≤ 0.001 px and ≤ 1 µm."""

from dataclasses import replace

import numpy as np
import pytest
from camera_principles import corners, look, printed, project, raised, read, solve
from first_principles import turn
from holding import bench

from benchsim.bench.place import camera_pose, place
from benchsim.instruments.bench.board_coordinates import measured, view_of_all
from benchsim.rays import screen, see
from benchsim.rays.camera import project as seen_by
from benchsim.trace.pose import Pose


def two(*tables):
    return pytest.mark.parametrize("size", tables, ids=["small", "cap"] + ["other"] * (len(tables) - 2))


@pytest.fixture
def camera():
    return bench("a").cameras["A"]


GRID = np.stack(np.meshgrid(np.linspace(-300.0, 300.0, 7), np.linspace(-300.0, 300.0, 7)), -1).reshape(-1, 2)


def seen(effects, **options):
    recording = replace(bench("a"), effects=effects)
    return see(recording, recording.cameras["A"], *look(recording.cameras["A"]), GRID, **options)


def flat(camera, extra=(0.0, 0.0, 0.0, 0.0), board=GRID, **bow):
    return project(camera, *look(camera), raised(board, **bow), extra)


def test_camera(camera):
    """Expects OpenCV's pinhole, looking without roll: "image rows run downward, world z upward in the picture, right =
    forward × z"; a board rolled, shifted and re-seated is seen where it stands."""
    rotation, translation = look(camera)
    ours, theirs = camera_pose(camera), (rotation, translation)
    assert all(np.allclose(a, b, atol=1e-9) for a, b in zip(ours, theirs, strict=True))
    assert np.abs(seen({}) - flat(camera)).max() < 1e-9
    exposure = replace(bench("a").exposures[0], screen_shift=50.0, screen_roll=0.7)
    board = raised(GRID) @ turn([0.7, 0.0, 0.0]).T + [50.0, 0.0, 0.0]
    pixels = seen_by(camera, rotation, translation, screen.to_world(place(bench("a").mirror, exposure), GRID))
    assert np.abs(pixels - project(camera, rotation, translation, board)).max() < 1e-6


@two({"k1": 1e-3, "k2": -1e-3}, {"k1": -0.1}, {"k2": 0.1})
def test_radial_distortion(camera, size):
    """Expects "OpenCV's" k1, k2 added to the stated ones."""
    extra = (size.get("k1", 0.0), size.get("k2", 0.0), 0.0, 0.0)
    assert np.abs(seen({"radial-distortion": size}) - flat(camera, extra)).max() < 1e-3
    assert np.abs(flat(camera, extra) - flat(camera)).max() > 0.01


@two({"p1": 1e-4, "p2": -1e-4}, {"p1": -0.02}, {"p2": 0.02})
def test_tangential_distortion(camera, size):
    """Expects "OpenCV's" p1, p2 added to the stated ones."""
    extra = (0.0, 0.0, size.get("p1", 0.0), size.get("p2", 0.0))
    assert np.abs(seen({"tangential-distortion": size}) - flat(camera, extra)).max() < 1e-3
    assert np.abs(flat(camera, extra) - flat(camera)).max() > 0.01


@two({"rs_s": 0.1, "rs_c": -0.05, "rs_period": 900.0}, {"rs_s": -5.0, "rs_c": 5.0, "rs_period": 1400.0})
def test_rolling_shutter(camera, size):
    """Expects "u shifts by rs_s sin + rs_c cos(2π (row − principal row)/period)", the row that of the lens's image."""
    ideal = flat(camera)
    turns = 2.0 * np.pi * (ideal[:, 1] - camera.principal_point[1]) / size["rs_period"]
    moved = ideal + np.outer(size["rs_s"] * np.sin(turns) + size["rs_c"] * np.cos(turns), [1.0, 0.0])
    assert np.abs(seen({"rolling-shutter": size}) - moved).max() < 1e-3


@two({"sat": 0.05}, {"sat": 3.0})
def test_saturation(camera, size):
    """Expects v + sat · brightness²: "charge spills toward +v; centroid shift at the exposure's peak, ∝
    brightness²"."""
    level = np.linspace(0.0, 1.0, len(GRID))
    moved = flat(camera) + np.outer(size["sat"] * level**2, [0.0, 1.0])
    assert np.abs(seen({"saturation": size}, level=level) - moved).max() < 1e-3
    assert np.abs(seen({"saturation": size}) - flat(camera)).max() < 1e-9  # print has no brightness


@two({"gs": 0.1}, {"gs": -10.0})
def test_grid_scale(camera, size):
    """Expects marks at ((1 + gs + ga) y + gsh z, (1 + gs − ga) z + gsh y), light where it is."""
    check_print(camera, "grid-scale", size)


@two({"ga": 0.1}, {"ga": -10.0})
def test_grid_aspect(camera, size):
    """Expects marks at ((1 + gs + ga) y + gsh z, (1 + gs − ga) z + gsh y), light where it is."""
    check_print(camera, "grid-aspect", size)


@two({"gsh": 0.1}, {"gsh": -10.0})
def test_grid_shear(camera, size):
    """Expects marks at ((1 + gs + ga) y + gsh z, (1 + gs − ga) z + gsh y), light where it is."""
    check_print(camera, "grid-shear", size)


def check_print(camera, name, size):
    moved = flat(camera, board=printed(GRID, **size))
    assert np.abs(seen({name: size}, printed=True) - moved).max() < 1e-3
    assert np.abs(seen({name: size}) - flat(camera)).max() < 1e-9
    assert np.abs(moved - flat(camera)).max() > 0.02


@two({"bow_y": 0.002, "bow_z": -0.001}, {"bow_y": -0.2}, {"bow_z": 0.2})
def test_screen_bow(camera, size):
    """Expects points raised "along the board's normal at unchanged board coordinates", light and print alike."""
    moved = flat(camera, **size)
    for is_print in (False, True):
        assert np.abs(seen({"screen-bow": size}, printed=is_print) - moved).max() < 1e-3


@two({"st_y": 0.2, "st_z": -0.1}, {"st_y": -20.0}, {"st_z": 20.0})
def test_screen_tilt_is_pose(camera, size):
    """Expects nothing in the board's own frame: the board "turns with its marks … and marks in their own plane cannot
    show a tilt"; what turns as a whole is part of the pose."""
    for is_print in (False, True):
        assert np.abs(seen({"screen-tilt": size}, printed=is_print) - flat(camera)).max() < 1e-3


@pytest.mark.parametrize("tilt", [(0.0, 20e-3, 0.0), (0.0, 0.0, -20e-3), (0.01, 0.05, -0.03)])
def test_marks_of_a_turned_board_show_nothing(camera, tilt):
    """Expects residual 0: rotate the planar target, project, solve the pose; points on it are read where they lie."""
    rotation, translation = look(camera)
    places = corners(bench("a").screen.marks)
    turned = rotation @ turn(tilt)
    pose, left = solve(camera, project(camera, turned, translation, raised(places)), places, (rotation, translation))
    assert np.abs(left).max() < 1e-6
    back = read(camera, pose, project(camera, turned, translation, raised(GRID)))
    assert np.abs(back - GRID).max() < 1e-5


def as_pose(camera, rotation, translation):
    """A solved pose of which only the camera's place is looked at."""
    none = np.zeros(0)
    return Pose(rotation, translation, camera, none, none, 1.0, none, (), 0.0)


MEASURED = {
    "grid-scale": ({"gs": 0.2}, {"gs": -10.0}),
    "grid-aspect": ({"ga": 0.2}, {"ga": -10.0}),
    "grid-shear": ({"gsh": 0.2}, {"gsh": -10.0}),
    "radial-distortion": ({"k1": 1e-3, "k2": -1e-3}, {"k1": -0.1, "k2": 0.05}),
    "tangential-distortion": ({"p1": 1e-4, "p2": -1e-4}, {"p1": -0.02, "p2": 0.01}),
    "screen-bow": ({"bow_y": 0.002, "bow_z": -0.001}, {"bow_y": -0.2, "bow_z": 0.1}),
    "screen-tilt": ({"st_y": 0.2, "st_z": -0.3}, {"st_y": -20.0, "st_z": 20.0}),
}
CASES = [
    pytest.param(name, size, id=f"{name}-{label}")
    for name, sizes in MEASURED.items()
    for label, size in zip(("small", "cap"), sizes, strict=True)
]


@pytest.mark.parametrize("name, size", CASES)
def test_position_as_the_marks_define_it(camera, name, size):
    """Expects light read with the stated camera from the pose that the true marks lead to: "position on the screen *as
    its marks define it*"; "the pose is solved in every image"; and what the pose leaves of the marks (the
    mean of a mark's four corners)."""
    recording = replace(bench("a"), effects={name: size})
    places = corners(recording.screen.marks)
    start = look(camera)
    extra = tuple(size.get(key, 0.0) for key in ("k1", "k2", "p1", "p2"))
    bow = {key: size[key] for key in ("bow_y", "bow_z") if key in size}
    grid = {key: size[key] for key in ("gs", "ga", "gsh") if key in size}
    pixels = project(camera, *start, raised(printed(places, **grid), **bow), extra)
    pose, left = solve(camera, pixels, places, start)
    expected = read(camera, pose, project(camera, *start, raised(GRID, **bow), extra))
    found = view_of_all(recording, as_pose(camera, *pose))
    board, residual = measured(recording, found, GRID)
    assert np.abs(board - expected).max() < 1e-3
    assert np.abs(residual + left.reshape(-1, 4, 2).mean(1)).max() < 1e-3
    if name != "screen-tilt":
        assert np.abs(expected - GRID).max() > 5e-3


def test_grid_scale_is_distance(camera):
    """Expects coordinates divided by 1 + gs and marks that show nothing: a print that is too large passes for a nearer
    board."""
    places = corners(bench("a").screen.marks)
    start = look(camera)
    pose, left = solve(camera, project(camera, *start, raised(printed(places, gs=10.0))), places, start)
    assert np.abs(left).max() < 1e-6
    back = read(camera, pose, project(camera, *start, raised(GRID)))
    assert np.abs(back - GRID / 1.01).max() < 1e-6
