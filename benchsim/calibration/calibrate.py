"""From photographs of the board to the camera: find the marks, solve, find them again through the lens, solve."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Marks
from benchsim.bench.names import printable
from benchsim.calibration import exif
from benchsim.calibration.advice import Advice, advise
from benchsim.calibration.focus import Change, focal, principal_point, refocused
from benchsim.calibration.solve import FEWEST_VIEWS, Bundle, solve
from benchsim.trace.counts import read_counts
from benchsim.trace.image import read_image
from benchsim.trace.marks import GAMMA_RANGE, MarkObservations, find_marks

Each = Callable[..., Iterable[Any]]

POOR_FOCAL = 0.02
"""Focal lengths less certain than this fraction are refused: the camera would be guessed better from EXIF."""

GUESSED_GAMMA = 2.2
"""A display's: where the search for an unknown gamma begins."""

SPREAD_PER_GAMMA = 0.33
"""By how many blurs (1 σ) the edges of black move outward when the gamma is assumed larger by one: measured, the same
on edges of all blurs and brightnesses of sRGB pictures, from 1.2 to 2.2."""

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif")
"""Pictures that are taken from a folder; HEIC to be refused with its mend."""


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera.

    Attributes
    ----------
    bundle : Bundle
    names : tuple of str
        Photographs used.
    left_out : tuple of (str, str)
        Photographs that are not used, and why.
    marks : Marks
    focal, principal_point : Change
        What each view says of its own.
    advice : Advice
    views : tuple of MarkObservations
        Of the photographs used.
    """

    bundle: Bundle
    names: tuple[str, ...]
    left_out: tuple[tuple[str, str], ...]
    marks: Marks
    focal: Change
    principal_point: Change
    advice: Advice
    views: tuple[MarkObservations, ...]

    @property
    def camera(self) -> Camera:
        """The camera found."""
        return self.bundle.camera

    @property
    def intrinsics_sigma(self) -> tuple[float, float, float]:
        """1 σ of focal length (fraction), principal point [px] and k1, with what the lens moves from view to view."""
        sigma, moved = self.bundle.sigma, (self.focal, self.principal_point)
        by_focal, by_point = (c.amount if c.seen else 0.0 for c in moved)
        return (
            float(np.hypot(sigma[0] / self.bundle.lens[0], by_focal)),
            float(np.hypot(max(sigma[1:3]), by_point)),
            float(sigma[3]),
        )


def pictures(paths: Sequence[Path]) -> list[Path]:
    """The photographs: files as given, of folders the pictures in them by name.

    Raises
    ------
    BenchsimError
        If one is not there, or they are fewer than `FEWEST_VIEWS`.
    """
    out: list[Path] = []
    for path in paths:
        if path.is_dir():
            out += sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
        elif path.exists():
            out.append(path)
        else:
            raise BenchsimError(f"{path}: not there; give photographs of the board, or the folder they are in")
    out = list(dict.fromkeys(out))
    if len(out) < FEWEST_VIEWS:
        raise BenchsimError(
            f"{paths[0] if paths else 'photographs'}: {len(out)} photographs of the board, and {FEWEST_VIEWS} are the "
            "least; take a dozen, from the left, the right, above and below, up to 45° off its normal"
        )
    return out


def calibrate(
    paths: Sequence[Path],
    marks: Marks,
    *,
    name: str = "A",
    gamma: float | str = "unknown",
    each: Each = map,
    progress: Callable[[str, float], None] = lambda what, done: None,
) -> Calibration:
    """Calibrate a camera from photographs of the board.

    Parameters
    ----------
    paths : sequence of path
        From `pictures`.
    marks : Marks
        Where they are in truth: corrected by what a ruler says of the print.
    name : str
        What the camera is called in recordings.
    gamma : float, "srgb" or "unknown"
        Of the pictures. The result hardly depends on it: see `solve`.
    each : callable
        A ``map``; one that spreads the pictures over processes.

    Raises
    ------
    BenchsimError
        If the pictures are not of one camera with one focal length, or too few show the board, or they leave the focal
        length open by more than `POOR_FOCAL`.
    """
    names = _names(paths)
    shape, bits = _format(paths, names)
    _same_lens({n: exif.lens_tags(p) for n, p in zip(names, paths, strict=True)}, names)
    provisional = GUESSED_GAMMA if gamma == "unknown" else gamma
    camera = Camera(
        name, shape, float(max(shape)), ((shape[0] - 1) / 2, (shape[1] - 1) / 2), bit_depth=bits, gamma=provisional,
        saturation_level=float(2**bits - 1),
    )  # fmt: skip
    progress("finding marks", 0.02)
    found, left_out = _look(
        paths, names, camera, marks, each, lambda done: progress("finding marks", 0.02 + 0.45 * done)
    )
    progress("solving", 0.5)
    first = solve(camera, found)
    lens = first.camera
    if gamma == "unknown":
        lens = replace(lens, gamma=_tone(first, found))
    # Straight edges are straight only through the lens.
    again = [p for p, n in zip(paths, names, strict=True) if n not in dict(left_out)]
    kept = [v.name for v in found]
    found, late = _look(again, kept, lens, marks, each, lambda done: progress("measuring marks", 0.52 + 0.4 * done))
    left_out += late
    progress("solving", 0.93)
    bundle = solve(replace(camera, gamma=gamma), found)
    seen = [v.name for v in found]
    moved = focal(bundle)
    point = principal_point(bundle)
    if refocused(moved, point):
        raise BenchsimError(_how_it_is_known(moved, bundle, seen))
    advice = advise(bundle, marks)
    if advice.sigma["focal length"] > POOR_FOCAL:
        raise BenchsimError(
            f"{seen[0]} and the others: they leave the focal length open by {100 * advice.sigma['focal length']:.0f} "
            f"%; add photographs: {'; '.join(advice.views)}"
        )
    return Calibration(bundle, tuple(seen), tuple(left_out), marks, moved, point, advice, tuple(found))


def _names(paths: Sequence[Path]) -> list[str]:
    """File names; with their folder where two have the same."""
    plain = [p.name for p in paths]
    return [printable(p.name if plain.count(p.name) == 1 else f"{p.parent.name}/{p.name}") for p in paths]


def _format(paths: Sequence[Path], names: Sequence[str]) -> tuple[tuple[int, int], int]:
    """Resolution and bit depth, which all pictures share."""
    first: tuple[tuple[int, int], int] | None = None
    for path, name in zip(paths, names, strict=True):
        counts, _ = read_counts(path)
        bits = {"uint8": 8, "uint16": 16}.get(str(counts.dtype))
        if bits is None:
            raise BenchsimError(f"{name}: pixels are {counts.dtype}; save the picture with 8 or 16 bit")
        this = ((counts.shape[1], counts.shape[0]), bits)
        first = first or this
        if this != first:
            (w, h), b = first
            (x, y), c = this
            turned = ", turned by a quarter" if (x, y) == (h, w) else ""
            raise BenchsimError(
                f"{name}: {x} × {y} pixels of {c} bit{turned}, but {names[0]} has {w} × {h} of {b}; give the pictures "
                "of one camera and one zoom as it wrote them, not turned or cut by another program"
            )
    assert first is not None
    return first


def _same_lens(tags: dict[str, dict[str, str]], names: Sequence[str]) -> None:
    said = exif.changed(tags, names)
    if said:
        raise BenchsimError(
            f"{said}: the lens or its zoom changed between the pictures; keep to one lens without zoom, lock the "
            "focus, and take them again"
        )


def _look(
    paths: Sequence[Path], names: Sequence[str], camera: Camera, marks: Marks, each: Each, done: Callable[[float], None]
) -> tuple[list[MarkObservations], list[tuple[str, str]]]:
    """Marks of every photograph, and those photographs that show too few, with the reason."""
    found, left_out = [], []
    count = len(paths)
    results = each(_find, paths, names, [camera] * count, [marks] * count)
    for k, (name, result) in enumerate(zip(names, results, strict=True)):
        if isinstance(result, str):
            left_out.append((name, result))
        else:
            found.append(result)
        done((k + 1) / count)
    if len(found) < FEWEST_VIEWS:
        raise BenchsimError(
            f"{left_out[0][0]}: {left_out[0][1]} ({len(left_out)} of {count} photographs cannot be used, and "
            f"{FEWEST_VIEWS} good ones are the least)"
        )
    return found, left_out


def _find(path: Path, name: str, camera: Camera, marks: Marks) -> MarkObservations | str:
    try:
        return replace(find_marks(read_image(path, camera), marks, camera), name=name)
    except BenchsimError as error:
        return str(error).removeprefix(f"{path.name}: ")


def _tone(bundle: Bundle, views: Sequence[MarkObservations]) -> float:
    """The gamma at which black does not spread: a wrong one makes blurred edges lopsided and moves them all outward.

    Ink that spreads is taken for a tone curve; what is left of either is each view's ``spread``.
    """
    blur = np.array([float(np.median(v.blur)) for v in views])
    return float(np.clip(GUESSED_GAMMA - np.median(bundle.spread[:, 0] / blur) / SPREAD_PER_GAMMA, *GAMMA_RANGE))


def _how_it_is_known(moved: Change, bundle: Bundle, names: Sequence[str]) -> str:
    """Why a lens is taken to have changed its focal length between the views, and the mend."""
    own, sigma = bundle.lens[0] * (1 + moved.value[:, 0]), bundle.lens[0] * moved.sigma[:, 0]
    # Of the views that say something of it.
    telling = sigma <= 3 * np.median(sigma)
    low, high = (
        int(k) for k in (np.argmin(np.where(telling, own, np.inf)), np.argmax(np.where(telling, own, -np.inf)))
    )
    near, far = bundle.distance.min(), bundle.distance.max()
    if moved.follows:
        why = (
            f"it follows the distance, {100 * moved.trend:+.2g} ± {100 * moved.trend_sigma:.1g} % from the farthest "
            f"view ({far:.0f} mm) to the nearest ({near:.0f} mm), as autofocus does"
        )
    else:
        why = (
            f"it is {own[low]:.1f} ± {sigma[low]:.1g} px in {names[low]} and {own[high]:.1f} ± {sigma[high]:.1g} px in "
            f"{names[high]}, as zoom or autofocus does"
        )
    chance = f"p = {moved.probability:.0e}" if moved.probability > 1e-300 else "p below 1e-300"
    return (
        f"{names[high]} and {names[low]}: the focal length is not the same in all pictures: fitted to each view on its "
        f"own, {why} ({chance}); lock focus and zoom, and take the pictures again"
    )
