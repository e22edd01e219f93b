"""Does what was found predict settings that the judge never saw?

At the opening four settings of the campaign that the case does not use are set up on its bench. What the truth does to
their data and what ``amended.toml`` does are both computed with `rays`, without noise; setting errors, beam and camera
are marginalised with their priors. The whitened norms squared of truth less nothing, and of truth less amended, are the
excess χ² before and after.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import Field, field
from benchsim.bench.files import read, shipped
from benchsim.bench.model import Recording
from benchsim.diagnosis.linear import predict_all, whiten
from benchsim.instruments.bench import observables
from benchsim.instruments.bench import problem as bench_problem
from benchsim.trial import draws
from benchsim.trial.hashing import rng_of
from benchsim.trial.visibility import Sight

Array = NDArray[np.float64]

SETTINGS = 4
"""Kept back of each case."""

Effects = Mapping[str, Mapping[str, float]]


@dataclass(frozen=True)
class Predicted:
    """Excess χ² of ``data`` data before and after what was found is put in."""

    data: int
    before: float
    after: float

    def plain(self) -> dict[str, Any]:
        """For ``score.json``."""
        return {"data": self.data, "excess_chi2_before": self.before, "excess_chi2_after": self.after}


def kept_back(bench: Recording, rng: np.random.Generator) -> Recording:
    """The bench at settings of the campaign that it does not use, moved about as those of a case."""
    whole = shipped("campaign12.toml")
    used = {e.setting for e in bench.exposures}
    free = [e for e in whole.exposures if e.setting not in used]
    chosen = [free[int(i)] for i in np.sort(rng.choice(len(free), min(SETTINGS, len(free)), replace=False))]
    shrink = whole.cameras[chosen[0].camera].resolution[0] // next(iter(bench.cameras.values())).resolution[0]
    cameras = {e.camera: whole.cameras[e.camera].binned(shrink) for e in chosen}
    moved = draws.moved(chosen, rng)
    return replace(bench, exposures=moved, cameras=cameras)


def predicted(settings: Recording, truth: tuple[Effects, Mapping[str, Field]], amended: Recording) -> Predicted | None:
    """Excess χ² on settings, of a truth against nothing and against what was found.

    Parameters
    ----------
    settings : Recording
        Without effects; see `kept_back`.
    truth : (effects, fields)
    amended : Recording
        Its effects and fields are what was found.

    Returns
    -------
    Predicted or None
        None where a trace misses the board.
    """
    try:
        observed = observables.simulate(settings)
        nominal = bench_problem.build(settings, observed, attached=False)
        sight = Sight.of(nominal)

        def changed(effects: Effects, fields: Mapping[str, Field]) -> Array:
            true = bench_problem.build(replace(settings, effects=effects, fields=fields), observed, attached=False)
            change = predict_all(true, {}) - true.data + nominal.data - predict_all(nominal, {})
            return whiten(nominal, nominal.covariance, change)[0]

        true = changed(*truth)
        after = true - changed(amended.effects, amended.fields)
    except BenchsimError:
        return None
    return Predicted(
        len(nominal.data),
        float(np.linalg.norm(sight.through(true)) ** 2),
        float(np.linalg.norm(sight.through(after)) ** 2),
    )


def of_case(seed: str, truth: Mapping[str, Any], recording: Path, verdict: Path) -> dict[str, Any] | None:
    """What a verdict's ``amended.toml`` predicts of a case's kept-back settings; None where it says nothing, or nothing
    is there to predict.

    Parameters
    ----------
    seed : str
        Of the trial's plan.
    truth : mapping
        See `cases.make`.
    recording, verdict : Path
        Folders of the case.
    """
    path = verdict / "amended.toml"
    if truth["zero"] or not (truth["effects"] or truth["fields"]) or not path.is_file():
        return None
    amended = read(path, images=False)
    if not amended.effects and not amended.fields:
        return None
    settings = kept_back(read(recording, images=False), rng_of(seed, truth["case"], "kept back"))
    fields = {name: field(f["knots"], _shaped(f)) for name, f in truth["fields"].items()}
    found = predicted(settings, (truth["effects"], fields), amended)
    return None if found is None else found.plain()


def _shaped(table: Mapping[str, Any]) -> Array:
    shape = [len(k) for k in table["knots"]]
    return np.array(table["values"]).reshape(len(table["values"]), *shape)


def much(data: int, before: float) -> bool:
    """Whether there is so much to predict that a case can be judged alone: 60 √(2 n)."""
    return before >= 60 * math.sqrt(2 * data)
