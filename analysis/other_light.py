"""Light of the laser bench on its board: geometric optics or diffraction along the facets' narrow side.

For each phase of rotation and each place across a facet the light is spread along the facet's narrow side: by rays in
geometric optics, by the Fresnel integral over that slice where diffraction is on. The slices sum to an irradiance
tabulated in a chart that follows the trace. Lengths in mm, angles in rad.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial.legendre import leggauss
from other_optics import Scene, Vector, cross2, dot, unit
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.ndimage import gaussian_filter1d

KNOTS = 33  # phases tabulated along a trace: a spline through them is within 0.1 µm of one through 121
HALF_WIDTH_MM = 16.0  # of the chart across a facet's trace: 0.4 % of a diffracted line's light falls outside
BIN_MM = 0.05  # of the chart: a third of the narrowest feature (a geometric line's edge, seen by 1 mm pixels)


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
        leaning = [scene.reflect(self.phase, zero, zero, one)[:2] for one in (min(scene.leans), max(scene.leans))]
        along = self.base(self.phase, 1)
        apart = [np.abs(cross2(scene.land(*ray) - base, along) / cross2(across, along)).max() for ray in leaning]
        half = HALF_WIDTH_MM + BIN_MM * np.ceil(max(apart) / BIN_MM)
        self.edges = np.arange(-half, half + BIN_MM / 2, BIN_MM)
        table = np.zeros((KNOTS, len(self.edges) - 1))
        add = _diffracted if scene.diffraction else _geometric
        for front in (False, True) if scene.mirror.glass and ghost else (False,):
            table += add(self, front)
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
        seen = (np.abs(x) < self.edges[-1] - BIN_MM) & (phase > self.phase[0]) & (phase < self.phase[-1])
        return np.where(seen, np.clip(light, 0, None), 0.0)

    def line(self, at: Vector, reach: float = 12.0, step: float = 0.04) -> dict[str, Vector]:
        """Centroid (board mm), rms width (mm) and flux (per mm of trace) of profiles at right angles to the trace."""
        tangent = unit(self.base(at, 1))
        centre = self.base(at)
        q = np.arange(-reach, reach + step / 2, step)
        for _ in range(3):  # the window follows the centroid
            normal = np.stack([-tangent[:, 1], tangent[:, 0]], -1)
            spots = centre[:, None] + q[:, None] * normal[:, None]
            light = self.irradiance(spots.reshape(-1, 2)).reshape(len(at), -1)
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


def _geometric(trace: Trace, front: bool) -> Vector:
    """Table of geometric optics: every ray of a slice is brought to every knot's line."""
    scene, table = trace.scene, np.zeros((KNOTS, len(trace.edges) - 1))
    s, ws = scene.mirror.half_width * np.array(leggauss(32))
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


def _diffracted(trace: Trace, front: bool) -> Vector:
    """Table with Fresnel diffraction along the facet's narrow side, the beam's amplitude and phase over it.

    A slice at fixed phase and s lies in the plane of the axis and the reflected ray, which is at right angles to the
    sweep; light that the sweep smears along the trace does not interfere across it (Parseval), so the slices add.
    """
    scene, table = trace.scene, np.zeros((KNOTS, len(trace.edges) - 1))
    mirror, board = scene.mirror, scene.board
    s, ws = mirror.half_width * np.array(leggauss(16))
    h, wh = mirror.half_height * np.array(leggauss(72))
    q = np.arange(-HALF_WIDTH_MM - 2, HALF_WIDTH_MM + 2.01, 0.1)
    shapes = None
    for lean in sorted(scene.leans, key=lambda one: abs(one - np.mean(scene.leans))):

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
                lit = scene.reflect(phase[j][:, None], s[:, None], h, lean, front)
                shapes[j] = _slices(scene, lit, wh, world[j], foot[j], p0[j], q)
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
    scene: Scene, lit: tuple[Vector, ...], wh: Vector, world: Vector, foot: Vector, p0: Vector, q: Vector
) -> Vector:
    """Power per mm of q (len(s), len(q)) of every slice at one knot, q along the board through the slice's centre.

    lit: what `Scene.reflect` gives at the slices' nodes (s, h), of weights wh; the slices' centres leave p0 and land
    at world, where foot is one mm of q.
    """
    out, _, power, path = lit
    k = 2 * np.pi / scene.wavelength
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
