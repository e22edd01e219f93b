"""Whole fields with concealed causes: is what heliostats share found, what each has for itself, and how long it takes.

    python analysis/field_study.py shared --fields 20 --heliostats 16 --records 24 --seed 7 [-o out/field-shared.jsonl]
    python analysis/field_study.py whole --heliostats 1000 --records 30 --shared target --seed 7 -o out/field

``shared`` draws fields (`field_made.py`), each with one of its shared causes or none, and judges the joint step alone:
a line per field. ``whole`` runs ``benchsim field`` on one field and holds every heliostat's row against its truth: a
cause is *right* where all that was said is there, *in class* where the truth is a member of each class that is open,
*wrong* where something that is not there was said as named or probable. Clock and CPU seconds, and the largest memory
of a worker process, are printed.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import field_made
import numpy as np

from benchsim.instruments.mount import shared_causes
from benchsim.jobs.field_diagnosis import field, hear
from benchsim.jobs.field_list import heliostats

KINDS = ("target", "tower", "clock", "refraction", "camera", "none")


def joined(folder: Path) -> tuple[shared_causes.Joint, dict[str, float]]:
    """What a field says that its heliostats share, and the truth."""
    truth = json.loads((folder / "truth.json").read_text())
    everyone = heliostats(folder, None)
    _, found, _ = hear(everyone, lambda function, tasks, *_: enumerate(function(*task) for task in tasks))
    return found, truth["shared"]


def shared(options: argparse.Namespace) -> None:
    """A line per field."""
    lines = []
    for k in range(options.fields):
        kind = KINDS[k % len(KINDS)]
        with tempfile.TemporaryDirectory() as scratch:
            field_made.make(Path(scratch), options.heliostats, options.records, options.seed + k, [kind])
            start = time.process_time()
            found, truth = joined(Path(scratch))
            spent = time.process_time() - start
        said = [s.cause.name.split()[0] for s in found.shared]
        pulls = []
        for s in found.shared:
            for name, value in s.values.items():
                true = truth.get(name, truth.get(f"target_{name[-1]}_1", 0.0) if name.startswith("tower") else 0.0)
                pulls.append((value - true * (1e3 if s.units[name] == "mm" else 1.0)) / s.sigma[name])
        lines.append({"field": k, "kind": kind, "said": said, "pulls": pulls, "cpu_s": spent})
        print(f"{k}: {kind} -> {', '.join(said) or 'nothing'}; pulls {np.round(pulls, 1)}; {spent:.1f} s", flush=True)
    right = sum(x["said"] == ([] if x["kind"] == "none" else [x["kind"]]) for x in lines)
    every = np.array([p for x in lines for p in x["pulls"] if x["said"] == [x["kind"]]])
    print(f"right {right} of {len(lines)}; {len(every)} sizes, std about 0 {np.sqrt(np.mean(every**2)):.2f}")
    if options.output:
        options.output.write_text("".join(json.dumps(x) + "\n" for x in lines))


def judged(row: dict[str, Any], truth: dict[str, Any]) -> str:
    """One heliostat's row against what was concealed in it."""
    there = set(truth)
    sure = {e["name"] for e in row["effects"] if e["confidence"] != "provisional"}
    if sure - there:
        return "wrong"
    said = {e["name"] for e in row["effects"]}
    if not row["classes"]:
        return "right" if said == there else "part of it" if said < there else "provisional besides"
    members = [{name for m in c for name in m} for c in row["classes"]]
    return "in class" if there <= said.union(*members) else "class without it"


def whole(options: argparse.Namespace) -> None:
    """One large field."""
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch) / "field"
        field_made.make(place, options.heliostats, options.records, options.seed, options.shared.split(","))
        truth = json.loads((place / "truth.json").read_text())
        start = time.monotonic()
        found = field(place, options.output, workers=options.workers)
        took = time.monotonic() - start
    print(found.summary())
    counts = Counter(judged(dict(row), truth["heliostats"][row["id"]]) for row in found.rows)
    print(f"truth shared: {truth['shared']}")
    print(", ".join(f"{k} {v}" for k, v in counts.most_common()))
    after = np.array([row["miss_after_mrad"] for row in found.rows])
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"miss after: median {np.median(after):.3f}, 95 % below {np.quantile(after, 0.95):.3f} mrad of the normal")
    print(
        f"{took:.0f} s by the clock, {used.ru_utime + used.ru_stime:.0f} s of CPU in workers, at most "
        f"{used.ru_maxrss / 2**20:.2f} GiB in one; {took / len(found.rows):.2f} s a heliostat"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, job in (("shared", shared), ("whole", whole)):
        own = commands.add_parser(name)
        own.add_argument("--heliostats", type=int, default=16 if name == "shared" else 1000)
        own.add_argument("--records", type=int, default=24 if name == "shared" else 30)
        own.add_argument("--seed", type=int, required=True)
        own.add_argument("-o", "--output", type=Path, default=None if name == "shared" else Path("out/field"))
        own.set_defaults(job=job)
        if name == "shared":
            own.add_argument("--fields", type=int, default=20)
        else:
            own.add_argument("--shared", default="target")
            own.add_argument("--workers", type=int)
    options = parser.parse_args()
    options.job(options)


if __name__ == "__main__":
    main()
