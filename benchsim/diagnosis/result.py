"""The finished diagnosis, and its form in ``diagnosis.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

VERDICTS = ("nothing-missing", "named", "class", "located", "unexplained")
"""What is left open: nothing at all was found; all is named; only alternatives; an element; not even that."""

CONFIDENCES = ("named", "probable", "provisional")
"""How sure a name is: by the rules; likely; in the model that predicts best, though its name is not certain."""


@dataclass(frozen=True)
class Size:
    """A parameter with its 1 sigma, both in ``unit``."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Found:
    """An effect that was found. ``confidence``: one of `CONFIDENCES`."""

    name: str
    element: str
    probability: float
    confidence: str
    parameters: Mapping[str, Size]
    says: str
    remedy: str


@dataclass(frozen=True)
class SplitBy:
    """What would tell the members of a class apart. ``kind``: "recording" or "observable"."""

    kind: str
    what: str
    separation_sigma: float


@dataclass(frozen=True)
class Class:
    """Alternatives that the data cannot tell apart: each member a set of effects, the most probable first.

    ``sizes``: of every member the parameters of its effects, as they are fitted beside all else that is stated; empty
    where that was not fitted. ``stated``: the amended file has the first of them in it.
    """

    members: tuple[tuple[str, ...], ...]
    probability: float
    split_by: SplitBy | None
    sizes: tuple[Mapping[str, Size], ...] = ()
    stated: bool = False


@dataclass(frozen=True)
class Stretch:
    """A stretch of a trace where the misfit lies, [mm] of arc length; ``z`` its corrected significance.

    ``kind`` of the datum that shows it.
    """

    exposure: str
    from_mm: float
    to_mm: float
    z: float
    kind: str


@dataclass(frozen=True)
class Location:
    """Where in the path of the light the misfit lies. ``margin``: Δ ln Z over the best other element.

    Where effects of several elements were named, ``element`` lists them, nothing is claimed and the margin is 0.
    ``by_kind``: by how many sigma each kind of datum alone shows what was found; empty where nothing was.
    """

    element: str
    coordinate: str
    claimed: bool
    margin: float
    along_trace: tuple[Stretch, ...]
    by_kind: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Law:
    """A function of one coordinate that stands in for a cause without a name.

    ``attachment`` names the attachment whose function it is; ``knots`` (K, d) and ``coefficients`` (K,) are that
    function, in the attachment's units; ``terms`` its sparse monomials, empty where the Gaussian process itself stands.
    """

    attachment: str
    coordinate: str
    terms: Mapping[str, float]
    held_out_gain: float
    gain_sigma: float
    knots: Array
    component: NDArray[np.intp]
    coefficients: Array


@dataclass(frozen=True)
class Left:
    """What is left of a family of data beside everything that was found, though it does not change the verdict.

    Attributes
    ----------
    family : str
        Kind of datum, or ``pulls``.
    p : float
        Probability of as much by chance.
    rms : float
        Of it, in the data's unit; nan for pulls.
    rms_mm : float
        The same in millimetres where it is a length, else nan; the instrument puts it in.
    """

    family: str
    p: float
    rms: float
    rms_mm: float = float("nan")


@dataclass(frozen=True)
class HeldOut:
    """Excess χ² of left-out settings before and after, summed over folds."""

    folds: int
    data: int
    excess_chi2_before: float
    excess_chi2_after: float
    sigma: float

    @property
    def fraction_removed(self) -> float | None:
        """1 − after/before; None where there was no excess to remove."""
        if self.excess_chi2_before <= 0:
            return None
        return 1 - self.excess_chi2_after / self.excess_chi2_before


@dataclass(frozen=True)
class Limit:
    """Size of an effect's parameter that would have been seen at five sigma. ``reachable``: it is below the cap."""

    parameter: str
    five_sigma: float
    unit: str
    reachable: bool


@dataclass(frozen=True)
class Residuals:
    """Residuals of every datum for the pictures, in the data's units.

    ``before``: at the most probable nuisances without anything added; ``after``: with what was found;
    ``held_out_before`` and ``held_out_after``: predicted from the other settings (nan where there are fewer than
    three); ``sigma``: of each datum, noise as re-estimated.
    """

    before: Array
    after: Array
    held_out_before: Array
    held_out_after: Array
    sigma: Array


@dataclass(frozen=True)
class Diagnosis:
    """Everything the diagnosis concludes; see the contract of ``diagnosis.json``.

    ``probability`` is P(present) of every effect of the catalogue; ``values`` the most probable nuisances and
    parameters of what was found; ``rms`` before and after by kind of datum, in the data's units.
    """

    verdict: str
    effects: tuple[Found, ...]
    classes: tuple[Class, ...]
    location: Location | None
    law: Law | None
    rms: Mapping[str, tuple[float, float]]
    held_out: HeldOut | None
    pulls: Mapping[str, float]
    limits: Mapping[str, Limit]
    next: tuple[SplitBy, ...]
    sigma_scale: float
    correlation: float
    setting_scale: float
    probability: Mapping[str, float]
    values: Mapping[str, float]
    residuals: Residuals
    notes: tuple[str, ...] = field(default=())
    left: tuple[Left, ...] = field(default=())

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``diagnosis.json``; what is not finite is null."""
        held, law = self.held_out, self.law
        before, after = self.rms.get("c", (float("nan"), float("nan")))
        rms = {k: {"before": b, "after": a} for k, (b, a) in self.rms.items()}
        found = {
            "format": "benchsim-diagnosis/1",
            "verdict": self.verdict,
            "effects": self.effects,
            "classes": self.classes,
            "location": self.location,
            "law": None
            if law is None
            else {
                "coordinate": law.coordinate,
                "terms": law.terms,
                "held_out_gain": law.held_out_gain,
                "held_out_gain_sigma": law.gain_sigma,
            },
            "fit": {
                "rms_mm": {"before": before, "after": after},
                "rms": rms,
                "held_out": None if held is None else {**vars(held), "fraction_removed": held.fraction_removed},
            },
            "pulls": self.pulls,
            "limits": self.limits,
            "next": self.next,
            "left": self.left,
            "noise": {
                "sigma_scale": self.sigma_scale,
                "correlation_mm": self.correlation,
                "setting_scale": self.setting_scale,
            },
            "probability": self.probability,
            "notes": self.notes,
        }
        return {k: _plain(v) for k, v in found.items()}


def _plain(x: Any) -> Any:
    """Records and mappings as dicts, sequences as lists, numbers that are not finite as None."""
    if is_dataclass(x):
        return {k: _plain(v) for k, v in vars(x).items()}
    if isinstance(x, Mapping):
        return {k: _plain(v) for k, v in x.items()}
    if isinstance(x, list | tuple):
        return [_plain(v) for v in x]
    if isinstance(x, float | np.floating):
        return float(x) if np.isfinite(x) else None
    return x


def chosen(d: Diagnosis) -> tuple[str, ...]:
    """Effects of the first member of every class that is stated: one of its alternatives, not a decision."""
    return tuple(dict.fromkeys(name for c in d.classes if c.stated for name in c.members[0]))
