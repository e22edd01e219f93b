"""Paths of light from the sun by mirrors to receivers, as one kernel of Mitsuba.

A ray starts at a random point of a random facet, a sphere's piece, toward a random point of the sun; it is shaded if it
meets another mirror there. It is reflected at the facet's normal, tilted by a random slope, and turned by the
specularity; it is blocked if it meets another mirror before it has gone as far as the receiver is, and else meets the
first receiver on its way.

Mirrors that shade and block are flat rectangles, one mesh in the plant's frame; a ray leaves its own by starting
`CLEAR` before its plane. Float32 keeps 6e-8: 0.06 mm at 1 km. Facets lie in their mirror's plane, tilted as they cant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CLEAR = 5.0
"""Before a mirror's plane [mm]: beyond its facets' tilt rays start where they are, and float32 is finer than that."""

PASSING = 1e-3
"""Cosine of incidence below which a mirror reflects nothing."""

NAMES = ("whole", "shaded", "blocked", "turn", "aimed", "along", "up")
"""What is summed for each heliostat: weights of rays, and of those that land on the receiver aimed at also where."""


@dataclass(frozen=True)
class Mirrors:
    """Heliostats, n of them.

    Attributes
    ----------
    position : (n, 3) mm
    frame : (n, 3, 3)
        Rows: across, up and normal.
    width, height : (n,) mm
    facets : (n, 2)
        Across and up.
    focal, canting, reach : (n,) mm
        Focal length of the facets, where their axes meet, and how far away the receiver is.
    passed : (n,)
        By which what they reflect is multiplied: reflectance and air.
    specularity : (n,)
        Standard deviation of the reflected ray in one direction [rad].
    aims : (n,)
        At which of the surfaces.
    """

    position: Array
    frame: Array
    width: Array
    height: Array
    facets: NDArray[np.int64]
    focal: Array
    canting: Array
    reach: Array
    passed: Array
    specularity: Array
    aims: NDArray[np.int64]


@dataclass(frozen=True)
class Light:
    """Where light comes from, and the slopes of all mirrors.

    Attributes
    ----------
    sun : (3,)
        Unit vector toward its centre.
    angles : (k,)
        From its centre, at which k even steps of the part of its light within them are reached [rad]; one: a Gaussian's
        sigma in one direction.
    slope : float
        Standard deviation of the normal in one direction [rad].
    """

    sun: Array
    angles: Array
    slope: float


@dataclass(frozen=True)
class Surface:
    """A receiver: a rectangle that is lit on one side, or an upright cylinder that is lit from outside.

    Attributes
    ----------
    round : bool
    centre : (3,) mm
    frame : (3, 3)
        Rows: along, up and outward; of a cylinder east, north and up.
    width, height : float
        Of a cylinder the width is its diameter [mm].
    cells : (int, int)
        Along, all around from south through west for a cylinder, and up.
    """

    round: bool
    centre: Array
    frame: Array
    width: float
    height: float
    cells: tuple[int, int]


def columns(m: Mirrors) -> dict[str, Array]:
    """What `rays` takes of every heliostat, (n,) each; weights are of the mirrors' mean area."""
    area = m.width * m.height
    own = {
        "width": m.width, "height": m.height, "across": 1.0 * m.facets[:, 0], "up": 1.0 * m.facets[:, 1],
        "bend": 0.5 / m.focal, "cant": 0.5 / m.canting, "reach": m.reach, "passed": m.passed * area / area.mean(),
        "gloss": m.specularity, "aims": m.aims,
    }  # fmt: skip
    own |= {f"p{c}": m.position[:, k] for k, c in enumerate("xyz")}
    return own | {f"f{i}{j}": m.frame[:, i, j] for i in range(3) for j in range(3)}


def neighbours(m: Mirrors) -> Any:
    """All mirrors as one mesh of rectangles."""
    n = len(m.position)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * np.stack([m.width, m.height], 1)[:, None]
    points = m.position[:, None] + corners @ m.frame[:, :2]
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(n)[:, None, None]
    mesh = mi.Mesh("mirrors", vertex_count=4 * n, face_count=2 * n)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(points.ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters.update()
    return mi.load_dict({"type": "scene", "mirrors": mesh})


def shape(s: Surface) -> tuple[Surface, Any]:
    """A receiver as a scene of its own, in its own frame."""
    half = s.height / 2
    if s.round:
        shape = {"type": "cylinder", "p0": [0, 0, -half], "p1": [0, 0, half], "radius": s.width / 2}
    else:
        shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([s.width / 2, half, 1.0])}
    return s, mi.load_dict({"type": "scene", "receiver": shape})


def rays(
    who: Any, columns: dict[str, Any], light: Light, angles: Any, generator: Any, scene: Any, shapes: list[Any]
) -> dict[str, Any]:
    """Rays of the heliostats ``who``: their weights by `NAMES` and `landed`, and the cells they meet."""
    h = {name: dr.gather(mi.Float, column, who) for name, column in columns.items()}
    frame = [mi.Vector3f(*(h[f"f{i}{j}"] for j in range(3))) for i in range(3)]
    uniform = generator.next_float32

    def scattered(v: Any, sigma: Any) -> Any:
        g = mi.warp.square_to_std_normal(mi.Point2f(uniform(), uniform())) * sigma
        about = mi.Frame3f(v)
        return dr.normalize(v + about.s * g.x + about.t * g.y)

    # Not literals: one kernel serves all plants of a kind.
    def variable(x: float) -> Any:
        return dr.opaque(mi.Float, float(x))

    def constant(v: Array) -> Any:
        return mi.Vector3f(*map(variable, v))

    def world(v: Any) -> Any:
        return frame[0] * v.x + frame[1] * v.y + frame[2] * v.z

    a, b = (constant(v) for v in np.linalg.svd(light.sun[None])[2][1:])
    g = _of_the_sun(light, angles, uniform)
    toward = dr.normalize(constant(light.sun) + a * g.x + b * g.y)
    sun = mi.Vector3f(*(dr.dot(row, toward) for row in frame))

    # In the mirror's frame: the facet's centre, its own axes, and a point of its sphere.
    x, y = uniform(), uniform()
    cx = ((dr.minimum(dr.floor(x * h["across"]), h["across"] - 1) + 0.5) / h["across"] - 0.5) * h["width"]
    cy = ((dr.minimum(dr.floor(y * h["up"]), h["up"] - 1) + 0.5) / h["up"] - 0.5) * h["height"]
    x, y = (x - 0.5) * h["width"] - cx, (y - 0.5) * h["height"] - cy
    axis = dr.normalize(mi.Vector3f(-h["cant"] * cx, -h["cant"] * cy, 1.0))
    edge = dr.normalize(mi.Vector3f(1.0, 0.0, 0.0) - axis.x * axis)
    other = dr.cross(axis, edge)
    nx, ny = -h["bend"] * x, -h["bend"] * y
    steep = dr.sqrt(dr.maximum(1.0 - (nx * nx + ny * ny), 0.0))
    sag = (x * x + y * y) * h["bend"] / (1.0 + steep)
    normal = edge * nx + other * ny + axis * steep
    point = mi.Vector3f(cx, cy, 0.0) + edge * x + other * y + axis * sag

    # The beam through the piece of the sphere over an even piece of its chord's plane.
    weight = dr.maximum(dr.dot(normal, sun), 0.0) / dr.maximum(steep, 0.5)
    bent = scattered(normal, variable(light.slope))
    out = scattered(2 * dr.dot(bent, sun) * bent - sun, h["gloss"])
    there = (sun.z > PASSING) & (out.z > PASSING)
    weight = dr.select(there, weight, 0.0)
    centre = mi.Vector3f(h["px"], h["py"], h["pz"])

    def leaving(d: Any) -> Any:
        return centre + world(point + d * dr.maximum((CLEAR - point.z) / dr.maximum(d.z, PASSING), 0.0))

    shaded = scene.ray_test(mi.Ray3f(leaving(sun), toward), active=there)
    ray = world(out)
    way = mi.Ray3f(leaving(out), ray)
    way.maxt = h["reach"]  # type: ignore[assignment]
    blocked = scene.ray_test(way, active=there & ~shaded)
    free = there & ~shaded & ~blocked

    middle = 2 * dr.dot(frame[2], constant(light.sun)) * frame[2] - constant(light.sun)
    place = world(point)
    aside = place + ray * ((h["reach"] - dr.dot(place, middle)) / dr.dot(ray, middle)) - middle * h["reach"]
    cells: list[tuple[Any, Any]] = []
    along, up, nearest, which = mi.Float(0.0), mi.Float(0.0), mi.Float(dr.inf), mi.Float(-1.0)
    for number, (s, shape) in enumerate(shapes):
        rows = [constant(row) for row in s.frame]
        local = [mi.Vector3f(*(dr.dot(row, v) for row in rows)) for v in (centre + place - constant(s.centre), ray)]
        hit = shape.ray_intersect(mi.Ray3f(mi.Point3f(local[0]), local[1]), active=free)
        q, radius = hit.p, variable(s.width / 2)
        if s.round:
            met = free & hit.is_valid() & (q.x * local[1].x + q.y * local[1].y < 0)
            u, v, extent = dr.atan2(q.x, q.y) * radius, q.z, 2 * dr.pi * radius
            # About where the mirror stands, lest the centroid of what is lit around south be north.
            stands = dr.atan2(h["px"] - variable(s.centre[0]), h["py"] - variable(s.centre[1]))
            turned = u / radius - stands
            mean = (stands + dr.atan2(dr.sin(turned), dr.cos(turned))) * radius
        else:
            met = free & hit.is_valid() & (local[1].z < 0)
            u, v, extent, mean = q.x, q.y, 2 * radius, q.x
        first = met & (hit.t < nearest)
        nearest = dr.select(first, hit.t, nearest)
        along, up, which = (dr.select(first, *x) for x in ((mean, along), (v, up), (float(number), which)))
        many = [variable(k) for k in s.cells]
        i, j = (
            mi.UInt32(dr.clip((w / length + 0.5) * k, 0, k - 1))
            for w, length, k in ((u, extent, many[0]), (v, variable(s.height), many[1]))
        )
        cells = [*((cell, active & ~first) for cell, active in cells), (i * mi.UInt32(many[1]) + j, first)]
    landed = dr.select(nearest < dr.inf, weight * h["passed"], 0.0)
    aimed = dr.select(which == h["aims"], landed, 0.0)
    return {
        "whole": weight,
        "shaded": dr.select(shaded, weight, 0.0),
        "blocked": dr.select(blocked & ~shaded, weight, 0.0),
        "landed": landed,
        "turn": dr.select(free, weight * dr.squared_norm(aside), 0.0),
        "aimed": aimed,
        "along": aimed * along,
        "up": aimed * up,
        "cells": cells,
    }


def _of_the_sun(light: Light, angles: Any, uniform: Any) -> Any:
    """A random point of the sun, as tangents from its centre."""
    if len(light.angles) == 1:
        return mi.warp.square_to_std_normal(mi.Point2f(uniform(), uniform())) * dr.opaque(mi.Float, light.angles[0])
    place = uniform() * dr.opaque(mi.Float, len(light.angles) - 1)
    k = dr.minimum(mi.UInt32(place), mi.UInt32(len(light.angles) - 2))
    low, high = (dr.gather(mi.Float, angles, k + d) for d in (0, 1))
    radius = dr.tan(low + (high - low) * (place - mi.Float(k)))
    return radius * mi.Vector2f(*reversed(dr.sincos(2 * dr.pi * uniform())))
