"""Photographs of a known curve on the board, made without any of benchsim's optics, for the studies of the ridge.

A circular arc of known radius lies on the board; across it the light has a known shape whose mean is the arc, and whose
`centre.centre` behind the blur lies beside it by what `beside_arc` says.
OpenCV undoes lens and perspective for 4 x 4 points in every pixel of a band; their mean is the pixel's light, blurred
by a Gaussian, with shot and read noise, quantised.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.special import fresnel

from benchsim.bench.model import Camera
from benchsim.rays.width import placed
from benchsim.trace.band import band_along
from benchsim.trace.pose import Pose

SUB = 4
"""Points per pixel side."""

FULL_WELL = 12000.0
READ_NOISE = 6.0


@dataclass(frozen=True)
class Scene:
    """One geometry: camera and pose (OpenCV's R, t), the arc, the light's shape and its change along the arc."""

    camera: Camera
    rotation: np.ndarray
    translation: np.ndarray
    centre: np.ndarray
    radius: float
    middle: float
    shape: str
    width: float
    skew: float
    flux_slope: float
    width_slope: float
    blur: float


def random_scene(rng: np.random.Generator, bits: int = 16, size: tuple[int, int] = (2000, 1500)) -> Scene:
    """A camera, an arc and a line shape at random; the arc crosses the board in any direction."""
    w, h = size
    focal = 1.05 * w
    camera = Camera(
        "A",
        size,
        focal,
        (w / 2 - 0.5 + rng.uniform(-5, 5), h / 2 - 0.5 + rng.uniform(-5, 5)),
        (rng.uniform(-0.1, 0.05), rng.uniform(-0.03, 0.05), *rng.uniform(-1e-3, 1e-3, 2), 0.0),
        bit_depth=bits,
        saturation_level=2.0**bits - 1,
    )
    position = np.array([rng.uniform(1150, 1300), rng.uniform(-450, 450), rng.uniform(-300, 300)])
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    angle, radius = rng.uniform(0, 2 * np.pi), 10 ** rng.uniform(np.log10(1500), np.log10(30000))
    through = rng.uniform(-100, 100, 2)
    return Scene(
        camera,
        rotation,
        -rotation @ position,
        through + radius * np.array([np.cos(angle), np.sin(angle)]),
        radius,
        angle + np.pi,
        str(rng.choice(["gaussian", "ramp", "fresnel"])),
        rng.uniform(0.7, 1.6),
        rng.uniform(-0.6, 0.6),
        rng.uniform(-0.4, 0.4),
        rng.uniform(-0.2, 0.2),
        rng.uniform(0.5, 0.9),
    )


def shape_table(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Light across the line, unit integral and zero mean, against offset in units of the width."""
    x = np.linspace(-40.0, 40.0, 32001)
    if scene.shape == "gaussian":
        light = np.exp(-0.5 * x**2)
        mean = 0.0
    elif scene.shape == "ramp":
        # Edges soft over a pixel's 4 x 4 points, or their sum would come in steps.
        light = gaussian_filter1d(np.where(np.abs(x) < 1.7, 1 + scene.skew * x / 1.7, 0.0), 0.2 / (x[1] - x[0]))
        mean = scene.skew * 1.7 / 3
    else:
        # Two slits' Fresnel patterns, added without interference: side lobes, 1/x² tails, lopsided; each symmetric.
        # As lopsided as behind a 2 mm mirror up to a third of the beam's radius off its axis.
        weight, apart = 0.5 + 0.4 * scene.skew / 2, 0.8
        light = weight * _slit(x - apart, 1.3) + (1 - weight) * _slit(x + apart, 1.3)
        mean = apart * 0.4 * scene.skew
    return x - mean, light / (light.sum() * (x[1] - x[0]))


def _slit(x: np.ndarray, half: float) -> np.ndarray:
    scale = 1.1
    s1, c1 = fresnel((x + half) * scale)
    s2, c2 = fresnel((x - half) * scale)
    return ((s1 - s2) ** 2 + (c1 - c2) ** 2) / 2


def to_arc(scene: Scene, board: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Place along the arc and distance from it, outward, of board points (..., 2) [mm]."""
    d = board - scene.centre
    turn = np.angle(np.exp(1j * (np.arctan2(d[..., 1], d[..., 0]) - scene.middle)))
    return scene.radius * turn, np.linalg.norm(d, axis=-1) - scene.radius


def beside_arc(scene: Scene, s: np.ndarray) -> np.ndarray:
    """How far outward of the arc the centre of its light lies behind blur and pixel, at s [mm], (n,) mm."""
    at = np.linspace(s.min(), s.max(), 9)
    along, out = arc(scene, at + 0.5) - arc(scene, at - 0.5), arc(scene, at) - scene.centre
    step = out / np.linalg.norm(out, axis=1, keepdims=True)
    tangent, moved = (
        to_pixels(scene, arc(scene, at) + 0.5 * d) - to_pixels(scene, arc(scene, at) - 0.5 * d) for d in (along, step)
    )
    crossed = np.abs(tangent[:, 0] * moved[:, 1] - tangent[:, 1] * moved[:, 0])
    width = scene.width * (1 + scene.width_slope * at / 350)
    blur = np.hypot(scene.blur, 12**-0.5) * np.linalg.norm(tangent, axis=1) / crossed / width
    x, light = shape_table(scene)
    fine = slice(0, None, 20)
    near = np.abs(x[fine]) < 12
    x, light = x[fine][near], light[fine][near]
    _, found = placed(np.tile(x, (len(at), 1)), np.tile(light, (len(at), 1)), blur[:, None])
    return np.interp(s, at, found * width)


def arc(scene: Scene, s: np.ndarray) -> np.ndarray:
    """Board points (n, 2) of the arc at s [mm]."""
    turn = scene.middle + s / scene.radius
    return scene.centre + scene.radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def to_pixels(scene: Scene, board: np.ndarray) -> np.ndarray:
    """Board points (n, 2) [mm] to pixels."""
    world = np.concatenate([np.zeros((len(board), 1)), board], axis=1)
    out, _ = cv2.projectPoints(
        world,
        cv2.Rodrigues(scene.rotation)[0],
        scene.translation,
        _matrix(scene.camera),
        np.array(scene.camera.distortion),
    )
    return out[:, 0]


def to_board(scene: Scene, pixels: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) to board points [mm]."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-10)
    flat = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
    lens = _matrix(scene.camera), np.array(scene.camera.distortion)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        ideal = cv2.undistortPointsIter(flat, *lens, None, None, criteria)[:, 0]
    else:
        ideal = cv2.undistortPoints(flat, *lens, None, None, None, criteria)[:, 0]
    plane = np.linalg.inv(np.stack([scene.rotation[:, 1], scene.rotation[:, 2], scene.translation], axis=1))
    out = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1) @ plane.T
    return out[:, :2] / out[:, 2:]


def _matrix(camera: Camera) -> np.ndarray:
    (cx, cy), f = camera.principal_point, camera.focal
    return np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])


@dataclass(frozen=True)
class Light:
    """Expected electrons, before noise: of the laser, of the room; and the laser's derivatives, all (h, w).

    ``shift`` per mm of the arc outward, ``stretch`` per unit of log width. ``board`` marks the board's pixels.
    """

    line: np.ndarray
    room: np.ndarray
    shift: np.ndarray
    stretch: np.ndarray
    board: np.ndarray


def expose(scene: Scene, peak: float = 0.7, room: float = 0.3, half_band: float = 12.0) -> Light:
    """Expected light of a scene; the line's peak and the room-lit board as fractions of the full well."""
    w, h = scene.camera.resolution
    edge = np.linspace(-350, 350, 40)
    ring = np.concatenate(
        [
            np.stack(p, axis=1)
            for p in ((edge, 0 * edge - 350), (0 * edge + 350, edge), (-edge, 0 * edge + 350), (0 * edge - 350, -edge))
        ]
    )
    board = np.zeros((h, w), np.uint8)
    cv2.fillPoly(board, [np.round(to_pixels(scene, ring) * 16).astype(np.int32)], 1, shift=4)
    s = np.linspace(-600, 600, 2400)
    line = arc(scene, s)
    line = line[np.abs(line).max(axis=1) < 360]
    pixels = to_pixels(scene, line)
    band = np.zeros((h, w), np.uint8)
    width_px = 2 * int(np.ceil(half_band * 2.2)) + 1
    cv2.polylines(band, [np.round(pixels).astype(np.int32)], False, 1, thickness=width_px)
    v, u = np.nonzero(band)
    step = (np.arange(SUB) + 0.5) / SUB - 0.5
    du, dv = (a.ravel() for a in np.meshgrid(step, step))
    along, across = to_arc(
        scene, to_board(scene, np.stack([(u[:, None] + du).ravel(), (v[:, None] + dv).ravel()], axis=1))
    )
    x, table = shape_table(scene)
    width = scene.width * (1 + scene.width_slope * along / 350)
    flux = (1 + scene.flux_slope * along / 350) * (1 + 0.1 * np.sin(along / 120))

    def image(shift: float, stretch: float) -> np.ndarray:
        scaled = width * np.exp(stretch)
        light = flux * np.interp((across - shift) / scaled, x, table, 0.0, 0.0) / scaled
        out = np.zeros((h, w))
        out[v, u] = light.reshape(-1, SUB * SUB).mean(axis=1)
        return cv2.GaussianBlur(out, (0, 0), scene.blur)

    sharp = image(0, 0)
    scale = peak * FULL_WELL / sharp.max()
    lit = cv2.GaussianBlur(room * FULL_WELL * board.astype(float), (0, 0), scene.blur) + 0.005 * FULL_WELL
    uu, vv = np.meshgrid(np.arange(w) / w, np.arange(h) / h)
    lit *= 1 + 0.2 * (uu - 0.5) - 0.1 * (vv - 0.5)
    eps = 0.02
    return Light(
        sharp * scale * board,
        lit,
        (image(eps, 0) - image(-eps, 0)) * scale / (2 * eps),
        (image(0, eps) - image(0, -eps)) * scale / (2 * eps),
        board.astype(bool),
    )


def photograph(electrons: np.ndarray, rng: np.random.Generator, bits: int) -> np.ndarray:
    """Counts of one exposure: shot and read noise, full scale at the full well, rounded, clipped."""
    noisy = rng.poisson(np.maximum(electrons, 0)) + rng.normal(0, READ_NOISE, electrons.shape)
    top = 2**bits - 1
    return np.clip(np.round(noisy * top / FULL_WELL), 0, top).astype(np.uint8 if bits == 8 else np.uint16)


def counts_variance(electrons: np.ndarray, bits: int) -> np.ndarray:
    """True variance of a pixel in counts: shot, read, rounding."""
    gain = (2**bits - 1) / FULL_WELL
    return gain**2 * (electrons + READ_NOISE**2) + 1 / 12


def encode(path: Path, counts: np.ndarray, jpeg_quality: int | None = None) -> Path:
    """Write counts as PNG, or as JPEG if a quality is given; returns the file's path."""
    path = path.with_suffix(".png" if jpeg_quality is None else ".jpg")
    cv2.imwrite(str(path), counts, [] if jpeg_quality is None else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])
    return path


def true_pose(scene: Scene) -> Pose:
    """The scene's pose, known exactly."""
    none = np.zeros((0, 4, 2))
    return Pose(
        scene.rotation, scene.translation, scene.camera, np.zeros((6, 6)), none, 1.0, np.zeros(0, bool), (), 0.0
    )


def centre_bound(scene: Scene, light: Light, bits: int, dark: bool, half_width: float = 25.0) -> tuple:
    """Cramér–Rao bound of the centre of profiles one pixel wide: place along the arc [mm] and sigma [mm], (n,) each.

    Flux, width and a constant background are free; every pixel within ``half_width`` [px] counts with its true
    variance.
    """
    s = np.arange(-500.0, 500.0, 2.0)
    points = arc(scene, s)
    s = s[np.abs(points).max(axis=1) < 345]
    pixels = to_pixels(scene, arc(scene, s))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    curve = make_interp_spline(length, pixels)
    band = band_along(curve, (0.0, length[-1]), half_width, light.line.shape)
    gain = (2**bits - 1) / FULL_WELL
    variance = counts_variance(light.line + light.room, bits) + (counts_variance(light.room, bits) if dark else 0.0)
    use = band.inside & band.take(light.board)
    slopes = np.stack(
        [np.where(use, band.take(a), 0.0) for a in (light.line, light.shift, light.stretch, np.ones_like(light.line))],
        1,
    )
    information = np.einsum(
        "kam,kbm,km->kab", slopes * gain, slopes * gain, np.where(use, 1 / band.take(variance), 0.0)
    )
    return np.interp(band.t, length, s), np.sqrt(np.linalg.inv(information)[:, 1, 1])
