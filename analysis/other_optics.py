"""Light of the laser bench on its board, from first principles and apart from the product's own models (float64).

A ray leaves the beam's wavefront, meets a facet of the turning polygon, crosses the air, lands on the board. For each
phase of rotation and each place across a facet the light is spread along the facet's narrow side: by rays in geometric
optics, by the Fresnel integral over that slice where diffraction is on. The slices sum to an irradiance tabulated in a
chart that follows the trace. Lengths in mm, angles in rad unless a name says otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.ndimage import gaussian_filter1d

GLASS = 1.515  # of window and plate (diagnosis.md)
DN_DT = -0.95e-6  # 1/K, air
KNOTS = 33  # phases tabulated along a trace: a spline through them is within 0.1 µm of one through 121
HALF_WIDTH_MM = 16.0  # of the chart across the trace: 0.4 % of a diffracted line's light falls outside
BIN_MM = 0.05  # of the chart: a third of the narrowest feature (a geometric line's edge, seen by 1 mm pixels)

Vector = np.ndarray


def dot(a: Vector, b: Vector) -> Vector:
    """Scalar product over the last axis, which stays, so that results scale vectors."""
    return np.sum(a * b, axis=-1, keepdims=True)


def unit(a: Vector) -> Vector:
    """Vector of length 1 along a (..., 3)."""
    return a / np.sqrt(dot(a, a))


def cross2(a: Vector, b: Vector) -> Vector:
    """Signed area spanned by plane vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def rotation(turn: Vector) -> Vector:
    """Matrix (3, 3) of the right-handed rotation vector `turn` (rad)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = np.asarray(turn, float) / (angle or 1.0)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def turned_plane(slope_y: float, slope_z: float) -> Vector:
    """Matrix (3, 3) that turns the plane x = 0, without spin, into x = slope_y y + slope_z z."""
    normal = unit(np.array([1.0, -slope_y, -slope_z]))
    axis = np.cross([1.0, 0, 0], normal)
    sine = float(np.linalg.norm(axis))
    return rotation(axis / sine * np.arcsin(sine)) if sine else np.eye(3)


def to_source(azimuth_deg: float, elevation_deg: float) -> Vector:
    """Unit vector toward the laser; azimuth from +x toward -y."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(el) * np.cos(az), -np.cos(el) * np.sin(az), np.sin(el)])


@dataclass(frozen=True)
class Beam:
    """Laser beam about its axis: `aim` on the axis, section axes u, v, direction of travel d."""

    aim: Vector
    u: Vector
    v: Vector
    d: Vector
    radius: float
    curvature: Vector  # (2, 2) 1/mm, of the wavefront in (u, v)
    coma: tuple[float, float]  # rad/mm²
    shape: tuple[float, float, float]  # c4, e+, ex

    def kick(self, q: Vector) -> Vector:
        """Transverse direction (..., 2) of the ray through q = (u, v)."""
        u, v = q[..., 0], q[..., 1]
        cu, cv = self.coma
        bend = np.stack([cu * (3 * u * u + v * v) + 2 * cv * u * v, 2 * cu * u * v + cv * (u * u + 3 * v * v)], -1)
        return q @ self.curvature + bend

    def eikonal(self, q: Vector) -> Vector:
        """Optical path (mm) at the reference section, of which `kick` is the gradient."""
        u, v = q[..., 0], q[..., 1]
        r2 = u * u + v * v
        return 0.5 * np.sum(q * (q @ self.curvature), -1) + r2 * (self.coma[0] * u + self.coma[1] * v)

    def density(self, q: Vector) -> Vector:
        """Relative power per area of the reference section, 1 at the centre of a Gaussian."""
        u2, v2, w2 = q[..., 0] ** 2, q[..., 1] ** 2, self.radius**2
        g = 2 * (u2 + v2) / w2
        c4, plus, cross = self.shape
        more = c4 * (g * g - 2 * g) + (plus * (u2 - v2) + 2 * cross * q[..., 0] * q[..., 1]) / w2
        return np.exp(-g + more)

    def at(self, point: Vector) -> tuple[Vector, Vector, Vector]:
        """Direction of travel (..., 3), power per transverse area and optical path of the light at points (..., 3)."""
        off = point - self.aim
        flat = np.stack([off @ self.u, off @ self.v], -1)
        depth = (off @ self.d)[..., None]
        q = flat
        for _ in range(5):  # contracts by depth x curvature, 1 % or less a step
            kick = self.kick(q)
            q = flat - depth * kick / np.sqrt(1 - np.sum(kick**2, -1, keepdims=True))
        kick = self.kick(q)
        along = np.sqrt(1 - np.sum(kick**2, -1, keepdims=True))
        du, dv = ((self.kick(q + step) - self.kick(q - step)) / 2e-3 for step in 1e-3 * np.eye(2))
        z = depth[..., 0]
        spread = (1 + z * du[..., 0]) * (1 + z * dv[..., 1]) - z * z * du[..., 1] * dv[..., 0]
        direction = kick[..., :1] * self.u + kick[..., 1:] * self.v + along * self.d
        return direction, self.density(q) / np.abs(spread), self.eikonal(q) + z / along[..., 0]


@dataclass(frozen=True)
class Mirror:
    """Turning polygon: centre, axis, normal of facet 0 at phase 0."""

    centre: Vector
    axis: Vector
    normal: Vector
    distance: float  # of the reflecting face from the axis
    half_width: float
    half_height: float
    curvature: float  # 1/mm, > 0 convex, the same both ways
    glass: float  # mm in front of the coating

    def facet(self, phase: Vector, s: Vector, h: Vector, lean: float) -> tuple[Vector, Vector]:
        """Points and normals (..., 3) at `s` along the turn and `h` along the axis of the facet at `phase`."""
        phase, s, h = (np.asarray(a, float)[..., None] for a in (phase, s, h))
        tangent0 = np.cross(self.axis, self.normal)
        radial = np.cos(phase) * self.normal + np.sin(phase) * tangent0
        tangent = -np.sin(phase) * self.normal + np.cos(phase) * tangent0
        normal = np.cos(lean) * radial + np.sin(lean) * self.axis
        up = np.cos(lean) * self.axis - np.sin(lean) * radial
        sag = 0.5 * self.curvature * (s * s + h * h)
        point = self.centre + self.distance * radial + s * tangent + h * up - sag * normal
        return point, unit(normal + self.curvature * (s * tangent + h * up))


@dataclass(frozen=True)
class Air:
    """What lies between mirror and screen. Zero strengths do nothing."""

    screen_x: float
    gradient: Vector  # (3,) of the refractive index, 1/mm
    plume: tuple[float, float, float, float, float]  # kick rad, y, z, width mm, x of its plane
    window: float  # mm
    window_normal: Vector

    def cross(self, p: Vector, r: Vector) -> tuple[Vector, Vector]:
        """Rays (origin, direction) as they reach the screen, from rays leaving the mirror."""
        kick, y, z, width, x = self.plume
        if kick:
            p = p + r * (x - p[..., :1]) / r[..., :1]
            bell = np.exp(-0.5 * ((p[..., 1] - y) ** 2 + (p[..., 2] - z) ** 2) / width**2)
            r = unit(r + kick * bell[..., None] * np.array([0.0, 1.0, 0.0]))
        if self.window:
            inside = (r - dot(r, self.window_normal) * self.window_normal) / GLASS
            ahead = np.sign(dot(r, self.window_normal))
            inside = inside + ahead * np.sqrt(1 - dot(inside, inside)) * self.window_normal
            through, straight = np.abs(dot(inside, self.window_normal)), np.abs(dot(r, self.window_normal))
            p = p + self.window * (inside / through - r / straight)
        if np.any(self.gradient):
            bend = self.gradient - dot(self.gradient * np.ones_like(r), r) * r
            length = (self.screen_x - p[..., :1]) / r[..., :1]
            p, r = p - 0.5 * bend * length**2, r + bend * length
        return p, r


@dataclass(frozen=True)
class Board:
    """Screen as it stands: world = origin + turn @ board; bowed along its own normal."""

    origin: Vector
    turn: Vector
    bow: tuple[float, float]  # 1/mm, along board y and z
    drift: Vector  # (3,) mm, of the light over the board, world
    grid: Vector  # (2, 2): printed (y, z) to board (y, z)

    def height(self, yz: Vector) -> Vector:
        """Rise (...) of the board along its normal."""
        near = np.clip(yz, -1000, 1000)  # off every board: grazing rays must not run away
        return 0.5 * (self.bow[0] * near[..., 0] ** 2 + self.bow[1] * near[..., 1] ** 2)

    def meet(self, p: Vector, r: Vector) -> Vector:
        """Board coordinates (..., 2) where rays land; no drift."""
        p, r = (p - self.origin) @ self.turn, r @ self.turn
        rise = np.zeros(np.broadcast(p[..., 0], r[..., 0]).shape)
        for _ in range(8 if any(self.bow) else 1):  # contracts by slope x obliquity, 0.1 or less
            yz = p[..., 1:] + r[..., 1:] * ((rise - p[..., 0]) / r[..., 0])[..., None]
            rise = self.height(yz)
        return yz

    def world(self, yz: Vector) -> Vector:
        """World points (..., 3) of board coordinates."""
        local = np.concatenate([self.height(yz)[..., None], yz], -1)
        return self.origin + local @ self.turn.T

    def normal(self, yz: Vector) -> Vector:
        """Unit normals (..., 3), world."""
        slope = np.concatenate([np.ones_like(yz[..., :1]), -yz * np.array(self.bow)], -1)
        return unit(slope) @ self.turn.T


@dataclass(frozen=True)
class Scene:
    """One exposure: everything that light meets on its way to the board."""

    beam: Beam
    mirror: Mirror
    air: Air
    board: Board
    leans: tuple[float, ...]  # rad, of every facet that reflects
    wavelength: float
    diffraction: bool
    blur: float  # rad, sigma of the incoherent divergence
    size: tuple[float, float]

    def reflect(self, phase: Vector, s: Vector, h: Vector, lean: float, front: bool = False) -> tuple[Vector, ...]:
        """Exit point, direction, power per (s, h) area, entrance point and optical path there of reflected light."""
        point, normal = self.mirror.facet(phase, s, h, lean)
        going, density, path = self.beam.at(point)
        cosine = -dot(going, normal)
        out = going + 2 * cosine * normal
        power = density * np.clip(cosine[..., 0], 0, None)
        exit_point = point
        if self.mirror.glass:
            mirrored = fresnel(np.clip(cosine[..., 0], 1e-6, 1))
            if front:
                power = power * mirrored
            else:
                power = power * (1 - mirrored) ** 2
                inner = (going + cosine * normal) / GLASS
                exit_point = point + 2 * self.mirror.glass * inner / np.sqrt(1 - dot(inner, inner))
        return exit_point, out, power, point, path

    def land(self, p: Vector, r: Vector) -> Vector:
        """Board coordinates (..., 2) of light leaving the mirror, drift included."""
        yz = self.board.meet(*self.air.cross(p, r))
        return yz + (self.board.drift @ self.board.turn)[1:]


def fresnel(cosine: Vector) -> Vector:
    """Share of unpolarised light that a glass face reflects."""
    inner = np.sqrt(1 - (1 - cosine**2) / GLASS**2)
    s = (cosine - GLASS * inner) / (cosine + GLASS * inner)
    p = (GLASS * cosine - inner) / (GLASS * cosine + inner)
    return 0.5 * (s * s + p * p)


class Trace:
    """Irradiance on the board in a chart (phase, x): board point = base(phase) + x · across(phase)."""

    def __init__(self, scene: Scene, ghost: bool = True):
        self.scene = scene
        lean = float(np.mean(scene.leans))
        coarse = np.linspace(-0.5, 0.5, 1001)
        p, r, *_ = scene.reflect(coarse, 0 * coarse, 0 * coarse, lean)
        coming = (scene.air.screen_x - p[:, 0]) / r[:, 0] > 0
        coming &= np.abs(r[:, 0]) > 0.05  # grazing light never lands on a board of this size
        coarse, p, r = coarse[coming], p[coming], r[coming]
        inside = (np.abs(scene.land(p, r)) < np.array(scene.size) / 2 + 25).all(-1)
        if inside.sum() < 5:
            raise ValueError("the trace misses the board: see mirror position and laser angles")
        first, last = coarse[inside][[0, -1]]
        self.phase = np.linspace(first - 2e-3, last + 2e-3, KNOTS)
        zero = 0 * self.phase
        p, r, *_ = scene.reflect(self.phase, zero, zero, lean)
        base, across = scene.land(p, r), slit_direction(scene, p, r)
        self.base, self.across = CubicSpline(self.phase, base), CubicSpline(self.phase, across)
        self.edges = np.arange(-HALF_WIDTH_MM, HALF_WIDTH_MM + BIN_MM / 2, BIN_MM)
        table = np.zeros((KNOTS, len(self.edges) - 1))
        add = _diffracted if scene.diffraction else _geometric
        for front in (False, True) if scene.mirror.glass and ghost else (False,):
            table += add(self, lean, front)
        if scene.blur:
            sigma = self._blur(p, r)
            table = np.stack([gaussian_filter1d(row, w / BIN_MM) for row, w in zip(table, sigma, strict=True)])
        self.table = table
        centres = 0.5 * (self.edges[1:] + self.edges[:-1])
        self._spline = RectBivariateSpline(self.phase, centres, table, kx=3, ky=3 if scene.diffraction else 1)

    def _blur(self, p: Vector, r: Vector) -> Vector:
        """Sigma (mm, along `across`) at every knot of a round angular blur."""
        along, tau = self.base(self.phase, 1), self.across(self.phase)
        landed = self.scene.board.world(self.base(self.phase))
        length = np.linalg.norm(landed - p, axis=-1)
        facing = self.scene.board.normal(self.base(self.phase))
        first = unit(np.cross(r, [0.0, 0.0, 1.0]))
        total = 0.0
        for e in (first, np.cross(r, first)):
            foot = (e - r * dot(e, facing) / dot(r, facing)) @ self.scene.board.turn
            total = total + (cross2(along, foot[..., 1:]) / cross2(along, tau)) ** 2
        return np.asarray(self.scene.blur * length * np.sqrt(total))

    def solve(self, land: Callable[[Vector], Vector], phase: Vector) -> tuple[Vector, Vector, Vector]:
        """Phases at which `land` meets the chart's line of every knot; x there; and d(landing)/d(phase)."""
        shape = (KNOTS,) + (1,) * (phase.ndim - 1)
        base = self.base(self.phase).reshape(*shape, 2)
        tau = self.across(self.phase).reshape(*shape, 2)
        step = 1e-5
        for _ in range(4):  # a secant slope: 1e-3 off a step, 1e-9 mm after four
            here = land(phase)
            slope = (land(phase + step) - land(phase - step)) / (2 * step)
            phase = phase - cross2(here - base, tau) / cross2(slope, tau)
        return phase, np.sum((land(phase) - base) * tau, -1), slope

    def chart(self, yz: Vector) -> tuple[Vector, Vector]:
        """Chart coordinates (phase, x) of board points (n, 2)."""
        base = self.base(self.phase)
        main = int(np.argmax(np.ptp(base, axis=0)))
        order = np.argsort(base[:, main])
        phase = np.interp(yz[:, main], base[order, main], self.phase[order])
        for _ in range(6):
            b, tau = self.base(phase), self.across(phase)
            x = np.sum((yz - b) * tau, -1)
            slope = cross2(self.base(phase, 1) + x[:, None] * self.across(phase, 1), tau)
            phase = np.clip(phase + cross2(yz - b, tau) / slope, self.phase[0], self.phase[-1])
        return phase, np.sum((yz - self.base(phase)) * self.across(phase), -1)

    def irradiance(self, yz: Vector) -> Vector:
        """Power per board area (n,) at board points (n, 2), relative units."""
        return self.lookup(*self.chart(yz))

    def lookup(self, phase: Vector, x: Vector) -> Vector:
        """Irradiance (n,) at chart coordinates (n,)."""
        light = self._spline.ev(phase, x)
        seen = (np.abs(x) < HALF_WIDTH_MM - BIN_MM) & (phase > self.phase[0]) & (phase < self.phase[-1])
        return np.where(seen, np.clip(light, 0, None), 0.0)

    def line(self, at: Vector, reach: float = 12.0, step: float = 0.04) -> dict[str, Vector]:
        """Centroid (board mm), rms width (mm) and flux (per mm of trace) of profiles at right angles to the trace."""
        tangent = unit(self.base(at, 1))
        centre = self.base(at)
        q = np.arange(-reach, reach + step / 2, step)
        for _ in range(3):  # the window follows the centroid
            normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
            light = self.irradiance((centre[:, None] + q[:, None] * normal[:, None]).reshape(-1, 2)).reshape(
                len(at), -1
            )
            flux = light.sum(1)
            mean = light @ q / flux
            centre = centre + mean[:, None] * normal
        width = np.sqrt((light * (q - mean[:, None]) ** 2).sum(1) / flux)
        return {"yz": centre, "width": width, "flux": flux * step, "q": q, "profile": light, "normal": normal}


def slit_direction(scene: Scene, p: Vector, r: Vector) -> Vector:
    """Unit board vectors (..., 2) along which a facet's narrow side spreads light that leaves p along r."""
    yz = scene.board.meet(p, r)
    facing = scene.board.normal(yz)
    e = unit(scene.mirror.axis - dot(r, scene.mirror.axis * np.ones_like(r)) * r)
    foot = (e - r * dot(e, facing) / dot(r, facing)) @ scene.board.turn
    return unit(foot[..., 1:])


def _nodes(count: int, half: float) -> tuple[Vector, Vector]:
    x, w = np.polynomial.legendre.leggauss(count)
    return half * x, half * w


def _fill(trace: Trace, knot: int, x: Vector, power: Vector, table: Vector) -> None:
    """Add power per x, given at ascending or descending x, to one row of the table without loss."""
    if x[0] > x[-1]:
        x, power = x[::-1], power[::-1]
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(x))])
    edges = np.clip(trace.edges, x[0], x[-1])
    j = np.clip(np.searchsorted(x, edges) - 1, 0, len(x) - 2)
    step = edges - x[j]
    rise = (power[j + 1] - power[j]) / (x[j + 1] - x[j])
    table[knot] += np.diff(sums[j] + step * (power[j] + 0.5 * step * rise)) / BIN_MM


def _geometric(trace: Trace, mean_lean: float, front: bool) -> Vector:
    """Table of geometric optics: every ray of a slice is brought to every knot's line."""
    del mean_lean
    scene, table = trace.scene, np.zeros((KNOTS, len(trace.edges) - 1))
    s, ws = _nodes(32, scene.mirror.half_width)
    h = np.linspace(-1, 1, 17) * scene.mirror.half_height
    for lean in scene.leans:

        def land(phase: Vector, lean: float = lean) -> Vector:
            p, r, *_ = scene.reflect(phase, s[:, None], h, lean, front)
            return scene.land(p, r)

        start = np.broadcast_to(trace.phase[:, None, None], (KNOTS, len(s), len(h))).copy()
        phase, x, slope = trace.solve(land, start)
        power = scene.reflect(phase, s[:, None], h, lean, front)[2] * ws[:, None]
        power = power / np.abs(cross2(slope, trace.across(trace.phase)[:, None, None]))
        stretch = np.abs(np.gradient(x, h, axis=2, edge_order=2))
        for j in range(KNOTS):
            for i in range(len(s)):
                _fill(trace, j, x[j, i], power[j, i] / stretch[j, i], table)
    return table / len(scene.leans)


def _diffracted(trace: Trace, mean_lean: float, front: bool) -> Vector:
    """Table with Fresnel diffraction along the facet's narrow side, the beam's amplitude and phase over it.

    A slice at fixed phase and s lies in the plane of the axis and the reflected ray, which is at right angles to the
    sweep; light that the sweep smears along the trace does not interfere across it (Parseval), so the slices add.
    """
    scene, table = trace.scene, np.zeros((KNOTS, len(trace.edges) - 1))
    mirror, board = scene.mirror, scene.board
    s, ws = _nodes(16, mirror.half_width)
    h, wh = _nodes(72, mirror.half_height)
    q = np.arange(-HALF_WIDTH_MM - 2, HALF_WIDTH_MM + 2.01, 0.1)
    k = 2 * np.pi / scene.wavelength
    shapes = None
    for lean in sorted(scene.leans, key=lambda one: abs(one - mean_lean)):

        def centre(phase: Vector, lean: float = lean) -> tuple[Vector, ...]:
            return scene.reflect(phase, s, np.zeros_like(s), lean, front)

        start = np.broadcast_to(trace.phase[:, None], (KNOTS, len(s))).copy()
        phase, _, slope = trace.solve(lambda at: scene.land(*centre(at)[:2]), start)
        p0, r0, *_ = centre(phase)
        yz0, tau = board.meet(p0, r0), slit_direction(scene, p0, r0)
        ahead, behind = centre(phase + 1e-4), centre(phase - 1e-4)
        turning = (slit_direction(scene, *ahead[:2]) - slit_direction(scene, *behind[:2])) / 2e-4
        fan = cross2(turning, tau) / cross2(slope, tau)
        world = board.world(yz0)
        length = np.linalg.norm(world - p0, axis=-1)
        foot = np.concatenate([np.zeros_like(tau[..., :1]), tau], -1) @ board.turn.T
        e = unit(mirror.axis - dot(r0, mirror.axis * np.ones_like(r0)) * r0)
        scale = dot(foot, e)[..., 0] / length  # rad of fan per mm of board
        if shapes is None:
            shapes = np.empty((KNOTS, len(s), len(q)))
            first_scale = scale
            for j in range(KNOTS):
                shapes[j] = _slices(scene, phase[j], (s, h, wh), lean, front, (world[j], foot[j], p0[j]), (q, k))
        moved = q * (first_scale / scale)[..., None]
        target = yz0[..., None, :] + moved[..., None] * tau[..., None, :]
        aim = unit(board.world(target) - p0[..., None, :])
        spot = scene.land(np.broadcast_to(p0[..., None, :], aim.shape), aim)
        knot_tau = trace.across(trace.phase)[:, None]
        x = np.sum((spot - trace.base(trace.phase)[:, None, None]) * knot_tau[:, :, None], -1)
        power = shapes * (ws / np.abs(cross2(slope, knot_tau)))[..., None] / (1 + moved * fan[..., None])
        power = power / np.abs(np.gradient(x, axis=2) / np.gradient(q))
        for j in range(KNOTS):
            for i in range(len(s)):
                _fill(trace, j, x[j, i], power[j, i], table)
    return table / len(scene.leans)


def _slices(
    scene: Scene,
    phase: Vector,
    nodes: tuple[Vector, Vector, Vector],
    lean: float,
    front: bool,
    plane: tuple[Vector, Vector, Vector],
    across: tuple[Vector, float],
) -> Vector:
    """Power per mm of q (len(s), len(q)) of every slice at one knot, q along the board through the slice's centre."""
    s, h, wh = nodes
    world, foot, p0 = plane
    q, k = across
    out, _, power, _, path = scene.reflect(phase[:, None], s[:, None], h, lean, front)
    target = world[:, None] + q[:, None] * foot[:, None]  # (s, q, 3)
    length = np.linalg.norm(world - p0, axis=-1)
    wave = np.sqrt(power) * wh * np.exp(1j * k * (path - path[:, :1]))
    sight, strip = target - p0[:, None], out - p0[:, None]
    squared = (sight**2).sum(-1)[:, :, None] - 2 * sight @ strip.transpose(0, 2, 1) + (strip**2).sum(-1)[:, None]
    field = np.einsum("sh,sqh->sq", wave, np.exp(1j * k * (np.sqrt(squared) - length[:, None, None])))
    reach = np.linalg.norm(sight, axis=-1)
    facing = np.abs(np.sum(sight * scene.board.normal(scene.board.meet(p0, world - p0))[:, None], -1)) / reach
    shape = np.abs(field) ** 2 * facing / reach
    total = (power * wh).sum(1)
    return shape * (total / (shape.sum(1) * (q[1] - q[0])))[:, None]
