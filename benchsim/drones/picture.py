"""What the drone's camera sees, in Mitsuba: mirrors with the sky in them, the ground, and the lamp's glints.

A second realisation of the flight: the mirrors are meshes with normals, the lamp a disc that shines, the light's path
Mitsuba's. Everything is placed about a centre near the mirrors, in mm: at 150 m float32 still holds 8 µm, 0.0001 mrad.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from benchsim.drones.flight import Flight, Heliostat
from benchsim.drones.heliostat import axes, normals, shape
from benchsim.renderer import backend

Array = NDArray[np.float64]

LAMP_RADIUS = 25.0
"""[mm]"""

LAMP_RADIANCE = 40.0
"""In units of the sky's."""

BODY_RADIUS = 250.0
"""Of the drone, a dark disc behind camera and lamp [mm]."""

GROUND = 0.15
"""Reflectance of the ground, 2 m below the axes."""

MIRROR = 0.93

MESH_PITCH = 20.0
"""[mm]: normals between the mesh's nodes are right to 0.001 mrad for slope errors 250 mm long."""

BLUR = 0.6
"""Of the lens, standard deviation [px]."""

SKY = 0.1
"""Exposure: what the sky's radiance makes of full scale."""

GIMBAL = 3e-3
"""Error of the camera's pitch and yaw in each image, 1 sigma [rad]: some 25 px."""

FULL_WELL, READ_NOISE, BITS = 12e3, 6.0, 12


@dataclass(frozen=True)
class Camera:
    """A camera without distortion: 35 mm lens, pixels of 4.4 µm, 45 MP.

    Attributes
    ----------
    resolution : tuple of int
        Columns, rows.
    focal : float
        [px]
    """

    resolution: tuple[int, int] = (8192, 5460)
    focal: float = 7970.0


@dataclass(frozen=True)
class View:
    """Where a camera stands and looks.

    Attributes
    ----------
    position : (3,) ndarray
        Field frame [mm].
    turned : (3, 3) ndarray
        Rows: right, down, forward, in the field frame.
    """

    position: Array
    turned: Array


def looking(position: Array, at: Array, off: Sequence[float] | Array = (0.0, 0.0)) -> View:
    """A view without roll toward ``at``; ``off``: turned rightward and downward [rad], as a gimbal errs."""
    forward = (at - position) / np.linalg.norm(at - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    forward = forward + off[0] * right + off[1] * down
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return View(position, np.stack([right, np.cross(forward, right), forward]))


def project(camera: Camera, view: View, points: Array) -> Array:
    """(n, 2) pixels of points (n, 3) [mm]; the middle of the first pixel is (0, 0)."""
    x, y, z = ((points - view.position) @ view.turned.T).T
    middle = (np.array(camera.resolution) - 1) / 2
    return camera.focal * np.stack([x / z, y / z], axis=-1) + middle


def outline(heliostat_axes: tuple[Array, Array], corners: Array) -> Array:
    """(n, 3) field points [mm] of points (n, 2) in a mirror's plane."""
    turned, origin = heliostat_axes
    return origin + corners @ turned[:, :2].T


def _mesh(heliostat: Heliostat, facet: int, centre: Array) -> Any:
    """One facet as a mesh with the surface's own normals at its nodes."""
    design = heliostat.surface.design
    nx, ny = (math.ceil(s / MESH_PITCH) + 1 for s in design.size)
    x, y = (np.linspace(-s / 2, s / 2, n) for s, n in zip(design.size, (nx, ny), strict=True))
    points = design.centres[facet] + np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    height, slopes = shape(heliostat.surface, np.full(len(points), facet), points)
    turned, origin = axes(heliostat.mount)
    index = np.arange(nx * ny).reshape(ny, nx)
    a, b, c, d = (index[i : ny - 1 + i, j : nx - 1 + j].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.column_stack([a, b, d]), np.column_stack([a, d, c])])
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(
        {"type": "conductor", "material": "none", "specular_reflectance": {"type": "uniform", "value": MIRROR}}
    )
    mesh = mi.Mesh(f"facet{facet}", len(points), len(faces), has_vertex_normals=True, props=props)
    p = mi.traverse(mesh)
    places = np.column_stack([points, height]) @ turned.T + (origin - centre)
    p["vertex_positions"] = places.astype(np.float32).ravel()
    p["faces"] = faces.astype(np.uint32).ravel()
    p["vertex_normals"] = (normals(slopes) @ turned.T).astype(np.float32).ravel()
    p.update()
    return mesh


def mirrors(heliostats: Sequence[Heliostat], centre: Array) -> dict[str, Any]:
    """The heliostats' facets as Mitsuba's shapes about ``centre`` (3,) [mm], to be photographed any number of times."""
    backend.use()
    return {f"mirror{i}_{f}": _mesh(h, f, centre) for i, h in enumerate(heliostats) for f in range(len(h.surface.cant))}


def radiance(
    shapes: dict[str, Any],
    centre: Array,
    camera: Camera,
    view: View,
    lamp: Array,
    window: tuple[slice, slice],
    samples: int = 64,
    seed: int = 0,
) -> Array:
    """Mean radiance over every pixel of a window, in units of the sky's.

    Parameters
    ----------
    shapes : dict
        From `mirrors`, about the same ``centre``.
    centre : (3,) array
        [mm]
    camera : Camera
    view : View
    lamp : (3,) array
        Centre of the lamp, which faces as the camera does [mm].
    window : tuple of slice
        Rows and columns of the camera.
    samples : int
        Per pixel.
    seed : int

    Returns
    -------
    (rows, columns) ndarray
    """
    backend.use()
    _, down, forward = view.turned
    rows, columns = window
    eye = view.position - centre

    def disc(where: Array, radius: float) -> Any:
        to = mi.ScalarTransform4f().look_at(
            origin=where.tolist(), target=(where + 1e3 * forward).tolist(), up=(-down).tolist()
        )
        return to.scale([radius, radius, 1.0])

    floor = np.array([centre[0], centre[1], -2e3]) - centre
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "sensor": {
                "type": "perspective",
                "fov": math.degrees(2 * math.atan(camera.resolution[0] / 2 / camera.focal)),
                "fov_axis": "x",
                "near_clip": 1e3,
                "far_clip": 1e6,
                "to_world": mi.ScalarTransform4f().look_at(
                    origin=eye.tolist(), target=(eye + 1e5 * forward).tolist(), up=(-down).tolist()
                ),
                "film": {
                    "type": "hdrfilm",
                    "width": camera.resolution[0],
                    "height": camera.resolution[1],
                    "crop_offset_x": columns.start,
                    "crop_offset_y": rows.start,
                    "crop_width": columns.stop - columns.start,
                    "crop_height": rows.stop - rows.start,
                    "pixel_format": "luminance",
                    "rfilter": {"type": "gaussian", "stddev": BLUR},
                    "sample_border": True,
                },
                "sampler": {"type": "independent", "sample_count": samples},
            },
            "sky": {"type": "constant", "radiance": 1.0},
            "ground": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate(floor.tolist()).scale([5e5, 5e5, 1.0]),
                "bsdf": {"type": "diffuse", "reflectance": GROUND},
            },
            "lamp": {
                "type": "disk",
                "to_world": disc(lamp - centre, LAMP_RADIUS),
                "emitter": {"type": "area", "radiance": LAMP_RADIANCE},
            },
            "body": {
                "type": "disk",
                "to_world": disc((eye + lamp - centre) / 2 - 60 * forward, BODY_RADIUS),
                "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.03}},
            },
            **shapes,
        }
    )
    image = np.array(mi.render(scene, spp=samples, seed=mi.UInt32(seed)), np.float64)
    return np.asarray(image[..., 0] if image.ndim == 3 else image)


def window_of(corners: Array, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the camera that hold ``corners`` (n, 2) [px] and ``margin`` pixels around."""
    low, high = np.floor(corners.min(axis=0)).astype(int) - margin, np.ceil(corners.max(axis=0)).astype(int) + margin
    return slice(int(low[1]), int(high[1]) + 1), slice(int(low[0]), int(high[0]) + 1)


def photograph(light: Array, rng: np.random.Generator) -> Array:
    """Counts in units of full scale of a radiance image: shot and read noise, saturation, quantisation."""
    electrons = rng.poisson(np.maximum(light, 0) * SKY * FULL_WELL) + READ_NOISE * rng.standard_normal(light.shape)
    steps = 2**BITS - 1
    return np.asarray(np.round(np.clip(electrons / FULL_WELL, 0, 1) * steps) / steps)


def photographs(
    heliostat: Heliostat, flight: Flight, camera: Camera, rng: np.random.Generator, samples: int = 16
) -> tuple[list[Array], list[Array]]:
    """Every frame of a flight, cut out around one heliostat.

    Parameters
    ----------
    heliostat : Heliostat
    flight : Flight
    camera : Camera
        Looks to the field frame's origin, but for the gimbal's error `GIMBAL`.
    rng : Generator
    samples : int
        Per pixel.

    Returns
    -------
    images : list of (rows, columns) ndarray
        As from `photograph`.
    near : list of (4, 2) ndarray
        Where the drone and the plant say that the mirror's corners are in them [px].
    """
    corners = heliostat.surface.design.outline
    true, said = (outline(axes(m), corners) for m in (heliostat.mount, heliostat.said))
    centre = axes(heliostat.mount)[1]
    shapes = mirrors([heliostat], centre)
    images, near = [], []
    for eye, lamp, said_eye in zip(flight.cameras, flight.lamps, flight.said_cameras, strict=True):
        view = looking(eye, np.zeros(3), GIMBAL * rng.standard_normal(2))
        window = window_of(project(camera, view, true), 15)
        seed = int(rng.integers(2**31))
        images.append(photograph(radiance(shapes, centre, camera, view, lamp, window, samples, seed), rng))
        expected = project(camera, looking(said_eye, np.zeros(3)), said)
        near.append(expected - [window[1].start, window[0].start])
    return images, near
