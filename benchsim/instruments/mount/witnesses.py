"""Which records are witnesses of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchsim.instruments.mount.records import Session

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
        names = tuple(records.names[k] for k in own)
        kept = np.searchsorted(own, first)
        remarks += _left_out(
            names, kept, f"Within {AGAIN_DEG:g} deg of the star before, no witness of its own, left out"
        )
        own = np.array(first, int)
    return replace(session, records=records.chosen(own), remarks=tuple(remarks))


def _left_out(names: Sequence[str], kept: NDArray[np.intp], why: str) -> list[str]:
    gone = [n for k, n in enumerate(names) if k not in set(kept.tolist())]
    more = f" and {len(gone) - 5} more" if len(gone) > 5 else ""
    return [f"{why}: {', '.join(gone[:5])}{more}."] if gone else []
