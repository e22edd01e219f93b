"""A whole trial with quick stand-ins: commitments hold, what was stopped goes on, what was spoilt is found."""

import json
import shutil

import cv2
import fakes
import numpy as np
import pytest

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.trial import cases, equalised, leak_test, ledger, running
from benchsim.trial.hashing import commitment

CASES, SEED = 20, 7


def test_opened_it_verifies_and_scores(opened):
    assert trial.verify(opened).stage == "opened and scored"
    score = json.loads((opened / "score.json").read_text())
    by = {c["case"]: c for c in score["cases"]}
    for name in by:
        truth = json.loads((opened / "truth" / f"{name}.json").read_text())["truth"]
        said = json.loads((opened / "verdicts" / name / "diagnosis.json").read_text())
        if truth["kind"] in ("stranger", "removed"):
            right = said["verdict"] == "located"
        else:
            # Settings thrice as far off as stated are a finding of their own.
            there = ["setting-errors"] if truth["kind"] == "clean-settings" else list(truth["effects"])
            right = [e["name"] for e in said["effects"]] == there
        assert (by[name]["cause"] == "right") == right, by[name]
    assert sum(sum(row) for row in score["confusion"]["counts"]) == CASES
    assert (opened / "report.html").stat().st_size > 1000


def test_every_file_is_committed_to(opened, tmp_path):
    rng = np.random.default_rng(3)
    files = sorted(p.relative_to(opened) for p in opened.rglob("*") if p.is_file())
    assert len(files) > 5 * CASES
    for k, file in enumerate(files):
        path = opened / file
        whole = path.read_bytes()
        at = int(rng.integers(len(whole)))
        try:
            path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :])
            with pytest.raises(BenchsimError):
                trial.verify(opened)
            path.unlink()
            if k % 5 == 0 or len(file.parts) == 1:
                with pytest.raises(BenchsimError):
                    trial.verify(opened)
        finally:
            path.write_bytes(whole)
    trial.verify(opened)


@pytest.mark.parametrize("place", ["recordings/001/x", "recordings/x", "verdicts/001/x", "verdicts/x", "truth/x"])
def test_a_file_added_is_found(spoilt, place):
    (spoilt / place).write_text("x")
    with pytest.raises(BenchsimError, match="does not verify"):
        trial.verify(spoilt)


def test_a_salt_binds(spoilt):
    path = spoilt / "truth" / "003.json"
    opening = json.loads(path.read_text())
    salt = opening["salt"]
    path.write_text(path.read_text().replace(salt, salt[:-1] + ("0" if salt[-1] != "0" else "1")))
    with pytest.raises(BenchsimError, match=r"truth/003.json: truth or salt"):
        trial.verify(spoilt)


def test_the_last_line_cannot_be_taken_away(spoilt):
    path = spoilt / ledger.NAME
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:-1]))
    with pytest.raises(BenchsimError, match="removed"):
        trial.verify(spoilt)


def test_parts_verify_before_the_opening_without_the_truth(concealed, tmp_path):
    given = tmp_path / "t"
    given.mkdir()
    shutil.copytree(concealed / "recordings", given / "recordings")
    with pytest.raises(BenchsimError, match="is not opened"):
        trial.verify(given)
    assert trial.verify(given, unopened=True).stage == "concealed, NOT judged"
    trial.judge(given / "recordings", given / "verdicts", workers=0, diagnose=fakes.diagnose)
    assert trial.verify(given, unopened=True).stage == "judged, NOT opened"


def test_the_judge_needs_the_recordings_alone(opened, concealed, keys, tmp_path):
    """Elsewhere, with nothing but the recordings, he commits to the same verdicts."""
    shutil.copytree(concealed / "recordings", tmp_path / "given")
    options = {"diagnose": fakes.diagnose, "key": keys["judge"].path}
    trial.judge(tmp_path / "given", tmp_path / "verdicts", workers=0, **options)
    assert (tmp_path / "verdicts" / ledger.NAME).read_bytes() == (opened / "verdicts" / ledger.NAME).read_bytes()


def test_nothing_of_the_truth_is_in_the_recordings(concealed):
    secret = json.loads((concealed / "truth" / "plan.json").read_text())
    words = {secret["seed"], *secret["kinds"]}
    for name in ledger.cases_of(CASES):
        opening = json.loads((concealed / "truth" / f"{name}.json").read_text())
        words |= {opening["salt"], *opening["truth"]["effects"], opening["truth"]["stranger"]} - {""}
    words -= set(secret["withheld"])  # which every judge is told, of every case alike
    for path in (concealed / "recordings").rglob("*"):
        assert not words & {path.name}
        if path.is_file():
            data = path.read_bytes()
            assert not [w for w in words if w.encode() in data]


def test_commitments_differ_though_truths_may_not(concealed):
    opening = json.loads((concealed / "truth" / "001.json").read_text())
    line = ledger.standing(ledger.read(concealed / "recordings" / ledger.NAME)).concealed["001"]
    assert commitment(opening["salt"], opening["truth"]) == line["commitment"]
    assert commitment("00" * 32, opening["truth"]) != line["commitment"]


def test_sizes_times_and_metadata_are_equal(concealed):
    seen = {}
    for name in ledger.cases_of(CASES):
        folder = concealed / "recordings" / name
        clues = {k: v for k, v in leak_test.clues(folder).items() if not k.endswith("order on disk")}
        seen.setdefault(clues["files"], []).append(clues)
        assert folder.stat().st_mtime == equalised.EPOCH
        for path in folder.iterdir():
            assert path.stat().st_mtime == equalised.EPOCH
            if path.suffix == ".png":
                assert {k for k, _ in leak_test._chunks(path)} == {b"IHDR", b"IDAT", b"IEND"}
    assert len(seen) == 2
    assert all(clues == group[0] for group in seen.values() for clues in group)


def test_pictures_keep_their_counts(tmp_path):
    counts = np.random.default_rng(0).integers(0, 65536, (30, 40)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), counts)
    equalised.plain_images(tmp_path)
    assert np.array_equal(cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED), counts)


class Stops:
    """A generator or judge that stops the machine at its third case, once; counts what it began."""

    def __init__(self, do):
        self.do, self.begun, self.stopped = do, [], False

    def __call__(self, *arguments):
        self.begun.append(arguments[1] if isinstance(arguments[1], int) else arguments[0].name)
        if len(self.begun) == 3 and not self.stopped:
            self.stopped = True
            raise KeyboardInterrupt
        return self.do(*arguments)


def test_a_stopped_trial_goes_on_where_it_was(opened, concealed, tmp_path):
    make, judge = Stops(fakes.make), Stops(fakes.diagnose)
    folder = tmp_path / "t"
    options = {"seed": SEED, "workers": 0, "make": make, "certificate": fakes.certificate}
    with pytest.raises(KeyboardInterrupt):
        trial.conceal(folder, CASES, **options)
    assert not (folder / "recordings").exists()
    trial.conceal(folder, CASES, **options)
    assert sorted(make.begun) == sorted([3, *range(1, CASES + 1)])
    assert of_content(folder / "recordings") == of_content(concealed / "recordings")
    with pytest.raises(KeyboardInterrupt):
        trial.judge(folder / "recordings", folder / "verdicts", workers=0, diagnose=judge)
    trial.judge(folder / "recordings", folder / "verdicts", workers=0, diagnose=judge)
    assert sorted(judge.begun) == sorted(["003", *ledger.cases_of(CASES)])
    trial.open(folder)
    assert of_content(folder) == of_content(opened)


def of_content(folder):
    """What the lines of a ledger say, but for hashes, signatures and the places of files on the disk."""
    lines = [dict(line) for line in ledger.read(folder / ledger.NAME) if line["kind"] != "signed"]
    for line in lines:
        for key in ("before", "hash", "results", "page"):
            line.pop(key, None)
        line["clues"] = {k: v for k, v in line.get("clues", {}).items() if not k.endswith(leak_test.PASSING)}
    return lines


def test_another_trial_is_not_gone_on_with(concealed):
    for options in (
        {"cases": CASES + 1, "seed": SEED},
        {"cases": CASES, "seed": SEED + 1},
        {"cases": CASES, "zero": True},
    ):
        with pytest.raises(BenchsimError, match="another trial"):
            trial.conceal(concealed, **options, workers=0, make=fakes.make, certificate=fakes.certificate)


def test_a_foreign_folder_is_refused(concealed, tmp_path):
    (tmp_path / "x").write_text("mine")
    with pytest.raises(BenchsimError, match="not empty"):
        trial.conceal(tmp_path, 2, workers=0, make=fakes.make, certificate=fakes.certificate)
    with pytest.raises(BenchsimError, match="not empty"):
        trial.judge(concealed / "recordings", tmp_path, workers=0, diagnose=fakes.diagnose)


def test_a_generator_that_is_not_certified_conceals_nothing(tmp_path):
    test = {"what": "coarse against rays", "quantity": "light", "p_value": 1e-9}
    found = {"passed": False, "rays": [10, 20], "tests": [test]}
    with pytest.raises(BenchsimError, match=r"not certified.*coarse against rays, light, p = 1e-09"):
        trial.conceal(tmp_path / "t", 2, workers=0, make=fakes.make, certificate=lambda plan: found)
    assert not (tmp_path / "t" / "recordings").exists()


def test_a_second_run_is_recorded_and_does_not_count(concealed, tmp_path):
    folder = tmp_path / "t"
    shutil.copytree(concealed, folder)
    recordings, verdicts = folder / "recordings", folder / "verdicts"
    first = trial.judge(recordings, verdicts, workers=0, diagnose=fakes.diagnose)
    assert trial.judge(recordings, verdicts, workers=0, diagnose=Stops(fakes.diagnose)).head == first.head

    def other(recording, folder, target, withheld):
        (folder / "diagnosis.json").write_text(json.dumps(fakes.diagnosis("canting", value=9.0)))

    done = trial.judge(recordings, verdicts, workers=0, diagnose=other, again=["002"])
    assert done.again == ("002",)
    with pytest.raises(BenchsimError, match="002: was judged 2 times"):
        trial.verify(folder)
    trial.open(folder)
    score = json.loads((folder / "score.json").read_text())
    assert "judged twice" in score["cases"][1]["note"]
    sizes = [s["estimate"] for c in score["cases"] for s in c["sizes"]]
    assert 9.0 not in sizes
    with pytest.raises(BenchsimError, match="no such case"):
        trial.judge(recordings, verdicts, workers=0, diagnose=fakes.diagnose, again=["999"])


def test_after_the_opening_nothing_is_judged_unseen(spoilt):
    trial.judge(spoilt / "recordings", spoilt / "verdicts", workers=0, diagnose=fakes.diagnose, again=["001"])
    with pytest.raises(BenchsimError, match="does not begin with that of verdicts"):
        trial.verify(spoilt)


def test_recordings_that_were_changed_are_not_judged(spoilt, tmp_path):
    (spoilt / "recordings" / "002" / "recording.toml").write_text("")
    with pytest.raises(BenchsimError, match="not what the ledger commits to"):
        trial.judge(spoilt / "recordings", tmp_path / "v", workers=0, diagnose=fakes.diagnose)


def test_a_case_that_cannot_be_judged_is_a_verdict_of_its_own(concealed, tmp_path):
    folder = tmp_path / "t"
    shutil.copytree(concealed, folder)

    def blind(recording, folder, target, withheld):
        raise BenchsimError("no trace") if recording.name == "004" else RuntimeError("a fault")

    done = trial.judge(folder / "recordings", folder / "verdicts", workers=0, diagnose=blind)
    assert len(done.unusable) == CASES
    said = json.loads((folder / "verdicts" / "001" / "failed.json").read_text())
    assert said["error"] == "RuntimeError: a fault" and " blind" in said["where"][0]
    score = trial.open(folder).score
    assert {c["cause"] for c in score["cases"]} == {""}
    assert trial.verify(folder).stage == "opened and scored"


def test_run_hands_the_judge_two_folders(concealed, opened, tmp_path):
    """The parts in a row, going on from what is concealed; the judge is told recordings and verdicts."""
    folder = tmp_path / "t"
    shutil.copytree(concealed, folder)
    told = []

    def judge(recordings, verdicts, scheduler, workers, key):
        told.append((recordings, verdicts))
        trial.judge(recordings, verdicts, workers=workers, diagnose=fakes.diagnose)

    trial.run(folder, CASES, seed=SEED, workers=0, judge=judge)
    trial.run(folder, CASES, seed=SEED, workers=0, judge=judge)
    assert told == [(folder / "recordings", folder / "verdicts")]
    assert trial.verify(folder).stage == "opened and scored"


def test_without_the_pictures_the_rest_still_verifies(spoilt):
    for name in ledger.cases_of(CASES):
        for path in (spoilt / "recordings" / name).glob("*.png"):
            path.unlink()
    with pytest.raises(BenchsimError, match="is not there"):
        trial.verify(spoilt)
    assert "NOT checked: the recordings' images" in trial.verify(spoilt, recordings=False).summary()
    (spoilt / "recordings" / "001" / "recording.toml").unlink()
    with pytest.raises(BenchsimError, match=r"001/recording.toml: is not there"):
        trial.verify(spoilt, recordings=False)


def test_a_trial_of_zero_size_keeps_all_else(tmp_path, concealed):
    """The same seed gives the same cases, and what is concealed scores as nothing; settings are as far off as before,
    which this judge does not see."""
    folder = tmp_path / "t"
    trial.conceal(folder, CASES, seed=SEED, zero=True, workers=0, make=fakes.make, certificate=fakes.certificate)
    plans = [json.loads((f / "truth" / "plan.json").read_text()) for f in (folder, concealed)]
    assert {k for k in plans[0] if plans[0][k] != plans[1][k]} == {"zero"}
    trial.judge(folder / "recordings", folder / "verdicts", workers=0, diagnose=fakes.diagnose)
    score = trial.open(folder).score
    thrice = {c["case"] for c in score["cases"] if c["row"] == "clean-settings"}
    for c in score["cases"]:
        off = c["case"] in thrice
        assert (c["concealed"], c["cause"]) == (("setting-errors", "missed") if off else ("nothing", "right"))


def test_the_plan_draws_kinds_in_their_shares():
    plan = cases.plan(200, 1)
    for kind, share in cases.KINDS.items():
        assert plan.kinds.count(kind) == round(200 * share)
    assert plan.kinds != cases.plan(200, 2).kinds
    assert cases.planned(json.loads(json.dumps(plan.plain()))) == plan
    assert len({cases.plan(1).seed for _ in range(3)}) == 3


def test_the_judge_s_own_process_tells_when_it_fails(tmp_path):
    with pytest.raises(BenchsimError, match=r"ledger\.jsonl: cannot be read"):
        running.apart(tmp_path, tmp_path / "v", None, 0)
