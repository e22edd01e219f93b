"""The bench from the contract's words alone: a vector ray tracer in NumPy, float64, that holds `rays` and `renderer`.

Nothing here is taken from the package but its description of an experiment (`benchsim.bench`'s dataclasses). Frame,
units and signs are the contract's: x is the screen's normal toward the mirror, y west, z up; mm, rad, s; effects in
file units.

A node (t, h) is a place on a facet: t along its width, h along its height. In the course of a turn ε the light of a
node draws a line on the board; it cuts the normal of a trace at one offset q, and lays there its power per radian over
the speed along the trace. Sums over Gauss-Legendre nodes of the facet are therefore exact integrals of the
time-averaged irradiance: its mean offset (the centre), its light per mm (flux) and its spread (width).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline

GLASS = 1.515  # the contract's index of plate and mirror glass
THERMO_OPTIC = -0.95e-6  # dn/dT of air [1/K], the contract's
PLATE = 4.0  # thickness [mm] of a tilted window whose thickness is not given


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def dot(a, b):
    return (a * b).sum(-1)


def turn(vector):
    """Rotation matrix of a rotation vector (Rodrigues)."""
    vector = np.asarray(vector, float)
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * k @ k


def toward_source(azimuth, elevation):
    """Azimuth from north (+x) toward east (−y)."""
    return np.array([np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


@dataclass(frozen=True)
class Errors:
    """Setting errors in the contract's words: mm and rad, true minus stated."""

    centre: tuple = (0.0, 0.0, 0.0)
    axis: tuple = (0.0, 0.0)  # about n, about n × axis
    dials: tuple = (0.0, 0.0)  # azimuth, elevation
    screen: tuple = (0.0, 0.0, 0.0)
    screen_turn: tuple = (0.0, 0.0, 0.0)  # about world x, y, z


@dataclass(frozen=True)
class Tracer:
    """One exposure of a recording; ``effects`` are flat, {parameter: value in the file's unit}."""

    recording: object
    exposure: object
    errors: Errors = Errors()
    effects: Mapping[str, float] = field(default_factory=dict)
    ghost: bool = False  # the front face's reflection instead of the coating's
    shape: tuple = (0.0, 0.0, 0.0)  # c4, e+, e× of the true profile
    tip: tuple = (0.0, 0.0)  # slopes along u and v added to every ray [rad]

    def __post_init__(self):
        mirror, laser, exposure, e = self.recording.mirror, self.recording.laser, self.exposure, self.effects
        polygon = self.recording.physics.facets
        r = mirror.diameter / 2.0 * (np.cos(np.pi / mirror.facets) if mirror.shape == "polygon" else 1.0)
        source = toward_source(exposure.laser_azimuth, exposure.laser_elevation)
        c = np.array(exposure.mirror_position)
        n = unit(source - unit(c))
        for _ in range(60):  # Eq. (17): the normal bisects at P, which moves with it
            n = unit(source - unit(c + r * n))
        east = unit(np.cross([0.0, 0.0, 1.0], n))
        axis = east if mirror.stands_for == "elevation" else np.cross(n, east)
        aimed = c + r * n
        about_n, about_m = self.errors.axis
        body = turn(about_n * n + about_m * np.cross(n, axis))
        lean = turn(1e-3 * np.array([e.get("ped_x", 0.0), e.get("ped_y", 0.0), e.get("az_enc", 0.0)]))
        n, axis = lean @ body @ n, lean @ body @ axis
        az = exposure.laser_azimuth + self.errors.dials[0] + 1e-3 * e.get("saz", 0.0)
        el = exposure.laser_elevation + self.errors.dials[1] + 1e-3 * e.get("sel", 0.0)
        d = -toward_source(az, el)
        v = unit(axis - dot(axis, d) * d)
        u = np.cross(v, d)
        curvature = laser.divergence / laser.beam_diameter + 1e-3 * e.get("curv", 0.0)
        a0, a45 = 1e-3 * e.get("astig0", 0.0), 1e-3 * e.get("astig45", 0.0)
        count = mirror.facets
        k = 2.0 * np.pi * np.arange(count) / count
        tilt = np.array([e.get(f"tilt_{i}", 0.0) for i in range(count)])
        leans = 1e-3 * (e.get("pyr", 0.0) + tilt + e.get("wob_c", 0.0) * np.cos(k) + e.get("wob_s", 0.0) * np.sin(k))
        if exposure.facet is not None:
            leans = leans[exposure.facet : exposure.facet + 1]
        roll = exposure.screen_roll
        sy, sz = 1e-3 * e.get("st_y", 0.0), 1e-3 * e.get("st_z", 0.0)
        # The plane x = st_z y + st_y z, reached by the turn without twist that carries x to its normal.
        normal = unit(np.array([1.0, -sz, -sy]))
        across = np.cross([1.0, 0.0, 0.0], normal)
        sine = np.linalg.norm(across)
        board = turn(across / sine * np.arcsin(sine)) if sine else np.eye(3)
        hours = (exposure.time - min(x.time for x in self.recording.exposures)) / 3600.0
        drift = hours * np.array([0.0, e.get("dry", 0.0), e.get("drz", 0.0)])
        # The tilt rolls with the known roll; the board's own rotation stays in its plane, which is as stated then.
        frame = (
            turn(self.errors.screen_turn) @ turn([roll, 0.0, 0.0]) @ board @ turn([1e-3 * e.get("srot", 0.0), 0.0, 0.0])
        )
        put = object.__setattr__
        put(self, "centre", c + np.array(self.errors.centre))
        put(self, "aimed", aimed)
        put(self, "n", n)
        put(self, "axis", axis)
        put(self, "d", d)
        put(self, "u", u)
        put(self, "v", v)
        put(self, "through", aimed + e.get("bu", 0.0) * u + e.get("bv", 0.0) * v)
        put(self, "distance", r + e.get("dr", 0.0))
        put(self, "bend", np.array([[curvature + a0, a45], [a45, curvature - a0]]))
        put(self, "coma", 1e-3 * np.array([e.get("coma_u", 0.0), e.get("coma_v", 0.0)]))
        put(self, "leans", leans)
        put(self, "half", (mirror.diameter / 2.0 * np.sin(np.pi / count) if polygon else 0.0, mirror.height / 2.0))
        put(self, "board", frame)
        put(
            self,
            "origin",
            np.array([exposure.screen_shift + e.get("sx", 0.0), 0.0, 0.0]) + np.array(self.errors.screen),
        )
        put(self, "half_way", 0.5 * (c[0] + exposure.screen_shift))  # x of the plane between mirror (C) and screen
        put(self, "drift", (frame.T @ drift)[1:])

    def slope(self, a, b):
        """Slopes along u and v of the ray through (a, b) of the section through the aimed point, perpendicular to d."""
        m, (cu, cv) = self.bend, self.coma
        su = m[0, 0] * a + m[0, 1] * b + cu * (3 * a * a + b * b) + 2 * cv * a * b
        sv = m[1, 0] * a + m[1, 1] * b + 2 * cu * a * b + cv * (a * a + 3 * b * b)
        return su + self.tip[0], sv + self.tip[1]

    def spreading(self, a, b, w):
        """By how much an area of rays grows from the section through the aimed point to a distance w along the beam."""
        m, (cu, cv) = self.bend, self.coma
        mixed = m[0, 1] + 2 * cu * b + 2 * cv * a
        uu, vv = m[0, 0] + 6 * cu * a + 2 * cv * b, m[1, 1] + 2 * cu * a + 6 * cv * b
        return (1 + w * uu) * (1 + w * vv) - (w * mixed) ** 2

    def beam(self, x):
        """Direction of the beam's ray through points x, and the power there per area perpendicular to the beam.

        The section through the aimed point has the stated Gaussian; along the rays power is conserved.
        """
        along = x - self.through
        w, a, b = dot(along, self.d), dot(along, self.u), dot(along, self.v)
        p, q = a, b
        for _ in range(8):  # the place (p, q) in the section from which the ray comes
            su, sv = self.slope(p, q)
            p, q = a - w * su, b - w * sv
        su, sv = self.slope(p, q)
        direction = unit(self.d + su[..., None] * self.u + sv[..., None] * self.v)
        waist = self.recording.laser.beam_diameter / 2.0
        density = 2.0 / (np.pi * waist**2) * np.exp(-2.0 * (p * p + q * q) / waist**2)
        s, (c4, plus, cross) = 2.0 * (p * p + q * q) / waist**2, self.shape
        density = density * np.exp(c4 * (s * s - 2.0 * s) + (plus * (p * p - q * q) + 2.0 * cross * p * q) / waist**2)
        return direction, density / self.spreading(p, q, w)

    def facet(self, t, h, turned, lean):
        """Point and unit normal of the front face at (t, h), when the facet's normal is turned by ``turned``."""
        c, s = np.cos(turned)[..., None], np.sin(turned)[..., None]
        m = np.cross(self.axis, self.n)
        n, along = c * self.n + s * m, c * m - s * self.n
        normal, high = np.cos(lean) * n + np.sin(lean) * self.axis, np.cos(lean) * self.axis - np.sin(lean) * n
        bend = 1e-3 * self.effects.get("fcurv", 0.0)
        t, h = np.broadcast_arrays(t, h)
        t, h = t[..., None], h[..., None]
        x = self.centre + self.distance * n + t * along + h * high - 0.5 * bend * (t * t + h * h) * normal
        return x, unit(normal + bend * (t * along + h * high))

    def share_of_glass(self, cosine):
        """Of unpolarised light (Fresnel): what the front face reflects, or what passes it twice."""
        inside = np.sqrt(1.0 - (1.0 - cosine**2) / GLASS**2)
        s = (cosine - GLASS * inside) / (cosine + GLASS * inside)
        p = (GLASS * cosine - inside) / (GLASS * cosine + inside)
        front = 0.5 * (s * s + p * p)
        return front if self.ghost else (1.0 - front) ** 2

    def reflect(self, x, normal, direction):
        """Where the light leaves the front face, and its direction."""
        cosine = dot(direction, normal)[..., None]
        out = direction - 2.0 * cosine * normal
        glass = self.effects.get("glass", 0.0)
        if glass and not self.ghost:
            tangential = direction - cosine * normal
            sine = tangential / GLASS
            x = x + 2.0 * glass * sine / np.sqrt(1.0 - dot(sine, sine))[..., None]
        return x, out

    def land(self, x, direction):
        """Board coordinates (..., 2) of rays from x."""
        e = self.effects
        if e.get("plume", 0.0):
            s = (self.half_way - x[..., 0]) / direction[..., 0]
            x = x + s[..., None] * direction
            square = (x[..., 1] - e.get("plume_y", 0.0)) ** 2 + (x[..., 2] - e.get("plume_z", 0.0)) ** 2
            kick = 1e-3 * e["plume"] * np.exp(-0.5 * square / e["plume_width"] ** 2)
            direction = unit(direction + kick[..., None] * np.array([0.0, 1.0, 0.0]))
        if any(e.get(key, 0.0) for key in ("win", "wty", "wtz")):
            x = x + self.plate(direction)
        gradient = THERMO_OPTIC * 1e-3 * np.array([0.0, e.get("airh", 0.0), e.get("air", 0.0)])
        bend = gradient - dot(gradient, direction)[..., None] * direction
        start, along, bend = ((y @ self.board) for y in (x - self.origin, direction, bend))
        by, bz = 1e-3 * e.get("bow_y", 0.0), 1e-3 * e.get("bow_z", 0.0)
        s = -start[..., 0] / along[..., 0]
        for _ in range(4):  # Newton on the path length, to the curved board
            at = start + s[..., None] * along + 0.5 * (s * s)[..., None] * bend
            rate = along + s[..., None] * bend
            miss = at[..., 0] - 0.5 * (by * at[..., 1] ** 2 + bz * at[..., 2] ** 2)
            s = s - miss / (rate[..., 0] - by * at[..., 1] * rate[..., 1] - bz * at[..., 2] * rate[..., 2])
        at = start + s[..., None] * along + 0.5 * (s * s)[..., None] * bend
        return at[..., 1:] + self.drift

    def plate(self, direction):
        """Shift of a ray by a plane-parallel plate that is parallel to the screen, or turned about y and z."""
        e = self.effects
        tilted = e.get("wty", 0.0) or e.get("wtz", 0.0)
        thick = e.get("win", 0.0) or (PLATE if tilted else 0.0)
        tilt = turn(np.deg2rad([0.0, e.get("wty", 0.0), e.get("wtz", 0.0)]))
        m = -(tilt @ np.array([1.0, 0.0, 0.0]))  # inward, the way the light goes
        cosine = dot(direction, m)[..., None]
        sine = (direction - cosine * m) / GLASS
        inside = np.sqrt(1.0 - dot(sine, sine))[..., None]
        return thick * (sine / inside - GLASS * sine / cosine)

    def node(self, t, h, turned, lean):
        """Landing point of a node's light, and its power per mm² of the facet."""
        x, normal = self.facet(t, h, turned, lean)
        direction, density = self.beam(x)
        power = density * -dot(direction, normal)
        if self.effects.get("glass", 0.0):
            power = power * self.share_of_glass(-dot(direction, normal))
        if not self.recording.physics.beam:  # a ray of the pencil, of power 1
            direction, power = np.broadcast_to(self.d, direction.shape), power / (density * -dot(direction, normal))
        return self.land(*self.reflect(x, normal, direction)), power

    def single(self, turned, lean=0.0):
        """Landing point of the one ray along the laser's axis off the turning facet, and its place (t, h) there."""
        t = h = np.zeros_like(turned)
        for _ in range(30):  # where the axis meets the facet's tangent plane, anew from there
            x, normal = self.facet(t, h, turned, lean)
            step = self.through + (dot(x - self.through, normal) / dot(self.d, normal))[..., None] * self.d - x
            along = unit(np.cross(np.broadcast_to(self.axis, normal.shape), normal))
            t, h = t + dot(step, along), h + dot(step, np.cross(normal, along))
        return self.land(*self.reflect(x, normal, np.broadcast_to(self.d, x.shape))), (t, h)

    def nodes(self, along, across):
        """Gauss-Legendre nodes (t, h) and weights [mm²] (t, h) of the facet; of a cylinder's pencil t is 0 [mm]."""
        (x, wx), (y, wy) = np.polynomial.legendre.leggauss(along), np.polynomial.legendre.leggauss(across)
        half_t, half_h = self.half
        if half_t == 0.0:
            x, wx, half_t = np.zeros(1), np.ones(1), 1.0
        if not self.recording.physics.beam:
            y, wy, half_h = np.zeros(1), np.ones(1), 1.0
        t, h = np.meshgrid(half_t * x, half_h * y, indexing="ij")
        return t, h, np.outer(half_t * wx, half_h * wy)

    def cut(self, land, points, tangent, start):
        """Turn at which ``land(turn)`` (profile, ...) crosses each profile's normal, offset there and speed past it."""
        points, tangent = (x.reshape(len(x), *[1] * (start.ndim - 1), 2) for x in (points, tangent))
        left = np.stack([-tangent[..., 1], tangent[..., 0]], -1)
        turned, step = start, 1e-5
        for _ in range(4):
            ahead, behind = (dot(land(turned + k * step) - points, tangent) for k in (1, -1))
            speed = (ahead - behind) / (2 * step)
            turned = turned - 0.5 * (ahead + behind) / speed
        return turned, dot(land(turned) - points, left), speed

    def profiles(self, points, tangent, along=28, across=8):
        """Offsets q and light per mm of the trace, (facet, profile, t, h), of the light on each profile's normal.

        ``points`` and unit ``tangent`` (n, 2) on the board, in the order of growing turn; q is to the left of it. Laser
        power 1, averaged over a revolution.
        """
        physics = self.recording.physics
        ray = physics.facets and not physics.beam
        t, h, area = (np.zeros((1, 1)), np.zeros((1, 1)), np.ones((1, 1))) if ray else self.nodes(along, across)
        grid = np.linspace(-0.25, 0.25, 401)
        leans = self.leans if np.ptp(self.leans) else self.leans[:1]
        middle = float(np.mean(self.leans))
        seen = self.single(grid, middle)[0] if ray else self.node(np.zeros(1), np.zeros(1), grid, middle)[0]
        first = grid[np.argmin(((points[:, None] - seen) ** 2).sum(-1), axis=1)]
        start = np.broadcast_to(first[:, None, None], (len(points), *t.shape))
        spread, light = [], []
        for lean in leans:
            land = (lambda e, k=lean: self.single(e, k)[0]) if ray else (lambda e, k=lean: self.node(t, h, e, k)[0])
            turned, q, speed = self.cut(land, points, tangent, start)
            power = self.node(t, h, turned, lean)[1] if not ray or self.effects.get("glass") else np.ones_like(q)
            spread.append(q)
            light.append(power * area / np.abs(speed) * self.share / len(leans))
        spread, light = np.array(spread), np.array(light)
        if self.effects.get("glass", 0.0) and not self.ghost:  # the ghost's light lies across the same trace
            more = replace(self, ghost=True).profiles(points, tangent, along, across)
            spread, light = np.concatenate([spread, more[0]]), np.concatenate([light, more[1]])
        return spread, light

    @property
    def share(self):
        """Light per mm: of all facets, or the gated one; of a cylinder with beam the strip r dε; of a pencil a ray."""
        physics = self.recording.physics
        if not physics.facets:
            return self.distance if physics.beam else 1.0 / (2.0 * np.pi)
        return (self.recording.mirror.facets if self.exposure.facet is None else 1) / (2.0 * np.pi)

    def centre_line(self, points, tangent, **nodes):
        """Mean offset (n,) [mm], light per mm, and adaptive width about the mean of the irradiance across a trace."""
        q, light = (x.swapaxes(0, 1).reshape(len(points), -1) for x in self.profiles(points, tangent, **nodes))
        flux = light.sum(1)
        mean = (q * light).sum(1) / flux
        return mean, flux, adaptive(q - mean[:, None], light)

    def line(self, samples, turns=(-0.2, 0.2), edge=340.0):
        """Centre line (samples, 2) [mm] within ±edge of the board, and its unit tangents."""
        grid = np.linspace(*turns, 801)
        points = self.node(np.zeros(1), np.zeros(1), grid, float(np.mean(self.leans)))[0]
        points = points[np.abs(points).max(1) < edge]
        points = points[np.linspace(0, len(points) - 1, samples).round().astype(int)]
        for _ in range(2):
            tangent = tangents(points)
            off = self.centre_line(points, tangent, along=16, across=6)[0]
            points = points + off[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], -1)
        return points, tangents(points)

    def fresnel(self, points, tangent, q, along=24, across=64):
        """Irradiance (n, len(q)) [1/mm²] on each profile's normal with diffraction at the facet's height.

        Huygens and Fresnel along the height, with the beam's amplitude across the facet and true path lengths from the
        beam's source point to the board; the turn averages the phase along the width away, so that its nodes add as
        intensities, each in the turn at which its light is stationary along the width.
        """
        leans = float(np.mean(self.leans))
        t, h, area = self.nodes(along, across)
        wave = 2.0 * np.pi / self.recording.laser.wavelength
        source = self.through - self.d / self.bend[0, 0]
        left = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
        out = np.zeros((len(points), len(q)))
        turned, _, speed = self.cut(
            lambda e: self.node(t, h, e, leans)[0], points, tangent, np.zeros((len(points), *t.shape))
        )
        light = self.node(t, h, turned, leans)[1] * area / np.abs(speed) * self.share  # per node, light per mm
        for i in range(len(points)):
            board = points[i] + q[:, None] * left[i]
            target = self.origin + np.concatenate([np.zeros((len(q), 1)), board], 1) @ self.board.T

            def path(e, tt, hh, target=target):
                x = self.facet(tt, hh, e, leans)[0]
                return np.linalg.norm(x - source, axis=-1) + np.linalg.norm(target[:, None, None] - x, axis=-1)

            mid, tt, step = np.zeros(1), t[None, :, :1], 1e-3
            e = np.broadcast_to(turned[i].mean(1)[None, :, None], (len(q), along, 1))
            for _ in range(5):  # the turn at which the path is stationary along the width
                slope = [path(e + k, tt + step, mid) - path(e + k, tt - step, mid) for k in (-1e-4, 0.0, 1e-4)]
                e = e - slope[1] * 2e-4 / (slope[2] - slope[0])
            phase = wave * path(e, t[None], h[None])
            phase = phase - phase[..., :1]
            rule = area / area.sum(1, keepdims=True) * 2.0 * self.half[1]  # dh
            amplitude = np.sqrt(light[i] / rule)
            field_ = (amplitude * rule * np.exp(1j * phase)).sum(-1)
            # d²phase/dq dh turns the integral over q of |field|² into that of the light over h (Parseval).
            mixed = np.gradient(np.gradient(phase, h[0], axis=-1), q, axis=0)
            chirp = np.abs(mixed[len(q) // 2, :, across // 2])
            out[i] = (np.abs(field_) ** 2 * chirp / (2.0 * np.pi)).sum(-1)
        return out

    def spot(self, turned, along=28, across=8):
        """Of the spots at turns (n,): mean (n, 2), light, and covariance (n, 2, 2) of their irradiance."""
        t, h, area = self.nodes(along, across)
        landed, power = self.node(t, h, turned[:, None, None], self.leans[0])
        w = (power * area)[..., None]
        total = w.sum((1, 2))
        mean = (w * landed).sum((1, 2)) / total
        off = landed - mean[:, None, None]
        return mean, total[:, 0], np.einsum("nth,nthi,nthj->nij", w[..., 0], off, off) / total[..., None]


def tangents(points):
    """Unit tangents of the smooth curve through points, by a cubic spline in the chord length."""
    s = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    return unit(CubicSpline(s, points)(s, 1))


def adaptive(q, light):
    """The σ of the Gaussian about 0 that matches the light under its own weight: 2 Σ W L q² = σ² Σ W L."""
    square = (light * q * q).sum(1) / light.sum(1)
    for _ in range(60):
        weighted = light * np.exp(-0.5 * q * q / np.where(square, square, 1.0)[:, None])
        square = 2.0 * (weighted * q * q).sum(1) / weighted.sum(1)
    return np.sqrt(square)
