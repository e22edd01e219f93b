"""Identifiers as words, and numbers with a unit and a prefix that people read; files keep their own spelling."""

from __future__ import annotations

from collections.abc import Mapping
from math import floor, isfinite, log10

from benchsim.bench.units import IN_TEXT

WORDS: Mapping[str, str] = {
    "facets": "share of the facets",
    "size_mm": "shift of the trace, rms",
    "dr": "surface further out by",
    "pyr": "lean of every facet",
    "tilt_rms": "rms of the facets' leans",
    "wob_c": "lean, cosine over the facets",
    "wob_s": "lean, sine over the facets",
    "ped_x": "turn about x",
    "ped_y": "turn about y",
    "az_enc": "turn about the vertical",
    "glass": "thickness of the glass",
    "fcurv": "curvature of the facets",
    "saz": "azimuth",
    "sel": "elevation",
    "bu": "across the mirror's axis",
    "bv": "along the mirror's axis",
    "curv": "curvature of the wavefront",
    "astig0": "along less across the mirror's axis",
    "astig45": "at 45° to the mirror's axis",
    "coma_u": "across the mirror's axis",
    "coma_v": "along the mirror's axis",
    "beam": "share of the beam",
    "fresnel": "share of the diffraction",
    "win": "thickness of the plate",
    "wty": "turn about y",
    "wtz": "turn about z",
    "air": "gradient along z",
    "airh": "gradient along y",
    "plume": "turn of the light",
    "plume_y": "place in y",
    "plume_z": "place in z",
    "plume_width": "width, rms",
    "sx": "nearer to the mirror by",
    "st_y": "turn about y",
    "st_z": "turn about z",
    "srot": "roll",
    "bow_y": "bow along y",
    "bow_z": "bow along z",
    "gs": "too far apart by",
    "ga": "along y more, along z less",
    "gsh": "shear",
    "k1": "first radial term",
    "k2": "second radial term",
    "p1": "first tangential term",
    "p2": "second tangential term",
    "rs_s": "shift, sine over the rows",
    "rs_c": "shift, cosine over the rows",
    "rs_period": "period",
    "sat": "shift where it is brightest",
    "dry": "along y",
    "drz": "along z",
    "amp": "rms",
    "freq": "frequency",
    "scale": "times as large as stated",
    "mirror_position_x": "mirror along x",
    "mirror_position_y": "mirror along y",
    "mirror_position_z": "mirror along z",
    "mirror_axis_1": "mirror turned about its normal",
    "mirror_axis_2": "mirror's normal leaning toward its axis",
    "laser_azimuth": "laser's azimuth",
    "laser_elevation": "laser's elevation",
    "screen_position_x": "screen along x",
    "screen_position_y": "screen along y",
    "screen_position_z": "screen along z",
    "screen_angle_x": "screen turned about x",
    "screen_angle_y": "screen turned about y",
    "screen_angle_z": "screen turned about z",
    "beam_diameter": "beam's diameter, as a fraction",
    "divergence": "beam's divergence, as a fraction",
    "beam_c4": "beam's profile, fourth order",
    "beam_plus": "beam's profile, elliptic along u and v",
    "beam_cross": "beam's profile, elliptic at 45°",
    "blur": "blur of the camera, as a fraction",
    "focal": "focal length",
    "principal_u": "principal point along u",
    "principal_v": "principal point along v",
    "gain": "logarithm of the light",
}
"""Identifier of a parameter, a setting error or another fitted number → what it is; see `rays`' table of effects."""

IN_MICRO: Mapping[str, str] = {"mm": "µm", "mrad": "µrad", "mrad/mm2": "µrad/mm²", "mm/h": "µm/h", "1e-3": "µm/m"}
"""Units in which less than a tenth is read as a thousand times as much."""


def words_of(name: str) -> str:
    """``s1.laser_azimuth`` → ``s1: laser's azimuth``; a name without words of its own stays as it is."""
    owner, _, own = name.rpartition(".")
    facet = own.removeprefix("tilt_")
    word = f"lean of facet {facet}" if facet.isdecimal() else WORDS.get(own, own)
    return f"{owner}: {word}" if owner else word


def unit_text(unit: str) -> str:
    """A unit as text shows it; see `bench.units`."""
    return IN_TEXT.get(unit, unit)


def readable(unit: str, *values: float) -> tuple[float, str]:
    """Factor and unit in which numbers of one size are read: ``1e-3`` is mm per m, and small ones are micro."""
    most = max((abs(v) for v in values if isfinite(v)), default=0.0)
    if unit in IN_MICRO and 0 < most < 0.1:
        return 1e3, IN_MICRO[unit]
    if unit == "1" and 0 < most < 1e-3:
        return 1e6, "×10⁻⁶"
    return 1.0, "mm/m" if unit == "1e-3" else unit_text(unit)


def rounded(value: float, sigma: float, unit: str = "") -> str:
    """``value ± sigma unit`` with two digits of sigma: ``0.0310 ± 0.0009 1/m``."""
    factor, unit = readable(unit, value, sigma)
    value, sigma = factor * value, factor * sigma
    if not isfinite(sigma) or sigma <= 0:
        return f"{value:.3g} {unit}".rstrip()
    digits = max(0, 1 - floor(log10(sigma)))
    return f"{value:.{digits}f} ± {sigma:.{digits}f} {unit}".rstrip()


def counted(number: int, noun: str) -> str:
    """``1 heliostat``, ``2 heliostats``: of nouns whose plural is an s."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def short(value: float, digits: int) -> str:
    """A number of so many digits, without an exponent."""
    return f"{float(f'{value:.{digits}g}'):.10g}"


def said(value: float, unit: str, digits: int = 4) -> str:
    """Power or energy for a person, of kWh beyond ten thousand in MWh."""
    if unit == "kWh" and abs(value) >= 1e4:
        return f"{short(value / 1e3, digits)} MWh"
    return f"{short(value, digits)} {unit}"
