"""Rays of the laser bench, from first principles and apart from the product's own models (float64).

A ray leaves the beam's wavefront, meets a facet of the turning polygon, crosses the air, lands on the board.
Lengths in mm, angles in rad unless a name says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GLASS = 1.515  # of window and plate (diagnosis.md)
DN_DT = -0.95e-6  # 1/K, air

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
        """Exit point, direction, power per (s, h) area and optical path to the exit point of reflected light."""
        point, normal = self.mirror.facet(phase, s, h, lean)
        going, density, path = self.beam.at(point)
        cosine = -dot(going, normal)
        out = going + 2 * cosine * normal
        power = density * np.clip(cosine[..., 0], 0, None)
        if self.mirror.glass:
            mirrored = fresnel(np.clip(cosine[..., 0], 1e-6, 1))
            if front:
                power = power * mirrored
            else:
                power = power * (1 - mirrored) ** 2
                inner = (going + cosine * normal) / GLASS
                depth = np.sqrt(1 - dot(inner, inner))
                point = point + 2 * self.mirror.glass * inner / depth
                path = path + 2 * self.mirror.glass * GLASS / depth[..., 0]
        return point, out, power, path

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
