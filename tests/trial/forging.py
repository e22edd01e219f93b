"""Tools of a forger: he has the folder, the code and all secrets but the others' keys.

He chains the ledger anew, signs with what keys he has, and makes score and page again as the opening does.
"""

import json
import shutil
from pathlib import Path

import fakes

from benchsim.jobs.reporting import report
from benchsim.trial import anchors, deriving, ledger
from benchsim.trial.checking import Trial
from benchsim.trial.hashing import canonical, commitment, digest, files_of

PARTS = ("recordings/ledger.jsonl", "verdicts/ledger.jsonl", "ledger.jsonl")
FIRST_OF_NEXT = ("judged", "opened", None)


def written(path, lines):
    path.write_bytes(b"".join(canonical(line) + b"\n" for line in lines))


def said(line):
    return {k: v for k, v in line.items() if k not in ("before", "hash")}


def chained(lines, signers=None):
    """Lines with new hashes; signatures stay as they are (None), or are made anew by those who are named."""
    before, out = ledger.START, []
    for line in map(said, lines):
        if line["kind"] == "signed" and signers is not None:
            if line["by"] not in signers:
                continue
            line = anchors.signature(anchors.read_key(signers[line["by"]].path), line["by"], before)
        out.append(ledger.chained(before, line))
        before = out[-1]["hash"]
    return out


def of(lines, kind, case=None):
    return next(line for line in lines if line["kind"] == kind and line.get("case") == case)


def edited(path, change):
    """A JSON file, changed and written as it was laid out."""
    value = json.loads(path.read_text())
    change(value)
    canonically = path.parent.name == "truth"
    path.write_text(canonical(value).decode() + "\n" if canonically else deriving.written(value))


def closed_anew(t):
    """The opener's last line over score and page as they lie there."""
    lines = ledger.read(t / ledger.NAME)
    new = {"kind": "closed", "results": digest((t / "score.json").read_bytes())}
    new["page"] = digest((t / "report.html").read_bytes())
    written(t / ledger.NAME, [*lines[:-1], ledger.chained(lines[-2]["hash"], new)])


def rescored(t, change):
    """Another score, the page of it, and the ledger closed over both."""
    edited(t / "score.json", change)
    report(t)
    closed_anew(t)


def redone(t, change, signers=None):
    """Recordings' and verdicts' lines changed, all chained anew, and opened again as the opening does it."""
    lines = [dict(line) for line in ledger.read(t / "verdicts" / ledger.NAME)]
    change(lines)
    lines = chained(lines, signers)
    end = next((k for k, line in enumerate(lines) if line["kind"] == "judged"), len(lines))
    written(t / "recordings" / ledger.NAME, lines[:end])
    written(t / "verdicts" / ledger.NAME, lines)
    opened_anew(t, lines)


def opened_anew(t, lines, change=lambda lines: None):
    one = Trial(t, ledger.standing(lines))
    new = deriving.opened_lines(one)
    change(new)
    lines = [*lines, *ledger.follow(lines[-1]["hash"], new)]
    text = deriving.written(deriving.assembled(one, deriving.predictions(one), lines))
    (t / "score.json").write_text(text)
    page = digest(report(t).path.read_bytes())
    closed = {"kind": "closed", "results": digest(text.encode()), "page": page}
    written(t / ledger.NAME, [*lines, *ledger.follow(lines[-1]["hash"], [closed])])


def committed_anew(t, case, lines, change):
    """A truth changed, and its commitment with it."""
    path = t / "truth" / f"{case}.json"
    edited(path, change)
    opening = json.loads(path.read_text())
    of(lines, "concealed", case)["commitment"] = commitment(opening["salt"], opening["truth"])


def removed(*names):
    def attack(t):
        for name in names:
            path = t / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    attack.__name__ = "removed_" + "_".join(Path(name).name for name in names)
    return attack


def better_verdict(t, lines):
    """The first that was not right is told what is concealed."""
    case = next(c["case"] for c in json.loads((t / "score.json").read_text())["cases"] if c["concealed"] != "nothing")
    truth = json.loads((t / "truth" / f"{case}.json").read_text())["truth"]
    (t / "verdicts" / case / "diagnosis.json").write_text(
        json.dumps(fakes.diagnosis(next(iter(truth["effects"]), None), value=1))
    )
    of(lines, "judged", case)["files"] = files_of(t / "verdicts" / case)
