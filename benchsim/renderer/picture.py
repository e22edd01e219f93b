"""The camera's picture of the board, lit by the laser and by the room: what an ideal sensor's pixels would integrate.

The board is a Lambertian rectangle in its own frame, where float32 is exact to a micrometre; rays of sight start at
the camera in that frame. Radiance is ρ E/π; the two lights stay apart, so that exposure, speckle and colour can treat
each in its own way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field
from benchsim.bench.model import Camera, Screen
from benchsim.bench.place import Placement, camera_pose
from benchsim.renderer import backend
from benchsim.renderer.board import BoardTexture, printed, reflectance
from benchsim.renderer.irradiance import ScreenMap
from benchsim.renderer.lens import reach, sources, true_camera
from benchsim.renderer.surface import Surface, surface, turned

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Pose = tuple[Array, Array]
Pair = tuple[float, float]
Effects = Mapping[str, Mapping[str, float]]

WALL = 0.01
"""Reflectance of the dark room behind the board; the laser does not reach it."""

ROOM_SLOPE = (0.03, 0.05)
"""Relative change of the room light from the board's centre to its +y and +z edges: lamps hang above, to one side."""

_NEWTON_STEPS = 6

_MEET_STEPS = 5
"""Steps to a ray's point on a board that is not plane: each leaves the slope of the free height field of the miss, some
0.05 at worst."""

_LIT, _BESIDE = 1e-5, 16
"""Of the brightest bin, what counts as lit; and bins about the lit ones that are shown with them: what sharpening a map
adds beyond falls by 3.7 a bin."""

_HEIGHT_PITCH = 1.0
"""Grid on which the free height field is looked up [mm]; between its own knots it is linear anyway."""


@dataclass(frozen=True)
class Picture:
    """Mean radiance over every pixel, times π.

    Attributes
    ----------
    laser : (rows, columns) float32 [1/mm²]
        ρ E of the laser's light, in the units of the map that was photographed.
    room : (rows, columns) float32
        ρ E of the room light, which is 1 at the board's centre.
    """

    laser: Image
    room: Image


def _sharpen(light: ScreenMap, *, narrow: bool) -> Image:
    """Values of a bilinear surface that is the least-squares fit to the irradiance behind a map.

    A map holds means with a tent of half width ``pitch``; a bilinear texture smears them with the same tent again. Both
    together are the cubic B-spline, whose inverse on the grid takes the smearing back (Unser 1999, IEEE Signal Process.
    Mag. 16(6), 22). A trace that is one bin wide has no such fit and stays as it is.
    """
    if narrow:
        return light.values.astype(np.float32)
    once = spline_filter1d(light.values.astype(np.float32), order=3, axis=0, output=np.float32, mode="mirror")
    return np.asarray(spline_filter1d(once, order=3, axis=1, output=np.float32, mode="mirror"), np.float32)


def _lit(light: ScreenMap) -> ScreenMap:
    """The part of a map that holds its light."""
    lit = light.values > _LIT * light.values.max()
    i, k, j, m = (
        int(np.clip(end + beside, 0, len(across)))
        for across in (lit.any(axis=1), lit.any(axis=0))
        for end, beside in zip(np.flatnonzero(across)[[0, -1]], (-_BESIDE, _BESIDE + 1), strict=True)
    )
    return replace(light, values=light.values[i:k, j:m], y0=light.y[j], z0=light.z[i])


def _on_texture(texture: BoardTexture, light: ScreenMap, values: Image) -> Image:
    """The map's values on the texture's grid, zero beyond the map."""
    out = np.zeros(texture.values.shape, np.float32)
    i = round((light.z0 - texture.z0) / texture.pitch)
    j = round((light.y0 - texture.y0) / texture.pitch)
    aligned = max(abs(light.y0 - texture.y0 - j * texture.pitch), abs(light.z0 - texture.z0 - i * texture.pitch))
    if light.pitch != texture.pitch or aligned > 1e-6 or min(i, j) < 0:
        raise ValueError("the map's bins are not the texels of the board's texture")
    out[i : i + values.shape[0], j : j + values.shape[1]] = values
    return out


def _room(texture: BoardTexture) -> tuple[Image, Image]:
    """Room light along z (nz, 1) and along y (1, ny); their product, 1 at the centre."""
    nz, ny = texture.values.shape
    y = np.linspace(-1, 1, ny, dtype=np.float32)[None, :]
    z = np.linspace(-1, 1, nz, dtype=np.float32)[:, None]
    return 1 + np.float32(ROOM_SLOPE[1]) * z, 1 + np.float32(ROOM_SLOPE[0]) * y


def _bitmap(values: Image) -> Any:
    """A bilinear Mitsuba texture of values whose row 0 is the lowest: v of a rectangle grows upward."""
    data = mi.TensorXf(np.ascontiguousarray(values, np.float32)[..., None])
    return mi.load_dict(
        # Hardware texture units of GPUs interpolate with 8 bits only.
        {"type": "bitmap", "data": data, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp", "accel": False}
    )


def _heights(shape: Surface, centre: Pair, half: Pair) -> Any:
    """The free height field as a texture over the board's texture, or None."""
    if shape.field is None:
        return None
    y, z = (
        c + h * ((np.arange(k) + 0.5) / k * 2 - 1)
        for c, h, k in ((c, h, int(np.ceil(2 * h / _HEIGHT_PITCH))) for c, h in zip(centre, half, strict=True))
    )
    only = Surface(field=shape.field)
    return _bitmap(only.height(y[None, :], z[:, None]).astype(np.float32))


def _meet(shape: Surface, field: Any, centre: Pair, half: Pair, origin: Any, direction: Any, active: Any) -> Any:
    """Where rays meet a board that is not plane, by Newton's method on the height of the ray over the surface.

    Components are (y, z, x) of the board, as Mitsuba's rectangle has them.
    """
    hit = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    # Values that may change from picture to picture are no constants of the compiled kernel.
    shape = Surface((_opaque(shape.bow[0]), _opaque(shape.bow[1])))
    (mid_y, mid_z), (wide, high) = ([_opaque(h) for h in pair] for pair in (centre, half))

    def texture_at(y: Any, z: Any) -> Any:
        return mi.Point2f(0.5 * ((y - mid_y) / wide + 1), 0.5 * ((z - mid_z) / high + 1))

    t = -origin.z / direction.z
    y, z = origin.x + t * direction.x, origin.y + t * direction.y
    for _ in range(_MEET_STEPS):
        h, slope_y, slope_z = shape.smooth(y, z)
        if field is not None:
            hit.uv = texture_at(y, z)
            h = h + field.eval_1(hit, active)
        over = origin.z + t * direction.z - h
        t = t - over / (direction.z - slope_y * direction.x - slope_z * direction.y)
        y, z = origin.x + t * direction.x, origin.y + t * direction.y
    there = active & (t > 0) & (direction.z < 0) & (dr.abs(y - mid_y) <= wide) & (dr.abs(z - mid_z) <= high)
    hit.uv = texture_at(y, z)
    return hit, there


def _facing(shape: Surface, texture: BoardTexture) -> Image | np.float32:
    """Area of the plane per area of the surface: a map is light by area of the plane, radiance by area of the paper."""
    if shape.flat:
        return np.float32(1)
    nz, ny = texture.values.shape
    y, z = texture.y0 + texture.pitch * np.arange(ny), texture.z0 + texture.pitch * np.arange(nz)
    _, slope_y, slope_z = shape.smooth(y[None, :], z[:, None])
    if shape.field is not None:
        h = Surface(field=shape.field).height(y[None, :], z[:, None])
        slope_y, slope_z = slope_y + np.gradient(h, y, axis=1), slope_z + np.gradient(h, z, axis=0)
    return np.asarray(1 / np.sqrt(1 + slope_y**2 + slope_z**2), np.float32)


def _window(camera: Camera, in_camera: Array, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns that may see the board, whose outline is (n, 3) in the camera's frame."""
    columns, rows = camera.resolution
    if (in_camera[:, 2] <= 0).any():
        return slice(0, rows), slice(0, columns)
    zero, (cx, cy) = np.zeros(3), camera.principal_point
    matrix = np.array([[camera.focal, 0, cx], [0, camera.focal, cy], [0, 0, 1.0]])
    seen = cv2.projectPoints(in_camera, zero, zero, matrix, np.array(camera.distortion))[0].reshape(-1, 2)
    low, high = np.floor(seen.min(axis=0)).astype(int) - 2, np.ceil(seen.max(axis=0)).astype(int) + 3
    low, high = low - margin, high + margin
    low, high = np.clip(low, 0, camera.resolution), np.clip(high, 0, camera.resolution)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _opaque(value: float) -> Any:
    return dr.opaque(mi.Float, float(value))


def _ideal(camera: Camera, u: Any, v: Any) -> tuple[Any, Any, tuple[Any, Any, Any, Any], Any]:
    """Brown's model inverted by Newton's method at pixels (u, v).

    Returns
    -------
    x, y : array
        Ideal image coordinates, x = X/Z.
    jacobian : four arrays
        ∂x/∂u, ∂x/∂v, ∂y/∂u, ∂y/∂v [1/px].
    valid : mask
        Where the model can be inverted.
    """
    k1, k2, p1, p2, k3 = (_opaque(k) for k in camera.distortion)
    scale = _opaque(1 / camera.focal)
    xd = (u - _opaque(camera.principal_point[0])) * scale
    yd = (v - _opaque(camera.principal_point[1])) * scale

    def forward(x: Any, y: Any) -> tuple[Any, ...]:
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
        fx = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - xd
        fy = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y - yd
        fxx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        fyy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        return fx, fy, fxx, cross, fyy, fxx * fyy - cross * cross

    x, y = mi.Float(xd), mi.Float(yd)
    for _ in range(_NEWTON_STEPS):
        fx, fy, fxx, cross, fyy, det = forward(x, y)
        x, y = x - (fyy * fx - cross * fy) / det, y - (fxx * fy - cross * fx) / det
    fx, fy, fxx, cross, fyy, det = forward(x, y)
    # Beyond the fold of the polynomial Newton lands on another branch, where a Jacobian's eigenvalue is negative.
    valid = (dr.abs(fx) + dr.abs(fy) < 1e-5) & (det > 0) & (fxx + fyy > 0)
    inverse = scale / det
    return x, y, (fyy * inverse, -cross * inverse, -cross * inverse, fxx * inverse), valid


def photograph(
    screen: Screen,
    camera: Camera,
    light: ScreenMap | None,
    *,
    placement: Placement,
    pose: Pose | None = None,
    samples: int | None = None,
    narrow: bool = False,
    effects: Effects | None = None,
    fields: Mapping[str, Field] | None = None,
    lit_only: bool = False,
) -> Picture:
    """Photograph the board.

    Parameters
    ----------
    screen : Screen
    camera : Camera
        The true one but for the effects; its pose is used where ``pose`` is None.
    light : ScreenMap or None
        Irradiance of the laser on the board; None where it is off.
    placement : Placement
        Where the board stands (``screen_rotation``, ``screen_origin``).
    pose : (R, t), optional
        Of the camera, in OpenCV's sense [mm].
    samples : int, optional
        Rays of sight per pixel along u and along v, at the midpoints of equal strata; by default so many that they
        lie two or more to the texel. Midpoints integrate a surface that is bilinear between texels with 1/20 of the
        error of random points, and add no noise.
    narrow : bool
        The light has no width of its own (``physics.beam = false``); its map is shown as it is.
    effects, fields : mapping, optional
        Of the recording: those of the board's shape and turn (`surface`), of its print (`board`), of lens and read-out
        (`lens`) are shown, the others belong to the light or the sensor.
    lit_only : bool
        Show the board only as far as the laser lights it, which is quicker; the room's light is none to be used then.

    Returns
    -------
    Picture
        Pixel (0, 0) is centred on the top-left pixel, as in OpenCV. No vignetting, no blur of the lens.

    Raises
    ------
    BenchsimError
        If the camera does not see the front of the board.
    """
    backend.use()
    effects, fields = effects or {}, fields or {}
    placement, camera = turned(placement, effects), true_camera(camera, effects)
    shape = surface(effects, fields)
    rotation, translation = pose or camera_pose(camera)
    to_camera = rotation @ placement.screen_rotation
    offset = rotation @ placement.screen_origin + translation
    eye = -to_camera.T @ offset
    if eye[0] <= 0:
        raise BenchsimError(f"camera {camera.name} stands behind the screen; move its position_mm to x > 0")

    pitch = 0.25 if light is None else light.pitch
    within = None
    if light is not None and lit_only:
        light = _lit(light)
        within = light.y, light.z
    texture = reflectance(screen, pitch, outside=WALL, lay=printed(effects, fields), within=within)
    room_z, room_y = _room(texture)
    white = texture.values.astype(np.float32)
    room = _bitmap(white * room_z * room_y)
    laser = None
    if light is not None:
        lit = _on_texture(texture, light, _sharpen(light, narrow=narrow))
        laser = _bitmap(white * lit * _facing(shape, texture))
    nz, ny = texture.values.shape
    half = (ny * pitch / 2, nz * pitch / 2)
    centre = (texture.y0 - pitch / 2 + half[0], texture.z0 - pitch / 2 + half[1])

    columns, rows = camera.resolution
    edge = np.linspace(-1, 1, 65)
    one = np.ones(65)
    around = (
        np.concatenate([np.column_stack(s) for s in ((edge, one), (edge, -one), (one, edge), (-one, edge))]) * half
        + centre
    )
    outline = np.column_stack([shape.height(*around.T), around]) @ to_camera.T + offset
    window = _window(camera, outline, reach(effects, fields))
    height, width = window[0].stop - window[0].start, window[1].stop - window[1].start
    wall = np.full((rows, columns), WALL, np.float32)
    dark = np.zeros((rows, columns), np.float32)
    if height <= 0 or width <= 0:
        return Picture(dark, wall)
    if samples is None:
        footprint = np.linalg.norm(offset) / camera.focal
        samples = int(np.clip(np.ceil(2 * footprint / texture.pitch), 3, 16))

    # Mitsuba's rectangle lies in its xy plane: x is the board's y, y its z, z its normal.
    board = mi.load_dict(
        {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([*centre, 0.0]).scale([*half, 1.0])}
    )
    heights = _heights(shape, centre, half)
    mapped = to_camera.T[[1, 2, 0]]
    m = [[_opaque(e) for e in row] for row in mapped]
    origin = mi.Point3f(*(_opaque(e) for e in eye[[1, 2, 0]]))

    lane = dr.arange(mi.UInt32, height * width)
    w = dr.opaque(mi.UInt32, width)
    u = mi.Float(lane % w) + _opaque(window[1].start)
    v = mi.Float(lane // w) + _opaque(window[0].start)
    source = sources(camera, effects, fields, window)
    if source is not None:
        u, v = mi.Float(source.u.ravel().astype(np.float32)), mi.Float(source.v.ravel().astype(np.float32))
    x0, y0, (xu, xv, yu, yv), valid = _ideal(camera, u, v)
    if source is not None:
        uu, uv, vu, vv = (mi.Float(s.ravel().astype(np.float32)) for s in source.slope)
        xu, xv, yu, yv = xu * uu + xv * vu, xu * uv + xv * vv, yu * uu + yv * vu, yu * uv + yv * vv
    n = dr.opaque(mi.UInt32, samples)
    step = 1 / mi.Float(n)

    def look(k: Any, seen_laser: Any, seen_room: Any) -> tuple[Any, Any, Any]:
        # Over one pixel the distortion is linear to 1e-4 px.
        du, dv = (mi.Float(k % n) + 0.5) * step - 0.5, (mi.Float(k // n) + 0.5) * step - 0.5
        x, y = x0 + xu * du + xv * dv, y0 + yu * du + yv * dv
        direction = mi.Vector3f(*(row[0] * x + row[1] * y + row[2] for row in m))
        if shape.flat:
            # Asked directly, the shape answers three times as fast as through a scene of one shape.
            hit = board.ray_intersect(mi.Ray3f(origin, dr.normalize(direction)), active=valid)
            there = valid & hit.is_valid()
        else:
            hit, there = _meet(shape, heights, centre, half, origin, direction, valid)
        if laser is not None:
            seen_laser = seen_laser + dr.select(there, laser.eval_1(hit, there), 0.0)
        seen_room = seen_room + dr.select(there, room.eval_1(hit, there), WALL)
        return k + 1, seen_laser, seen_room

    start = (
        dr.zeros(mi.UInt32, height * width),
        dr.zeros(mi.Float, height * width),
        dr.zeros(mi.Float, height * width),
    )
    _, seen_laser, seen_room = dr.while_loop(start, lambda k, a, b: k < n * n, look)
    dr.eval(seen_laser, seen_room)
    share = np.float32(1 / samples**2)
    dark[window] = seen_laser.numpy().reshape(height, width) * share
    wall[window] = seen_room.numpy().reshape(height, width) * share
    return Picture(dark, wall)
