"""Days on which records of many heliostats went wrong: a field sees them, a single heliostat has wrong records only."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from scipy.stats import binom

from benchsim.instruments.mount.records import Records

ALPHA = 0.01
"""Probability that chance alone makes one of a field's days wrong."""

NAMED = 6
"""Heliostats that are named of such a day."""

Counts = Mapping[str, tuple[int, int]]
"""Day in UTC → how many of its records were set aside, and how many it has."""


def counted(records: Records, aside: Collection[str]) -> dict[str, tuple[int, int]]:
    """The days of one heliostat's records, of those with a stamp; ``aside``: names of the records set aside."""
    out: dict[str, tuple[int, int]] = {}
    for k, name in enumerate(records.names):
        if day := records.date(k):
            wrong, all_of_them = out.get(day, (0, 0))
            out[day] = wrong + (name in aside), all_of_them + 1
    return out


def told(field: Mapping[str, Counts]) -> list[str]:
    """Wrong days of a field, one sentence each.

    A heliostat's records of a day share an error, and count as one: gone wrong if any was set aside. If heliostats go
    wrong independently, and no day is worse than others, the number of them on a day is binomial; Bonferroni-corrected
    over the days.

    Parameters
    ----------
    field : mapping of str to Counts
        By heliostat.
    """
    seen: dict[str, list[tuple[str, int, int]]] = {}
    for name, days in field.items():
        for day, (wrong, count) in days.items():
            seen.setdefault(day, []).append((name, wrong, count))
    share = float(np.mean([wrong > 0 for each in seen.values() for _, wrong, _ in each])) if seen else 0.0
    out = []
    for day, each in sorted(seen.items()):
        bad = [name for name, wrong, _ in each if wrong]
        if len(bad) > 1 and len(seen) * binom.sf(len(bad) - 1, len(each), share) < ALPHA:
            records, whole = (sum(counts) for counts in list(zip(*each, strict=True))[1:])
            names = ", ".join(bad[:NAMED]) + (" and others" if len(bad) > NAMED else "")
            out.append(
                f"{day} went wrong for many: {len(bad)} of {len(each)} heliostats had records of that day set aside, "
                f"{records} of {whole} ({names})."
            )
    return out
