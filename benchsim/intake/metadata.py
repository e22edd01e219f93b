"""Do the pictures' own words agree: one lens, one exposure of photograph and dark picture, the order of time?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from benchsim.bench.model import Camera
from benchsim.intake.finding import Finding, Kind
from benchsim.intake.photo import Photo

ALIKE = 0.02
"""Exposures that differ by less than this fraction are alike: EXIF rounds."""


def same_lens(photos: Sequence[Photo], cameras: Sequence[str]) -> list[Finding]:
    """One camera has one lens and one zoom.

    Parameters
    ----------
    photos : sequence of Photo
    cameras : sequence of str
        Name of the camera of each.
    """
    first: dict[str, Photo] = {}
    out = []
    for p, name in zip(photos, cameras, strict=True):
        reference = first.setdefault(name, p)
        what = _lens_change(reference, p)
        if what:
            out.append(
                Finding(
                    Kind.inconsistent,
                    p.path.name,
                    f"{what}, and {reference.path.name} is said to be by the same camera {name}; use one lens without "
                    "zoom, or list it as another camera with a calibration of its own",
                )
            )
    return out


def _lens_change(a: Photo, b: Photo) -> str:
    if a.model != b.model:
        return f"taken with {b.model or 'an unnamed camera'}, not {a.model or 'an unnamed one'}"
    for what, x, y in (("focal length", a.focal, b.focal), ("zoom", a.lens[-1], b.lens[-1])):
        if x and y and abs(x - y) > ALIKE * x:
            return f"{what} {y:g} in place of {x:g}"
    return ""


def focal_agrees(photos: Sequence[Photo], camera: Camera, sigma: float) -> list[Finding]:
    """EXIF's focal length against the camera's, which may be of another lens.

    ``sigma`` is the stated one [fraction]; EXIF's own rounding and the crops that phones make allow 15 % beyond five of
    it.
    """
    for p in photos:
        told = p.focal_px
        if told and abs(told / camera.focal - 1) > 5 * sigma + 0.15:
            return [
                Finding(
                    Kind.inconsistent,
                    f"cameras.{camera.name}.focal_px",
                    f"{camera.focal:.0f}, but EXIF of {p.path.name} means about {told:.0f}; calibrate with the lens "
                    "and zoom that took the pictures",
                )
            ]
    return []


def dark_alike(photo: Photo, dark: Photo) -> list[Finding]:
    """A dark picture is exposed as its photograph, by the same lens."""
    changed = _lens_change(photo, dark)
    if not changed and photo.resolution != dark.resolution:
        changed = f"{dark.resolution[0]} × {dark.resolution[1]} pixels"
    for what, a, b in (
        ("exposure time (s)", photo.exposure, dark.exposure),
        ("ISO", photo.iso, dark.iso),
        ("f-number", photo.aperture, dark.aperture),
    ):
        if not changed and a and b and abs(a - b) > ALIKE * a:
            changed = f"{what} {b:g}, its photograph {photo.path.name} has {a:g}"
    if not changed:
        return []
    return [
        Finding(
            Kind.inconsistent,
            dark.path.name,
            f"is not exposed as its photograph: {changed}; lock exposure and focus and take both again, or remove dark",
        )
    ]


def merged(photos: Sequence[Photo]) -> list[Finding]:
    """Pictures that the camera made of several."""
    names = [p.path.name for p in photos if p.hdr]
    if not names:
        return []
    return [
        Finding(
            Kind.inconsistent,
            names[0],
            f"{_these(names)} merged from several exposures (HDR, night mode), whose light is no longer that of one; "
            "switch that off and take it again",
        )
    ]


def _these(names: Sequence[str]) -> str:
    return "was" if len(names) == 1 else f"and {len(names) - 1} more were"


def in_order(photos: Sequence[Photo], times: Sequence[float]) -> list[Finding]:
    """``time_s`` must tell the order in which the pictures were taken: moves of the screen are counted by it.

    Parameters
    ----------
    photos, times
        Of every exposure; times in s.
    """
    told = [(t, p) for t, p in zip(times, photos, strict=True) if p.time]
    told.sort(key=lambda x: x[0])
    for (ta, a), (tb, b) in pairwise(told):
        assert a.time and b.time
        if tb > ta and b.time < a.time:
            return [
                Finding(
                    Kind.inconsistent,
                    "exposure.time_s",
                    f"{a.path.name} stands before {b.path.name}, but their clocks say the reverse; mend time_s",
                )
            ]
    return []
