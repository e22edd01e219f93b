"""``benchsim trial open``: commitments checked, truths opened, cause, size and prediction scored, the ledger closed."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import file_hash, load_json
from benchsim.bench.writing import write_text
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.reporting import report
from benchsim.trial import deriving, ledger
from benchsim.trial.anchors import unsigned
from benchsim.trial.checking import Trial, checked, complain
from benchsim.trial.hashing import digest


@dataclass(frozen=True)
class OpenResult:
    """The score, and where it lies."""

    folder: Path
    score: Mapping[str, Any]
    head: str

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {"folder": str(self.folder), "head": self.head, "score": self.score}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        lines = [self.score["headline"], ""]
        width = max(len(c["concealed"]) for c in self.score["cases"])
        for c in self.score["cases"]:
            snr = "" if c["snr"] is None else f"  SNR {c['snr']:.0f}"
            lines.append(
                f"{c['case']}  {c['concealed']:<{width}} → {c['said']}{snr}  [{c['cause'] or 'none'}] {c['note']}"
            )
        lines += ["", "Bars:"]
        for b in self.score["bars"]:
            lines.append(f"  {b['quantity']:<68} {b['value']:>20}  ({b['interval']})  {b['bar']}  {b['state']}")
        found = self.score["leak"]
        if found["p_value"] is not None:
            lines.append(f"Leak test: best clue '{found['clue']}', AUC {found['auc']:.2f}, p = {found['p_value']:.3f}")
        return "\n".join([*lines, "", f"Root hash, to be published: {self.head}", f"written: {self.folder}/score.json"])


def open(folder: Path | str, *, workers: int | None = None, progress: Progress = silent) -> OpenResult:
    """Open a trial that was judged: check, score, and write ``ledger.jsonl``, ``score.json`` and ``report.html``.

    Parameters
    ----------
    folder : path
        Holds ``recordings/``, ``truth/`` and ``verdicts/``.
    workers : int, optional
        See `cluster.cluster`.

    Raises
    ------
    BenchsimError
        If anything is not what was committed to, or the verdicts are not all committed.

    Notes
    -----
    Opened once, it is the same again: truths, verdicts and ledger give the score.
    """
    at = Path(folder)
    path = at / ledger.NAME
    progress("checking every commitment", 0.0)
    stands = ledger.standing(ledger.read(at / "verdicts" / ledger.NAME), "verdicts/ledger.jsonl")
    if not stands.committed:
        raise BenchsimError(f"{at}: not every verdict is committed to; finish 'benchsim trial judge' first")
    if stands.trial["format"] != ledger.FORMAT:
        raise BenchsimError(f"{at}: was begun by an earlier version; open it with that one")
    trial = Trial(at, stands)
    complain([*unsigned(stands, {}), *checked(trial, opened=True)])
    lines = ledger.read(path) if path.exists() else []
    with deriving.readable(at):
        if lines and ledger.standing(lines).closed is not None:
            complain(deriving.differing(Trial(at, ledger.standing(lines)), lines, page=False, workers=workers)[0])
            if not (at / "report.html").exists():
                report(at)
            return OpenResult(at, load_json(at / "score.json"), lines[-1]["hash"])
        kept_back = deriving.predictions(trial, workers, progress=lambda what, done: progress(what, 0.1 + 0.8 * done))
        partial = at / f".{ledger.NAME}"
        shutil.copyfile(at / "verdicts" / ledger.NAME, partial)
        ledger.append(partial, deriving.opened_lines(trial))
        whole = deriving.assembled(trial, kept_back, ledger.read(partial))
    text = deriving.written(whole)
    write_text(at / "score.json", text)
    page = file_hash(report(at).path)
    head = ledger.append(partial, [{"kind": "closed", "results": digest(text.encode()), "page": page}])
    partial.rename(path)
    return OpenResult(at, whole, head)
