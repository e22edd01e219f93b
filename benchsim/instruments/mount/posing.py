"""Records as data blocks: what a session's own problem and that of a recording yet to be taken have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchsim.diagnosis.problem import Effect, Parameter, Problem
from benchsim.instruments.mount.prediction import Predict
from benchsim.instruments.mount.records import Mount

ZERO_SIGMA = 600.0
"""Of a telescope's encoder zeros about their robust estimates [arcsec]."""

SURVEY_SIGMA = 20.0
"""Of a heliostat's surveyed position [mm]."""


def nuisances(mount: Mount) -> tuple[Parameter, ...]:
    """What may differ from the file without being an effect."""
    if mount.observes == "sky":
        return tuple(Parameter(n, mount.unit, ZERO_SIGMA) for n in ("IA", "IE"))
    return tuple(Parameter(f"survey_{k}", "mm", SURVEY_SIGMA) for k in "enu")


def _drift(predict: Predict) -> tuple[Parameter, ...]:
    """What records share: of a telescope at a scale that is fitted, of a heliostat's day on its own records."""
    telescope = predict.mount.observes == "sky"
    out = []
    for k, column in enumerate(predict.drift.T):
        on = None if telescope else tuple(int(i) for i in np.flatnonzero(column))
        out += [Parameter(f"drift.{w}_{k + 1}", "1", 1.0, scaled=telescope, blocks=on) for w in ("across", "up")]
    return tuple(out)


def problem_of(predict: Predict, catalogue: Sequence[Effect], sigma: float) -> Problem:
    """The problem of a prediction, every record with the same errors, no attachments."""
    records = predict.records
    n = len(records.names)
    return Problem(
        data=np.zeros(2 * n),
        block=np.repeat(np.arange(n), 2),
        kind=np.tile(np.array(["across", "up"]), n),
        position=np.repeat(np.arange(n, dtype=float), 2),
        stretch=np.full(2 * n, -1),
        covariance=tuple(np.eye(2) * sigma**2 for _ in range(n)),
        names=records.names,
        groups=records.names,
        nuisances=(*nuisances(predict.mount), *_drift(predict)),
        catalogue=tuple(catalogue),
        predict=predict,
        # How far a telescope drifts in a night is a guess.
        stated=False,
    )
