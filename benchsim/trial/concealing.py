"""``benchsim trial conceal``: recordings in one folder, the truth in another, and a commitment to every truth."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import load_json
from benchsim.bench.staging import staged, sweep
from benchsim.bench.writing import write_text
from benchsim.jobs.cluster import Each, Scheduler, beside, cluster
from benchsim.jobs.progress import Progress, silent
from benchsim.trial import anchors, draws, equalised, leak_test, ledger
from benchsim.trial import cases as making
from benchsim.trial.cases import Plan
from benchsim.trial.generator_test import certify
from benchsim.trial.hashing import canonical, code, commitment, derived, digest, files_of, rng_of

Make = Callable[[Plan, int, Path], dict[str, Any]]
"""make(plan, number, folder) renders a case into the folder and returns its truth."""

Certify = Callable[[Plan], dict[str, Any]]
"""certify(plan) → the certificate in plain values, with ``passed``."""

PACKAGES = ("benchsim", "mitsuba", "drjit", "numpy", "scipy", "opencv-contrib-python-headless", "dask", "distributed")


@dataclass(frozen=True)
class ConcealResult:
    """Folders that were written, and the hash to publish before anything is judged."""

    folder: Path
    cases: int
    head: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {"folder": str(self.folder), "cases": self.cases, "head": self.head}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return (
            f"{self.cases} cases concealed. Give away {self.folder / 'recordings'}/, keep {self.folder / 'truth'}/.\n"
            f"Root hash, to be published: {self.head}\n"
            f"next: benchsim trial judge {self.folder / 'recordings'} -o {self.folder / 'verdicts'}"
        )


def certified(plan: Plan) -> dict[str, Any]:
    """Certificate of the generator on a clean bench of the trial."""
    bench = draws.bench("six", rng_of(plan.seed, "certificate"), plan.shrink)
    seed = int(rng_of(plan.seed, "certificate", "rays").integers(2**62))
    return certify(bench, seed).plain()


def conceal(
    output: Path | str,
    cases: int = 60,
    *,
    seed: int | None = None,
    shrink: int = 2,
    zero: bool = False,
    key: Path | None = None,
    scheduler: Scheduler | None = None,
    workers: int | None = None,
    make: Make = making.make,
    certificate: Certify = certified,
    progress: Progress = silent,
) -> ConcealResult:
    """Draw, conceal and photograph the cases of a trial. A stopped one is gone on with.

    Parameters
    ----------
    output : path
        Folder that gets ``recordings/``, to be given away, and ``truth/``, to be kept.
    cases : int
    seed, shrink, zero
        See `cases.plan`.
    key : path, optional
        Ed25519 key that signs what is concealed, see `anchors.key`.
    scheduler, workers
        What the cases run on, see `cluster.cluster`.
    make, certificate : callable
        What makes a case and certifies the generator, see `Make` and `Certify`.

    Raises
    ------
    BenchsimError
        If the folder holds something else, another trial, or the key, or the generator is not certified.
    """
    # Workers may have been started elsewhere.
    folder = Path(output).absolute()
    recordings, truth = folder / "recordings", folder / "truth"
    private = None if key is None else anchors.read_key(key, [folder])
    plan = _planned(folder, cases, seed, shrink, zero)
    names = ledger.cases_of(cases)
    rendered = truth / "rendered"
    if recordings.exists():
        shutil.rmtree(rendered, ignore_errors=True)
        stands = ledger.standing(ledger.read(recordings / ledger.NAME))
        if private is not None:
            anchors.complain(stands, "concealer", anchors.public_of(private))
        return ConcealResult(folder, cases, stands.head)
    rendered.mkdir(exist_ok=True)
    todo = [k for k, name in enumerate(names, 1) if not (truth / f"{name}.json").exists()]
    failed: list[str] = []
    with cluster(scheduler, workers) as each:
        _certify(plan, truth, certificate, each, progress)
        for done, (index, result) in enumerate(each(_one, [(make, plan, k, rendered) for k in todo]), 1):
            name = names[todo[index] - 1]
            progress(f"concealed {len(names) - len(todo) + done} of {len(names)}", done / len(todo))
            if isinstance(result, BaseException):
                where = " ".join(getattr(result, "__notes__", []))
                failed.append(f"case {name}: {type(result).__name__}: {result} ({where})")
                continue
            salt = derived(plan.seed, name, "salt").hex()
            write_text(truth / f"{name}.json", canonical({"salt": salt, "truth": result}).decode() + "\n")
    if failed:
        raise BenchsimError(f"{len(failed)} cases were not made, the first: {failed[0]}; run the command again")
    progress("sealing", 1.0)
    head = _seal(plan, names, recordings, truth, rendered, private)
    return ConcealResult(folder, cases, head)


def _planned(folder: Path, cases: int, seed: int | None, shrink: int, zero: bool) -> Plan:
    """The plan that lies there if it is the one that is asked for, else a new one."""
    path = folder / "truth" / "plan.json"
    if path.exists():
        plan = making.planned(load_json(path))
        asked = (cases, shrink, zero, plan.seed if seed is None else f"{seed:064x}")
        if (len(plan.kinds), plan.shrink, plan.zero, plan.seed) != asked:
            raise BenchsimError(f"{folder}: holds another trial; choose another folder with -o, or ask for the same")
        return plan
    sweep(path.parent)
    if folder.exists() and any(folder.iterdir()):
        raise BenchsimError(f"{folder}: not empty and no trial that was begun; choose another folder with -o")
    if cases < 1:
        raise BenchsimError(f"--cases {cases}: give at least 1")
    plan = making.plan(cases, seed, shrink=shrink, zero=zero)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Its owner's alone, as every staging folder.
        with staged(path.parent) as staging:
            write_text(staging / path.name, canonical(plan.plain()).decode() + "\n")
            os.rename(staging, path.parent)
    except OSError as error:
        raise BenchsimError(f"{folder}: cannot be written ({error.strerror}); choose another with -o") from None
    return plan


def _certify(plan: Plan, truth: Path, certificate: Certify, each: Each, progress: Progress) -> None:
    path = truth / "certificate.json"
    if path.exists():
        return
    progress("certifying the generator", 0.0)
    [(_, found)] = each(certificate, [(plan,)])
    if isinstance(found, BaseException):
        raise found
    if not found["passed"]:
        worst = min(found["tests"], key=lambda t: t["p_value"])
        raise BenchsimError(
            "the generator is not certified: on a clean bench its light does not agree with rays within Monte Carlo "
            f"error (worst of six tests: {worst['what']}, {worst['quantity']}, p = {worst['p_value']:.2g}; "
            f"{found['rays'][0]} and {found['rays'][1]} rays); run the command again, and if it stays, do not use it"
        )
    write_text(path, canonical(found).decode() + "\n")


def _one(make: Make, plan: Plan, number: int, rendered: Path) -> dict[str, Any]:
    """Make a case beside its place, equal in all that is no content, and move it there."""
    name = ledger.cases_of(number)[-1]
    with beside(rendered / name) as staging:
        truth = make(plan, number, staging)
        equalised.plain_images(staging)
    return truth


def _seal(
    plan: Plan, names: list[str], recordings: Path, truth: Path, rendered: Path, private: anchors.Private | None
) -> str:
    """Lay all recordings out at once, write the ledger beside them, and make it all equally old."""
    lines: list[dict[str, Any]] = [
        {
            "kind": "trial",
            "format": ledger.FORMAT,
            "cases": len(names),
            "withheld": list(plan.withheld),
            # The seed in it has 256 bits: it is its own salt.
            "plan": digest(canonical(plan.plain())),
            "certificate": load_json(truth / "certificate.json"),
            "code": code(),
            "versions": versions(),
        }
    ]
    for stray in (p for p in rendered.iterdir() if p.name not in names):
        shutil.rmtree(stray)
    staging = recordings.with_name(".recordings")
    shutil.rmtree(staging, ignore_errors=True)
    equalised.laid_out(rendered, staging)
    equalised.timeless(staging)
    for name in names:
        opening = load_json(truth / f"{name}.json")
        lines.append(
            {
                "kind": "concealed",
                "case": name,
                "commitment": commitment(opening["salt"], opening["truth"]),
                "files": files_of(staging / name),
                "clues": leak_test.clues(staging / name),
            }
        )
    lines.append({"kind": "sealed", "cases": len(names)})
    head = ledger.append(staging / ledger.NAME, lines)
    if private is not None:
        head = ledger.append(staging / ledger.NAME, [anchors.signature(private, "concealer", head)])
    equalised.timeless(staging)
    os.rename(staging, recordings)
    shutil.rmtree(rendered)
    return head


def versions() -> dict[str, str]:
    """Of what the outcome depends on."""
    out = {}
    for package in PACKAGES:
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            continue
    return out
