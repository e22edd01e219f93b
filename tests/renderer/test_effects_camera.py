"""Effects of board, print, lens, read-out and sensor in rendered pictures, against closed forms in float64 by OpenCV
and against the ray model.

Rationale: `renderer` draws every effect as what it is; where points of the board must then be seen follows from
geometry alone, and so does how wide and how bright what lies there is seen. Set-up: blobs of light at known (y, z), or
the printed squares, photographed with the effect at two magnitudes. Expectation: centroids of blobs within 0.003 px,
edges of squares within 0.01 px in the mean; second moments and sums, of the blobs' light and of the squares' ink,
change as `rays.see` maps the neighbourhood of each, within 2 % of the effect and a floor, together a fifth of it at
most.

Nothing here is drawn at random: the blobs' light is a table and pixels are integrated on fixed points, so that no test
fails by chance, and what is tolerated is the error of pixels and texels.
"""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from benchsim import rays
from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import field
from benchsim.bench.files import read
from benchsim.bench.model import Camera, Exposure, Laser, Marks, Mirror, Recording, RenderOptions, Screen
from benchsim.bench.place import Placement, SettingErrors, camera_pose, place
from benchsim.renderer import recording as module
from benchsim.renderer.board import CELLS, INK, printed, reflectance, tag_cells
from benchsim.renderer.charge import arrived, level
from benchsim.renderer.irradiance import ScreenMap
from benchsim.renderer.picture import photograph

PITCH = 0.25
CAMERA = Camera("A", (560, 420), 900.0, (283.2, 206.7), (-0.12, 0.05, 0.0007, -0.0005, 0.01))
EXPOSURE = Exposure("A", "s", np.radians(101), np.radians(50), (1500.0, -160.0, -1430.0), 12.0, np.radians(8.0))
SCREEN = Screen((400.0, 300.0), 0.8)
SPOTS = [(y, z) for y in (-160.0, -61.3, 40.7, 155.0) for z in (-110.0, -33.3, 90.9)]
SIGMA = 3.0
SIDE = 48.0
MARKED = replace(
    SCREEN,
    marks=Marks(tuple(range(6)), tuple((y, z) for y in (-140.0, 0.0, 150.0) for z in (-90.0, 80.0)), (SIDE,) * 6),
)

HEIGHT = (np.array([-200.0, -60.0, 50.0, 220.0]), np.array([-160.0, 10.0, 150.0]))
HEIGHT_MM = np.array([[1.0, -2.0, 0.5], [2.0, 3.0, -1.0], [-2.0, 1.5, 2.5], [0.0, -1.0, 1.0]])
PIXEL = (np.array([0.0, 200.0, 420.0, 559.0]), np.array([0.0, 210.0, 419.0]))
PIXEL_PX = np.array(
    [
        [[0.3, -0.6, 0.9], [0.8, 0.2, -0.5], [-0.4, 1.0, 0.3], [0.1, 0.0, -0.7]],
        [[-0.2, 0.5, 0.6], [0.4, -0.9, 0.1], [0.7, 0.3, -0.3], [0.0, 0.2, 0.5]],
    ]
)


def bilinear(knots, values, a, b):
    """Bilinear interpolation, written out."""
    i = np.clip(np.searchsorted(knots[0], a) - 1, 0, len(knots[0]) - 2)
    j = np.clip(np.searchsorted(knots[1], b) - 1, 0, len(knots[1]) - 2)
    p = (a - knots[0][i]) / (knots[0][i + 1] - knots[0][i])
    q = (b - knots[1][j]) / (knots[1][j + 1] - knots[1][j])
    low = values[i, j] * (1 - q) + values[i, j + 1] * q
    return low * (1 - p) + (values[i + 1, j] * (1 - q) + values[i + 1, j + 1] * q) * p


def standing() -> Placement:
    errors = SettingErrors(screen_position=np.array([1.0, 2.0, -3.0]), screen_angle=np.array([0.01, -0.02, 0.015]))
    return place(Mirror(), EXPOSURE, errors)


def stands_turned(sx, st_y, st_z, srot):
    """Axes of the rigid board in the world, written out, and its centre.

    Seen along its own normal it is turned by ``srot``. Its plane x = st_z y + st_y z is reached by a turn about the
    line in which that meets the plane as it was.
    """
    placement, a = standing(), 1e-3 * srot
    rolled = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    fall = 1e-3 * np.array([0.0, st_z, st_y])
    steep = np.linalg.norm(fall)
    tilted = np.eye(3)
    if steep:
        # The line of steepest rise, the level line, and the normal: each is turned into what it becomes.
        rise, c = fall / steep, 1 / np.hypot(1, steep)
        level = np.cross([1.0, 0, 0], rise)
        before = np.stack([[1.0, 0, 0], rise, level])
        after = np.stack([c * (np.array([1.0, 0, 0]) - fall), c * np.array([steep, *rise[1:]]), level])
        tilted = after.T @ before
    return placement.screen_rotation @ tilted @ rolled, placement.screen_origin + np.array([sx, 0.0, 0.0])


def seen(y, z, effects=None, fields=(), *, on_paper=False, scale=1.0):
    """Pixels of points of the board, written out from the table of effects; free fields by their names, times scale."""
    e = {k: v for table in (effects or {}).values() for k, v in table.items()}
    e = {
        **dict.fromkeys("sx st_y st_z bow_y bow_z srot gs ga gsh k1 k2 p1 p2 rs_s rs_c".split(), 0.0),
        "rs_period": 1400.0,
    } | e
    if on_paper:
        gs, ga, gsh = (1e-3 * e[k] for k in ("gs", "ga", "gsh"))
        dy, dz = (
            (bilinear(HEIGHT, scale * HEIGHT_MM, y, z), -0.5 * bilinear(HEIGHT, scale * HEIGHT_MM, y, z))
            if "shift" in fields
            else (0, 0)
        )
        y, z = (1 + gs + ga) * y + gsh * z + dy, (1 + gs - ga) * z + gsh * y + dz
    x = 0.5e-3 * (e["bow_y"] * y**2 + e["bow_z"] * z**2)
    if "height" in fields:
        x = x + bilinear(HEIGHT, scale * HEIGHT_MM, y, z)
    turn, origin = stands_turned(e["sx"], e["st_y"], e["st_z"], e["srot"])
    world = origin + np.stack([x, y, z], axis=-1) @ turn.T
    rotation, translation = camera_pose(CAMERA)
    in_camera = world.reshape(-1, 3) @ rotation.T + translation
    (cx, cy), f, zero = CAMERA.principal_point, CAMERA.focal, np.zeros(3)
    lens = np.array(CAMERA.distortion) + np.array([e["k1"], e["k2"], e["p1"], e["p2"], 0.0])
    matrix = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
    uv = cv2.projectPoints(in_camera, zero, zero, matrix, lens)[0].reshape(*np.shape(y), 2)
    if "pixel" in fields:
        uv = uv + np.stack([bilinear(PIXEL, scale * c, uv[..., 0], uv[..., 1]) for c in PIXEL_PX], axis=-1)
    phase = 2 * np.pi * (uv[..., 1] - cy) / e["rs_period"]
    return uv + np.stack([e["rs_s"] * np.sin(phase) + e["rs_c"] * np.cos(phase), 0 * phase], axis=-1)


def blobs():
    n = [round(s / PITCH) for s in SCREEN.size]
    y, z = (-(k - 1) / 2 * PITCH + PITCH * np.arange(k) for k in n)
    # The map's tent adds pitch²/6.
    var = SIGMA**2 + PITCH**2 / 6
    values = sum(np.outer(np.exp(-((z - b) ** 2) / (2 * var)), np.exp(-((y - a) ** 2) / (2 * var))) for a, b in SPOTS)
    return ScreenMap(values, y[0], z[0], PITCH, 0.0)


def free(name, scale):
    """A free field of the board, the print or the camera."""
    knots, values = {
        "height": (HEIGHT, HEIGHT_MM[None]),
        "shift": (HEIGHT, np.stack([HEIGHT_MM, -0.5 * HEIGHT_MM])),
        "pixel": (PIXEL, PIXEL_PX),
    }[name]
    return {name: field(knots, scale * values)}


def ray_model(points, effects, fields, *, printed=False):
    """Pixels that `rays.see` gives; a shift or turn of the board as a whole is a matter of the pose."""
    rotation, translation = camera_pose(CAMERA)
    of_board = {"sx": "screen-distance", "st_y": "screen-tilt", "st_z": "screen-tilt", "srot": "screen-rotation"}
    turn, origin = stands_turned(*(effects.get(name, {}).get(key, 0.0) for key, name in of_board.items()))
    true = bench(stands(), effects=effects, fields=fields)
    return rays.see(true, CAMERA, rotation @ turn, rotation @ origin + translation, points, printed=printed)


def moments(places, weight):
    """Log of the sum of weights (n,) at pixels (n, 2), their mean u, v, and the second moments uu, vv, uv about it."""
    mean = weight @ places / weight.sum()
    off = places - mean
    (uu, uv), (_, vv) = (weight[:, None] * off).T @ off / weight.sum()
    return np.array([np.log(weight.sum()), *mean, uu, vv, uv])


def moments_near(image, near, reach):
    """`moments` of a square of a picture."""
    c, r = np.round(near).astype(int)
    cut = image[r - reach : r + reach + 1, c - reach : c + reach + 1].astype(float)
    v, u = np.mgrid[r - reach : r + reach + 1, c - reach : c + reach + 1]
    return moments(np.column_stack([u.ravel(), v.ravel()]), cut.ravel())


def mapped(points, weight, effects, fields, *, printed=False):
    """`moments` of points with their weights per mm² of the board, as the ray model maps them and their area."""
    see, h = partial(ray_model, effects=effects, fields=fields, printed=printed), 1e-2
    uy, uz = ((see(points + e) - see(points - e)) / (2 * h) for e in h * np.eye(2))
    area = np.abs(uy[:, 0] * uz[:, 1] - uy[:, 1] * uz[:, 0])
    return moments(see(points), area * weight)


def blob(spot, effects, fields):
    """`moments` of a blob's light as the ray model sees it.

    Sloping paper shows the light by its cosine, which the ray model leaves out: 2e-4 of the flux at a slope of 20 mrad.
    """
    q, h = np.linspace(-5, 5, 61) * SIGMA, 1e-2
    points = np.array(spot) + np.stack(np.meshgrid(q, q), axis=-1).reshape(-1, 2)
    height = partial(rays.camera.board_height, bench(stands(), effects=effects, fields=fields))
    slope = [(height(points + e) - height(points - e)) / (2 * h) for e in h * np.eye(2)]
    gauss = np.exp(-((points - spot) ** 2).sum(axis=1) / (2 * SIGMA**2))
    return mapped(points, gauss / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2), effects, fields)


def as_wide_and_bright(picture, plain, effects, fields):
    """Sums and second moments of the blobs against the picture without the effect, as the ray model has their change.

    Tolerated: 2 % of what the effect does anywhere, 3e-5 of the flux, 2e-4 px² of some 4 px².
    """
    got, want = [], []
    for spot in SPOTS:
        here, there = blob(spot, effects, fields), blob(spot, {}, {})
        want.append(here - there)
        got.append(moments_near(picture, here[1:3], 14) - moments_near(plain, there[1:3], 14))
    miss, size = np.abs(np.subtract(got, want)).max(axis=0), np.abs(want).max(axis=0)
    flux, wide = 3e-5 + 0.02 * size[0], 2e-4 + 0.02 * size[3:].max()
    assert miss[0] < flux and miss[3:].max() < wide, (miss, size)
    assert max(size[0] / flux, size[3:].max() / wide) > 5, "the effect shows"


def centroid(image, near, reach=14):
    c, r = np.round(near).astype(int)
    cut = image[r - reach : r + reach + 1, c - reach : c + reach + 1].astype(float)
    v, u = np.mgrid[r - reach : r + reach + 1, c - reach : c + reach + 1]
    return np.array([(cut * u).sum(), (cut * v).sum()]) / cut.sum()


def expected_centroid(spot, **keywords):
    """Centroid of the pixels of a Gaussian blob's points, weighted with the area that they fill."""
    q, h = np.linspace(-5, 5, 81) * SIGMA, 1e-2
    y, z = np.meshgrid(spot[0] + q, spot[1] + q)
    uy, uz = (seen(y + a, z + b, **keywords) - seen(y - a, z - b, **keywords) for a, b in ((h, 0), (0, h)))
    area = np.abs(uy[..., 0] * uz[..., 1] - uy[..., 1] * uz[..., 0])
    weight = area * np.exp(-((y - spot[0]) ** 2 + (z - spot[1]) ** 2) / (2 * SIGMA**2))
    return (weight[..., None] * seen(y, z, **keywords)).sum(axis=(0, 1)) / weight.sum()


OF_LIGHT = {
    "screen-distance": {"sx": 10.0},
    "screen-tilt": {"st_y": 12.0, "st_z": -9.0},
    "screen-bow": {"bow_y": 0.15, "bow_z": -0.1},
    "screen-rotation": {"srot": 11.0},
    "radial-distortion": {"k1": 0.09, "k2": 0.07},
    "tangential-distortion": {"p1": 0.008, "p2": -0.006},
    "rolling-shutter": {"rs_s": 2.5, "rs_c": -1.5, "rs_period": 500.0},
}


def scaled(table, scale):
    return {k: v if k == "rs_period" else scale * v for k, v in table.items()}


@pytest.fixture(scope="module")
def light():
    return blobs()


@pytest.fixture(scope="module")
def plain_light(light):
    """The picture of the blobs without any effect."""
    return photograph(SCREEN, CAMERA, light, placement=standing()).laser


@pytest.mark.parametrize("scale", [0.25, 1.0])
@pytest.mark.parametrize("name", OF_LIGHT)
def test_light_is_seen_where_and_as_wide_and_bright_as_the_effect_makes_it(light, plain_light, name, scale):
    effects = {name: scaled(OF_LIGHT[name], scale)}
    picture = photograph(SCREEN, CAMERA, light, placement=standing(), effects=effects)
    plain = max(np.abs(seen(*map(np.array, s), effects) - seen(*map(np.array, s))).max() for s in SPOTS)
    assert plain > 0.05, "the effect shows"
    for spot in SPOTS:
        want = expected_centroid(spot, effects=effects)
        np.testing.assert_allclose(centroid(picture.laser, want), want, atol=3e-3)
    as_wide_and_bright(picture.laser, plain_light, effects, {})


@pytest.mark.parametrize("scale", [0.3, 1.0])
@pytest.mark.parametrize("name", ["height", "pixel"])
def test_light_is_seen_where_and_as_wide_and_bright_as_the_field_makes_it(light, plain_light, name, scale):
    fields = free(name, scale)
    picture = photograph(SCREEN, CAMERA, light, placement=standing(), fields=fields)
    for spot in SPOTS:
        want = expected_centroid(spot, fields=(name,), scale=scale)
        np.testing.assert_allclose(centroid(picture.laser, want), want, atol=3e-3)
    as_wide_and_bright(picture.laser, plain_light, {}, fields)


def test_effects_act_together(light, plain_light):
    """Nothing is applied twice or lost where lens, board, turn and read-out meet."""
    picture = photograph(SCREEN, CAMERA, light, placement=standing(), effects=OF_LIGHT)
    for spot in SPOTS:
        want = expected_centroid(spot, effects=OF_LIGHT)
        np.testing.assert_allclose(centroid(picture.laser, want), want, atol=5e-3)
    as_wide_and_bright(picture.laser, plain_light, OF_LIGHT, {})


def test_a_sloping_surface_shows_the_same_light_on_more_paper(light):
    """Light per area of the paper, not of the plane: radiance falls by the cosine of a slope (exaggerated here).

    A board that is turned as a whole has its map along itself: there is nothing to lose.
    """
    plain = photograph(SCREEN, CAMERA, light, placement=standing())
    k = np.array([-300.0, 300.0])
    rising = {"height": field([k, k], (0.3 * k[:, None] + 0.0 * k)[None])}
    for expected, more in (
        (1 / np.hypot(1, 0.3), {"fields": rising}),
        (1.0, {"effects": {"screen-tilt": {"st_z": 300.0}}}),
    ):
        steep = photograph(SCREEN, CAMERA, light, placement=standing(), **more)
        assert steep.laser.max() / plain.laser.max() == pytest.approx(expected, rel=0.02)


def test_a_turned_board_shows_nothing_of_it():
    """Marks of a board turned by tilt and roll, and moved along x: the solved pose leaves no residual.

    Expectation: edges of the printed squares, and so the corners, are those of a plane: 0.01 px, which is what the
    squares of the board as it is stated leave.
    """
    effects = {
        "screen-tilt": {"st_y": 18.0, "st_z": -14.0},
        "screen-rotation": {"srot": 9.0},
        "screen-distance": {"sx": 6.0},
    }
    y, z = np.array([c for c in MARKED.marks.centres]).T
    board = np.column_stack([np.zeros(len(y)), y, z])
    picture = photograph(MARKED, CAMERA, None, placement=standing(), effects=effects)
    assert np.abs(misses(picture, effects=effects)).mean() < 0.01
    (cx, cy), f = CAMERA.principal_point, CAMERA.focal
    lens = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
    pixels, distortion = seen(y, z, effects), np.array(CAMERA.distortion)
    found, turn, shift = cv2.solvePnP(board, pixels, lens, distortion)
    turn, shift = cv2.solvePnPRefineLM(board, pixels, lens, distortion, turn, shift)
    assert found and np.abs(cv2.projectPoints(board, turn, shift, lens, distortion)[0][:, 0] - pixels).max() < 1e-4


@pytest.mark.parametrize("scale", [0.2, 1.0])
@pytest.mark.parametrize("name", [*OF_LIGHT, "grid-scale", "grid-aspect", "grid-shear", "height", "pixel", "shift"])
def test_the_ray_model_sees_the_same(name, scale):
    """`rays.see`, written apart, gives the closed form that pictures are held against."""
    table = {**OF_LIGHT, **ON_PAPER}.get(name)
    effects = {name: scaled(table, scale)} if table else {}
    fields = {} if table else free(name, scale)
    y, z = np.array(SPOTS).T
    got = ray_model(np.array(SPOTS), effects, fields, printed=True)
    np.testing.assert_allclose(got, seen(y, z, effects, tuple(fields), on_paper=True, scale=scale), atol=1e-6)


def misses(picture, **keywords):
    """Left and top edges of the printed squares, line of pixels by line, against the closed form."""
    along, out = np.linspace(-SIDE / 2, SIDE / 2, 201), []
    for y, z in MARKED.marks.centres:
        left = seen(np.full(201, y - SIDE / 2), z + along, on_paper=True, **keywords)
        top = seen(y + along, np.full(201, z + SIDE / 2), on_paper=True, **keywords)
        for axis, edge, image in ((0, left, picture.room), (1, top, picture.room.T)):
            across, down = edge[:, axis], edge[:, 1 - axis]
            order = np.argsort(down)
            for line in range(int(down.min()) + 5, int(down.max()) - 5):
                want = np.interp(line, down[order], across[order])
                first = round(want) - 3
                cut = image[line, first : first + 6].astype(float)
                share = (cut - cut[-2:].mean()) / (cut[:2].mean() - cut[-2:].mean())
                out.append(first - 0.5 + share.sum() - want)
    return np.array(out)


ON_PAPER = {"grid-scale": {"gs": 8.0}, "grid-aspect": {"ga": -9.0}, "grid-shear": {"gsh": 7.0}}


def ink(effects, fields):
    """The picture of the printed squares, and the share of every pixel that is ink."""
    picture = photograph(MARKED, CAMERA, None, placement=standing(), effects=effects, fields=fields)
    white = photograph(SCREEN, CAMERA, None, placement=standing(), effects=effects, fields=fields)
    return picture, (1 - picture.room / white.room) / (1 - INK / MARKED.reflectance)


@pytest.fixture(scope="module")
def plain_ink():
    return ink({}, {})[1]


def square(k, effects, fields):
    """`moments` of a mark's black cells as the ray model sees them, by Gauss' rule in each cell."""
    x, w = np.polynomial.legendre.leggauss(3)
    row, column = np.nonzero(tag_cells(MARKED.marks.ids[k]))
    a, b = (0.5 * g.ravel() for g in np.meshgrid(x, x))
    at = SIDE * (np.stack([column[:, None] + 0.5 + a, row[:, None] + 0.5 + b], axis=-1) / CELLS - 0.5)
    weight = np.tile(np.outer(w, w).ravel() / 4 * (SIDE / CELLS) ** 2, len(row))
    return mapped(np.array(MARKED.marks.centres[k]) + at.reshape(-1, 2), weight, effects, fields, printed=True)


@pytest.mark.parametrize("scale", [0.2, 1.0])
@pytest.mark.parametrize("name", [*ON_PAPER, "shift", "screen-bow", "rolling-shutter", "pixel"])
def test_print_is_seen_where_and_as_large_as_the_effect_makes_it(plain_ink, name, scale):
    """Biased edges would show in the mean (0.01 px); a single line's is uncertain by some 0.03 px (midpoint rule).

    The squares' ink against the ray model: tolerated are 3e-3 px of its mean, and 1 % of what the effect does beside
    0.03 px² of some 100 px² of second moments and 1e-4 of the sum.
    """
    table = {**ON_PAPER, **OF_LIGHT}.get(name)
    effects = {name: scaled(table, scale)} if table else {}
    fields = {} if table else free(name, scale)
    picture, black = ink(effects, fields)
    got, want = [], []
    for k in range(len(MARKED.marks.ids)):
        here, there = square(k, effects, fields), square(k, {}, {})
        want.append(here - there)
        got.append(moments_near(black, here[1:3], 26) - moments_near(plain_ink, there[1:3], 26))
    off, size = np.abs(np.subtract(got, want)).max(axis=0), np.abs(want).max(axis=0)
    tolerated = np.array([1e-4 + 0.01 * size[0], 3e-3, 3e-3, *3 * [0.03 + 0.01 * size[3:].max()]])
    assert (off < tolerated).all(), (off, size)
    assert (size / tolerated)[1:3].max() > 10 and (size / tolerated)[3:].max() > 5, "the effect shows"
    assert scale < 1 or name not in ("grid-scale", "shift", "screen-bow") or size[0] > 20 * tolerated[0]
    miss = misses(picture, effects=effects, fields=tuple(fields), scale=scale)
    assert len(miss) > 200
    assert abs(miss.mean()) < 0.01 and np.abs(miss).max() < 0.1, (miss.mean(), np.abs(miss).max())


def test_grid_errors_leave_light_and_outline_alone(light):
    effects = {**ON_PAPER}
    plain, warped = (photograph(SCREEN, CAMERA, light, placement=standing(), effects=e) for e in ({}, effects))
    np.testing.assert_array_equal(plain.laser, warped.laser)
    np.testing.assert_array_equal(plain.room, warped.room)


def test_print_out_of_place_by_nothing_is_print_in_place():
    """The general way to lay print reproduces the exact one."""
    lay = printed({}, {"shift": field(HEIGHT, np.zeros((2, 4, 3)))})
    np.testing.assert_allclose(reflectance(MARKED, lay=lay).values, reflectance(MARKED).values, atol=1e-9)


def ridge(width=1.6, slope=0.35, rows=120, columns=400):
    """A slanted line whose brightness is a parabola along it, 1 at the middle; crest rows per column."""
    v, u = np.mgrid[0:rows, 0:columns].astype(float)
    crest = 20 + slope * 0.5 * u + 1e-4 * u**2
    bright = 1 - ((u - columns / 2) / (0.75 * columns)) ** 2
    return (bright * np.exp(-((v - crest) ** 2) / (2 * width**2))).astype(np.float32), bright[0]


@pytest.mark.parametrize("sat", [-2.5, 0.4, 2.5])
@pytest.mark.parametrize("width", [1.2, 2.4])
def test_charge_spills_by_the_square_of_the_brightness(sat, width):
    """Columns' centroids move by sat b²; no charge is lost and the line is as wide as it was."""
    image, bright = ridge(width)
    (flux, at, wide), (before, was, narrow) = (
        column_moments(x) for x in (arrived(image, {"saturation": {"sat": sat}}, {}), image)
    )
    inner = slice(20, -20)
    np.testing.assert_allclose((at - was)[inner], (sat * bright**2)[inner], atol=0.05 * abs(sat))
    np.testing.assert_allclose(flux[inner], before[inner], rtol=5e-3)
    np.testing.assert_allclose(wide[inner], narrow[inner], rtol=1e-2)


def column_moments(image):
    """Sum, mean row and variance of every column."""
    v = np.arange(len(image))[:, None]
    total = image.sum(axis=0, dtype=float)
    mean = (v * image).sum(axis=0) / total
    return total, mean, ((v - mean) ** 2 * image).sum(axis=0) / total


@pytest.mark.parametrize("scale", [0.3, 1.5])
def test_the_trace_moves_with_its_brightness_as_the_field_says(scale):
    image, bright = ridge()
    values = scale * np.array([[0.0, 0.0, 0.0], [0.0, 0.4, -0.6]])
    out = arrived(image, {}, {"brightness": field([np.array([0.0, 0.7, 1.0])], values)})
    (flux, at, wide), (before, was, narrow) = column_moments(out), column_moments(image)
    moved = at - was
    want = np.interp(bright, [0, 0.7, 1.0], values[1])
    inner = slice(20, -20)
    np.testing.assert_allclose(level(image)[image.argmax(axis=0), np.arange(400)][inner], bright[inner], atol=0.02)
    np.testing.assert_allclose(moved[inner], want[inner], atol=0.05 * scale)
    # A line that moves as a whole keeps its light and its width.
    np.testing.assert_allclose(flux[inner], before[inner], rtol=5e-3)
    np.testing.assert_allclose(wide[inner], narrow[inner], rtol=1e-2)


def test_bad_effects_are_told():
    with pytest.raises(BenchsimError, match="rs_period: must be above 0"):
        photograph(
            SCREEN, CAMERA, None, placement=standing(), effects={"rolling-shutter": {"rs_s": 1.0, "rs_period": 0.0}}
        )
    folded = {
        "pixel": field([np.array([280.0, 281.0]), np.array([0.0, 1.0])], [[[5.0, 5.0], [-5.0, -5.0]], np.zeros((2, 2))])
    }
    with pytest.raises(BenchsimError, match=r"fields\.pixel: folds"):
        photograph(SCREEN, CAMERA, None, placement=standing(), fields=folded)


def bench(*exposures, **keywords):
    camera = Camera("A", (200, 150), 500.0, (99.5, 74.5))
    marks = Marks((0,), ((-60.0, 60.0),), (32.0,))
    screen = Screen((200.0, 200.0), 0.8, marks)
    options = RenderOptions(relative_error=0.2, dark=False)
    return Recording(Laser(), Mirror(), screen, {"A": camera}, exposures, render=options, **keywords)


def stands(time=0.0):
    return Exposure("A", "s", np.radians(101), np.radians(50), (1500.0, -160.0, -1430.0), time=time)


def test_what_is_concealed_is_rendered_and_not_written(tmp_path):
    """Bytes of the pictures are the same, the file is silent."""
    effects, fields = {"screen-distance": {"sx": 15.0}}, {"pixel": field(PIXEL, PIXEL_PX)}
    b = bench(stands(), effects=effects, fields=fields)
    light = ScreenMap(np.eye(800), -99.875, -99.875, PITCH, 0.0)
    pictures = {}
    for name, conceal, recording in (("told", False, b), ("hidden", True, b), ("none", False, bench(stands()))):
        folder = tmp_path / name
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "irradiance", lambda *a, **k: light)
            truth = module.render_recording(recording, folder, noise=False, setting_errors=False, conceal=conceal)
        back = read(folder, images=True)
        assert bool(back.effects) == bool(back.fields) == (name == "told"), name
        assert truth.recording.effects == back.effects
        pictures[name] = cv2.imread(str(folder / "001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(pictures["told"], pictures["hidden"])
    assert (pictures["none"] != pictures["hidden"]).mean() > 0.1


@pytest.mark.parametrize(("keywords", "times"), [({}, 1), ({"effects": {"drift": {"dry": 0.3}}}, 2)])
def test_light_that_drifts_is_traced_at_every_time(tmp_path, monkeypatch, keywords, times):
    calls = []

    def counted(recording, exposure, **_):
        calls.append(exposure.time)
        return ScreenMap(np.eye(800), -99.875, -99.875, PITCH, 0.0)

    monkeypatch.setattr(module, "irradiance", counted)
    module.render_recording(bench(stands(), stands(3600.0), **keywords), tmp_path, setting_errors=False)
    assert len(calls) == times
