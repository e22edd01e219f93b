"""``benchsim field``: every heliostat of a field diagnosed, and what they share found from all of them together.

First every heliostat says, by linear algebra, what its records show of causes that a field shares
(`instruments.mount.shared_causes`); then each is diagnosed on its own, what the field shares put into its file. Of
three heliostats and more, a target, the clock and the sun's model are the field's and are not looked for in a single
one. Every heliostat has a folder of its own, as ``benchsim diagnose`` writes it; a field that was stopped goes on where
it was, and a heliostat whose files, or whose field, have changed is done again.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import file_hash, load_json
from benchsim.bench.writing import write_csv, write_text
from benchsim.diagnosis.result import Size
from benchsim.instruments.mount import misses, paint, shared_causes, witnesses, wrong_days
from benchsim.instruments.mount.field_likelihood import Witness
from benchsim.instruments.mount.records import UNITS, Session
from benchsim.instruments.mount.shared_causes import About, Joint, Shared
from benchsim.jobs import mount_diagnosis
from benchsim.jobs.cluster import Scheduler, cluster
from benchsim.jobs.field_list import Heliostat, heliostats
from benchsim.jobs.mount_diagnosis import MountDiagnosis
from benchsim.jobs.output import begun_folder, default_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.reports import page
from benchsim.reports.quantities import counted, rounded

FORMAT = "benchsim-field/1"

ROW = "field-row.json"
"""What a field keeps of a heliostat, in its folder."""


@dataclass(frozen=True, repr=False)
class FieldDiagnosis(Shown):
    """A finished field.

    Attributes
    ----------
    rows : tuple of mapping
        Of every heliostat, as ``field.json`` holds them.
    joint : Joint
        What they share.
    lost : tuple of str
        A sentence for every heliostat that could not be used.
    remarks : tuple of str
    folder : Path
    """

    rows: tuple[Mapping[str, Any], ...]
    joint: Joint
    lost: tuple[str, ...]
    remarks: tuple[str, ...]
    folder: Path

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``field.json``."""
        return {
            "format": FORMAT,
            "shared": [
                {
                    "name": s.cause.name,
                    "says": s.cause.says,
                    "probability": s.probability,
                    "parameters": {
                        k: {"value": v, "sigma": s.sigma[k], "unit": s.units[k]} for k, v in s.values.items()
                    },
                    "witnesses": s.witnesses,
                }
                for s in self.joint.shared
            ],
            "rivals": [{"causes": list(names), "behind": behind} for names, behind in self.joint.rivals],
            "heliostats": list(self.rows),
            "lost": list(self.lost),
            "remarks": list(self.remarks),
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        n = len(self.rows)
        before, after = (np.array([r[f"miss_{w}_mrad"] for r in self.rows], float) for w in ("before", "after"))
        lines = [f"{counted(n, 'heliostat')} diagnosed" + (f", {len(self.lost)} not" if self.lost else "") + "."]
        if n:
            lines.append(
                f"Median miss of a record, mrad of the mirror's normal, median heliostat: {np.median(before):.2f} as "
                f"stated, {np.median(after):.2f} with what was found."
            )
        lines += ["", *(f"SHARED: {told(s, n)}" for s in self.joint.shared), *self.remarks]
        names = Counter(e["name"] for row in self.rows for e in row["effects"])
        if names:
            listed = ", ".join(f"{name} {count}" for name, count in names.most_common())
            lines += ["", f"Said of heliostats, of how many: {listed}."]
        verdicts = Counter(row["verdict"] for row in self.rows)
        lines += [f"Verdicts: {', '.join(f'{v} {count}' for v, count in verdicts.most_common())}."] if n else []
        lines += [f"Not used: {sentence}" for sentence in self.lost[:5]]
        if len(self.lost) > 5:
            lines.append(f"… and {len(self.lost) - 5} more, in field.json.")
        return "\n".join([*lines, "", f"written: {self.folder}/ (report.html, field.csv, field.json)"])


def told(shared: Shared, heliostats: int) -> str:
    """A shared cause in a sentence."""
    units = {k: "" if unit == "1" else f" {unit}" for k, unit in shared.units.items()}
    sizes = ", ".join(f"{k} = {v:.4g} ± {shared.sigma[k]:.2g}{units[k]}" for k, v in shared.values.items())
    return (
        f"{shared.cause.says} {sizes}; borne out by {shared.witnesses} of {heliostats} heliostats, probability "
        f"{'above 99.99' if shared.probability > 0.9999 else f'{100 * shared.probability:.2f}'} %."
    )


def field(
    source: Path,
    output: Path | str | None = None,
    *,
    tower: Path | None = None,
    scheduler: Scheduler | None = None,
    workers: int | None = None,
    draw: bool = False,
    allow_outside: bool = False,
    progress: Progress = silent,
) -> FieldDiagnosis:
    """Diagnose every heliostat of a field, and what they share.

    Parameters
    ----------
    source : Path
        A folder of PAINT folders, one for each heliostat, or a CSV file with the columns ``id``, ``path`` (relative to
        the file) and, if it is not beside or above, ``tower``.
    output : path, optional
        Default ``./NAME-field/``. What is finished in it is kept.
    tower : Path, optional
        Tower file of all heliostats; default it is looked for beside and above each.
    scheduler : Scheduler, optional
        Default processes of this machine.
    workers : int, optional
        Of this machine; default one per core, 0: everything in this process.
    draw : bool
        Whether to draw pictures of every heliostat.
    allow_outside : bool
        Whether what a list names may lie outside of its folder.
    progress : callable

    Returns
    -------
    FieldDiagnosis

    Raises
    ------
    BenchsimError
        If the field or the folder cannot be used. A heliostat that cannot is said in `FieldDiagnosis.lost`.
    """
    source = Path(source)
    folder = Path(output) if output is not None else default_folder(source, "field")
    everyone = heliostats(source, tower, allow_outside)
    begun_folder(folder, "field", everyone[0].folder)
    with cluster(scheduler, workers) as each:

        def all_of(
            function: Callable[..., Any], tasks: Sequence[tuple[Any, ...]], what: str, start: float, end: float
        ) -> Iterator[tuple[int, Any]]:
            for done, (k, result) in enumerate(each(function, tasks), 1):
                progress(f"{what} ({done} of {len(tasks)})", start + (end - start) * done / len(tasks))
                yield k, result

        heard, joint, lost = hear(everyone, all_of)
        together = len(heard) >= shared_causes.FEWEST
        usable = [everyone[k] for k in sorted(heard)]
        rows: dict[str, Mapping[str, Any]] = {}
        tasks = [(h, (folder / h.name).absolute(), joint.shared, together, draw) for h in usable]
        for k, result in all_of(row_of, tasks, "heliostats", 0.15, 0.97):
            if isinstance(result, Mapping):
                rows[usable[k].name] = result
            else:
                lost[usable[k].name] = sentence(usable[k], result)
    if not rows:
        raise BenchsimError(f"{source}: not one heliostat can be used; the first: {next(iter(lost.values()))}")
    remarks = wrong_days.told({name: row["days"] for name, row in rows.items()})
    if not together:
        remarks.append(
            f"What heliostats share cannot be told from {len(heard)}: a mirror that stands elsewhere and a target that "
            f"does look alike to one; {shared_causes.FEWEST} or more with the same targets tell them apart."
        )
    elif not joint.shared:
        near = len([names for names, _ in joint.rivals if names])
        remarks.append(
            "Nothing is shown that all share"
            + (f"; {counted(near, 'set')} of causes not excluded, see rivals in field.json." if near else ".")
        )
    found = FieldDiagnosis(
        tuple(rows[h.name] for h in everyone if h.name in rows), joint, tuple(lost.values()), tuple(remarks), folder
    )
    _write(found, folder)
    progress("done", 1.0)
    return found


def hear(
    everyone: Sequence[Heliostat], all_of: Callable[..., Iterable[tuple[int, Any]]]
) -> tuple[dict[int, Witness], Joint, dict[str, str]]:
    """What the heliostats share; heard are all, and once more about what was found.

    Parameters
    ----------
    everyone : sequence of Heliostat
        Those of another plant's targets are no witnesses of this one's.
    all_of : callable
        Of a function, its tasks, what they are, and the progress at start and end: each task's number and result.

    Returns
    -------
    heard : dict of int to Witness
        Heliostats that can be used, as they were heard first.
    joint : Joint
    lost : dict of str to str
        By name, what kept the others from being used.
    """
    heard: dict[int, Witness] = {}
    lost: dict[str, str] = {}
    for k, result in all_of(witness_of, [(h,) for h in everyone], "what the heliostats share", 0.0, 0.1):
        if isinstance(result, Witness):
            heard[k] = result
        else:
            lost[everyone[k].name] = sentence(everyone[k], result)
    if len(heard) < shared_causes.FEWEST:
        return heard, Joint((), ()), lost
    if len({w.projection.shape[1] for w in heard.values()}) > 1:
        raise BenchsimError(
            f"{everyone[0].folder.parent}: the heliostats' tower files list different targets; name one with --tower"
        )
    first = everyone[min(heard)]
    session = paint.read(first.folder, first.tower)
    many = shared_causes.causes(session.mount, session.records)
    own = shared_causes.parameters(session, many)
    usable = sorted(heard)
    joint = shared_causes.joint([heard[k] for k in usable], many, own)
    if joint.shared:
        # The first time they were linear from too far off for the size of what was found.
        tasks = [(everyone[k], shared_causes.linear_from(heard[k], joint, many, own)) for k in usable]
        again = dict(all_of(witness_of, tasks, "what the heliostats share, again", 0.1, 0.15))
        both = [again[i] if isinstance(again[i], Witness) else heard[k] for i, k in enumerate(usable)]
        joint = shared_causes.joint(both, many, own)
    return heard, joint, lost


@threadpool_limits.wrap(limits=1)
def witness_of(heliostat: Heliostat, about: About | None = None) -> Witness:
    """What one heliostat says of what the field shares."""
    session = witnesses.distinct(paint.read(heliostat.folder, heliostat.tower))
    many = shared_causes.causes(session.mount, session.records)
    return shared_causes.witness(heliostat.name, session, many, about)


def row_of(
    heliostat: Heliostat, target: Path, shared: Sequence[Shared], together: bool, draw: bool
) -> Mapping[str, Any]:
    """One heliostat diagnosed into its folder, unless that is done already, and its row."""
    session = paint.read(heliostat.folder, heliostat.tower)
    key = _key(session, shared, together, draw)
    kept = target / ROW
    if kept.is_file():
        try:
            row: dict[str, Any] = load_json(kept)
        except ValueError:
            row = {}
        # A row of before a column was there is made anew.
        if row.get("key") == key and {*COLUMNS} <= {*row}:
            return row
    result = mount_diagnosis.diagnose(
        session,
        target,
        draw=draw,
        shared=shared,
        without=shared_causes.OF_THE_FIELD if together else (),
    )
    row = {"key": key, **_row(heliostat, session, result)}
    write_text(kept, json.dumps(row, allow_nan=False) + "\n")
    return row


def _key(session: Session, shared: Sequence[Shared], together: bool, draw: bool) -> str:
    """Of everything that a heliostat's result rests on."""
    digest = hashlib.sha256()
    for path in session.files:
        digest.update(path.name.encode() + b"\0" + file_hash(path).encode())
    digest.update(json.dumps([[asdict(s) for s in shared], together, draw], sort_keys=True).encode())
    return digest.hexdigest()


def _row(heliostat: Heliostat, session: Session, result: MountDiagnosis) -> dict[str, Any]:
    d, position = result.diagnosis, session.mount.position / 1e3
    distance = np.linalg.norm(session.records.spot - session.mount.position, axis=1)
    amended = replace(session, effects=result.found, fields=result.fields)
    angle = {w: misses.misses(x, {})[0] for w, x in (("before", session), ("after", amended))}
    return {
        "id": heliostat.name,
        "east_m": float(position[0]),
        "north_m": float(position[1]),
        "up_m": float(position[2]),
        "records": len(session.records.names),
        "verdict": d.verdict,
        "causes": [f.name for f in d.effects]
        + [" or ".join("+".join(m) or "nothing" for m in c.members) for c in d.classes],
        "effects": [asdict(f) for f in d.effects],
        "classes": [[list(m) for m in c.members] for c in d.classes],
        "sizes": [
            *(_sized(f.name, f.parameters, "") for f in d.effects),
            *(_sized(" + ".join(m), s, "if ") for c in d.classes for m, s in zip(c.members, c.sizes, strict=True) if s),
        ],
        **{f"miss_{w}_mrad": float(np.nanmedian(x)) for w, x in angle.items()},
        # The beam turns by twice the normal's angle.
        **{f"miss_{w}_m": float(np.nanmedian(2 * UNITS["mrad"] * x * distance)) / 1e3 for w, x in angle.items()},
        "changed_at": result.changed_at,
        "changed_on": result.changed_on,
        "set_aside": list(result.built.aside),
        "days": wrong_days.counted(result.session.records, result.built.aside),
        "next": d.next[0].what if d.next else "",
        "page": f"{heliostat.name}/report.html",
    }


def _sized(name: str, sizes: Mapping[str, Size], perhaps: str) -> str:
    """``if clock: dt = 18 ± 5 s``."""
    return f"{perhaps}{name}: " + ", ".join(f"{k} = {rounded(s.value, s.sigma, s.unit)}" for k, s in sizes.items())


def sentence(heliostat: Heliostat, error: Any) -> str:
    """What kept a heliostat from being used."""
    return str(error) if isinstance(error, BenchsimError) else f"{heliostat.folder}: {type(error).__name__}: {error}"


COLUMNS = (
    "id,east_m,north_m,up_m,records,verdict,causes,sizes,miss_before_mrad,miss_after_mrad,miss_before_m,miss_after_m,"
    "changed_at,changed_on,set_aside,next,page"
).split(",")


def _write(found: FieldDiagnosis, folder: Path) -> None:
    table = []
    for row in found.rows:
        flat = {
            **row,
            "causes": "; ".join(row["causes"]),
            "sizes": "; ".join(row["sizes"]),
            "set_aside": "; ".join(row["set_aside"]),
        }
        table.append([flat[c] for c in COLUMNS])
    write_csv(folder / "field.csv", COLUMNS, table, 6)
    plain = found.as_dict()
    write_text(folder / "field.json", json.dumps(plain, indent=1, allow_nan=False) + "\n")
    title = folder.resolve().name
    write_text(
        folder / "report.html", page.field_page(plain, title, [told(s, len(found.rows)) for s in found.joint.shared])
    )
