"""``benchsim diagnose`` for two-axis mounts: what a heliostat's or a telescope's recordings say of its drift."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchsim import diagnosis
from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_text
from benchsim.diagnosis.evidence import PRESENCE, shapes
from benchsim.diagnosis.problem import Effect, Problem
from benchsim.diagnosis.result import Diagnosis, Size, chosen
from benchsim.instruments.mount import effects, functions, shared_causes, small_terms, stated, witnesses
from benchsim.instruments.mount import problem as mount_problem
from benchsim.instruments.mount.problem import Built
from benchsim.instruments.mount.records import UNITS, Function, Learnt, Session, added
from benchsim.instruments.mount.shared_causes import Shared
from benchsim.instruments.mount.small_terms import SmallTerms
from benchsim.jobs import amended_mounts, mount_page, mount_remarks
from benchsim.jobs.output import wanted_folder, written
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.reporting import report
from benchsim.jobs.shown import Diagnosed
from benchsim.reports import diagnosis_pictures as pictures
from benchsim.reports import mount_pictures
from benchsim.reports.diagnosis_text import About, summary
from benchsim.reports.vocabulary import mount as vocabulary

ROUNDS = 2
"""Times at most that outlying records are looked for about a fit, and the rest diagnosed anew."""

WILD = {"mrad": 20.0, "arcsec": 60.0}
"""Errors of a single record, beside everything that was fitted, above which nothing is believed: noise is estimated
from the records themselves, so that records and mount that do not belong together would pass for noisy ones. Ten times
what heliostats and telescopes show."""

NEXT = 5
"""Proposals for a next record that are told; the others are hardly worse than these, and far too many to read."""

SMALL = (
    "It states small values of all other terms too, none of which was found, and what was found as it is fitted beside "
    "them: records left out are predicted better so."
)


@dataclass(frozen=True, repr=False)
class MountDiagnosis(Diagnosed):
    """A finished diagnosis of a mount and what it rests on.

    Attributes
    ----------
    session : Session
        As it was read.
    built : Built
        The problem, and which records were set aside.
    diagnosis : Diagnosis
    found : mapping of str to mapping of str to float
        Stated effects with what was found and the small terms added, in the catalogue's units.
    fields : mapping of str to Function
        Stated functions with a law added.
    learnt : Learnt
        What predictions rest on beside both.
    folder : Path, optional
        Where it was written.
    """

    session: Session
    built: Built
    diagnosis: Diagnosis
    found: dict[str, dict[str, float]]
    fields: dict[str, Function]
    learnt: Learnt
    folder: Path | None
    small: SmallTerms

    @property
    def title(self) -> str:
        """What the person calls the recordings."""
        return self.session.title

    @property
    def catalogue(self) -> tuple[Effect, ...]:
        """The effects that were looked for."""
        return self.built.problem.catalogue

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """What limits the conclusion, one sentence each."""
        return tuple(mount_remarks.remarks(self))

    @property
    def claimed(self) -> set[str]:
        """Effects that were found; of a class its most probable member."""
        return {*(f.name for f in self.diagnosis.effects), *chosen(self.diagnosis)}

    @property
    def changed_at(self) -> str:
        """Name of the first record after the change that ``amended.toml`` states; empty where it states none."""
        if "change-point" not in self.claimed or "change" not in self.diagnosis.values:
            return ""
        kept = self.built.session.records.names
        return kept[min(int(np.ceil(self.diagnosis.values["change"])), len(kept) - 1)]

    @property
    def changed_on(self) -> str:
        """Day of that record in UTC; empty where nobody states it."""
        records = self.session.records
        return records.date(records.names.index(self.changed_at)) if self.changed_at else ""

    @property
    def encoder_zeros(self) -> tuple[tuple[float, float], ...]:
        """A telescope's IA and IE with 1 sigma [arcsec], beside everything that was found."""
        known = self.learnt
        assert known.zeros is not None
        sigma = [float(np.sqrt(known.covariance[k, k])) for k in map(known.parameters.index, ("IA", "IE"))]
        return tuple(zip((known.zeros / UNITS["arcsec"]).tolist(), sigma, strict=True))

    @property
    def lost(self) -> tuple[str, ...]:
        """Records that were set aside, one sentence for each and for each run of neighbours."""
        return tuple(mount_remarks.lost(self))

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``diagnosis.json``."""
        plain = self.diagnosis.as_dict()
        plain["pulls"] = {k: v for k, v in plain["pulls"].items() if not k.startswith(amended_mounts.DRIFT)}
        plain["fit"].pop("rms_mm")
        return {
            **plain,
            "against": "mount",
            "mount": {"axes": self.session.mount.axes, "observes": self.session.mount.observes},
            "set_aside": list(self.built.aside),
            "lost": list(self.lost),
            "remarks": list(self.remarks),
            "small_terms": {n: dict(terms) for n, terms in self.small.values.items() if n not in self.claimed},
            "defaults_used": [],
        }

    def text(self) -> str:
        """Plain sentences for ``summary.txt``."""
        put = [n for n in self.found if n in self.claimed]
        put += [] if self.diagnosis.law is None else [f"a function of {self.diagnosis.law.coordinate}"]
        names = ", ".join(put)
        return summary(
            self.diagnosis,
            About(
                title=self.session.title,
                exposures=len(self.built.problem.names),
                settings=len(self.built.problem.names),
                against="mount",
                catalogue=self.built.problem.catalogue,
                lost=self.lost,
                remarks=self.remarks,
                amended=" ".join(
                    [
                        *([f"amended.toml states the mount with what was found: {names}."] if put else []),
                        *([SMALL] if self.small.parameters else []),
                    ]
                ),
                words=vocabulary(self.session.mount.unit),
            ),
        )

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return f"{self.text()}\n{written(self.folder, page=True)}"


def diagnose(
    source: Path | Session,
    output: Path | str | None = None,
    *,
    tower: Path | None = None,
    draw: bool = True,
    shared: Sequence[Shared] = (),
    without: Sequence[str] = (),
    progress: Progress = silent,
) -> MountDiagnosis:
    """Say what drifts in a mount, from its recordings alone.

    Parameters
    ----------
    source : Path or Session
        A PAINT folder, a pointing file, or an ``amended.toml`` of one; or what was read of it.
    output : path, optional
        Folder to write; by default nothing is written or drawn.
    tower : Path, optional
        Tower file of PAINT recordings.
    draw : bool
        Whether to draw pictures.
    shared : sequence of Shared
        What the mount's field shares: it is stated beforehand.
    without : sequence of str
        Effects that are not looked for.
    progress : callable

    Returns
    -------
    MountDiagnosis

    Raises
    ------
    BenchsimError
        If the recordings or the folder cannot be used.
    """
    folder = None if output is None else Path(output)
    progress("reading the records", 0.0)
    session = source if isinstance(source, Session) else stated.read(source, tower)
    session = shared_causes.applied(session, shared)
    with wanted_folder(folder, "diagnose", session.files, {"pictures": draw}) as staging:
        result = diagnose_session(session, folder, without=without, progress=progress)
        if folder is None or staging is None:
            return result
        write_text(staging / "diagnosis.json", json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n")
        write_text(staging / "summary.txt", result.text() + "\n")
        stated.write(session, result.found, result.fields, staging / "amended.toml", folder, result.learnt)
        write_text(staging / "page.json", json.dumps(mount_page.page(result), allow_nan=False) + "\n")
    if draw:
        progress("drawing", 0.9)
        b, title = result.built, session.title
        pictures.save(result.plot_probability(), folder / "probability.png")
        mount_pictures.residuals(
            folder / "residuals.png", b.session.records.source, result.diagnosis.residuals, session.mount.unit, title
        )
    report(folder)
    progress("done", 1.0)
    return result


@threadpool_limits.wrap(limits=1)
def diagnose_session(
    session: Session, folder: Path | None = None, *, without: Sequence[str] = (), progress: Progress = silent
) -> MountDiagnosis:
    """Diagnose recordings that were read, by the catalogue without some effects; writes nothing."""
    if not np.isfinite(session.records.source).all():
        raise BenchsimError(f"{session.path}: a direction is not finite; mend the records")
    progress("looking for outlying records", 0.05)
    session = witnesses.distinct(session)
    known = [e for e in effects.candidates(session.mount, session.records) if e.name not in without]
    built = mount_problem.build(session, catalogue=known)
    found = diagnosis.diagnose(built.problem, lambda what, done: progress(what, 0.1 + 0.7 * done))
    for _ in range(ROUNDS):
        if found.verdict == "nothing-missing":
            break
        shaped = {p.name for e in built.problem.catalogue for p in shapes(e)}
        fewer = mount_problem.again(built, {k: v for k, v in found.values.items() if k not in shaped or found.effects})
        if fewer is None:
            break
        built = fewer
        found = diagnosis.diagnose(built.problem, lambda what, done: progress(what, 0.1 + 0.7 * done))
    if far := witnesses.far_target(found):
        session = replace(session, remarks=(*session.remarks, far))
        return diagnose_session(session, folder, without=(*without, "target-position"), progress=progress)
    unit, size = session.mount.unit, float(np.sqrt(np.mean(found.residuals.sigma**2)))
    if size > WILD[unit]:
        remark = (
            f"Whatever of the catalogue is put in, single records miss by {size:.3g} {unit}, more than the "
            f"{WILD[unit]:g} {unit} up to which names are believed: records and mount do not belong together; check "
            "units and signs, which record has which source, position and constants of the mount."
        )
        built = replace(built, remarks=(*built.remarks, remark))
        found = _withdrawn(found, built.problem)
    found, doubted = witnesses.doubted(replace(found, next=found.next[:NEXT]))
    built = replace(built, remarks=(*built.remarks, *doubted))
    put, small, fields = amended(session, built, found), SmallTerms({}, ()), lawful(session, built, found)
    if session.mount.observes == "spot" and found.verdict != "nothing-missing" and size <= WILD[unit]:
        small = small_terms.small_terms(built.problem, found.values, put)
        put = added(put, small.values)
    learnt = amended_mounts.learnt(built, found, put, fields, small)
    return MountDiagnosis(session, built, _counted(found, built), put, fields, learnt, folder, small)


def _counted(d: Diagnosis, built: Built) -> Diagnosis:
    """A diagnosis that says where the mount changed as the files count records, those that were set aside too."""

    def told(sizes: Mapping[str, Size]) -> Mapping[str, Size]:
        if "change" not in sizes:
            return sizes
        at = mount_problem.change_of(built.session.records, sizes["change"].value)
        return {**sizes, "change": replace(sizes["change"], value=at)}

    return replace(
        d,
        effects=tuple(replace(f, parameters=told(f.parameters)) for f in d.effects),
        classes=tuple(replace(c, sizes=tuple(map(told, c.sizes))) for c in d.classes),
    )


def _withdrawn(d: Diagnosis, problem: Problem) -> Diagnosis:
    """A diagnosis that claims neither a name nor a place, and no gain."""
    r, held, own = d.residuals, d.held_out, {p.name for e in problem.catalogue for p in e.parameters}
    return replace(
        d,
        verdict="unexplained",
        effects=(),
        classes=(),
        location=None,
        law=None,
        next=(),
        held_out=None if held is None else replace(held, excess_chi2_after=held.excess_chi2_before),
        probability=dict.fromkeys(d.probability, PRESENCE),
        rms={k: (before, before) for k, (before, _) in d.rms.items()},
        values={k: v for k, v in d.values.items() if k not in own},
        residuals=replace(r, after=r.before, held_out_after=r.held_out_before),
    )


def amended(session: Session, built: Built, d: Diagnosis) -> dict[str, dict[str, float]]:
    """Stated effects with what was found added; of a class its most probable member."""
    out = {n: dict(terms) for n, terms in session.effects.items()}
    claimed = {*(f.name for f in d.effects), *chosen(d)}
    for effect in effects.candidates(session.mount, session.records):
        if effect.name not in claimed:
            continue
        own = out.setdefault(effect.name, {})
        for p in effect.parameters:
            if p.name in d.values:
                own[p.name] = d.values[p.name] + (own.get(p.name, 0.0) if not p.grid else 0.0)
        if "change" in own:
            own["change"] = mount_problem.change_of(built.session.records, d.values["change"])
    return {n: terms for n, terms in out.items() if terms}


def lawful(session: Session, built: Built, d: Diagnosis) -> dict[str, Function]:
    """Stated functions with a law added."""
    out = dict(session.fields)
    if d.law is not None:
        form = next(f for f in mount_problem.functions_of(built.session) if f.name == d.law.attachment)
        new = functions.of_law(d.law, form, built.session.records)
        out[form.name] = functions.summed(out[form.name], new) if form.name in out else new
    return out
