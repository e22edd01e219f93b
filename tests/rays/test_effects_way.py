"""Effects on the way from the mirror and at its end: air, window, the board's surface, and time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchsim.bench.fields import field
from benchsim.bench.model import Physics
from benchsim.bench.place import SettingErrors, place
from benchsim.rays import air, predict, screen
from benchsim.rays.prediction import bench_of
from benchsim.rays.profile import adaptive


def rays_of(lab, n=9):
    """Rays from near the mirror to all of the board, directions of different lengths."""
    rng = np.random.default_rng(5)
    x = lab.placement.centre + rng.uniform(-9, 9, (n, 3))
    to = np.column_stack([np.zeros(n), rng.uniform(-340, 340, (n, 2))])
    return x, (to - x) * rng.uniform(2e-4, 8e-4, (n, 1))


def test_window_shifts_beside(lab):
    """Textbook: T sin i (1 − cos i / (n cos r)) across the ray, away from the slab's normal; the direction stays."""
    x, g = rays_of(lab)
    slab = air.AirEffects(window=6.0, turn=(np.radians(10.0), np.radians(-7.0)))
    moved, direction = air.carry(slab, lab.placement, x, g)
    np.testing.assert_array_equal(direction, g)
    ray = g / np.linalg.norm(g, axis=1, keepdims=True)
    # +x turned by the rotation vector (0, 10°, −7°).
    angle = np.hypot(np.radians(10.0), np.radians(7.0))
    axis = np.array([0.0, np.radians(10.0), np.radians(-7.0)]) / angle
    normal = np.cos(angle) * np.array([1.0, 0.0, 0.0]) + np.sin(angle) * np.cross(axis, [1.0, 0.0, 0.0])
    i = np.arccos(-ray @ normal)
    r = np.arcsin(np.sin(i) / 1.515)
    shift = moved - x
    shift -= (shift * ray).sum(axis=1, keepdims=True) * ray
    across = 6.0 * np.sin(i) * (1 - np.cos(i) / (1.515 * np.cos(r)))
    np.testing.assert_allclose(np.linalg.norm(shift, axis=1), across, atol=1e-10)
    # Toward the foot of the normal: light inside is steeper.
    assert (shift @ -normal > 0).all()


def test_window_moves_the_trace_by_that(lab):
    """A single ray through a slab parallel to the board: y and z shrink by T (tan i − tan r) along the tangent of i."""
    ray = Physics(False, False, False)
    before, after = (lab.trace(e, physics=ray, errors=None) for e in ({}, {"window": {"win": 8.0}}))
    bench = bench_of(lab.recording, lab.exposure)
    for phase, point in zip(after.phase, after.points, strict=True):
        p = bench.placement
        n = np.cos(phase) * p.normal + np.sin(phase) * np.cross(p.axis, p.normal)
        x = p.centre + lab.recording.mirror.radius * n
        out = p.laser_direction - 2 * (p.laser_direction @ n) * n
        hit = (x - x[0] / out[0] * out)[1:]
        tangent = np.linalg.norm(out[1:]) / abs(out[0])
        sine = np.linalg.norm(out[1:]) / 1.515
        short = 8.0 * (tangent - sine / np.sqrt(1 - sine**2))
        np.testing.assert_allclose(point, hit - short * out[1:] / np.linalg.norm(out[1:]), atol=1e-9)
    assert len(before.points) == len(after.points)


def test_tilted_window_is_four_millimetres_thick(lab):
    tilt = {"wty": 8.0, "wtz": -5.0}
    default = lab.trace({"window-tilt": tilt})
    lab.same(default, lab.trace({"window-tilt": tilt, "window": {"win": 4.0}}), 1e-12)
    assert np.abs(lab.apart(default, lab.trace({"window": {"win": 4.0}}))[0]).max() > 0.01


def test_gradient_is_the_ray_equation(lab):
    """d/ds (n dX/ds) = ∇n integrated by Runge–Kutta with n(y, z) = 1.00027 + dn/dT (air z + airh y).

    The model leaves the 1.00027 out, 1e-4 mm of the shift.
    """
    x, g = rays_of(lab, 4)
    per_mm = -0.95e-6 * 1e-3 * np.array([0.0, 150.0, 200.0])
    bent = air.AirEffects(gradient=(per_mm[1], per_mm[2]))
    line, direction = air.carry(bent, lab.placement, x, g)
    board, _ = screen.meet(lab.placement, line, direction)
    straight, _ = screen.meet(lab.placement, x, g)
    for i in range(4):
        ray = g[i] / np.linalg.norm(g[i])

        def fall(_, state):
            n = 1.00027 + per_mm @ (state[:3] - x[i])  # noqa: B023 - used within the round
            return np.concatenate([state[3:] / n, per_mm])

        front = lab.placement.screen_rotation[:, 0]

        def there(_, state):
            return front @ (state[:3] - lab.placement.screen_origin)  # noqa: B023

        there.terminal = True
        done = solve_ivp(
            fall, (0, 4000), np.concatenate([x[i], 1.00027 * ray]), events=there, rtol=1e-12, atol=1e-10
        ).y_events[0][0]
        hit = (done[:3] - lab.placement.screen_origin) @ lab.placement.screen_rotation[:, 1:]
        np.testing.assert_allclose(board[i], hit, atol=1e-4)
        assert np.linalg.norm(board[i] - straight[i]) > 0.2


def test_warm_air_above_bends_down(lab):
    """The sign, alone: air that is warmer above sends light down, warmer toward +y toward −y."""
    x, g = rays_of(lab)
    straight, _ = screen.meet(lab.placement, x, g)
    for table, axis in (({"air": 150.0}, 1), ({"airh": 150.0}, 0)):
        bent = air.effects({"air-gradient": table}, {})
        hit, _ = screen.meet(lab.placement, *air.carry(bent, lab.placement, x, g))
        assert (hit[:, axis] < straight[:, axis]).all()


def test_plume_kicks_where_it_is(lab):
    """Through its middle half way: the hit moves by kick × the rest of the way, along y; one width off by exp(−1/2)."""
    p = lab.placement
    half = 0.5 * (p.centre[0] + p.screen_origin[0])
    plume = air.effects({"plume": {"plume": 1.5, "plume_y": -50.0, "plume_z": -700.0, "plume_width": 40.0}}, {})
    for off, share in ((0.0, 1.0), (40.0, np.exp(-0.5)), (400.0, 0.0)):
        through = np.array([half, -50.0, -700.0 + off])
        x = p.centre[None]
        g = (through - p.centre)[None]
        line, direction = air.carry(plume, p, x, g)
        turned = direction[0] / np.linalg.norm(direction[0]) - g[0] / np.linalg.norm(g[0])
        np.testing.assert_allclose(np.cross(line - through, direction), 0.0, atol=1e-6)
        ray = g[0] / np.linalg.norm(g[0])
        expected = 1.5e-3 * share * (np.array([0.0, 1.0, 0.0]) - ray[1] * ray)
        np.testing.assert_allclose(turned, expected, atol=3e-6)


def test_kick_field_is_the_plume(lab):
    y, z = np.linspace(-300, 300, 121), np.linspace(-1100, -300, 161)
    shape = np.exp(-0.5 * ((y[:, None] + 30.0) ** 2 + (z[None, :] + 700.0) ** 2) / 60.0**2)
    kick = field([y, z], [1e-3 * shape, np.zeros_like(shape)])
    plume = {"plume": {"plume": 1.0, "plume_y": -30.0, "plume_z": -700.0, "plume_width": 60.0}}
    by_field, by_name = lab.trace(fields={"kick": kick}), lab.trace(plume)
    d, _ = lab.apart(lab.trace(), by_name)
    e, _ = lab.apart(by_field, by_name)
    assert np.abs(d).max() > 0.1
    # Straight lines between knots 5 mm apart miss a Gaussian of 60 mm by (5/60)²/8 of it, 9e-4.
    assert np.abs(e).max() < 2e-3 * np.abs(d).max()


SURFACE = {
    "screen-distance": {"sx": 5.0},
    "screen-tilt": {"st_y": 8.0, "st_z": -6.0},
    "screen-bow": {"bow_y": 0.1, "bow_z": -0.15},
    "screen-rotation": {"srot": 11.0},
}


def about(axis, angle):
    """Matrix of a turn about a unit vector, by Rodrigues' formula."""
    x, y, z = axis
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def tilt(st_y, st_z):
    """Axis and angle of the smallest turn of the plane x = 0 to x = 1e-3 (st_z y + st_y z)."""
    normal = np.array([1.0, -1e-3 * st_z, -1e-3 * st_y])
    axis = np.cross([1.0, 0.0, 0.0], normal)
    return axis / np.linalg.norm(axis), np.arctan2(np.linalg.norm(axis), normal[0])


def rays_by_hand(lab, p, phases):
    """Points and directions of the pencil's rays off the cylinder."""
    for phase in phases:
        n = np.cos(phase) * p.normal + np.sin(phase) * np.cross(p.axis, p.normal)
        x = p.centre + lab.recording.mirror.radius * n
        yield x, p.laser_direction - 2 * (p.laser_direction @ n) * n


@pytest.mark.parametrize("roll", [0.0, np.pi, 0.4])
def test_light_lands_on_the_turned_board(lab, roll):
    """The pencil's rays, by hand: the board's point (y, z), moved, tilted, rolled and bowed, lies on its phase's ray.

    The known roll takes the tilt with it; ``srot`` turns the board in its own plane.
    """
    exposure = replace(lab.exposure, screen_roll=roll)
    p = place(lab.recording.mirror, exposure, lab.off)
    curve = lab.trace(SURFACE, physics=lab.pencil, exposure=exposure)
    frame = p.screen_rotation @ about(*tilt(8.0, -6.0)) @ about((1.0, 0.0, 0.0), 11e-3)
    for (x, out), (y, z) in zip(rays_by_hand(lab, p, curve.phase), curve.points, strict=True):
        raised = 0.5 * (0.1e-3 * y**2 - 0.15e-3 * z**2)
        point = p.screen_origin + [5.0, 0.0, 0.0] + frame @ np.array([raised, y, z])
        np.testing.assert_allclose(np.cross(point - x, out / np.linalg.norm(out)), 0.0, atol=1e-6)


def test_light_meets_the_plane_that_the_tilt_names(lab):
    """x = sx + st_z y + st_y z in the world, intersected with no frame of the board's; distances on it are kept.

    Expectation: 1e-6 mm for the board seated as stated.
    """
    effects = {"screen-distance": {"sx": 5.0}, "screen-tilt": {"st_y": 8.0, "st_z": -6.0}}
    curve = lab.trace(effects, physics=lab.pencil, errors=None)
    p = place(lab.recording.mirror, lab.exposure)
    slope = np.array([1.0, 6e-3, -8e-3])
    hits = []
    for x, out in rays_by_hand(lab, p, curve.phase):
        hits.append(x + (5.0 - slope @ x) / (slope @ out) * out)
    hits = np.array(hits)
    centre = np.linalg.norm(hits - [5.0, 0.0, 0.0], axis=1)
    np.testing.assert_allclose(np.linalg.norm(curve.points, axis=1), centre, atol=1e-6)
    apart = np.linalg.norm(hits[:, None] - hits[None], axis=2)
    np.testing.assert_allclose(np.linalg.norm(curve.points[:, None] - curve.points[None], axis=2), apart, atol=1e-6)
    # No turn within the plane: where the tilt's axis cuts the board, board and world coincide.
    axis = np.array([0.0, 8.0, 6.0]) / 10.0
    np.testing.assert_allclose(curve.points @ axis[1:], hits @ axis, atol=1e-6)


def test_height_field_is_the_surface(lab):
    """A parabola on knots 4 mm apart is met to ½ κ (4/2)² ≈ 3e-4 mm of height; a plane exactly, seen along x."""
    k = np.linspace(-400, 400, 201)
    y, z = np.meshgrid(k, k, indexing="ij")
    raised = 0.5 * (0.1e-3 * y**2 - 0.15e-3 * z**2)
    by_name = lab.trace({"screen-bow": SURFACE["screen-bow"]})
    assert np.abs(lab.apart(by_name, lab.trace(fields={"height": field([k, k], raised[None])}))[0]).max() < 1e-3
    two = np.array([-400.0, 400.0])
    plane = field([two, two], (3e-3 * two[:, None] - 2e-3 * two[None, :])[None])
    seen = lab.trace(fields={"height": plane}, physics=lab.pencil)
    turned = lab.trace({"screen-tilt": {"st_z": 3.0, "st_y": -2.0}}, physics=lab.pencil)
    raised = np.column_stack([seen.points @ [3e-3, -2e-3], seen.points])
    along = (raised @ about(*tilt(-2.0, 3.0)))[:, 1:]
    assert np.abs(lab.apart(turned, replace(seen, points=along))[0]).max() < 1e-6


@pytest.mark.parametrize("physics", [Physics(), Physics(False, False, False)], ids=["whole", "pencil"])
@pytest.mark.parametrize("roll", [0.0, np.pi, 0.4])
def test_tilt_is_a_turn_of_the_board(lab, roll, physics):
    """A tilt is the re-seating turn about the same axis, and with the opposite one nothing is left, 1e-9 mm."""
    exposure = replace(lab.exposure, screen_roll=roll)
    axis, angle = tilt(12.0, -17.0)
    world = about((1.0, 0.0, 0.0), roll) @ axis * angle
    tilted = {"screen-tilt": {"st_y": 12.0, "st_z": -17.0}}
    same = {"physics": physics, "exposure": exposure}
    named, seated = lab.trace(tilted, errors=None, **same), lab.trace(errors=SettingErrors(screen_angle=world), **same)
    lab.same(named, seated, 1e-9)
    both = lab.trace(tilted, errors=SettingErrors(screen_angle=-world), **same)
    neither = lab.trace(errors=None, **same)
    lab.same(both, neither, 1e-9)
    assert np.abs(lab.apart(neither, named)[0]).max() > 0.3


def test_distance_and_rotation_are_the_boards(lab):
    """Distance is a shift along x, however the board is seated; rotation, of one seated as stated, its turn about x."""
    errors = replace(lab.off, screen_angle=np.array([2e-3, -5e-3, 4e-3]))
    moved = replace(errors, screen_position=np.array([12.0, 0, 0]))
    expected = predict(lab.recording, lab.exposure, moved, 24)
    lab.same(lab.trace({"screen-distance": {"sx": 12.0}}, errors=errors), expected, 1e-9)
    turned = replace(lab.off, screen_angle=np.array([9e-3, 0, 0]))
    expected = predict(lab.recording, lab.exposure, turned, 24)
    lab.same(lab.trace({"screen-rotation": {"srot": 9.0}}), expected, 1e-9)


def test_drift_goes_by_the_hours(lab):
    """From the earliest exposure, wherever it stands in the file; along the world's axes on a rolled board."""
    rolled = np.radians(30.0)
    late = replace(lab.exposure, time=9000.0, screen_roll=rolled)
    first = replace(lab.exposure, time=1800.0)
    recording = replace(lab.bench({"drift": {"dry": 0.5, "drz": -0.25}}), exposures=(late, first))
    at_rest, drifted = predict(lab.recording, late, None, 24), predict(recording, late, None, 24)
    shift = np.array([1.0, -0.5])
    c, s = np.cos(rolled), np.sin(rolled)
    on_board = np.array([c * shift[0] + s * shift[1], -s * shift[0] + c * shift[1]])
    moved = replace(at_rest, points=at_rest.points + on_board)
    assert np.abs(lab.apart(moved, drifted)[0]).max() < 1e-6
    lab.same(predict(recording, first, None, 24), predict(lab.recording, first, None, 24), 1e-12)
    hours = field([[0.0, 9000.0]], [[-0.25, 1.0], [0.125, -0.5]])
    by_field = predict(replace(lab.recording, fields={"time": hours}), late, None, 24)
    lab.same(by_field, drifted, 1e-9)


def test_vibration_widens(lab):
    """A single ray becomes a Gaussian of that rms; a beam's widths add up about in squares, its centre stays."""
    shaken = {"vibration": {"amp": 0.8, "freq": 50.0}}
    np.testing.assert_allclose(lab.trace(shaken, physics=lab.pencil).width, 0.8, atol=1e-12)
    for physics in (lab.geometric, Physics()):
        still, moved = lab.trace(physics=physics), lab.trace(shaken, physics=physics)
        np.testing.assert_allclose(moved.points, still.points, atol=1e-12)
        assert ((moved.width > still.width + 0.1) & (moved.width < np.hypot(still.width, 0.8) + 0.3)).all()


@pytest.mark.parametrize("held", [False, True])
def test_blurred_moments_are_those_of_the_blurred_profile(held):
    """The closed forms against a profile whose points are spread into Gaussians on a fine grid."""
    q, light = np.array([[-1.0, 0.2, 0.9]]), np.array([[1.0, 2.0, 0.7]])
    blur = np.array([[0.3, 0.5, 0.4]])
    grid = np.linspace(-6, 6, 6001)
    spread = (light[0] / blur[0] * np.exp(-0.5 * ((grid[:, None] - q[0]) / blur[0]) ** 2)).sum(axis=1)
    centre = np.zeros(1) if held else None
    got, expected = adaptive(q, light, centre, 200, blur=blur), adaptive(grid[None], spread[None], centre, 200)
    np.testing.assert_allclose(got[0], expected[0], atol=1e-8)
    np.testing.assert_allclose(got[1], expected[1], atol=1e-8)
