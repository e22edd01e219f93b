"""Words and units in which an instrument's results are told; results themselves are alike for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Vocabulary:
    """How results of one instrument read.

    Attributes
    ----------
    kinds : mapping of str to (str, str)
        Observable → its name and unit; a kind that is not here is called by its own name.
    one, setting : str
        What one recording is called, and what is left out in turn.
    remedy : str
        Before what is to be done about an effect.
    recordings : str
        What was diagnosed, in the plural.
    noise : str
        Whose error bars the noise is compared with.
    unit : str
        Of residuals.
    along : str
        Axis of their drawings.
    distance : str
        What a residual is.
    of : str
        After residuals, what turns by them.
    """

    kinds: Mapping[str, tuple[str, str]]
    one: str
    setting: str
    remedy: str
    recordings: str
    noise: str
    unit: str
    along: str
    distance: str
    of: str = ""

    def of_kind(self, kind: str) -> Vocabulary:
        """The same for residuals of another kind of datum than the first."""
        name, unit = self.kinds[kind]
        return replace(self, unit=unit, distance=f"{name} less its prediction")


BENCH = Vocabulary(
    kinds={
        "c": ("centre line", "mm"),
        "w": ("width squared", "mm²"),
        "f": ("logarithm of the flux", ""),
        "g": ("parting of the lines", "mm²"),
        "m": ("marks", "px"),
    },
    one="exposure",
    setting="setting",
    remedy="On the bench",
    recordings="recordings",
    noise="what the photographs' own error bars say",
    unit="mm",
    along="along the trace (mm)",
    distance="distance of the trace from its prediction",
)


def mount(unit: str) -> Vocabulary:
    """Of a two-axis mount whose directions are in ``unit``."""
    return Vocabulary(
        kinds={"across": ("across", unit), "up": ("up", unit)},
        one="record",
        setting="record",
        remedy="At the mount",
        recordings="records",
        noise="the scatter of the records about the most probable single effects",
        unit=unit,
        along="number of the record",
        distance="direction recorded less predicted",
        of=" of the beam" if unit == "mrad" else "",
    )


def of(page: Mapping[str, object]) -> Vocabulary:
    """The vocabulary that a ``page.json`` asks for: its ``instrument`` and ``unit``, the bench's by default."""
    return mount(str(page["unit"])) if page.get("instrument") == "mount" else BENCH
