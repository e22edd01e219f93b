"""Irradiance across the trace of a recording's exposure, with effects, fields and setting errors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.curve import Curve
from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import SettingErrors
from benchsim.rays.curve import beam_profiles
from benchsim.rays.phases import check, sample_phases
from benchsim.rays.prediction import Shape, bench_of
from benchsim.rays.width import across

Array = NDArray[np.float64]


def cross_sections(
    recording: Recording,
    exposure: Exposure,
    q: Array,
    errors: SettingErrors | None = None,
    shape: Shape = (0.0, 0.0, 0.0),
    samples: int = 8,
) -> tuple[Curve, Array]:
    """Profiles of an exposure's trace, as `curve.irradiance_profiles` gives those of the bench without effects.

    Without the ghost of a second surface, and with the physics as `Recording.physics` has them: not for physics that
    effects mix in by amplitudes.

    Parameters
    ----------
    recording, exposure, errors, shape
        As `prediction.predict`; ``physics.beam`` must be true.
    q : (n,) array [mm]
        Evenly spaced offsets from the centre line, along the tangent of growing phase turned by +90 degrees.
    samples : int
        Profiles, evenly over the board.

    Returns
    -------
    curve : Curve
        Points, flux and phase.
    irradiance : (samples, n) ndarray [1/mm²]

    Raises
    ------
    BenchsimError
        As `prediction.predict`; or without beam.
    """
    bench = bench_of(recording, exposure, errors, shape)
    if not bench.physics.beam:
        raise BenchsimError("physics.beam: false, a single ray has no profile; set it to true")
    check(bench)
    points, _, nodes = beam_profiles(bench, sample_phases(bench, samples))
    curve = Curve(points, None, nodes.flux, nodes.mean(nodes.phase))
    return curve, across(bench, nodes, np.broadcast_to(q, (len(points), len(q))))
