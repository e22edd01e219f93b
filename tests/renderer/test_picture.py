"""The camera's picture against OpenCV's projection, against flux, and against a float64 integral over pixels."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.interpolate import griddata

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Laser, Marks, Mirror, Recording, Screen
from benchsim.bench.place import Placement, SettingErrors, camera_pose, place
from benchsim.renderer.irradiance import ScreenMap
from benchsim.renderer.picture import WALL, photograph
from benchsim.renderer.rerendered import expected

PITCH = 0.25
CAMERA = Camera("A", (800, 600), 880.0, (403.2, 296.7), (-0.12, 0.05, 0.0007, -0.0005, 0.01))
EXPOSURE = Exposure("A", "s", np.radians(101), np.radians(50), (1500.0, -160.0, -1430.0), 12.0, np.radians(8.0))
SCREEN = Screen((600.0, 400.0), 0.8)


def matrix(camera):
    (cx, cy), f = camera.principal_point, camera.focal
    return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])


def board_to_pixels(camera, pose, placement, y, z):
    board = np.stack([np.zeros_like(y), y, z], axis=-1)
    world = placement.screen_origin + board @ placement.screen_rotation.T
    seen = world.reshape(-1, 3) @ pose[0].T + pose[1]
    zero = np.zeros(3)
    return cv2.projectPoints(seen, zero, zero, matrix(camera), np.array(camera.distortion))[0].reshape(*y.shape, 2)


def tilted() -> Placement:
    errors = SettingErrors(screen_position=np.array([1.0, 2.0, -3.0]), screen_angle=np.array([0.01, -0.02, 0.015]))
    return place(Mirror(), EXPOSURE, errors)


def pixels_per_mm2(camera, pose, placement, y, z, h=1e-3):
    """|d(u, v)/d(y, z)|."""
    uy, uz = (
        board_to_pixels(camera, pose, placement, y + a, z + b) - board_to_pixels(camera, pose, placement, y - a, z - b)
        for a, b in ((h, 0), (0, h))
    )
    return np.abs(uy[..., 0] * uz[..., 1] - uy[..., 1] * uz[..., 0]) / (4 * h * h)


def grid(size):
    n = [round(s / PITCH) for s in size]
    y, z = (-(k - 1) / 2 * PITCH + PITCH * np.arange(k) for k in n)
    return y, z


def map_of(values, y, z):
    return ScreenMap(values, y[0], z[0], PITCH, 0.0)


def blobs(centres, sigma):
    """Gaussian blobs as a map holds them: means with a tent."""
    y, z = grid(SCREEN.size)
    values = np.zeros((len(z), len(y)))
    # The tent adds pitch²/6; a Gaussian of that variance more is the same to 1e-5 of the blob.
    var = sigma**2 + PITCH**2 / 6
    for cy, cz in centres:
        over_z, over_y = (np.exp(-((x - c) ** 2) / (2 * var)) for x, c in ((z, cz), (y, cy)))
        values += sigma**2 / var * np.outer(over_z, over_y)
    return map_of(values, y, z)


def blob_in_picture(camera, pose, placement, centre, sigma):
    """First moments and flux of a blob in the picture, float64: the integral over pixels of L(X(u))."""
    q = np.linspace(-6, 6, 121) * sigma
    y, z = np.meshgrid(centre[0] + q, centre[1] + q)
    u = board_to_pixels(camera, pose, placement, y, z)
    jacobian = pixels_per_mm2(camera, pose, placement, y, z)
    weight = jacobian * np.exp(-((y - centre[0]) ** 2 + (z - centre[1]) ** 2) / (2 * sigma**2))
    first = (weight[..., None] * u).sum(axis=(0, 1)) / weight.sum()
    second = (weight[..., None] * (u - first) ** 2).sum(axis=(0, 1)) / weight.sum()
    return first, second, weight.sum() * (q[1] - q[0]) ** 2


def test_points_lie_where_opencv_projects_them():
    """Rationale: pixel convention, distortion, pose, the board's shift, roll and re-seating, and float32, all at once.

    Set-up: Gaussian blobs all over a shifted, rolled and tilted board, a strongly distorting camera with a pose of its
    own. Expectation: centroids as the float64 projection's to 0.002 px, flux to 0.1 %, widths to 0.3 % beyond what a
    pixel adds (1/12 px²).
    """
    centres = [(y, z) for y in (-250.0, -101.3, 40.7, 255.0) for z in (-160.0, -33.3, 120.9)]
    sigma = 3.0
    rotation, translation = camera_pose(CAMERA)
    turn = cv2.Rodrigues(np.array([0.004, -0.003, 0.02]))[0]
    pose = (turn @ rotation, turn @ translation + [3.0, -2.0, 5.0])
    placement = tilted()
    picture = photograph(SCREEN, CAMERA, blobs(centres, sigma), placement=placement, pose=pose)
    worst = 0.0
    for centre in centres:
        first, second, flux = blob_in_picture(CAMERA, pose, placement, centre, sigma)
        c, r = np.round(first).astype(int)
        cut = picture.laser[r - 14 : r + 15, c - 14 : c + 15].astype(float)
        v, u = np.mgrid[r - 14 : r + 15, c - 14 : c + 15]
        mean = np.array([(cut * u).sum(), (cut * v).sum()]) / cut.sum()
        spread = np.array([(cut * (u - mean[0]) ** 2).sum(), (cut * (v - mean[1]) ** 2).sum()]) / cut.sum() - 1 / 12
        worst = max(worst, np.abs(mean - first).max())
        assert cut.sum() == pytest.approx(SCREEN.reflectance * flux, rel=1e-3)
        np.testing.assert_allclose(np.sqrt(spread), np.sqrt(second), rtol=3e-3)
    assert worst < 0.002, worst


def test_flux_is_the_maps():
    """The sum over pixels times the board's area per pixel is the light on the board times its reflectance."""
    y, z = grid(SCREEN.size)
    values = np.exp(-((z[:, None] - 0.3 * y - 0.0004 * y**2) ** 2) / (2 * 1.2**2))
    values *= (np.abs(y) < 280) * (np.abs(z) < 190)[:, None]
    placement = tilted()
    picture = photograph(SCREEN, CAMERA, map_of(values, y, z), placement=placement)
    pose = camera_pose(CAMERA)
    yy, zz = np.meshgrid(y[::8], z[::8])
    where = board_to_pixels(CAMERA, pose, placement, yy, zz).reshape(-1, 2)
    area = 1 / pixels_per_mm2(CAMERA, pose, placement, yy, zz).ravel()
    rows, columns = np.nonzero(picture.laser > 1e-6 * picture.laser.max())
    per_pixel = griddata(where, area, (columns, rows), method="linear")
    seen = np.nansum(picture.laser[rows, columns] * per_pixel)
    assert seen == pytest.approx(SCREEN.reflectance * values.sum() * PITCH**2, rel=2e-4)


def edge_at(line, near):
    """Where a line of pixels falls from white to black next to ``near``, from the light it lost."""
    start = round(near) - 4
    cut = line[start : start + 8].astype(float)
    white, black = cut[:2].mean(), cut[-2:].mean()
    return start - 0.5 + ((cut - black) / (white - black)).sum()


def test_marks_lie_where_opencv_projects_them():
    """Left and top edges of the black squares, pixel line by pixel line: unbiased to 0.005 px, each to 0.06 px.

    A single line's edge is uncertain by the midpoint rule over the edge pixel, some 0.02 px.
    """
    places = [(y, z) for y in (-230.0, -70.0, 90.0, 220.0) for z in (-130.0, 0.0, 120.0)]
    side = 60.0
    screen = Screen(SCREEN.size, 0.8, Marks(tuple(range(12)), tuple(places), (side,) * 12))
    placement = tilted()
    picture = photograph(screen, CAMERA, None, placement=placement)
    assert not picture.laser.any()
    seen = np.round(np.clip(picture.room / 0.9, 0, 1) * 255).astype(np.uint8)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    assert sorted(detector.detectMarkers(seen)[1].ravel()) == list(range(12))
    pose, along = camera_pose(CAMERA), np.linspace(-side / 2, side / 2, 201)
    misses = {0: [], 1: []}
    for y, z in places:
        left = board_to_pixels(CAMERA, pose, placement, np.full(201, y - side / 2), z + along)
        top = board_to_pixels(CAMERA, pose, placement, y + along, np.full(201, z + side / 2))
        for axis, edge, image in ((0, left, picture.room), (1, top, picture.room.T)):
            across, down = edge[:, axis], edge[:, 1 - axis]
            order = np.argsort(down)
            for line in range(int(down.min()) + 6, int(down.max()) - 6):
                want = np.interp(line, down[order], across[order])
                misses[axis].append(edge_at(image[line], want) - want)
    for miss in map(np.array, misses.values()):
        assert abs(miss.mean()) < 0.005, miss.mean()
        assert np.abs(miss).max() < 0.06, np.abs(miss).max()


def test_beside_the_board_is_the_wall():
    picture = photograph(SCREEN, CAMERA, None, placement=tilted())
    assert picture.room[0, 0] == np.float32(WALL)
    assert picture.room.max() < 0.8 * 1.09


def test_a_camera_behind_the_screen_is_refused():
    rotation, translation = camera_pose(Camera("B", (80, 60), 88.0, (39.5, 29.5), position=(-1200.0, 350.0, -150.0)))
    with pytest.raises(BenchsimError, match="camera A stands behind"):
        photograph(SCREEN, CAMERA, None, placement=tilted(), pose=(rotation, translation))


@pytest.mark.parametrize("bow", [{}, {"screen-bow": {"bow_y": 0.1, "bow_z": -0.05}}], ids=["plane", "bowed"])
def test_the_trace_alone_is_the_whole_pictures(bow):
    """Two spots on one side of the board, a mark under one: photographed alone they are as in the whole picture."""
    screen = Screen(SCREEN.size, 0.8, Marks((7,), ((-180.0, 60.0),), (40.0,)))
    light = blobs([(-200.0, 50.0), (-90.0, -20.0)], 5.0)
    whole, part = (
        photograph(screen, CAMERA, light, placement=tilted(), effects=bow, lit_only=alone) for alone in (False, True)
    )
    assert np.abs(part.laser - whole.laser).max() < 2e-4 * whole.laser.max()
    assert (part.room == np.float32(WALL)).sum() > (whole.room == np.float32(WALL)).sum() + 50_000


@pytest.mark.parametrize(
    "table", [{"screen-distance": {"sx": 15.0}}, {"screen-tilt": {"st_y": 20.0, "st_z": -12.0}},
              {"screen-rotation": {"srot": 18.0}}]
)  # fmt: skip
def test_what_turns_a_board_is_in_the_pose_that_its_marks_gave(table):
    """Rationale: a pose solved from marks holds all that moves them together; shown besides, it would be seen twice.

    Set-up: one light on the board, seen from one pose of its marks. Expectation: the same picture with the effect.
    """
    bench = Recording(Laser(), Mirror(), SCREEN, {"A": CAMERA}, (EXPOSURE,))
    pose = camera_pose(CAMERA)
    light = blobs([(-200.0, 50.0), (90.0, -120.0)], 4.0)
    shown = [
        expected(replace(bench, effects=effects), EXPOSURE, CAMERA, *pose, light=light).laser for effects in ({}, table)
    ]
    np.testing.assert_array_equal(*shown)
