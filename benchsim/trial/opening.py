"""``benchsim trial open``: commitments checked, truths opened, cause, size and prediction scored, the ledger closed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import load_json
from benchsim.bench.writing import write_text
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.reporting import report
from benchsim.trial import claims, leak_test, ledger, prediction, score
from benchsim.trial.checking import Trial, checked, complain, diagnosis_of, truths_of
from benchsim.trial.hashing import digest
from benchsim.trial.ledger import Standing

FORMAT = "benchsim-score/1"


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
        return "\n".join([*lines, "", f"Ledger closed: {self.head}", f"written: {self.folder}/score.json"])


def open(folder: Path | str, *, progress: Progress = silent) -> OpenResult:
    """Open a trial that was judged: check, score, and write ``ledger.jsonl``, ``score.json`` and ``report.html``.

    Parameters
    ----------
    folder : path
        Holds ``recordings/``, ``truth/`` and ``verdicts/``.

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
    trial = Trial(at, stands)
    complain(checked(trial, opened=True))
    if path.exists() and ledger.standing(ledger.read(path)).closed is not None:
        whole = load_json(at / "score.json")
        if not (at / "report.html").exists():
            report(at)
        return OpenResult(at, whole, ledger.standing(ledger.read(path)).head)
    progress("scoring", 0.1)
    truths = truths_of(trial)
    partial = at / f".{ledger.NAME}"
    shutil.copyfile(at / "verdicts" / ledger.NAME, partial)
    lines = []
    for case, (salt, truth) in truths.items():
        said = claims.said_in_words(diagnosis_of(trial, case))
        lines.append(
            {"kind": "opened", "case": case, "salt": salt, "says": f"{claims.concealed_in_words(truth)} → {said}"}
        )
    ledger.append(partial, lines)
    nothing = {case: not truth["zero"] and not truth["kind"].startswith("clean") for case, (_, truth) in truths.items()}
    blind = leak_test.blind([leak_test.clues(at / "recordings" / case) for case in truths], list(nothing.values()))
    seed = load_json(at / "truth" / "plan.json")["seed"]
    kept_back = {}
    for k, (case, (_, truth)) in enumerate(truths.items()):
        progress(f"predicting settings kept back from {case}", 0.1 + 0.8 * k / len(truths))
        kept_back[case] = prediction.of_case(seed, truth, at / "recordings" / case, at / "verdicts" / case)
    only = {case: truth for case, (_, truth) in truths.items()}
    whole = {**assembled(trial, only, kept_back, ledger.read(partial)), "leak": blind}
    text = json.dumps(whole, indent=1, allow_nan=False) + "\n"
    write_text(at / "score.json", text)
    head = ledger.append(partial, [{"kind": "closed", "results": digest(text.encode())}])
    partial.rename(path)
    report(at)
    return OpenResult(at, whole, head)


def assembled(
    trial: Trial, truths: Mapping[str, Any], kept_back: Mapping[str, Any], lines: list[ledger.Line]
) -> dict[str, Any]:
    """The score, all but the leak test: it follows from truths, verdicts, predictions and ledger alone."""
    stands: Standing = trial.stands
    withheld = list(stands.trial["withheld"])
    pairs = [(truth, diagnosis_of(trial, case)) for case, truth in truths.items()]
    cases = [score.scored(t, d, withheld, len(stands.judged[t["case"]]), kept_back.get(t["case"])) for t, d in pairs]
    return {
        "format": FORMAT,
        "title": f"Concealed trial of {len(cases)} cases",
        "headline": score.headline(cases),
        "cases": cases,
        "confusion": score.confusion(cases),
        "reliability": score.reliability(pairs, withheld),
        "power": score.power(pairs, withheld),
        "bars": score.bars(pairs, withheld, kept_back),
        "kept_back": dict(kept_back),
        "ledger": [
            {"line": k, "time": "", "what": _in_words(line), "hash": line["hash"]} for k, line in enumerate(lines, 1)
        ],
        "verified": True,
        "commands": [f"benchsim trial run --cases {len(cases)}", "benchsim trial verify"],
        "withheld": withheld,
        "certificate": stands.trial["certificate"],
        "versions": stands.trial["versions"],
    }


def _in_words(line: ledger.Line) -> str:
    kind, case = line["kind"], line.get("case", "")
    if kind == "concealed":
        return f"{case} concealed, commitment {line['commitment'][:12]}"
    if kind == "judged":
        return f"{case} judged" + (f", run {line['run']}" if line["run"] > 1 else "")
    if kind == "opened":
        return f"{case} opened: {line['says']}"
    return {"trial": "trial begun", "sealed": "recordings sealed", "committed": "verdicts committed"}[kind]
