"""Photographs of a marked target with a beam on it, drawn for the tests with other code than what reads them.

A wall of 8 m × 7 m (two such targets above each other with ``family="stj"``, one with ``"mft"``), angles and tees with
rounded edges, a camera below it with some roll, uneven daylight, a lopsided beam, 8-bit sRGB counts with noise.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

BAR, ARM = 150.0, 740.0  # mm
ORIGIN = (50.9134, 6.3878, 87.0)
METRES_PER_DEGREE = (111_257.6, 70_333.0)  # at that latitude and height, WGS 84; latitude, longitude

BOXES = {
    "solar_tower_juelich_upper": (-4300.0, 4300.0, 39_500.0, 46_700.0),
    "solar_tower_juelich_lower": (-4300.0, 4300.0, 32_300.0, 39_500.0),
    "multi_focus_tower": (-20_500.0, -15_100.0, 48_800.0, 55_200.0),
}
STJ = {
    "left_top": (1, 1, "L"),
    "right_top": (-1, 1, "L"),
    "left_middle": (1, 0, "T"),
    "right_middle": (-1, 0, "T"),
    "left_bottom": (1, -1, "L"),
    "right_bottom": (-1, -1, "L"),
    "top_middle": (0, 1, "T"),
    "bottom_middle": (0, -1, "T"),
}
"""Mark → which side of the wall it is on (east, up) and its shape."""


def bars(side: tuple[int, int], shape: str) -> list[tuple[float, float, float, float]]:
    """Rectangles of a mark relative to its surveyed point: (east low, east high, up low, up high), mm."""
    e, u = side
    bar_e, arm_e = sorted((0.0, -e * BAR)), sorted((0.0, -e * ARM))
    bar_u, arm_u = sorted((0.0, -u * BAR)), sorted((0.0, -u * ARM))
    if shape == "L":
        return [(*arm_e, *bar_u), (*bar_e, *arm_u)]
    across, along = (-ARM / 2, ARM / 2), (-BAR / 2, BAR / 2)
    return [(*bar_e, *across), (*arm_e, *along)] if e else [(*across, *bar_u), (*along, *arm_u)]


def ink(east, up, marks, soft: float):
    """Fraction of light that is left by the marks; edges are soft over ``soft`` mm."""

    def inside(x, low, high):
        return (np.tanh((x - low) / soft / 2) - np.tanh((x - high) / soft / 2)) / 2

    cover = np.zeros_like(east)
    for point, rectangles in marks:
        for a, b, c, d in rectangles:
            cover = np.maximum(cover, inside(east - point[0], a, b) * inside(up - point[1], c, d))
    return 1 - 0.85 * np.clip(cover, 0, 1)


@dataclass
class Scene:
    """What is drawn; lengths in mm, relative to the target's centre."""

    target: str = "solar_tower_juelich_upper"
    height: int = 400
    beam: tuple[float, float] = (300.0, -200.0)
    widths: tuple[float, float] = (900.0, 500.0)
    turn: float = 0.6
    tail: float = 0.25
    brightness: float = 0.35
    daylight: float = 0.25
    slope: tuple[float, float] = (0.1, -0.06)
    bow: float = 0.05
    noise: float = 1.5
    roll: float = 0.02
    survey: float = 0.0
    hidden: tuple[str, ...] = ()
    moved: dict[str, tuple[float, float]] = field(default_factory=dict)


def wall(target: str) -> tuple[float, float, float, float]:
    """East and up limits of the marks' rectangle, from the plant's origin."""
    if target == "multi_focus_tower":
        return BOXES[target]
    return (-4300.0, 4300.0, 32_300.0, 46_700.0)


def mark_places(target: str) -> dict[str, tuple[np.ndarray, list]]:
    e0, e1, u0, u1 = wall(target)
    names = STJ if target != "multi_focus_tower" else {k: v for k, v in STJ.items() if v[2] == "L"}
    return {
        n: (np.array([(e0 + e1) / 2 + s * (e1 - e0) / 2, (u0 + u1) / 2 + t * (u1 - u0) / 2]), bars((s, t), shape))
        for n, (s, t, shape) in names.items()
    }


def draw(folder: Path, scene: Scene, seed: int, name: str = "1") -> tuple[Path, np.ndarray]:
    """Write ``NAME-raw.png``, its properties and the tower file; give the path and the true centroid (east, up) mm."""
    rng = np.random.default_rng(seed)
    e0, e1, u0, u1 = wall(scene.target)
    width = int(scene.height * (e1 - e0) / (u1 - u0) * 1.25)
    corners = np.array([[e0, u1], [e1, u1], [e1, u0], [e0, u0]], np.float32)
    # Who looks south sees east on the left; from below, the upper edge is shorter.
    margin, h = 0.1, scene.height
    seen = np.array(
        [[1 - margin - 0.015, margin], [margin + 0.015, margin], [margin, 1 - margin], [1 - margin, 1 - margin]]
    ) * [width, h]
    c, s = np.cos(scene.roll), np.sin(scene.roll)
    middle = np.array([width, h]) / 2
    seen = (seen - middle) @ np.array([[c, s], [-s, c]]) + middle + rng.uniform(-2, 2, 2)
    to_pixel = cv2.getPerspectiveTransform(corners, seen.astype(np.float32)).astype(float)
    over = 2
    v, u = np.mgrid[0 : h * over, 0 : width * over]
    pixels = np.stack([(u + 0.5) / over - 0.5, (v + 0.5) / over - 0.5], axis=-1)
    place = cv2.perspectiveTransform(pixels.reshape(-1, 1, 2), np.linalg.inv(to_pixel)).reshape(pixels.shape)
    east, up = place[..., 0], place[..., 1]

    box = BOXES[scene.target]
    centre = np.array([(box[0] + box[1]) / 2, (box[2] + box[3]) / 2])
    x, y = (east - centre[0]) / (e1 - e0) * 2, (up - centre[1]) / (u1 - u0) * 2
    room = scene.daylight * (
        1 + scene.slope[0] * x + scene.slope[1] * y + scene.bow * (x**2 - y**2 + 0.5 * np.cos(3 * x))
    )
    ct, st = np.cos(scene.turn), np.sin(scene.turn)

    def spot(at, widths):
        de, du = east - centre[0] - at[0], up - centre[1] - at[1]
        p, q = ct * de + st * du, -st * de + ct * du
        return np.exp(-((p / widths[0]) ** 2 + (q / widths[1]) ** 2) / 2)

    core = np.array(scene.beam, float)
    shift = np.array([ct, st]) * scene.widths[0] * 0.6
    tail = tuple(1.4 * w for w in scene.widths)
    light = room + scene.brightness * (spot(core, scene.widths) + scene.tail * spot(core + shift, tail))
    share = scene.tail * 1.4**2 / (1 + scene.tail * 1.4**2)
    truth = core + share * shift
    places = mark_places(scene.target)
    shown = [(p + np.array(scene.moved.get(n, (0.0, 0.0))), b) for n, (p, b) in places.items() if n not in scene.hidden]
    light = light * ink(east, up, shown, 12.0)
    wall_edge = 400.0
    outside = (east < e0 - wall_edge) | (east > e1 + wall_edge) | (up < u0 - wall_edge) | (up > u1 + wall_edge)
    light = np.where(outside, 0.12, light)
    small = light.reshape(h, over, width, over).mean(axis=(1, 3))
    counts = encode(small) + rng.normal(0, scene.noise, small.shape)
    rgb = np.stack([np.clip(counts * k, 0, 255) for k in (0.94, 1.0, 1.03)], axis=-1).round().astype(np.uint8)
    path = folder / f"{name}-raw.png"
    assert cv2.imwrite(str(path), rgb)
    (folder / f"{name}-calibration-properties.json").write_text(json.dumps({"target_name": scene.target}))
    write_tower(folder / "tower-measurements.json", rng, scene.survey)
    return path, truth


def encode(light):
    """sRGB counts of light 0 to 1."""
    light = np.clip(light, 0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def geodetic(east: float, up: float) -> list[float]:
    return [ORIGIN[0], ORIGIN[1] + east / 1e3 / METRES_PER_DEGREE[1], ORIGIN[2] + up / 1e3]


def write_tower(path: Path, rng, survey: float) -> None:
    """The tower file; each point is surveyed with an error of ``survey`` mm, 1 σ."""
    content: dict = {"power_plant_properties": {"ID": "drawn", "coordinates": list(ORIGIN)}}
    points = {}
    for target in ("solar_tower_juelich_upper", "multi_focus_tower"):
        family = target[:5]
        for n, (p, _) in mark_places(target).items():
            e, u = p + rng.normal(0, survey, 2)
            points[family, n] = geodetic(e, u)
    names = {
        "solar_tower_juelich_upper": ("solar", {"upper_left": "left_top", "upper_middle": "top_middle",
            "upper_right": "right_top", "lower_left": "left_middle", "lower_right": "right_middle"}),
        "solar_tower_juelich_lower": ("solar", {"upper_left": "left_middle", "upper_right": "right_middle",
            "lower_left": "left_bottom", "lower_middle": "bottom_middle", "lower_right": "right_bottom"}),
        "multi_focus_tower": ("multi", {"upper_left": "left_top", "upper_right": "right_top",
            "lower_left": "left_bottom", "lower_right": "right_bottom"}),
    }  # fmt: skip
    for target, (family, corners) in names.items():
        e0, e1, u0, u1 = BOXES[target]
        coordinates = {"center": geodetic((e0 + e1) / 2, (u0 + u1) / 2)}
        coordinates |= {k: points[family, n] for k, n in corners.items()}
        content[target] = {"type": "planar", "normal_vector": [0, 1, 0], "coordinates": coordinates}
    path.write_text(json.dumps(content))


def draw_templates(folder: Path, family: str, pixel: float = 14.0) -> Path:
    """Templates at ``pixel`` mm, seen straight on; PAINT has none of the tees in the middle of the edges."""
    folder.mkdir(exist_ok=True)
    target = "multi_focus_tower" if family == "mft" else "solar_tower_juelich_upper"
    for n, (p, rectangles) in mark_places(target).items():
        if n in ("top_middle", "bottom_middle"):
            continue
        size = int(1.5 * ARM / pixel)
        lows, highs = np.min(rectangles, axis=0), np.max(rectangles, axis=0)
        middle = p + np.array([lows[0] + highs[1], lows[2] + highs[3]]) / 2
        v, u = np.mgrid[0:size, 0:size]
        east = middle[0] - (u - size / 2) * pixel
        up = middle[1] - (v - size / 2) * pixel
        light = 0.3 * ink(east, up, [(p, rectangles)], 18.0)
        cv2.imwrite(str(folder / f"{family}_{n}.png"), encode(light).astype(np.uint8))
    return folder
