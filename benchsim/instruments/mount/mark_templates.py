"""Templates of a target's printed marks, and where in each the surveyed point lies.

Marks are the angles and tees printed on the targets of the Jülich solar tower (PAINT's data). Their templates are cut
out of photographs, one file per mark (``stj_left_top.png``), upright and in no particular scale. The surveyed point of
an angle is its outer corner, that of a tee the middle of its crossbar's outer edge: so PAINT's own cropping of targets
reads them (its table of template offsets), and so `reference_point` finds them in any template.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.trace.counts import read_counts

Array = NDArray[np.float64]
Image = NDArray[Any]
"""float32; OpenCV's type stubs know no dtype."""


@dataclass(frozen=True)
class Template:
    """One mark's picture.

    Attributes
    ----------
    name : str
        Of the mark, such as ``left_top``.
    image : (h, w) float32
        Grey.
    ink : (h, w) bool
        The mark itself.
    point : (2,) px
        The surveyed point.
    bar : float
        Width of a bar [px].
    """

    name: str
    image: Image
    ink: NDArray[np.bool_]
    point: Array
    bar: float


def read_templates(folder: Path, family: str, names: tuple[str, ...]) -> tuple[Template, ...]:
    """Templates of the marks ``family_name.png`` of a folder.

    A tee without a file of its own (``top_middle``, ``bottom_middle``) is that of ``left_middle`` turned by a right
    angle.

    Raises
    ------
    BenchsimError
        No such folder; fewer than four of the names have a file; a file that shows no mark.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BenchsimError(
            f"{folder}: there is no such folder; give the folder of the mark templates ({family}_*.png)"
        )
    images = {n: _read_grey(folder / f"{family}_{n}.png") for n in names if (folder / f"{family}_{n}.png").is_file()}
    if "left_middle" in images:
        for name, turn in (("top_middle", cv2.ROTATE_90_CLOCKWISE), ("bottom_middle", cv2.ROTATE_90_COUNTERCLOCKWISE)):
            if name in names:
                images.setdefault(name, cv2.rotate(images["left_middle"], turn))
    if len(images) < 4:
        wanted = ", ".join(f"{family}_{n}.png" for n in names)
        raise BenchsimError(f"{folder}: holds {len(images)} of the target's mark templates; put {wanted} there")
    made = []
    for name, image in images.items():
        try:
            ink, bar, point = reference_point(image, name)
        except ValueError as e:
            raise BenchsimError(f"{folder / f'{family}_{name}.png'}: {e}; cut the template out anew") from None
        made.append(Template(name, image, ink, point, bar))
    return tuple(made)


def _read_grey(path: Path) -> Image:
    return read_counts(path, cv2.IMREAD_GRAYSCALE)[0].astype(np.float32)


def reference_point(image: Image, name: str) -> tuple[NDArray[np.bool_], float, Array]:
    """The surveyed point of the mark in a template: outer corner of an angle, outer middle of a tee's crossbar.

    Parameters
    ----------
    image : (h, w) float32
        A dark mark on a bright ground.
    name : str
        Two words of left, right, top, bottom, middle: which way is out.

    Returns
    -------
    ink : (h, w) bool
    bar : float
        Width of a bar [px].
    point : (2,) px

    Raises
    ------
    ValueError
        There is no mark.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    grey = np.interp(smooth, (smooth.min(), smooth.max()), (0, 255)).astype(np.uint8)
    _, dark = cv2.threshold(grey, 0, 1, cv2.THRESH_BINARY_INV | cv2.THRESH_OTSU)
    count, label, stats, _ = cv2.connectedComponentsWithStats(dark, connectivity=4)
    if count < 2:
        raise ValueError("shows no dark mark on bright ground")
    best = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    ink = label == best
    width, height, area = stats[best][[cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT, cv2.CC_STAT_AREA]]
    bar = area / max(width + height, 1)
    if min(width, height) < 8 or not 0.04 < bar / max(width, height) < 0.4:
        raise ValueError("shows no mark of two bars")
    level = (smooth[ink].mean() + smooth[~ink].mean()) / 2
    # The first crossing of the level from each of the four sides, per row or column, in subpixels.
    sides = {side: _edge(_turn(smooth, side), _turn(ink, side), level) for side in ("left", "right", "top", "bottom")}
    size = {"right": image.shape[1] - 1, "bottom": image.shape[0] - 1}
    place = {s: (t, size[s] - x if s in size else x) for s, (t, x) in sides.items()}
    outs = [w for w in name.split("_") if w != "middle"]
    lines = []
    for side in outs:
        t, x = place[side]
        outer = np.abs(x - np.median(_outermost(x, side))) < bar / 2
        lines.append((side, _line(t[outer], x[outer])))
    if len(outs) == 1:
        # The tee's stem: the middle of its two edges, away from the crossbar.
        side = outs[0]
        a, b = ("top", "bottom") if side in ("left", "right") else ("left", "right")
        (ta, xa), (tb, xb) = place[a], place[b]
        common, ia, ib = np.intersect1d(ta, tb, return_indices=True)
        stem = (xb[ib] - xa[ia]) < 2 * bar
        if stem.sum() < 4:
            raise ValueError("shows no tee")
        lines.append((a, _line(common[stem], (xa[ia] + xb[ib])[stem] / 2)))
    (s1, (a1, b1)), (_, (a2, b2)) = lines
    if s1 in ("top", "bottom"):
        (a1, b1), (a2, b2) = (a2, b2), (a1, b1)
    # u = a1 + b1 v, v = a2 + b2 u
    u = (a1 + b1 * a2) / (1 - b1 * b2)
    return ink, float(bar), np.array([u, a2 + b2 * u])


def _turn(a: NDArray, side: str) -> NDArray:
    """So that the side comes first along each row."""
    a = a.T if side in ("top", "bottom") else a
    return a[:, ::-1] if side in ("right", "bottom") else a


def _edge(smooth: NDArray, ink: NDArray, level: float) -> tuple[Array, Array]:
    """Rows that hold ink, and where their first ink begins, at the level between ink and ground."""
    rows = np.flatnonzero(ink.any(axis=1))
    first = np.argmax(ink[rows], axis=1)
    before = np.maximum(first - 1, 0)
    high, low = smooth[rows, before], smooth[rows, first]
    step = np.clip((high - level) / np.maximum(high - low, 1e-6), 0, 1)
    return rows.astype(float), before + step * (first > 0)


def _outermost(x: Array, side: str) -> Array:
    """The outermost third."""
    ordered = np.sort(x) if side in ("left", "top") else np.sort(-x) * -1
    return ordered[: max(len(x) // 3, 1)]


def _line(t: Array, x: Array) -> tuple[float, float]:
    """x = a + b t, by least squares on what lies within 3 σ of a first fit; bars' rounded ends drop out."""
    keep = np.ones(len(t), bool)
    a = b = 0.0
    for _ in range(3):
        b, a = np.polyfit(t[keep], x[keep], 1) if keep.sum() > 2 else (0.0, float(np.median(x)))
        off = np.abs(x - a - b * t)
        keep = off <= max(3 * 1.4826 * float(np.median(off)), 0.3)
    return float(a), float(b)
