"""Where everything stands: the stated setting and its errors as one rigid placement in the world frame.

The aim is a convention of the bench, not a result of a simulation, so `vector`, `rays` and `renderer` share it; what
light does from there on each of them works out for itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Mirror

Array = NDArray[np.float64]


def toward_source(azimuth: Array | float, elevation: Array | float) -> Array:
    """Unit vector toward the source (Carretero 2019, Eq. (1)); travel is its negative.

    Parameters
    ----------
    azimuth, elevation : float or (...) array
        From north (+x) toward east (−y), and above the horizon [rad].

    Returns
    -------
    (..., 3) ndarray
    """
    ce = np.cos(elevation)
    return np.array([ce * np.cos(azimuth), -ce * np.sin(azimuth), np.sin(elevation)]).T


@dataclass(frozen=True)
class Aim:
    """Nominal aim of one exposure: n(0,0), axis of rotation, P = C + r n, all world frame, mm."""

    source: Array
    normal: Array
    axis: Array
    point: Array


def ideal_normal(centre: Array, source: Array, radius: float, iterations: int = 100) -> Array:
    """n(0,0): bisects the direction to the source and that from P = C + r n to the screen's centre.

    Carretero 2019, Eq. (17), iterated to convergence with S toward the source and O − P toward the target (the
    paper's signs, see the design's traps). Each step contracts by about r/|C|.

    Parameters
    ----------
    centre : (3,) array
        C, the centre of rotation [mm].
    source : (3,) array
        Unit vector toward the source.
    radius : float
        r, distance from C to the reflecting surface [mm].

    Returns
    -------
    (3,) ndarray
        Unit normal.

    Raises
    ------
    BenchsimError
        If source and target lie in exactly opposite directions, where no mirror can aim.
    """
    n = np.zeros(3)
    for _ in range(iterations):
        to_target = -(centre + radius * n)
        bisector = source + to_target / np.linalg.norm(to_target)
        length = np.linalg.norm(bisector)
        if length < 1e-9:
            raise BenchsimError(
                "the laser shines from behind the mirror straight at the screen; no mirror can aim that"
            )
        previous, n = n, bisector / length
        if np.max(np.abs(n - previous)) < 1e-16:
            break
    return n


def rotation_axis(normal: Array, stands_for: str) -> Array:
    """Axis of the mirror: along z × n ("elevation"), or n × (z × n) ("azimuth"); unit, world frame."""
    horizontal = np.cross([0.0, 0.0, 1.0], normal)
    length = np.linalg.norm(horizontal)
    if length < 1e-9:
        raise BenchsimError(
            "the mirror's normal is vertical, so its elevation axis is not defined; move the mirror or laser"
        )
    horizontal /= length
    return horizontal if stands_for == "elevation" else np.cross(normal, horizontal)


@lru_cache(maxsize=256)
def aim(mirror: Mirror, exposure: Exposure, radius: float | None = None) -> Aim:
    """Aim the mirror and the laser as the setting states them.

    Parameters
    ----------
    mirror, exposure
        What is aimed.
    radius : float, optional
        r used for the aim [mm]; default the mirror's own.

    Returns
    -------
    Aim
    """
    r = mirror.radius if radius is None else radius
    centre = np.asarray(exposure.mirror_position, float)
    source = toward_source(exposure.laser_azimuth, exposure.laser_elevation)
    normal = ideal_normal(centre, source, r)
    found = Aim(source, normal, rotation_axis(normal, mirror.stands_for), centre + r * normal)
    # It is kept for the next who asks, so nobody may write into it.
    for vector in (found.source, found.normal, found.axis, found.point):
        vector.setflags(write=False)
    return found


def _zeros(n: int) -> Array:
    return np.zeros(n)


@dataclass(frozen=True)
class SettingErrors:
    """True minus stated, for one exposure; zero is the stated setting.

    Attributes
    ----------
    mirror_position : (3,) mm
        Of C, world x, y, z.
    mirror_axis : (2,) rad
        Turn of the mirror's body about n and about n × axis.
    laser_direction : (2,) rad
        Added to the azimuth and elevation dials; the beam still passes through the nominal P.
    screen_position : (3,) mm
        Re-seating of the board's centre, world x, y, z.
    screen_angle : (3,) rad
        Re-seating turn of the board about world x, y, z (a rotation vector), after its roll.
    """

    mirror_position: Array = field(default_factory=lambda: _zeros(3))
    mirror_axis: Array = field(default_factory=lambda: _zeros(2))
    laser_direction: Array = field(default_factory=lambda: _zeros(2))
    screen_position: Array = field(default_factory=lambda: _zeros(3))
    screen_angle: Array = field(default_factory=lambda: _zeros(3))


@dataclass(frozen=True)
class Placement:
    """Where everything stands in one exposure, world frame, mm.

    ``centre``, ``axis``, ``normal``: the mirror's centre of rotation, axis and the normal of facet 0 at phase 0;
    facet k's normal at phase ε is ``normal`` turned by ε + 2πk/facets about ``axis``, right-handed.
    ``laser_point``: on the laser's axis, where the beam diameter holds. ``laser_direction``: unit, of travel.
    ``screen_rotation`` (3, 3), ``screen_origin`` (3,): X_world = origin + rotation @ (0, y, z) of the board.
    """

    centre: Array
    axis: Array
    normal: Array
    laser_point: Array
    laser_direction: Array
    screen_rotation: Array
    screen_origin: Array


def place(
    mirror: Mirror, exposure: Exposure, errors: SettingErrors | None = None, radius: float | None = None
) -> Placement:
    """Placement of an exposure, with setting errors if given.

    The laser's axis is aimed at the nominal P once: setting errors do not re-aim it.

    Parameters
    ----------
    mirror, exposure
        The stated setting.
    errors : SettingErrors, optional
    radius : float, optional
        r used for the aim [mm]; default the mirror's own.
    """
    return places(mirror, [(exposure, errors)], radius)[0]


def places(
    mirror: Mirror, settings: Sequence[tuple[Exposure, SettingErrors | None]], radius: float | None = None
) -> list[Placement]:
    """`place` of many settings of one mirror, several times cheaper each than one alone."""
    by_exposure = {id(exposure): exposure for exposure, _ in settings}
    stated = {key: _stated(mirror, exposure, radius) for key, exposure in by_exposure.items()}
    none = SettingErrors()
    # Axes of the arrays: (setting, component).
    nominal = np.array([stated[id(exposure)] for exposure, _ in settings])
    normal, axis, point, centre, dials, screen = nominal.reshape(-1, 6, 3).transpose(1, 0, 2)
    position, body, laser, seat_shift, seat_turn = (
        np.array(column, float)
        for column in zip(
            *(
                (e.mirror_position, e.mirror_axis, e.laser_direction, e.screen_position, e.screen_angle)
                for e in (errors or none for _, errors in settings)
            ),
            strict=True,
        )
    )
    turn = Rotation.from_rotvec(body[:, :1] * normal + body[:, 1:] * np.cross(normal, axis)).as_matrix()
    roll, shift = screen[:, 1:2] * np.array([1.0, 0.0, 0.0]), screen[:, :1] * np.array([1.0, 0.0, 0.0])
    seats = (Rotation.from_rotvec(seat_turn) * Rotation.from_rotvec(roll)).as_matrix()
    columns = (
        centre + position,
        (turn @ axis[..., None])[..., 0],
        (turn @ normal[..., None])[..., 0],
        point,
        -toward_source(dials[:, 0] + laser[:, 0], dials[:, 1] + laser[:, 1]),
        seats,
        shift + seat_shift,
    )
    return [Placement(*one) for one in zip(*columns, strict=True)]


def _stated(mirror: Mirror, exposure: Exposure, radius: float | None) -> Array:
    """What a setting states, in rows of three: normal, axis, P, C, azimuth and elevation, the screen's shift, roll."""
    nominal = aim(mirror, exposure, radius)
    dials = (exposure.laser_azimuth, exposure.laser_elevation, 0.0)
    screen = (exposure.screen_shift, exposure.screen_roll, 0.0)
    return np.array([nominal.normal, nominal.axis, nominal.point, exposure.mirror_position, dials, screen], float)


def camera_pose(camera: Camera) -> tuple[Array, Array]:
    """Nominal pose in OpenCV's sense: x_camera = R @ x_world + t, x right, y down, z forward.

    The camera looks at ``look_at`` without roll: image rows run downward, world z upward in the picture,
    right = forward × z.

    Returns
    -------
    R : (3, 3) ndarray
    t : (3,) ndarray [mm]
    """
    position = np.asarray(camera.position, float)
    forward = np.asarray(camera.look_at, float) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ position
