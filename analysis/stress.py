"""Defects that no catalogue holds and no file states, put into a rendered recording: what a diagnosis has to live with.

``tail``: 1 to 3 % of the light lies in an exponential tail of 4.5 mm, four widths of a line, to one side of it, in a
direction of the board that the recording keeps. ``coarse``: speckle of 1.6 px, twice that of the other studies.
``wander``: the light wanders along the trace by 0.02 mm rms, smoothly over 60 mm, anew in every exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
from scipy.ndimage import fourier_gaussian, map_coordinates

from benchsim.renderer import recording as rendering
from benchsim.renderer.irradiance import ScreenMap

KINDS = ("tail", "coarse", "wander")

SHARE, TAIL = (0.01, 0.03), 4.5
"""Of the light, and mean distance [mm]."""

COARSE = 1.6
"""Speckle [px]."""

WANDER, OVER = 0.02, 60.0
"""rms of the displacement along each axis, and 1 sigma of what smooths it [mm]."""


def tailed(light: ScreenMap, share: float, angle: float) -> ScreenMap:
    """A share of the light moved to one side, along the direction ``angle`` from y."""
    kernel = np.zeros_like(light.values)
    nz, ny = kernel.shape
    at = np.arange(0.0, 8 * TAIL, 0.25 * light.pitch)
    weight = np.exp(-at / TAIL)
    rows, columns = (np.rint(at * x / light.pitch).astype(int) for x in (np.sin(angle), np.cos(angle)))
    inside = (np.abs(rows) < nz) & (np.abs(columns) < ny)
    np.add.at(kernel, (rows[inside] % nz, columns[inside] % ny), weight[inside] / weight.sum())
    far = np.fft.irfft2(np.fft.rfft2(light.values) * np.fft.rfft2(kernel), (nz, ny))
    return replace(light, values=(1 - share) * light.values + share * np.maximum(far, 0.0))


def wandering(light: ScreenMap, rng: np.random.Generator) -> ScreenMap:
    """The light displaced by a smooth field of its own, by splines: the cubics of `cv2.remap` move a line of 0.5 mm by
    1.4 to 1.5 times what small shifts ask for, and change its width with them."""
    moved = []
    for _ in range(2):
        waves = np.fft.fft2(rng.standard_normal(light.values.shape))
        field = np.fft.ifft2(fourier_gaussian(waves, OVER / light.pitch)).real
        moved.append(WANDER / light.pitch * field / field.std())
    places = np.indices(light.values.shape) + np.array(moved[::-1])
    return replace(light, values=map_coordinates(light.values, places, order=3, mode="nearest").clip(min=0.0))


@contextmanager
def put(kind: str, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Within, `render_recording` renders a defect; what it is. Speckle is the recording's own and not put here."""
    share, angle = float(rng.uniform(*SHARE)), float(rng.uniform(0, 2 * np.pi))
    make = rendering.irradiance
    change: Callable[[ScreenMap], ScreenMap]
    if kind == "tail":
        said, change = {"share": share, "angle_rad": angle}, lambda light: tailed(light, share, angle)
    elif kind == "wander":
        said, change = {"rms_mm": WANDER}, lambda light: wandering(light, rng)
    else:
        said, change = {"speckle_px": COARSE}, lambda light: light
    with mock.patch.object(rendering, "irradiance", lambda *a, **k: change(make(*a, **k))):
        yield {"stress": kind, **said}
