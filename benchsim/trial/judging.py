"""``benchsim trial judge``: a diagnosis of every recording, and a commitment to each before anything is opened.

It is handed the folder of recordings and nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.staging import sweep
from benchsim.bench.writing import write_bytes, write_text
from benchsim.jobs.cluster import Each, Scheduler, beside, cluster
from benchsim.jobs.progress import Progress, silent
from benchsim.trial import anchors, ledger
from benchsim.trial.hashing import canonical, code, files_of

Diagnose = Callable[[Path, Path, Path, Sequence[str]], None]
"""diagnose(recording, folder, target, withheld) writes ``diagnosis.json`` into a folder that will lie at ``target``."""


@dataclass(frozen=True)
class JudgeResult:
    """Verdicts that were committed to, and the hash to publish before anything is opened."""

    folder: Path
    cases: int
    again: tuple[str, ...]
    unusable: tuple[str, ...]
    head: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "folder": str(self.folder),
            "cases": self.cases,
            "judged_again": list(self.again),
            "unusable": list(self.unusable),
            "head": self.head,
        }

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        lines = [f"{self.cases} verdicts, all committed to: {self.folder}/"]
        if self.unusable:
            lines.append(f"{len(self.unusable)} without a verdict: {', '.join(self.unusable)}")
        if self.again:
            lines.append(f"judged more than once, and recorded so: {', '.join(self.again)}; the first run counts")
        return "\n".join([*lines, f"Root hash, to be published: {self.head}"])


def judge(
    recordings: Path | str,
    output: Path | str,
    *,
    again: Sequence[str] = (),
    key: Path | None = None,
    scheduler: Scheduler | None = None,
    workers: int | None = None,
    diagnose: Diagnose | None = None,
    progress: Progress = silent,
) -> JudgeResult:
    """Diagnose every recording once and commit to the verdicts. A stopped judgement is gone on with.

    Parameters
    ----------
    recordings : path
        Folder that ``trial conceal`` gave away.
    output : path
        Folder of the verdicts.
    again : sequence of str
        Cases to judge once more; recorded as a further run, which never counts.
    key : path, optional
        Ed25519 key that signs the verdicts, see `anchors.key`.
    scheduler, workers
        What the cases run on, see `cluster.cluster`.
    diagnose : callable
        See `Diagnose`; default the package's own.

    Raises
    ------
    BenchsimError
        If the recordings are not those that the ledger commits to, or the folder holds something else.
    """
    # Workers may have been started elsewhere.
    given, folder = Path(recordings).absolute(), Path(output).absolute()
    do = diagnose or diagnose_recording
    private = None if key is None else anchors.read_key(key, [given, folder])
    if key is not None and key.absolute().parent == given.parent == folder.parent:
        raise BenchsimError(f"--key {key}: lies in {given.parent}, which is handed on; keep keys elsewhere")
    published = ledger.read(given / ledger.NAME)
    stands = ledger.standing(published, str(given / ledger.NAME))
    if not stands.sealed:
        raise BenchsimError(f"{given}: the recordings are not sealed; finish 'benchsim trial conceal' first")
    for case, line in stands.concealed.items():
        if files_of(given / case) != line["files"]:
            raise BenchsimError(f"{given / case}: is not what the ledger commits to; get the recordings anew")
    anchors.complain(stands, "concealer")
    path = folder / ledger.NAME
    _take_up(folder, path, given, published)
    names = list(stands.concealed)
    withheld = tuple(stands.trial["withheld"])
    todo = [name for name in names if not (folder / name).exists()]
    _commit(folder, path, names)
    tasks = [(do, given / name, folder / name, withheld) for name in todo]
    with cluster(scheduler, workers if todo else 0) as each:
        for done, (index, result) in enumerate(each(_one, tasks), 1):
            progress(f"judged {len(names) - len(todo) + done} of {len(names)}", done / len(todo))
            if isinstance(result, BaseException):
                # A worker that died of its case three times, say: that is how the judge did on it.
                with beside(folder / todo[index]) as staging:
                    _failed(staging, result)
            _commit(folder, path, names)
    lines = ledger.standing(ledger.read(path), str(path))
    if not lines.committed:
        ledger.append(path, [{"kind": "committed", "cases": len(names), "code": code()}])
    if again:
        with cluster(scheduler, workers) as each:
            _again(given, folder, path, list(again), do, withheld, each)
    lines = ledger.standing(ledger.read(path), str(path))
    if private is not None and "judge" not in lines.signed:
        ledger.append(path, [anchors.signature(private, "judge", lines.head)])
        lines = ledger.standing(ledger.read(path), str(path))
    anchors.complain(lines, "judge", None if private is None else anchors.public_of(private))
    unusable = tuple(name for name in names if not (folder / name / "diagnosis.json").exists())
    return JudgeResult(folder, len(names), lines.twice, unusable, lines.head)


def _take_up(folder: Path, path: Path, given: Path, published: list[ledger.Line]) -> None:
    """Begin the judge's ledger with the concealer's lines, or make sure that it began with them."""
    sweep(path)
    ledger.mend(path)
    if path.exists():
        if ledger.read(path)[: len(published)] != published:
            raise BenchsimError(f"{folder}: holds verdicts on another trial; choose another folder with -o")
        return
    if folder.exists() and any(folder.iterdir()):
        raise BenchsimError(f"{folder}: not empty and no verdicts; choose another folder with -o")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BenchsimError(f"{folder}: cannot be written ({error.strerror}); choose another with -o") from None
    write_bytes(path, (given / ledger.NAME).read_bytes())


def _commit(folder: Path, path: Path, names: list[str]) -> None:
    """Commit to the verdicts that are there, in the order of the cases, up to the first that is not."""
    judged = ledger.standing(ledger.read(path), str(path)).judged
    lines = []
    for name in names[len(judged) :]:
        if not (folder / name).exists():
            break
        lines.append({"kind": "judged", "case": name, "run": 1, "files": files_of(folder / name)})
    if lines:
        ledger.append(path, lines)


def _again(
    given: Path, folder: Path, path: Path, cases: list[str], do: Diagnose, withheld: tuple[str, ...], each: Each
) -> None:
    """Further runs, each recorded."""
    runs = ledger.standing(ledger.read(path), str(path)).judged
    unknown = [c for c in cases if c not in runs]
    if unknown:
        raise BenchsimError(
            f"--again {unknown[0]}: no such case; name it as its folder, for instance {next(iter(runs))}"
        )
    places = [(c, len(runs[c]) + 1, folder / f"{c}-run-{len(runs[c]) + 1}") for c in dict.fromkeys(cases)]
    tasks = [(do, given / c, place, withheld) for c, _, place in places]
    for index, result in each(_one, tasks):
        if isinstance(result, BaseException):
            with beside(places[index][2]) as staging:
                _failed(staging, result)
    for case, run, place in places:
        ledger.append(path, [{"kind": "judged", "case": case, "run": run, "files": files_of(place)}])


def _one(do: Diagnose, recording: Path, target: Path, withheld: tuple[str, ...]) -> None:
    """Judge a case beside its place; what is there already stays, it was first."""
    if target.exists():
        return
    with beside(target) as staging:
        try:
            do(recording, staging, target, withheld)
        except BenchsimError as error:
            _failed(staging, error)


def _failed(folder: Path, error: BaseException) -> None:
    """Say in the place of a verdict why there is none."""
    said = {"error": f"{type(error).__name__}: {error}", "where": list(getattr(error, "__notes__", []))}
    write_text(folder / "failed.json", canonical(said).decode() + "\n")


def diagnose_recording(recording: Path, folder: Path, target: Path, withheld: Sequence[str]) -> None:
    """What ``benchsim diagnose`` writes without pictures, by a catalogue that lacks some effects, in one process."""
    from benchsim.instruments.bench import amended_file
    from benchsim.jobs.diagnosing import diagnose_recording as diagnosed
    from benchsim.jobs.workers import workers

    with workers(1) as pool:
        result = diagnosed(read(recording, images=True), target, pool=pool, without=tuple(withheld))
    write_text(folder / "diagnosis.json", json.dumps(result.as_dict(), indent=1, allow_nan=False) + "\n")
    write_text(folder / "summary.txt", result.text() + "\n")
    amended_file.write_amended(result.amended, folder / "amended.toml", target)
