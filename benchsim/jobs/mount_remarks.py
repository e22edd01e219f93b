"""What limits the conclusion on a mount, and which records it does without, in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from benchsim.diagnosis import linear
from benchsim.instruments.mount import effects, solar
from benchsim.instruments.mount import problem as mount_problem

if TYPE_CHECKING:
    from benchsim.jobs.mount_diagnosis import MountDiagnosis

NARROW_DEG = 10.0
"""Angle that the records span on the sky below which a remark is due."""

FEW = 8
"""Records below which it means little that nothing was found."""

AGAINST = 0.5
"""Part of the smaller of two effects that both together come to, below which they act against each other."""


def remarks(result: MountDiagnosis) -> Iterator[str]:
    """What limits the conclusion, one sentence each."""
    b, unit, d = result.built, result.built.session.mount.unit, result.diagnosis
    yield from (*result.session.remarks, *b.remarks)
    if unit == "arcsec":
        (ia, more), (ie, less) = result.encoder_zeros
        yield (
            f"The encoders' zeros are fitted in every hypothesis: IA = {ia:.2f} ± {more:.2f}, IE = {ie:.2f} ± "
            f"{less:.2f} arcsec (true less read)."
        )
    sun = b.session.records.source
    if np.degrees(np.arccos(np.clip((sun @ sun.T).min(), -1.0, 1.0))) < NARROW_DEG:
        yield (
            "All records are at nearly one place of the sky: every constant error looks alike there, so that "
            "hardly any two effects can be told apart; add records at other hours and seasons."
        )
    if any(name.startswith("target_") for name in result.found.get("target-position", {})):
        known = effects.targets(b.session.mount, b.session.records)
        yield "Targets are " + ", ".join(f"{k}: {name}" for k, name in enumerate(known, 1)) + "."
    across, up = result.learnt.sigma / b.session.mount.of_normal
    of, span = ("", "night") if unit == "arcsec" else (" of the beam", "day")
    yield (
        f"Records miss what was put in by {across:.3g} {unit} across and {up:.3g} {unit} up (1 sigma{of}, what a "
        f"{span} has in common included)."
    )
    yield from _against(result, f"{unit}{of}")
    shared = mount_problem.in_common(b, d.values)
    if shared > b.sigma:
        yield (
            f"What the records of a {span} have in common comes to {shared:.3g} {unit}{of} rms, more than "
            f"the {b.sigma:.3g} {unit} by which single ones scatter: the mount wanders with time. It is counted as "
            "noise, and hides errors of its size."
        )
    if len(b.problem.names) < FEW and d.verdict == "nothing-missing":
        yield (
            f"From {len(b.problem.names)} records little can be told from chance: what is missing may be as large "
            "as the residuals; add records."
        )
    clock = next((f.parameters["dt"] for f in d.effects if f.name == "clock"), None)
    if clock is not None and (zone := solar.zone(-clock.value)):
        yield f"{zone}: so the spots have it (dt = {clock.value:.0f} ± {clock.sigma:.0f} s)."
    if result.changed_at:
        # Counted as the files do, records that were set aside among them.
        number = result.session.records.names.index(result.changed_at) + 1
        day = f" ({result.changed_on})" if result.changed_on else ""
        since = f"from {result.changed_at}{day} on the mount is another"
        sure = any(f.name == "change-point" for f in d.effects)
        start = "Changed" if sure else "Changed, if that is what is there,"
        yield f"{start} at record {number}: {since}; diagnose both parts apart."


def _against(result: MountDiagnosis, unit: str) -> Iterator[str]:
    """Pairs of stated effects that cancel for the most part, so that their sizes rest on each other."""
    d, problem = result.diagnosis, result.built.problem
    moves = {}
    for e in (e for e in problem.catalogue if e.name in result.claimed):
        own = tuple(p for p in e.parameters if not p.grid and p.name in d.values)
        moves[e.name] = linear.columns(problem, d.values, own) @ np.array([d.values[p.name] for p in own])
    rms = {name: float(np.sqrt(2 * np.mean(move**2))) for name, move in moves.items()}
    for one, other in combinations(moves, 2):
        both = float(np.sqrt(2 * np.mean((moves[one] + moves[other]) ** 2)))
        if both < AGAINST * min(rms[one], rms[other]):
            yield (
                f"{one} and {other} act against each other: {rms[one]:.3g} and {rms[other]:.3g} {unit} rms by "
                f"themselves, {both:.3g} together, so that the size of either rests on that of the other."
            )


def lost(result: MountDiagnosis) -> Iterator[str]:
    """Records that were set aside, a sentence for each and for each run of neighbours."""
    records, unit = result.session.records, result.session.mount.unit
    aside = np.sort([records.names.index(n) for n in result.built.aside])
    others = {records.date(k) for k in range(len(records.names)) if k not in aside}
    of = "" if unit == "arcsec" else " of the beam"
    for run in np.split(aside, np.flatnonzero(np.diff(aside) > 1) + 1) if len(aside) else ():
        first, last = (f"{records.names[k]}{f' ({day})' if (day := records.date(k)) else ''}" for k in run[[0, -1]])
        days, was = {records.date(k) for k in run}, "was" if len(run) == 1 else "were"
        if len(run) == 1:
            which = f"{first} lies apart from all others"
        elif len(days) == 1 and not days & {*others, ""}:
            ends = " to ".join(records.names[k] for k in run[[0, -1]])
            which, was = (
                f"The day {days.pop()} ({len(run)} records, {ends}) lies apart from those before and after",
                "was",
            )
        else:
            which = f"{len(run)} records in a row, {first} to {last}, lie apart from those before and after"
        yield f"{which} by more than chance allows, and {was} set aside (errors {result.built.sigma:.3g} {unit}{of})."
