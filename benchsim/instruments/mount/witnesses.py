"""Which records are witnesses of their own, and which names need a second one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchsim.diagnosis.result import Diagnosis, chosen
from benchsim.instruments.mount.problem import FEWEST
from benchsim.instruments.mount.records import Session

FAR_M = 1.0
"""How far from its place no target hangs and hardly a heliostat stands: targets of Jülich agree to 0.1 m over 29
heliostats, while single ones with wrong days were given targets 3.6 and 7 m beside theirs."""

AGAIN_DEG = 0.5
"""Within this of the star before a star is the same, or one that shares its air and its place on every bearing. Of a
star that is followed one record for every half degree is left."""


def distinct(session: Session) -> Session:
    """A session of records that are witnesses of their own: without copies, and of a star that was taken again at once
    only the first, since both share the errors of the moment."""
    records, remarks = session.records, list(session.remarks)
    rows = np.column_stack([records.reading, records.source, np.nan_to_num(records.spot)])
    own = np.sort(np.unique(rows, axis=0, return_index=True)[1])
    remarks += _left_out(records.names, own, "Equal to an earlier record to the last digit, and left out")
    if session.mount.observes == "sky":
        first = own[:1].tolist()
        for k in own[1:]:
            if records.source[k] @ records.source[first[-1]] < np.cos(np.radians(AGAIN_DEG)):
                first.append(k)
        # Where next to nothing would be left, all are kept: that they lie at one place is said then.
        if len(first) >= FEWEST:
            names, kept = tuple(records.names[k] for k in own), np.searchsorted(own, first)
            why = f"Within {AGAIN_DEG:g} deg of the star before, no witness of its own, left out"
            remarks += _left_out(names, kept, why)
            own = np.array(first, int)
    return replace(session, records=records.chosen(own), remarks=tuple(remarks))


def _left_out(names: Sequence[str], kept: NDArray[np.intp], why: str) -> list[str]:
    gone = np.delete(np.array(names, object), kept).tolist()
    more = f" and {len(gone) - 5} more" if len(gone) > 5 else ""
    return [f"{why}: {', '.join(gone[:5])}{more}."] if gone else []


def far_target(d: Diagnosis) -> str:
    """A sentence where targets are stated at a distance that none has; else empty.

    Neighbours that use the same target refute it: whoever knows of none looks for what acts alike.
    """
    stated = {*(f.name for f in d.effects), *chosen(d)}
    far = max((abs(v) for k, v in d.values.items() if k.startswith("target_")), default=0.0) / 1e3
    if "target-position" not in stated or far <= FAR_M:
        return ""
    return (
        f"These records fit best with a target {far:.2g} m beside its place, where none hangs: target-position is not "
        "looked for without a second witness, a survey or neighbours that use the same target (benchsim field)."
    )


def doubted(d: Diagnosis) -> tuple[Diagnosis, list[str]]:
    """A diagnosis whose heliostat would stand where none does by a provisional name only, and a sentence on it."""
    out, said = [], []
    for f in d.effects:
        far = max((abs(s.value) for s in f.parameters.values() if s.unit == "mm"), default=0.0) / 1e3
        if f.name == "mirror-position" and far > FAR_M:
            f = replace(f, confidence="provisional")
            said.append(
                f"No plant is surveyed wrongly by {far:.2g} m: {f.name} needs a second witness, a survey; until then "
                "it stands for what acts alike."
            )
        out.append(f)
    return replace(d, effects=tuple(out)), said
