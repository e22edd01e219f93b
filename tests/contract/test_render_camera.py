"""Every effect between board and pixel, `renderer` against first principles: spots of light and marks in pictures."""

from dataclasses import replace

import numpy as np
import pytest
from camera_principles import look, printed, project, raised, read
from first_principles import turn, unit
from holding import bench

from benchsim.bench.place import place
from benchsim.renderer import ScreenMap, photograph
from benchsim.renderer.charge import arrived

pytestmark = pytest.mark.usefixtures("backend")

SPOTS = np.stack(np.meshgrid(np.linspace(-250.0, 250.0, 5), np.linspace(-250.0, 250.0, 5)), -1).reshape(-1, 2)
SIGMA = 3.0  # mm, of a spot
PLACE = 0.02  # px, of a spot's centroid: some 0.02 mm


def two(*tables):
    return pytest.mark.parametrize("size", tables, ids=["small", "cap"] + ["other"] * (len(tables) - 2))


@pytest.fixture(scope="module")
def camera():
    stated = bench("a").cameras["A"]
    return replace(stated, resolution=(1000, 750), focal=1050.0, principal_point=(499.0, 374.0))


@pytest.fixture(scope="module")
def light():
    axis = np.arange(-349.75, 350.0, 0.5)  # of the whole board
    one = [np.exp(-0.5 * ((axis[:, None] - SPOTS[None, :, k]) / SIGMA) ** 2) for k in (0, 1)]
    return ScreenMap(one[1] @ one[0].T, float(axis[0]), float(axis[0]), 0.5, 0.0)


def standing(board, size, roll=0.0, shift=0.0):
    """World points of board coordinates on a board that is shifted, turned, tilted and bowed."""
    slope = -1e-3 * np.array([size.get("st_z", 0.0), size.get("st_y", 0.0)])
    normal = unit(np.array([1.0, *slope]))
    across = np.cross([1.0, 0.0, 0.0], normal)
    sine = np.linalg.norm(across)
    tilt = turn(across / sine * np.arcsin(sine)) if sine else np.eye(3)
    frame = turn([roll, 0.0, 0.0]) @ tilt @ turn([1e-3 * size.get("srot", 0.0), 0.0, 0.0])
    bow = {key: size[key] for key in ("bow_y", "bow_z") if key in size}
    return raised(board, **bow) @ frame.T + [shift + size.get("sx", 0.0), 0.0, 0.0]


def shown(camera, size, roll=0.0):
    """Where first principles expect the centroids of the spots' images [px]."""
    g = np.linspace(-3.5, 3.5, 29) * SIGMA
    patch = np.stack(np.meshgrid(g, g), -1)
    board = SPOTS[:, None, None] + patch
    extra = tuple(size.get(key, 0.0) for key in ("k1", "k2", "p1", "p2"))
    pixels = project(camera, *look(camera), standing(board, size, roll), extra)
    if "rs_period" in size:
        turns = 2.0 * np.pi * (pixels[..., 1] - camera.principal_point[1]) / size["rs_period"]
        pixels = pixels + np.stack([size["rs_s"] * np.sin(turns) + size["rs_c"] * np.cos(turns), 0.0 * turns], -1)
    along = [np.gradient(pixels, g, axis=k) for k in (2, 1)]
    area = np.abs(along[0][..., 0] * along[1][..., 1] - along[0][..., 1] * along[1][..., 0])
    weight = (np.exp(-0.5 * (patch**2).sum(-1) / SIGMA**2) * area)[..., None]
    return (pixels * weight).sum((1, 2)) / weight.sum((1, 2))


def found(picture, expected, reach):
    """Centroids of the picture's light about expected places [px]."""
    out = []
    for u, v in expected:
        rows, columns = (slice(max(round(x) - reach, 0), round(x) + reach + 1) for x in (v, u))
        part = picture[rows, columns].astype(float)
        i, j = np.mgrid[rows, columns][:, : part.shape[0], : part.shape[1]]
        out.append([(part * j).sum() / part.sum(), (part * i).sum() / part.sum()])
    return np.array(out)


def check(camera, light, name, size, roll=0.0):
    exposure = replace(bench("a").exposures[0], screen_roll=roll)
    placed = place(bench("a").mirror, exposure)
    picture = photograph(bench("a").screen, camera, light, placement=placed, pose=look(camera), effects={name: size})
    expected = shown(camera, size, roll)
    off = found(picture.laser, expected, 20) - expected
    assert np.abs(off).max() < PLACE, np.abs(off).max()


def test_camera(camera, light):
    """Expects the picture of OpenCV's pinhole, centre of the top-left pixel at (0, 0), of a rolled board too."""
    check(camera, light, "radial-distortion", {"k1": 0.0})
    check(camera, light, "radial-distortion", {"k1": 0.0}, roll=0.7)


@two({"sx": 0.5}, {"sx": -20.0})
def test_screen_distance(camera, light, size):
    """Expects the board moved "along +x"."""
    check(camera, light, "screen-distance", size)


@two({"st_y": 0.5, "st_z": -0.5}, {"st_y": 20.0}, {"st_z": -20.0})
def test_screen_tilt(camera, light, size):
    """Expects "the board turned rigidly" to be seen turned, its coordinates "measured along the board"."""
    check(camera, light, "screen-tilt", size)


@two({"srot": 0.5}, {"srot": -20.0})
def test_screen_rotation(camera, light, size):
    """Expects the board turned "about +x"."""
    check(camera, light, "screen-rotation", size)


@two({"bow_y": 0.005, "bow_z": -0.005}, {"bow_y": -0.2, "bow_z": 0.1})
def test_screen_bow(camera, light, size):
    """Expects the light on a bowed board raised along its normal, at unchanged board coordinates, rolled with it."""
    check(camera, light, "screen-bow", size, roll=0.3)


@two({"k1": 2e-3, "k2": -1e-3}, {"k1": -0.1, "k2": 0.1})
def test_radial_distortion(camera, light, size):
    """Expects "OpenCV's" k1, k2 added to the stated ones."""
    check(camera, light, "radial-distortion", size)


@two({"p1": 2e-4, "p2": -2e-4}, {"p1": -0.02, "p2": 0.02})
def test_tangential_distortion(camera, light, size):
    """Expects "OpenCV's" p1, p2 added to the stated ones."""
    check(camera, light, "tangential-distortion", size)


@two({"rs_s": 0.2, "rs_c": -0.1, "rs_period": 900.0}, {"rs_s": -5.0, "rs_c": 5.0, "rs_period": 1400.0})
def test_rolling_shutter(camera, light, size):
    """Expects rows that shift along u by "rs_s sin + rs_c cos(2π (row − principal row)/period)"."""
    check(camera, light, "rolling-shutter", size)


@two({"sat": 0.1}, {"sat": 3.0})
def test_saturation(size):
    """Expects a line's centroid to move by sat · brightness² toward +v: "charge spills toward +v; centroid shift at the
    exposure's peak, ∝ brightness²"."""
    rows = np.arange(120.0)
    brightness = 0.2 + 0.8 * np.sin(np.linspace(0.0, np.pi, 401))
    line = brightness * np.exp(-0.5 * ((rows[:, None] - 50.3) / 4.0) ** 2)
    moved = arrived(line.astype(np.float32), {"saturation": size}, {})
    shift = (rows[:, None] * moved).sum(0) / moved.sum(0) - (rows[:, None] * line).sum(0) / line.sum(0)
    assert np.abs(shift - size["sat"] * brightness**2).max() < 0.01 * size["sat"]
    assert np.allclose(moved.sum(0), line.sum(0), rtol=1e-4)


def room(camera, effects, **screen):
    placed = place(bench("a").mirror, bench("a").exposures[0])
    board = replace(bench("a").screen, **screen)
    return photograph(board, camera, None, placement=placed, pose=look(camera), effects=effects).room


@pytest.fixture(scope="module")
def blank(camera):
    return room(camera, {}, marks=None)


def ink(camera, blank, effects):
    """Centroids of the marks' ink in the picture by room light [px]: the blank board's less the printed one's."""
    grid = {key: value for table in effects.values() for key, value in table.items()}
    centres = np.array(bench("a").screen.marks.centres)
    places = project(camera, *look(camera), raised(printed(centres, **grid)))
    return found(blank - room(camera, effects), places, 21)


@pytest.fixture(scope="module")
def unchanged(camera, blank):
    return ink(camera, blank, {})


@pytest.mark.parametrize("name, key", [("grid-scale", "gs"), ("grid-aspect", "ga"), ("grid-shear", "gsh")])
@pytest.mark.parametrize(
    "amount", [pytest.param(0.5, id="small", marks=pytest.mark.slow), pytest.param(-10.0, id="cap")]
)
def test_print(camera, blank, unchanged, name, key, amount):
    """Expects ink meant for (y, z) at ((1 + gs + ga) y + gsh z, (1 + gs − ga) z + gsh y): its centroid there."""
    meant = read(camera, look(camera), unchanged)
    expected = project(camera, *look(camera), raised(printed(meant, **{key: amount})))
    assert np.abs(ink(camera, blank, {name: {key: amount}}) - expected).max() < PLACE
    assert np.abs(expected - unchanged).max() > 5.0 * PLACE
