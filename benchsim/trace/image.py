"""Read a photograph: counts to light, linear in radiance, with what is saturated and which channel was taken.

Colour pictures: the board is lit by white room light and by a red laser, so one channel may be saturated by the
laser while another hardly sees it. The channel is chosen by the picture: the one that holds most information on
the place of what is wanted, that is the largest sum of squared brightness steps in units of its noise, saturated
pixels left out. Trace and marks may get different channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera
from benchsim.trace.counts import read_counts

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

FALSE_ALARM_SIGMA = 5.0
"""Steps above this many sigma of the noise count as structure: of 3 million pixels noise alone raises one or two."""

JPEG_COUNTS = 3.0
"""A saturated pixel may come back from JPEG this many counts lower (rounded coefficients, quality 85 and better)."""

MOST_FLOODED = 0.3
"""A channel in which more of the line than this has a saturated crest is taken only if no other shows the line: its
shape must be known from the rest, and the ridge's accuracy is measured up to a fifth."""

TILE = 32
"""Side of the tiles by which that is judged [px]."""

DIM = 0.3
"""Tiles whose brightest laser light is below this share of the brightest of all are not of the line."""

FLANK = 5
"""Beside what is saturated, the line's flanks [px]."""

_CHANNELS = ("blue", "green", "red")


@dataclass(frozen=True)
class Photograph:
    """Light of one picture, rows by columns.

    Attributes
    ----------
    name : str
        File name, for messages.
    light : (h, w) float32
        Proportional to radiance, 0 where the black level is, in counts of a sensor without gamma: saturation is
        at ``saturation_level - black_level``. Noise below black stays negative.
    saturated : (h, w) bool
        At or above the camera's saturation level.
    light_per_count : (h, w) or () float32
        d(light)/d(count): one count of quantisation, in units of ``light``.
    linear : bool
        False where the camera's gamma is unknown: ``light`` is then monotonic in radiance only; do not use flux,
        width or anything else that adds light up.
    lossy : bool
        JPEG: errors of neighbouring pixels are correlated over its 8 × 8 blocks.
    channel, marks_channel : str
        "mono", "red", "green" or "blue": where ``light`` and ``marks_light`` come from.
    marks_light, marks_saturated : (h, w)
        The same for the board's marks; the same arrays in a mono picture.
    """

    name: str
    light: Image
    saturated: Mask
    light_per_count: Image
    linear: bool
    lossy: bool
    channel: str
    marks_channel: str
    marks_light: Image
    marks_saturated: Mask

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.light.shape[0], self.light.shape[1]


def read_image(path: str | Path, camera: Camera, *, dark: bool = False, channel: str | None = None) -> Photograph:
    """Read a PNG, TIFF or JPEG, 8 or 16 bit, mono or colour, and undo the camera's black level and gamma.

    Parameters
    ----------
    path : path
    camera : Camera
        Resolution and bit depth are checked against the file; ``gamma`` "unknown" is read as sRGB in a picture of 8
        bits, as 1 in one of 16, and said in ``linear``.
    dark : bool
        A picture with the laser off: it may be black.
    channel : str, optional
        Take ``light`` from this channel of a colour picture ("red", "green", "blue"); give a dark picture the
        channel of its photograph. Default: chosen by the picture.

    Returns
    -------
    Photograph

    Raises
    ------
    BenchsimError
        One sentence with the image's name: missing, not an image, truncated, other resolution or bit depth than the
        recording's, black (nothing stands above its noise), saturated over more than half its area.

    Notes
    -----
    EXIF orientation is not applied: pixels are those of the sensor, as the camera's calibration means them.
    """
    path = Path(path)
    return photograph_of(path.name, *read_counts(path), camera, dark=dark, channel=channel)


def photograph_of(
    name: str, counts: NDArray, lossy: bool, camera: Camera, *, dark: bool = False, channel: str | None = None
) -> Photograph:
    """`read_image` of counts that were read."""
    _check_format(name, counts, camera)
    level = camera.saturation_level - (JPEG_COUNTS if lossy else 0.0)
    if counts.ndim == 2 or counts.shape[2] < 3:
        planes = {"mono": counts if counts.ndim == 2 else counts[..., 0]}
    else:
        planes = {c: counts[..., i] for i, c in enumerate(_CHANNELS)}
        if all(np.array_equal(planes["green"], planes[c]) for c in ("blue", "red")):
            planes = {"mono": planes["green"]}
    light = {c: _linear(plane, camera) for c, plane in planes.items()}
    saturated = {c: plane >= level for c, plane in planes.items()}
    best, for_marks = _choose(light, saturated)
    if channel is not None and channel in light:
        best = channel
    if not dark:
        _check_content(name, light[for_marks], light[best], saturated[for_marks])
    return Photograph(
        name=name,
        light=light[best],
        saturated=saturated[best],
        light_per_count=_light_per_count(planes[best], camera),
        linear=camera.gamma != "unknown",
        lossy=lossy,
        channel=best,
        marks_channel=for_marks,
        marks_light=light[for_marks],
        marks_saturated=saturated[for_marks],
    )


def _check_format(name: str, counts: NDArray, camera: Camera) -> None:
    h, w = counts.shape[:2]
    if (w, h) != camera.resolution:
        stated = f"{camera.resolution[0]} × {camera.resolution[1]}"
        if (h, w) == camera.resolution:
            raise BenchsimError(
                f"{name}: {w} × {h} pixels, but camera {camera.name} has resolution_px {stated}: the picture was "
                "turned by a quarter; give the file as the camera wrote it, whatever its EXIF orientation says"
            )
        raise BenchsimError(
            f"{name}: {w} × {h} pixels, but camera {camera.name} has resolution_px {stated}; mend the key (and the "
            "calibration with it) or give the picture as the camera took it"
        )
    bits = {"uint8": 8, "uint16": 16}.get(str(counts.dtype))
    if bits is None:
        raise BenchsimError(f"{name}: pixels are {counts.dtype}; save the picture with 8 or 16 bit")
    if bits != camera.bit_depth:
        raise BenchsimError(
            f"{name}: {bits} bit a pixel, but camera {camera.name} has bit_depth = {camera.bit_depth}; mend the key"
        )


def _curve(camera: Camera) -> float | str:
    """Gamma, or "srgb". Unknown curves of 8 bits are sRGB's but for some contrast: a lopsided line's centre is then off
    by a tenth of what it is if the counts are taken for light."""
    if camera.gamma == "unknown":
        return "srgb" if camera.bit_depth == 8 else 1.0
    return camera.gamma


def _linear(counts: NDArray, camera: Camera) -> Image:
    """Light ∝ radiance; odd about black, so that noise below black stays noise."""
    if counts.size > 2**16:
        # Counts are few, pixels many.
        return _linear(np.arange(np.iinfo(counts.dtype).max + 1, dtype=counts.dtype), camera)[counts]
    above = counts.astype(np.float32)
    if camera.black_level:
        above -= np.float32(camera.black_level)
    gamma = _curve(camera)
    if gamma == 1.0:
        return above
    full = np.float32(camera.saturation_level - camera.black_level)
    x = np.abs(above) / full
    if gamma == "srgb":
        # IEC 61966-2-1: linear toe, then a power of 2.4.
        y = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    else:
        y = x ** np.float32(gamma)
    return np.copysign(y * full, above).astype(np.float32)


def _light_per_count(counts: NDArray, camera: Camera) -> Image:
    gamma = _curve(camera)
    if gamma == 1.0:
        return np.ones((), np.float32)
    if counts.size > 2**16:
        return _light_per_count(np.arange(np.iinfo(counts.dtype).max + 1, dtype=counts.dtype), camera)[counts]
    full = camera.saturation_level - camera.black_level
    # Half a count above black: a power's slope vanishes or diverges at black itself.
    x = np.maximum(np.abs(counts.astype(np.float32) - np.float32(camera.black_level)), 0.5) / np.float32(full)
    if gamma == "srgb":
        slope = np.where(x <= 0.04045, 1 / 12.92, 2.4 / 1.055 * ((x + 0.055) / 1.055) ** 1.4)
    else:
        slope = float(gamma) * x ** np.float32(float(gamma) - 1)
    return slope.astype(np.float32)


def _steps(light: Image) -> Image:
    """Differences along the rows, every fourth row: enough to judge a channel by."""
    return np.diff(light[::4], axis=1)


def _noise(steps: Image) -> float:
    """Sigma of a difference of neighbours, from its median: structure covers less than half of a picture."""
    return max(float(np.median(np.abs(steps))) / 0.6745, 0.5)


def _choose(light: dict[str, Image], saturated: dict[str, Mask]) -> tuple[str, str]:
    """Channel for the trace and channel for the marks."""
    if len(light) == 1:
        only = next(iter(light))
        return only, only
    # Room light has one colour all over the board; what no channel needs for it is the laser's.
    total = sum(light.values())
    bright = total > total.mean()  # type: ignore[union-attr]
    white = {c: max(float(np.median(x[bright])), 1.0) for c, x in light.items()}
    room = np.minimum.reduce([x / white[c] for c, x in light.items()])
    laser = {c: x - white[c] * room for c, x in light.items()}
    noise = {c: _noise(_steps(x)) for c, x in light.items()}
    lit = np.any([x[::4] > FALSE_ALARM_SIGMA * _noise(_steps(x)) for x in laser.values()], axis=0)
    lit = lit[:, 1:] | lit[:, :-1]
    for_trace, for_marks = {}, {}
    for c in light:
        clipped = saturated[c][::4]
        good = ~(clipped[:, 1:] | clipped[:, :-1])
        for_trace[c] = _information(_steps(laser[c]), noise[c], good & lit)
        for_marks[c] = _information(_steps(light[c]), noise[c], good & ~lit)
    marks = max(for_marks, key=for_marks.__getitem__)
    strongest = max(for_trace, key=for_trace.__getitem__)
    if for_trace[strongest] == 0:
        return marks, marks
    if not _flooded(laser[strongest], saturated[strongest]):
        return strongest, marks
    # What the weakest channel sees of the laser counts as room light above: of the faint ones the steps are compared.
    shown = {
        c: _response(light[c], light[strongest], saturated[strongest], noise[strongest]) / noise[c]
        for c in light
        if c != strongest and not _flooded(laser[strongest], saturated[c])
    }
    crest = float(laser[strongest][saturated[strongest]].max())
    shown = {c: x for c, x in shown.items() if x * crest > FALSE_ALARM_SIGMA}
    return max(shown, key=shown.__getitem__, default=strongest), marks


def _response(light: Image, reference: Image, saturated: Mask, noise: float) -> float:
    """Laser light of a channel, in units of what another one has of it: median ratio of their steps on its flanks."""
    ratios = []
    # Whichever way the line runs.
    for one, other, clipped in ((light, reference, saturated), (light.T, reference.T, saturated.T)):
        steps, by, clipped = _steps(one), _steps(other), clipped[::4]
        flank = ~clipped & (cv2.dilate(clipped.astype(np.uint8), np.ones((1, 2 * FLANK + 1), np.uint8)) > 0)
        use = flank[:, 1:] & flank[:, :-1] & (np.abs(by) > FALSE_ALARM_SIGMA * noise)
        ratios.append(steps[use] / by[use])
    every = np.concatenate(ratios)
    return float(np.median(every)) if every.size else 0.0


def _flooded(laser: Image, saturated: Mask) -> bool:
    """Whether the line is saturated all along, so that its shape cannot be known from this channel.

    Judged by tiles, whichever way the line runs; tiles without it are dim.
    """
    h, w = (n - n % TILE for n in laser.shape)
    if min(h, w) == 0:
        return False
    tiles = (h // TILE, TILE, w // TILE, TILE)
    brightest = np.asarray(laser[:h, :w].reshape(tiles).max(axis=(1, 3)))
    clipped = np.asarray((saturated & (laser > 0))[:h, :w].reshape(tiles).max(axis=(1, 3)))
    crest = np.asarray(brightest > DIM * brightest.max())
    return bool((clipped & crest).sum() > MOST_FLOODED * crest.sum())


def _information(steps: Image, noise: float, use: Mask) -> float:
    strong = use & (np.abs(steps) > FALSE_ALARM_SIGMA * noise)
    return float((steps[strong].astype(float) ** 2).sum()) / noise**2


def _check_content(name: str, marks: Image, trace: Image, saturated: Mask) -> None:
    if saturated.mean() > 0.5:
        raise BenchsimError(
            f"{name}: {100 * saturated.mean():.0f} % of the picture is saturated; expose shorter, or mend "
            "saturation_level"
        )
    for light in (marks, trace):
        part = light[::4, ::2]
        noise = _noise(_steps(light)) / np.sqrt(2)
        if float(np.quantile(part, 0.999)) - float(np.median(part)) > FALSE_ALARM_SIGMA * noise:
            return
        if float(np.median(part)) - float(np.quantile(part, 0.001)) > FALSE_ALARM_SIGMA * noise:
            return
    level = "black" if float(np.median(trace)) <= FALSE_ALARM_SIGMA * noise else "uniform"
    raise BenchsimError(f"{name}: the picture is {level}, nothing stands above its noise; check exposure and lens cap")
