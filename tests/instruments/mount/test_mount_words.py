"""What is said of a heliostat beside its causes: wrong days, sizes in classes, what cancels, what was learnt."""

import json
from pathlib import Path

import hand_made as hand
import numpy as np
import pytest
from test_history import NOISE, YEAR, heliostat, recorded, stamps

from benchsim.jobs import diagnose, predict

FIELD = Path(__file__).resolve().parents[4] / "shared" / "recordings" / "heliostat-juelich" / "field"
real = pytest.mark.skipif(not FIELD.is_dir(), reason="the real recordings are not beside the project")


def test_a_day_that_went_wrong_is_told_as_a_day(tmp_path):
    """Four of 48 records are of a day on which every spot lies 0.4 m, some 5 mrad of the beam, up."""
    rows, _ = recorded(YEAR, {"tilt_n": 3.0}, NOISE)
    wrong = [k for k, time in enumerate(YEAR) if time.date() == YEAR[20].date()]
    for k in wrong:
        rows[k] = (*rows[k][:2], rows[k][2] + np.array([0.0, 0.0, 0.4]))
    found = diagnose(hand.write_heliostat(tmp_path / "spoilt", rows, 1000, stamps(YEAR)))
    (told,) = found.lost
    assert len(wrong) == 4 and told.startswith(f"The day {YEAR[20].date()} (4 records, 1020 to 1023) lies apart")


def test_a_class_has_the_sizes_of_its_members(tmp_path):
    """Increments are near synonyms of lengths and levers: a class, of which each member has its own sizes."""
    truth = {"increment_1": 0.008, "increment_2": -0.01}
    done = diagnose(heliostat(tmp_path / "stepped", YEAR, truth, NOISE), tmp_path / "out")
    plain = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    (one,) = [c for c in plain["classes"] if ["encoder-increment"] in c["members"]]
    sizes = one["sizes"][one["members"].index(["encoder-increment"])]
    for name, value in truth.items():
        assert abs(sizes[name]["value"] - value) < 4 * sizes[name]["sigma"]
    assert one["stated"] and "encoder-increment (increment_1 = " in done.text()
    assert "increment_1 = " in (tmp_path / "out" / "report.html").read_text()


@real
def test_what_cancels_is_said_to(tmp_path):
    """Of BG23 an encoder offset and a canting of 13 mrad each are found, of which little is left together."""
    done = diagnose(FIELD / "BG23")
    assert {"encoder-offset", "canting"} <= done.claimed
    (told,) = [r for r in done.remarks if "act against each other" in r]
    assert told.startswith("encoder-offset and canting")
    alone = diagnose(heliostat(tmp_path / "alone", YEAR, {"CA": 12.0}, NOISE))
    assert not any("against each other" in r for r in alone.remarks)


def test_records_that_were_learnt_from_have_no_coverage(tmp_path):
    folder = heliostat(tmp_path / "known", YEAR, {"tilt_n": 5.0}, NOISE)
    diagnose(folder, tmp_path / "out")
    again = predict(tmp_path / "out" / "amended.toml", folder)
    assert again.coverage is None and again.as_dict()["coverage"] is None
    later = heliostat(tmp_path / "later", YEAR[:20], {"tilt_n": 5.0}, NOISE, seed=2, first=2000)
    assert predict(tmp_path / "out" / "amended.toml", later).coverage == pytest.approx(0.68, abs=0.35)
