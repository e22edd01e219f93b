"""Do the settings put the trace where the photograph shows it? If not, which slip of the pen would?"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchsim import vector
from benchsim.bench.curve import signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Mirror, Recording
from benchsim.bench.place import place
from benchsim.bench.settings import from_vector, prior_sigma, uncertainty_of
from benchsim.intake.finding import Finding, Kind

Array = NDArray[np.float64]

FALSE_ALARM = 1e-7
"""Probability with which hands as good as ``[uncertainty]`` says are taken for a wrong number."""

MODEL = 2.0
"""1 sigma of what is not asked here, point by point: facets, the beam's width, a board or lens not yet mended [mm]."""

POINTS = 24
"""Points of the line that are compared."""

_Slip = Callable[[Mirror, Exposure], tuple[Mirror, Exposure]]


def _moved(e: Exposure, axis: int) -> Exposure:
    x, y, z = e.mirror_position
    return replace(e, mirror_position=(x, -y, z) if axis == 1 else (x, y, -z))


SLIPS: tuple[tuple[str, _Slip], ...] = (
    ("east and west swapped in laser_azimuth_deg", lambda m, e: (m, replace(e, laser_azimuth=-e.laser_azimuth))),
    (
        "laser_elevation_deg counted from the zenith",
        lambda m, e: (m, replace(e, laser_elevation=math.pi / 2 - e.laser_elevation)),
    ),
    ("the sign of y in mirror_position_mm", lambda m, e: (m, _moved(e, 1))),
    ("the sign of z in mirror_position_mm", lambda m, e: (m, _moved(e, 2))),
    (
        "mirror.stands_for",
        lambda m, e: (replace(m, stands_for="azimuth" if m.stands_for == "elevation" else "elevation"), e),
    ),
    ("the sign of screen_roll_deg", lambda m, e: (m, replace(e, screen_roll=-e.screen_roll))),
)
"""What is easily got wrong, as the key to mend and what it turns the setting into."""


def stands(recording: Recording, exposure: Exposure, line: Array | None, *, reseated: bool) -> list[Finding]:
    """Compare the line on the board with the vector model at the stated setting.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    line : (n, 2) array [mm], or None
        Points of the photographed line; None: only whether the settings put a trace onto the board is asked.
    reseated : bool
        Whether the screen was moved before this exposure, so that its own errors count.

    Returns
    -------
    list of Finding

    Notes
    -----
    Linear in the setting errors, with ``MODEL`` for what is left. The mirror is aimed by the stated setting, so a wrong
    number turns and bends the line rather than moving it. Rough on purpose: it finds wrong numbers, `validate` judges
    the model.
    """
    where = f"{exposure.name}, setting {exposure.setting}"
    mirror = recording.mirror
    if line is not None:
        line = _spread(line)
    try:
        off = _off(recording, mirror, exposure, line)
    except BenchsimError as error:
        says = f"its settings put no trace on the board ({error}); mend laser angles or mirror position"
        slip = "" if line is None else _slip(recording, exposure, line, reseated)
        return [Finding(Kind.inconsistent, where, says + slip)]
    if line is None or _agrees(recording, mirror, exposure, line, reseated):
        return []
    says = (
        f"the line lies up to {np.abs(off).max():.0f} mm from where its settings put it, more than [uncertainty] "
        "explains; mend its laser angles, mirror position or [mirror], or widen [uncertainty]"
    )
    return [Finding(Kind.inconsistent, where, says + _slip(recording, exposure, line, reseated))]


def _spread(line: Array) -> Array:
    """``POINTS`` of the line, evenly along its longer coordinate: the median of those nearby."""
    axis = int(np.argmax(np.ptp(line, axis=0)))
    parts = np.array_split(line[np.argsort(line[:, axis])], POINTS)
    return np.array([np.median(p, axis=0) for p in parts if len(p)])


def _slip(recording: Recording, exposure: Exposure, line: Array, reseated: bool) -> str:
    """Every slip that would explain the line, as the end of a sentence."""
    fitting = []
    for name, change in SLIPS:
        mirror, changed = change(recording.mirror, exposure)
        if (mirror, changed) == (recording.mirror, exposure):
            continue
        try:
            if _agrees(recording, mirror, changed, line, reseated):
                fitting.append(name)
        except BenchsimError:
            continue
    return f" (it would fit if this was the slip: {'; or: '.join(fitting)})" if fitting else ""


def _agrees(recording: Recording, mirror: Mirror, exposure: Exposure, line: Array, reseated: bool) -> bool:
    """Whether setting errors of the stated size put the trace where the line is."""
    prior = prior_sigma(uncertainty_of(recording), reseated=reseated)
    off = _off(recording, mirror, exposure, line)
    covariance = MODEL**2 * np.eye(len(off))
    for k in np.flatnonzero(prior > 0):
        step = np.zeros(len(prior))
        step[k] = prior[k]
        moved = _off(recording, mirror, exposure, line, step) - off
        covariance += np.outer(moved, moved)
    return bool(off @ np.linalg.solve(covariance, off) < chi2.isf(FALSE_ALARM, len(off)))


def _off(
    recording: Recording, mirror: Mirror, exposure: Exposure, line: Array | None, errors: Array | None = None
) -> Array:
    """Signed distance of the line's points from the trace of the stated setting, or with setting errors [mm]."""
    where = place(mirror, exposure, None if errors is None else from_vector(errors))
    screen = replace(recording.screen, size=_wide(recording))
    curve = vector.trace(mirror, exposure, count=201, placement=where, screen=screen)
    return np.zeros(1) if line is None else signed_distance(curve, line)[0]


def _wide(recording: Recording) -> tuple[float, float]:
    """The plane is asked half a board beyond the board: a trace that just misses it still has a distance."""
    y, z = recording.screen.size
    return 2 * y, 2 * z
