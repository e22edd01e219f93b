"""An exposure rendered again from what a fit found: the expected picture before blur, exposure and noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.model import Camera, Exposure, Recording
from benchsim.bench.place import SettingErrors, place
from benchsim.renderer.beam_table import BeamTable, axes, powers
from benchsim.renderer.irradiance import ScreenMap, irradiance
from benchsim.renderer.picture import Picture, photograph
from benchsim.renderer.surface import AS_A_WHOLE

Array = NDArray[np.float64]
REACH = 2.5
"""Radius of the beam's section, in 1/e² radii, within which its shape is followed; 4e-6 of the power lies beyond."""


def shaped(shape: tuple[float, float, float], direction: Array, axis: Array) -> BeamTable:
    """A beam whose density is not Gaussian: log-density perturbed over its section.

    exp(c4 (q² − 2q) + e_plus (u² − v²)/w² + 2 e_cross u v/w²) with q = 2ρ²/w²; v is the mirror's axis less its part
    along the direction of travel d, u = v × d, w the 1/e² radius.

    Parameters
    ----------
    shape : (c4, e_plus, e_cross)
    direction, axis : (3,) array
        d and the mirror's axis, world frame.
    """
    c4, plus, cross = shape
    direction, axis = np.asarray(direction, float), np.asarray(axis, float)
    x, y = axes(direction)
    across = axis - (axis @ direction) * direction
    v = across / np.linalg.norm(across)
    u = np.cross(v, direction)
    ux, uy, vx, vy = (float(a @ b) for a in (u, v) for b in (x, y))
    r2 = REACH**2
    log_ratio = dict.fromkeys(powers(), 0.0)
    # q = 2 R² (a² + b²) in units of the table.
    for (i, j), times in {(4, 0): 1.0, (2, 2): 2.0, (0, 4): 1.0}.items():
        log_ratio[i, j] += c4 * 4 * r2**2 * times
    for i, j in ((2, 0), (0, 2)):
        log_ratio[i, j] -= c4 * 4 * r2
    log_ratio[2, 0] += r2 * (plus * (ux**2 - vx**2) + 2 * cross * ux * vx)
    log_ratio[0, 2] += r2 * (plus * (uy**2 - vy**2) + 2 * cross * uy * vy)
    log_ratio[1, 1] += 2 * r2 * (plus * (ux * uy - vx * vy) + cross * (ux * vy + uy * vx))
    none = (0.0,) * len(log_ratio)
    return BeamTable(REACH, none, none, tuple(log_ratio.values()))


def lit(
    recording: Recording,
    exposure: Exposure,
    errors: SettingErrors | None = None,
    *,
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    rays: int | None = None,
) -> ScreenMap:
    """Irradiance on the board with setting errors and a beam that is not quite Gaussian; see `expected`."""
    placement = place(recording.mirror, exposure, errors)
    lenses = shaped(shape, placement.laser_direction, placement.axis) if any(shape) else None
    return irradiance(recording, exposure, placement=placement, seed=seed, rays=rays, lenses=lenses)


def expected(
    recording: Recording,
    exposure: Exposure,
    camera: Camera,
    rotation: Array,
    translation: Array,
    errors: SettingErrors | None = None,
    *,
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seed: int = 0,
    rays: int | None = None,
    light: ScreenMap | None = None,
    lit_only: bool = False,
) -> Picture:
    """What the camera would see of an exposure, by this realisation of the bench.

    Parameters
    ----------
    recording : Recording
        Its effects and fields are rendered; its laser has the diameter and divergence that are to be shown.
    exposure : Exposure
    camera : Camera
        Its intrinsics as stated or as solved.
    rotation, translation : (3, 3) array, (3,) array [mm]
        Pose of the board as its marks define it: x_camera = R (height, y, z) + t, as a pose solver gives it. Height and
        print have their effects' errors; a shift or turn of the whole board is part of the pose.
    errors : SettingErrors, optional
        Default none. They move the light; the camera goes with the board.
    shape : (c4, e_plus, e_cross)
        Of the beam, see `shaped`.
    seed : int
        Of the light's rays.
    rays : int, optional
        As in `irradiance`.
    light : ScreenMap, optional
        From `lit`, in place of tracing it.
    lit_only : bool
        As in `photograph`.

    Returns
    -------
    Picture
        Before the lens's blur and any exposure: its scale is that of the irradiance for a laser of power 1. Blooming
        and the brightness field belong to the sensor and are not in it: `charge.arrived` puts them in after the blur.

    Raises
    ------
    BenchsimError
        As `irradiance` and `photograph`.
    """
    if light is None:
        light = lit(recording, exposure, errors, shape=shape, seed=seed, rays=rays)
    placement = place(recording.mirror, exposure, errors)
    seen_by = np.asarray(rotation) @ placement.screen_rotation.T
    pose = (seen_by, np.asarray(translation) - seen_by @ placement.screen_origin)
    shown = {name: table for name, table in recording.effects.items() if name not in AS_A_WHOLE}
    return photograph(
        recording.screen,
        camera,
        light,
        placement=placement,
        pose=pose,
        narrow=not recording.physics.beam,
        effects=shown,
        fields=recording.fields,
        lit_only=lit_only,
    )
