"""Mitsuba's pictures against the float64 predictor, and what is found in them.

Bars are in mm in the mirror, 19 mm to the pixel.
"""

import cv2
import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.drones.estimate import axis_error, estimate
from benchsim.drones.finding import find_glints, find_mirror, read_images, to_mirror
from benchsim.drones.flight import Errors, Flight, Sightings, camera_point, fly, pattern, seen, stand
from benchsim.drones.heliostat import axes, design_map, four_facets

DESIGN = four_facets()
QUAD = np.array([[20.3, 90.6], [121.2, 89.9], [120.8, 11.1], [19.9, 11.6]])


def drawn(spots):
    """A mirror over dark ground with Gaussian spots, supersampled."""
    big = np.zeros((880, 1120), np.float32)
    cv2.fillPoly(big, [np.round((QUAD + 0.5) * 8 - 0.5).astype(np.int32)], 0.1)
    image = cv2.GaussianBlur(cv2.resize(big, (140, 110), interpolation=cv2.INTER_AREA), (0, 0), 0.6) + 0.01
    y, x = np.mgrid[:110, :140]
    for u, v in spots:
        image = image + 0.6 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 2)
    return image + 0.003 * np.random.default_rng(1).standard_normal(image.shape)


def test_corners_and_glints_of_a_drawn_mirror():
    spots = np.array([[40.3, 30.7], [90.1, 60.4]])
    image = drawn(spots)
    corners = find_mirror(image, QUAD + np.array([9.0, -7.0]))
    np.testing.assert_allclose(corners, QUAD, atol=0.2)
    np.testing.assert_allclose(find_glints(image, corners), spots, atol=0.05)


def test_much_ground_around_moves_no_edge():
    """With the ground in most of the picture, as in a frame of a cluster."""
    image = drawn([[40.3, 30.7]])
    wide = np.full((250, 280), 0.01) + 0.003 * np.random.default_rng(3).standard_normal((250, 280))
    wide[70:180, 70:210] = image
    np.testing.assert_allclose(find_mirror(wide, QUAD + 70.0 + np.array([-6.0, 5.0])) - 70.0, QUAD, atol=0.2)


def test_a_neighbour_is_not_taken_for_a_part():
    """Another mirror 8 px beside it: the one that was expected is found, whole."""
    image = drawn([[40.3, 30.7]])
    wide = np.hstack([image[:, :129], image[:, 12:]])
    np.testing.assert_allclose(find_mirror(wide, QUAD + 4.0), QUAD, atol=0.25)


def test_a_half_hidden_mirror_is_refused():
    image = drawn([[40.3, 30.7]])
    image[:, 80:] = 0.01
    with pytest.raises(BenchsimError, match=r"shape|no mirror|located"):
        find_mirror(image, QUAD)


def test_corners_map_to_the_outline():
    np.testing.assert_allclose(to_mirror(QUAD, QUAD, DESIGN), DESIGN.outline, atol=0.01)
    assert to_mirror(np.empty((0, 2)), QUAD, DESIGN).shape == (0, 2)


def test_a_picture_without_a_mirror_is_refused():
    with pytest.raises(BenchsimError, match="no mirror"):
        find_mirror(0.01 + 0.003 * np.random.default_rng(2).random((110, 140)), QUAD)


@pytest.fixture(scope="module")
def rendered():
    """Frames of a flight that show a glint, every third, photographed."""
    from benchsim.drones import picture
    from benchsim.renderer import backend

    try:
        backend.use()
    except BenchsimError as error:
        pytest.skip(f"no back end of Mitsuba works here: {error}")
    rng = np.random.default_rng(51)
    target = camera_point(150e3, 3.7, 0.25)
    errors = Errors()
    flight = fly(target, pattern(target, (1600.0, 1600.0), 400.0), errors, rng)
    h = stand([[5e3, 8e3, 0.0]], DESIGN, target, errors, rng)[0]
    chosen = np.unique(seen(h, flight).frame)[::4]
    flight = Flight(
        target, *(a[chosen] for a in (flight.cameras, flight.lamps, flight.said_cameras, flight.said_lamps))
    )
    images, near = picture.photographs(h, flight, picture.Camera(), rng, samples=16)
    return h, flight, images, near


def test_rendered_glints_stand_where_the_law_of_reflection_says(rendered):
    """Those clear of facets' edges and of one another, where the lamp's size shows: within 5 mm rms, none beyond 20."""
    h, flight, images, near = rendered
    found, true = read_images(images, near, DESIGN), seen(h, flight)
    off, clear = [], 0
    for f in range(len(images)):
        own = true.points[true.frame == f]
        for i, p in enumerate(own):
            others = np.delete(own, i, axis=0)
            inset = np.array(DESIGN.size) / 2 - np.abs(p - DESIGN.centres)
            if inset.min(axis=1).max() < 50 or (len(others) and np.linalg.norm(others - p, axis=1).min() < 160):
                continue
            clear += 1
            seen_here = found.points[found.frame == f]
            if len(seen_here):
                off.append(seen_here[np.linalg.norm(seen_here - p, axis=1).argmin()] - p)
    off = np.array(off)
    missed = np.linalg.norm(off, axis=1) > 60  # too faint: another one answers
    assert clear >= 8 and len(off) - missed.sum() >= clear - 2
    assert np.sqrt((off[~missed] ** 2).mean()) < 5.0 and np.abs(off[~missed]).max() < 20.0


def test_the_mirror_is_found_in_every_picture(rendered):
    from benchsim.drones.picture import Camera, looking, outline, project

    h, flight, images, near = rendered
    for image, expected, eye in zip(images, near, flight.cameras, strict=True):
        corners = find_mirror(image, expected)
        # the gimbal's error, which moves the picture, is not known here: the quadrangle's shape is
        shape = project(Camera(), looking(eye, np.zeros(3)), outline(axes(h.mount), DESIGN.outline))
        assert np.abs((corners - corners.mean(axis=0)) - (shape - shape.mean(axis=0))).max() < 0.3


def test_the_axis_from_pictures_alone(rendered):
    """Estimated from rendered pictures and from the predicted glints of the same frames: within 0.1 mrad."""
    h, flight, images, near = rendered
    true = seen(h, flight)
    both = [read_images(images, near, DESIGN), Sightings(true.frame, true.points)]
    for reference in (h.measured, design_map(DESIGN)):
        a, b = (estimate(s, flight.said_cameras, flight.said_lamps, h.said, reference) for s in both)
        errors = [axis_error(p, h.mount, h.axis) for p in (a, b)]
        assert np.abs(errors[0] - errors[1]).max() < (0.05e-3 if reference is h.measured else 0.4e-3)
