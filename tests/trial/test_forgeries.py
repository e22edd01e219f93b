"""Forged trials: whatever somebody in one of the seats does to a finished folder is refused in a sentence."""

import json
import shutil

import fakes
import pytest
from forging import (
    FIRST_OF_NEXT,
    PARTS,
    better_verdict,
    chained,
    closed_anew,
    committed_anew,
    edited,
    of,
    opened_anew,
    redone,
    removed,
    rescored,
    written,
)

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.jobs.reporting import report
from benchsim.trial import deriving, ledger
from benchsim.trial.checking import Trial
from benchsim.trial.hashing import digest, files_of

# The opener.


def leak_test(t):
    rescored(t, lambda score: score["leak"].update(auc=0.5, p_value=1.0, at_chance=True, clue="none differs"))


def headline(t):
    rescored(t, lambda score: score.update(headline="All causes were found rightly."))


def a_miss_made_right(t):
    rescored(
        t, lambda score: score["cases"][0].update(cause="right" if score["cases"][0]["cause"] != "right" else "class")
    )


def a_bar_met(t):
    rescored(t, lambda score: next(b for b in score["bars"] if b["state"] != "met").update(state="met"))


def a_count_of_the_confusion(t):
    rescored(t, lambda score: score["confusion"]["counts"][0].__setitem__(0, 19))


def the_reliability_nudged(t):
    rescored(t, lambda score: score["reliability"][0].update(stated=score["reliability"][0]["stated"] * (1 + 1e-6)))


def withheld_in_the_score(t):
    rescored(t, lambda score: score["withheld"].pop())


def the_certificate_in_the_score(t):
    rescored(t, lambda score: score["certificate"].update(rays=[10, 20]))


def a_hash_in_the_score(t):
    rescored(t, lambda score: score["ledger"][3].update(hash=64 * "0"))


def one_more_key(t):
    rescored(t, lambda score: score.update(remark="found by all"))


def one_key_less(t):
    rescored(t, lambda score: score.pop("leak"))


def predictions(t):
    def change(score):
        score["kept_back"]["001"] = {"data": 50, "excess_chi2_before": 1e5, "excess_chi2_after": 1.0}

    rescored(t, change)


def predictions_and_all_that_follows(t):
    """Consistent: the score is assembled from the forged predictions."""
    lines = ledger.read(t / ledger.NAME)[:-1]
    one = Trial(t, ledger.standing(ledger.read(t / "verdicts" / ledger.NAME)))
    kept_back = {c: {"data": 50, "excess_chi2_before": 1e5, "excess_chi2_after": 1.0} for c in one.stands.concealed}
    (t / "score.json").write_text(deriving.written(deriving.assembled(one, kept_back, lines)))
    report(t)
    closed_anew(t)


def the_score_laid_out_otherwise(t):
    path = t / "score.json"
    path.write_text(json.dumps(json.loads(path.read_text()), indent=2))
    closed_anew(t)


def the_score_not_closed_over(t):
    edited(t / "score.json", lambda score: score.update(headline="All were found."))


def the_page(t):
    path = t / "report.html"
    path.write_text(path.read_text().replace("missed", "right"))


def the_page_closed_over(t):
    the_page(t)
    closed_anew(t)


def the_page_of_another_score(t):
    path, text = t / "score.json", (t / "score.json").read_text()
    edited(path, lambda score: score.update(headline="All were found."))
    report(t)
    path.write_text(text)
    closed_anew(t)


def all_in_the_first_format(t):
    """Which had no clues in its ledger, so that a forged leak test contradicts nothing."""
    score = json.loads((t / "score.json").read_text())
    lines = [{k: v for k, v in line.items() if k != "clues"} for line in ledger.read(t / ledger.NAME)]
    lines[0]["format"] = ledger.FIRST
    lines = chained(lines[:-1], {})
    for part, end in zip(PARTS, FIRST_OF_NEXT, strict=True):
        written(t / part, lines[: next((k for k, line in enumerate(lines) if line["kind"] == end), len(lines))])
    one = Trial(t, ledger.standing(ledger.read(t / PARTS[1])))
    text = deriving.written(deriving.assembled(one, score["kept_back"], lines, {**score["leak"], "auc": 0.5}))
    (t / "score.json").write_text(text)
    report(t)
    closed = {"kind": "closed", "results": digest(text.encode())}
    written(t / ledger.NAME, [*lines, *ledger.follow(lines[-1]["hash"], [closed])])


def words_of_the_opening(t):
    lines = ledger.read(t / "verdicts" / ledger.NAME)
    opened_anew(t, lines, lambda new: new[0].update(says="canting → canting"))


def a_salt_of_the_opening(t):
    lines = ledger.read(t / "verdicts" / ledger.NAME)
    opened_anew(t, lines, lambda new: new[0].update(salt=new[1]["salt"]))


def the_last_line_removed(t):
    written(t / ledger.NAME, ledger.read(t / ledger.NAME)[:-1])


def the_ledger_cut(t):
    path = t / ledger.NAME
    path.write_bytes(path.read_bytes()[:-40])


def the_ledger_back_at_the_verdicts(t):
    shutil.copyfile(t / "verdicts" / ledger.NAME, t / ledger.NAME)


def an_empty_ledger(t):
    (t / ledger.NAME).write_bytes(b"")


def added(name):
    def attack(t):
        (t / name).write_text("{}")

    attack.__name__ = f"added_{name}"
    return attack


# The judge.


def a_verdict(t):
    shutil.copyfile(t / "verdicts/001/diagnosis.json", t / "verdicts/002/diagnosis.json")


def verdicts_exchanged(t):
    one, two, aside = (t / "verdicts" / name for name in ("001", "002", "003x"))
    one.rename(aside), two.rename(one), aside.rename(two)


def a_verdict_under_the_old_signature(t):
    redone(t, lambda lines: better_verdict(t, lines))


def a_verdict_in_his_own_ledger_alone(t):
    lines = [dict(line) for line in ledger.read(t / "verdicts" / ledger.NAME)]
    better_verdict(t, lines)
    written(t / "verdicts" / ledger.NAME, chained(lines, {}))


def judged_again_after_the_opening(t):
    trial.judge(t / "recordings", t / "verdicts", workers=0, diagnose=fakes.diagnose, again=["001"])


def judged_again_and_opened_anew(t):
    judged_again_after_the_opening(t)
    opened_anew(t, ledger.read(t / "verdicts" / ledger.NAME))


def a_case_left_out(t):
    lines = [line for line in ledger.read(t / ledger.NAME) if line.get("case") != "004"]
    written(t / ledger.NAME, chained(lines, {}))


def no_verdict_in_its_place(t):
    (t / "verdicts/003/failed.json").write_text('{"error":"x","where":[]}\n')


def the_concealer_s_signature_as_the_judge_s(t):
    def change(lines):
        first = of(lines, "signed")
        lines[-1].update(key=first["key"], signature=first["signature"])

    redone(t, change)


# The concealer.


def a_truth(t):
    edited(t / "truth/001.json", lambda opening: opening["truth"].update(setting_scale=2.0))


def a_truth_under_the_old_signature(t):
    redone(t, lambda lines: committed_anew(t, "001", lines, lambda opening: opening["truth"].update(setting_scale=2.0)))


def a_salt_that_is_not_of_the_seed(t):
    redone(t, lambda lines: committed_anew(t, "001", lines, lambda opening: opening.update(salt=64 * "a")), {})


def a_case_of_another_kind(t):
    plan = json.loads((t / "truth/plan.json").read_text())
    case = ledger.case_of(plan["kinds"].index("single") + 1)
    redone(t, lambda lines: committed_anew(t, case, lines, lambda o: o["truth"].update(kind="clean", effects={})), {})


def a_truth_that_cannot_be_read(t):
    lines = [dict(line) for line in ledger.read(t / ledger.NAME)]
    committed_anew(t, "001", lines, lambda opening: opening["truth"].update(snr="large"))
    lines = chained(lines, {})
    for part, end in zip(PARTS, FIRST_OF_NEXT, strict=True):
        stop = next((k for k, line in enumerate(lines) if line["kind"] == end), len(lines))
        written(t / part, lines[:stop])


def plan(change):
    def attack(t):
        def changed(lines):
            edited(t / "truth/plan.json", change)
            lines[0]["plan"] = digest((t / "truth/plan.json").read_bytes()[:-1])

        redone(t, changed, {})

    return attack


def fewer_withheld_by_plan(t):
    plan(lambda values: values["withheld"].pop())(t)


def another_seed_in_the_plan(t):
    plan(lambda values: values.update(seed=64 * "b"))(t)


def the_plan_alone(t):
    edited(t / "truth/plan.json", lambda values: values.update(shrink=1))


def a_generator_that_was_not_certified(t):
    def change(lines):
        edited(t / "truth/certificate.json", lambda found: found.update(passed=False))
        lines[0]["certificate"] = json.loads((t / "truth/certificate.json").read_text())

    redone(t, change, {})


def sizes_for_the_leak_test(t):
    def change(lines):
        for line in lines:
            if line["kind"] == "concealed":
                line["clues"] = {**line["clues"], "size": 1}

    redone(t, change, {})


def metadata_in_a_picture(t):
    """A PNG with a chunk that tells, committed to, but not in what the leak test is given."""
    path = t / "recordings/001/001.png"
    path.write_bytes(path.read_bytes() + b"\0\0\0\4tEXtdent\0\0\0\0")
    redone(t, lambda lines: of(lines, "concealed", "001").update(files=files_of(path.parent)), {})


# The host.


def a_picture(t):
    shutil.copyfile(t / "recordings/001/001.png", t / "recordings/002/001.png")


def recordings_by_a_link(t):
    (t / "recordings").rename(t.with_name("elsewhere"))
    (t / "recordings").symlink_to(t.with_name("elsewhere"))


def a_picture_by_a_link(t):
    path = t / "recordings/001/001.png"
    path.rename(t.with_name("001.png"))
    path.symlink_to(t.with_name("001.png"))


def the_recordings_ledger_of_a_later_part(t):
    shutil.copyfile(t / "verdicts/ledger.jsonl", t / "recordings/ledger.jsonl")


ATTACKS = [
    (leak_test, "score.json: does not follow from truths and verdicts (leak)"),
    (headline, "does not follow from truths and verdicts (headline)"),
    (a_miss_made_right, "does not follow from truths and verdicts (cases)"),
    (a_bar_met, "does not follow from truths and verdicts (bars)"),
    (a_count_of_the_confusion, "does not follow from truths and verdicts (confusion)"),
    (the_reliability_nudged, "does not follow from truths and verdicts (reliability)"),
    (withheld_in_the_score, "does not follow from truths and verdicts (withheld)"),
    (the_certificate_in_the_score, "does not follow from truths and verdicts (certificate)"),
    (a_hash_in_the_score, "does not follow from truths and verdicts (ledger)"),
    (one_more_key, "does not follow from truths and verdicts (remark)"),
    (one_key_less, "does not follow from truths and verdicts (leak)"),
    (predictions, "kept_back 001: does not follow"),
    (predictions_and_all_that_follows, "kept_back 001: does not follow"),
    (the_score_laid_out_otherwise, "score.json: is not laid out as it is written"),
    (the_score_not_closed_over, "score.json: is not the one that the ledger closes with"),
    (the_page, "report.html: is not the one that the ledger closes with"),
    (the_page_closed_over, "report.html: is not the page of this score"),
    (the_page_of_another_score, "report.html: is not the page of this score"),
    (all_in_the_first_format, "is of the first format, which vouches for no leak test"),
    (words_of_the_opening, "ledger.jsonl: its lines 'opened' do not follow"),
    (a_salt_of_the_opening, "truth/001.json: truth or salt is not what was committed to"),
    (removed("score.json"), "score.json: is not there"),
    (removed("report.html"), "report.html: is not there"),
    (removed("ledger.jsonl"), "is not opened, or its opening was taken away"),
    (removed("ledger.jsonl", "score.json"), "is not opened, or its opening was taken away"),
    (removed("ledger.jsonl", "score.json", "report.html"), "is not opened, or its opening was taken away"),
    (removed("ledger.jsonl", "score.json", "report.html", "truth", "verdicts"), "is not opened"),
    (removed("truth"), "truth: is not there"),
    (removed("truth/007.json"), "007.json"),
    (removed("verdicts"), "verdicts/ledger.jsonl: is not there"),
    (removed("verdicts/ledger.jsonl"), "verdicts/ledger.jsonl: is not there"),
    (removed("verdicts/005"), "verdicts/005: is not there"),
    (removed("recordings"), "holds no recordings/ledger.jsonl"),
    (removed("recordings/ledger.jsonl"), "holds no recordings/ledger.jsonl"),
    (removed("recordings/005/001.png"), "recordings/005/001.png: is not there"),
    (the_last_line_removed, "ledger.jsonl: ends before the trial was closed"),
    (the_ledger_cut, "is cut off"),
    (the_ledger_back_at_the_verdicts, "ledger.jsonl: ends before the trial was closed"),
    (an_empty_ledger, "line 1: is cut off"),
    (added("benchsim.json"), "benchsim.json: the ledger knows nothing of it"),
    (added("truth/151.json"), "truth/151.json: the ledger knows nothing of it"),
    (added("recordings/001/notes.txt"), "recordings/001/notes.txt: was not there"),
    (a_verdict, "verdicts/002/diagnosis.json: was changed"),
    (verdicts_exchanged, "verdicts/001/diagnosis.json: was changed"),
    (a_verdict_under_the_old_signature, "the signature of the judge is not that of the key it names"),
    (a_verdict_in_his_own_ledger_alone, "opening: the ledger does not begin with that of verdicts"),
    (judged_again_after_the_opening, "opening: the ledger does not begin with that of verdicts"),
    (judged_again_and_opened_anew, "case 001: was judged 2 times"),
    (a_case_left_out, "cannot stand here"),
    (no_verdict_in_its_place, "verdicts/003/failed.json: was not there"),
    (the_concealer_s_signature_as_the_judge_s, "the signature of the judge is not that of the key it names"),
    (a_truth, "truth/001.json: truth or salt is not what was committed to"),
    (a_truth_under_the_old_signature, "the signature of the concealer is not that of the key it names"),
    (a_salt_that_is_not_of_the_seed, "truth/001.json: its salt does not follow from the plan's seed"),
    (a_case_of_another_kind, "is of another kind than the plan's"),
    (a_truth_that_cannot_be_read, "truths, verdicts or score are not what they should be"),
    (fewer_withheld_by_plan, "truth/plan.json: is the plan of another trial"),
    (another_seed_in_the_plan, "its salt does not follow from the plan's seed"),
    (the_plan_alone, "truth/plan.json: is not what was committed to"),
    (a_generator_that_was_not_certified, "the generator was not certified"),
    (sizes_for_the_leak_test, "recordings/001: its names, sizes or metadata are not those"),
    (metadata_in_a_picture, "recordings/001: its names, sizes or metadata are not those"),
    (a_picture, "recordings/002/001.png: was changed"),
    (recordings_by_a_link, "recordings: is a link"),
    (a_picture_by_a_link, "is a link or no plain file"),
    (the_recordings_ledger_of_a_later_part, "recordings/ledger.jsonl: does not end where"),
]


@pytest.mark.parametrize("forged", [the_page, the_score_not_closed_over])
def test_a_page_that_another_version_made_is_still_the_one_closed_with(spoilt, forged):
    forged(spoilt)
    with pytest.raises(BenchsimError, match="is not the one that the ledger closes with"):
        trial.verify(spoilt, page=False)


@pytest.mark.parametrize(("attack", "says"), ATTACKS, ids=lambda x: getattr(x, "__name__", ""))
def test_a_forged_trial_is_refused(spoilt, attack, says):
    attack(spoilt)
    with pytest.raises(BenchsimError) as refused:
        trial.verify(spoilt)
    assert says in str(refused.value) and "\n" not in str(refused.value)


def test_what_a_forger_does_without_forging_verifies(spoilt):
    """His tools make the trial that was there: what they forge is refused for that alone."""
    before = {p: p.read_bytes() for p in spoilt.rglob("*") if p.is_file()}
    rescored(spoilt, lambda score: None)
    redone(spoilt, lambda lines: None)
    edited(spoilt / "truth/001.json", lambda opening: None)
    assert all(p.read_bytes() == body for p, body in before.items())
    redone(spoilt, lambda lines: None, {})
    assert trial.verify(spoilt).signed == {}
