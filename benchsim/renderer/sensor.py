"""From radiance to counts: the lens's blur, exposure, speckle, noise, black level, gamma, saturation, quantisation.

Exposure, as ``[render]`` states it: the brightest point of the laser's line, without room light, reaches
``peak_fraction`` of the range from black to saturation; the white board under room light alone reaches
``room_fraction`` of that peak. The defaults 0.7 and 0.3 give 0.7 + 0.21 = 0.91 of the range. A larger
``peak_fraction`` is a longer exposure, which brightens both lights alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.special import gammaincinv, ndtr

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field
from benchsim.bench.model import Camera, RenderOptions
from benchsim.bench.writing import write_bytes
from benchsim.renderer.charge import arrived
from benchsim.renderer.picture import Picture

Image = NDArray[np.float32]
Counts = NDArray[np.unsignedinteger[Any]]

SPECKLE_CONTRAST = 0.1
"""rms of the speckle in a pixel relative to its mean: full speckle has 1, and here some 100 independent patterns add up
(the incident direction sweeps through milliradians, two polarisations, several grains to a pixel, scattering inside the
paper). Known to a factor of two."""

RED_LASER = (1.0, 0.06, 0.02)
"""Response of a colour sensor's red, green and blue pixels to 632.8 nm relative to red, typical of Bayer filters; white
room light gives 1 in each after white balance."""


@dataclass(frozen=True)
class Signals:
    """Expected signal of every pixel as a fraction of the range from black to saturation; may exceed 1.

    Attributes
    ----------
    laser, room : (rows, columns) float32
    """

    laser: Image
    room: Image


def signals(
    picture: Picture,
    options: RenderOptions,
    reflectance: float,
    *,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    fields: Mapping[str, Field] | None = None,
) -> Signals:
    """Blur a picture and choose the exposure.

    Parameters
    ----------
    picture : Picture
    options : RenderOptions
        ``blur_px`` (rms of the lens's Gaussian), ``peak_fraction``, ``room_fraction``.
    reflectance : float
        Of the white board, whose room light is the reference.
    effects, fields : mapping, optional
        Of the recording: those of `charge` are shown.

    Raises
    ------
    BenchsimError
        If the camera sees none of the laser's light, so that no exposure can be chosen.
    """
    laser, room = (_blurred(light, options.blur_px) for light in (picture.laser, picture.room))
    peak = float(laser.max())
    if not peak > 0:
        raise BenchsimError("the camera sees none of the laser's light; check its position_mm, look_at_mm and focal_px")
    room_level = options.peak_fraction * options.room_fraction / reflectance
    laser = arrived(laser, effects or {}, fields or {}) * np.float32(options.peak_fraction / peak)
    return Signals(laser, room * np.float32(room_level))


def _blurred(light: Image, blur: float) -> Image:
    if blur == 0 or not light.any():
        return np.maximum(light, 0)
    # Truncated at 5 sigma: a step of 4 sigma would show in noise-free pictures of 16 bits.
    return np.maximum(gaussian_filter(light, blur, mode="nearest", truncate=5.0), 0)


def speckle(
    laser: Image, size: float, rng: np.random.Generator | None, contrast: float = SPECKLE_CONTRAST, floor: float = 1e-5
) -> Image:
    """Laser light with speckle: each pixel multiplied by a correlated gamma variate of mean 1.

    The sum of M equal independent speckle patterns is gamma-distributed with contrast 1/√M (Goodman 2007, Speckle
    Phenomena in Optics, ch. 3); here M = 1/contrast².

    Parameters
    ----------
    laser : (rows, columns) float32
    size : float
        Distance at which the correlation of the underlying Gaussian field has fallen to 1/e [px]; 0 is no speckle.
    rng : Generator, optional
        None: no speckle.
    contrast : float
        rms relative to the mean, > 0.
    floor : float
        Light below this fraction of the brightest is left as it is.
    """
    if size == 0 or rng is None:
        return laser
    # White noise filtered with a Gaussian of rms s has the correlation exp(-d²/4s²).
    s = size / 2
    field = gaussian_filter(rng.standard_normal(laser.shape, dtype=np.float32), s, mode="wrap")
    field /= field.std()
    lit = laser > floor * laser.max()
    shape = contrast**-2
    out = laser.copy()
    uniform = np.clip(ndtr(field[lit].astype(float)), 1e-12, 1 - 1e-12)
    out[lit] *= (gammaincinv(shape, uniform) / shape).astype(np.float32)
    return out


def encode(signal: Image, gamma: float | str) -> Image:
    """Fraction of the range that counts show for a signal: its inverse is what `Camera.gamma` states.

    With a gamma other than 1 signals below zero are cut, as cameras do before they apply it.

    Raises
    ------
    BenchsimError
        For "unknown": a picture needs a curve.
    """
    if gamma == "unknown":
        raise BenchsimError('gamma: "unknown" cannot be rendered; give a number or "srgb" in the bench file')
    if gamma == "srgb":
        # IEC 61966-2-1.
        s = np.maximum(signal, 0)
        return np.where(s <= 0.0031308, 12.92 * s, 1.055 * s ** np.float32(1 / 2.4) - 0.055).astype(np.float32)
    if float(gamma) == 1.0:
        return signal
    return (np.maximum(signal, 0) ** np.float32(1 / float(gamma))).astype(np.float32)


def develop(signal: Image, camera: Camera, options: RenderOptions, rng: np.random.Generator | None) -> Counts:
    """Counts of an expected signal.

    Parameters
    ----------
    signal : (rows, columns) float32
        Fraction of the range from black to saturation.
    camera : Camera
    options : RenderOptions
        ``full_well_e`` electrons are the signal 1, where the sensor saturates; ``read_noise_e`` is Gaussian.
    rng : Generator or None
        None: no shot and no read noise; saturation and quantisation stay.

    Returns
    -------
    (rows, columns) ndarray of uint8 or uint16
    """
    well = options.full_well_e
    if rng is not None:
        # The clip is far above saturation and keeps the Poisson sampler in its range.
        electrons = rng.poisson(np.minimum(signal.astype(float), 1e3) * well).astype(np.float32)
        electrons += np.float32(options.read_noise_e) * rng.standard_normal(signal.shape, dtype=np.float32)
        signal = electrons / np.float32(well)
    span = camera.saturation_level - camera.black_level
    counts = camera.black_level + span * encode(np.minimum(signal, 1), camera.gamma)
    kind = np.uint8 if camera.bit_depth == 8 else np.uint16
    return np.asarray(np.rint(np.clip(counts, 0, camera.saturation_level)), kind)


def expose(
    light: Signals, camera: Camera, options: RenderOptions, rng: np.random.Generator | None, *, laser: bool = True
) -> Counts:
    """A mono picture.

    Parameters
    ----------
    light : Signals
    camera, options, rng
        As in `develop`; without ``rng`` there is no speckle either.
    laser : bool
        False: the dark picture, with the same room light and exposure time; give it noise of its own.
    """
    signal = light.room
    if laser:
        signal = signal + speckle(light.laser, options.speckle_px, rng)
    return develop(signal, camera, options, rng)


def write_image(path: str | Path, counts: Counts, *, jpeg_quality: int = 90) -> None:
    """Write a picture as PNG, TIFF or JPEG (by its suffix), mono or RGB, under a temporary name first.

    Raises
    ------
    BenchsimError
        If the suffix is not one of these, a JPEG of 16 bits is asked for, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".tif", ".tiff", ".jpg", ".jpeg"):
        raise BenchsimError(f"{path.name}: unknown kind of image; use .png, .tif or .jpg")
    jpeg = suffix in (".jpg", ".jpeg")
    if jpeg and counts.dtype != np.uint8:
        raise BenchsimError(f"{path.name}: JPEG holds 8 bits; set the camera's bit_depth to 8, or write a PNG")
    image = counts if counts.ndim == 2 else counts[..., ::-1]
    parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if jpeg else []
    good, data = cv2.imencode(suffix, np.ascontiguousarray(image), parameters)
    if not good:
        raise BenchsimError(f"{path.name}: the image could not be encoded")
    try:
        write_bytes(path, data.tobytes())
    except OSError as error:
        raise BenchsimError(f"{path}: cannot be written ({error.strerror}); choose another folder") from None
