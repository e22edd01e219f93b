"""What follows from a trial's commitments: the opening's lines, the score and the page.

`opening` writes it and `verifying` makes it again, so that nobody who holds the finished folder can say otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import JSON_BYTES, load_json, read_file
from benchsim.jobs import reporting
from benchsim.jobs.cluster import cluster
from benchsim.jobs.progress import Progress, silent
from benchsim.trial import cases as making
from benchsim.trial import claims, leak_test, ledger, prediction, score
from benchsim.trial.checking import Trial, diagnosis_of, truths_of
from benchsim.trial.hashing import derived, digest

FORMAT = "benchsim-score/1"

ROUNDING = 1e-9
"""Relative: floats of the score that another machine's mathematics library may round otherwise."""

PREDICTED = 1e-6
"""Of the excess χ² before: what is left of it is a difference of numbers that come through matrices of some hundred
rows, whose last digits hang on the linear algebra; no bar is near a millionth."""


@contextmanager
def readable(folder: Path) -> Iterator[None]:
    """Truths and verdicts may have been committed to in any form: what is not as it should be ends in a sentence."""
    try:
        yield
    except BenchsimError:
        raise
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as error:
        what = f"{type(error).__name__}: {str(error)[:100]}"
        raise BenchsimError(f"{folder}: truths, verdicts or score are not what they should be ({what})") from None


def opened_lines(trial: Trial) -> list[dict[str, Any]]:
    """Lines of the ledger by which truths are opened; they follow from truths and verdicts."""
    out = []
    for case, (salt, truth) in truths_of(trial).items():
        words = f"{claims.concealed_in_words(truth)} → {claims.said_in_words(diagnosis_of(trial, case))}"
        out.append({"kind": "opened", "case": case, "salt": salt, "says": words})
    return out


def predictions(trial: Trial, workers: int | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Case → what its verdict predicts of settings that the judge never saw; wants recordings without their images."""
    seed = load_json(trial.folder / "truth" / "plan.json")["seed"]
    at = trial.folder.absolute()
    tasks = {c: (seed, truth, at / "recordings" / c, at / "verdicts" / c) for c, (_, truth) in truths_of(trial).items()}
    # Others are told at once to predict nothing.
    slow = [case for case, (*_, verdict) in tasks.items() if (verdict / "amended.toml").is_file()]
    out = {case: None if case in slow else prediction.of_case(*task) for case, task in tasks.items()}
    with cluster(None, workers if slow else 0) as each:
        for done, (index, found) in enumerate(each(prediction.of_case, [tasks[case] for case in slow]), 1):
            if isinstance(found, BaseException):
                raise found
            out[slow[index]] = found
            progress(f"predicted settings kept back from {done} of {len(slow)}", done / len(slow))
    return out


def assembled(trial: Trial, kept_back: Mapping[str, Any], lines: list[ledger.Line], leak: Any = None) -> dict[str, Any]:
    """The score: it follows from truths, verdicts, predictions and ledger alone.

    Parameters
    ----------
    trial : Trial
    kept_back : mapping
        See `predictions`.
    lines : list
        Of the ledger, all but the one that closes it.
    leak : optional
        What `leak_test` found, for a trial of the first format, whose ledger does not hold what it takes.
    """
    stands = trial.stands
    withheld = list(stands.trial["withheld"])
    truths = {case: truth for case, (_, truth) in truths_of(trial).items()}
    pairs = [(truth, diagnosis_of(trial, case)) for case, truth in truths.items()]
    cases = [score.scored(t, d, withheld, len(stands.judged[t["case"]]), kept_back.get(t["case"])) for t, d in pairs]
    if leak is None:
        something = [not t["zero"] and not t["kind"].startswith("clean") for t in truths.values()]
        leak = leak_test.blind([line["clues"] for line in stands.concealed.values()], something)
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
        "leak": leak,
    }


def written(whole: Mapping[str, Any]) -> str:
    """The one text of ``score.json``."""
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def _in_words(line: ledger.Line) -> str:
    kind, case = line["kind"], line.get("case", "")
    if kind == "concealed":
        return f"{case} concealed, commitment {line['commitment'][:12]}"
    if kind == "judged":
        return f"{case} judged" + (f", run {line['run']}" if line["run"] > 1 else "")
    if kind == "opened":
        return f"{case} opened: {line['says']}"
    if kind == "signed":
        return f"signed by the {line['by']}, key {line['key'][:12]}"
    return {"trial": "trial begun", "sealed": "recordings sealed", "committed": "verdicts committed"}[kind]


def planned_otherwise(trial: Trial) -> list[str]:
    """Where truths and salts do not follow from the plan and its seed; wants them checked against the ledger."""
    plan = making.planned(load_json(trial.folder / "truth" / "plan.json"))
    out = []
    if list(plan.withheld) != trial.stands.trial["withheld"] or len(plan.kinds) != trial.stands.trial["cases"]:
        out.append("truth/plan.json: is the plan of another trial (cases or withheld)")
    for (case, (salt, truth)), kind, design in zip(truths_of(trial).items(), plan.kinds, plan.designs, strict=False):
        if (truth["kind"], truth["design"], truth["zero"]) != (kind, design, plan.zero):
            out.append(f"truth/{case}.json: is of another kind than the plan's")
        if salt != derived(plan.seed, case, "salt").hex():
            out.append(f"truth/{case}.json: its salt does not follow from the plan's seed")
    return out


def differing(
    trial: Trial, lines: list[ledger.Line], *, page: bool, workers: int | None = None, progress: Progress = silent
) -> tuple[list[str], list[str]]:
    """Where an opened trial says what does not follow, and what could not be made again; wants its files checked.

    Parameters
    ----------
    trial : Trial
        Closed.
    lines : list
        Of its ledger.
    page : bool
        Whether the page is made again as well.
    workers : int, optional
        See `cluster.cluster`.
    """
    closed, at = trial.stands.closed, trial.folder
    assert closed is not None
    newer = trial.stands.trial["format"] == ledger.FORMAT
    text = read_file(at / "score.json", JSON_BYTES)
    if digest(text) != closed["results"]:
        return ["score.json: is not the one that the ledger closes with"], []
    out, unmade = planned_otherwise(trial), []
    before = [k for k, line in enumerate(lines) if line["kind"] != "opened"][-2] + 1
    if lines[before:-1] != ledger.follow(lines[before - 1]["hash"], opened_lines(trial)):
        out.append("ledger.jsonl: its lines 'opened' do not follow from truths and verdicts")
    found = load_json(at / "score.json")
    if written(found).encode() != text:
        out.append("score.json: is not laid out as it is written")
    if all((at / "recordings" / case / "recording.toml").is_file() for case in trial.stands.concealed):
        again = predictions(trial, workers, progress)
        out += [
            f"score.json: kept_back {case}: does not follow from truth and verdict"
            for case in again
            if not _predicts(found["kept_back"].get(case), again[case])
        ]
    else:
        unmade.append("what the verdicts predict of settings kept back (their recordings are not there)")
    if not newer:
        unmade.append("the leak test (this ledger is of the first format, which does not hold what it takes)")
    again = json.loads(written(assembled(trial, found["kept_back"], lines[:-1], None if newer else found["leak"])))
    wrong = sorted(k for k in {*found, *again} if not (k in found and k in again and same(found[k], again[k])))
    if wrong:
        out.append(f"score.json: does not follow from truths and verdicts ({', '.join(wrong)[:200]})")
    if page and not newer:
        out.append("ledger.jsonl: is of the first format, which vouches for no leak test and page; say --no-page")
    elif page:
        out += _page(trial)
    else:
        unmade.append(f"{reporting.NAME}")
    return out, unmade


def _page(trial: Trial) -> list[str]:
    if read_file(trial.folder / reporting.NAME, JSON_BYTES) == reporting.build(trial.folder)[1].encode():
        return []
    return [
        f"{reporting.NAME}: is not the page of this score; if another version made it, say --no-page and make your own "
        "with 'benchsim report -o'"
    ]


def same(found: Any, again: Any) -> bool:
    """Whether plain values are the same, floats within `ROUNDING`."""
    if isinstance(found, float) and isinstance(again, float):
        return abs(found - again) <= ROUNDING * max(abs(found), abs(again))
    if isinstance(found, dict) and isinstance(again, dict):
        # In the same order, which the page shows.
        return list(found) == list(again) and all(same(found[k], again[k]) for k in found)
    if isinstance(found, list) and isinstance(again, list):
        return len(found) == len(again) and all(same(f, a) for f, a in zip(found, again, strict=True))
    return type(found) is type(again) and bool(found == again)


def _predicts(found: Any, again: Any) -> bool:
    if found is None or again is None:
        return found is again
    scale = PREDICTED * (1 + abs(again["excess_chi2_before"]))
    near = all(abs(found[k] - again[k]) <= scale for k in ("excess_chi2_before", "excess_chi2_after"))
    return near and found.keys() == again.keys() and found["data"] == again["data"]
