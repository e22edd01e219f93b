"""The blind judge finds a leak that is there, and is at chance where there is none."""

import cv2
import numpy as np

from benchsim.trial import leak_test


def folders(tmp_path, compress, late):
    """Forty cases of noise whose loudness, or time, goes with what is concealed."""
    rng = np.random.default_rng(1)
    concealed = rng.permutation([True, False] * 20)
    found = []
    for k, there in enumerate(concealed):
        folder = tmp_path / f"{k:03d}"
        folder.mkdir()
        counts = 3000 + (500 if there else 300) * rng.standard_normal((20, 30))
        cv2.imwrite(str(folder / "001.png"), counts.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, compress])
        found.append(
            {**leak_test.clues(folder), "001.png time": float(late and there), "001.png order on disk": float(k)}
        )
        found[-1]["folder time"] = 0.0
    return found, concealed


def test_a_leak_by_size_is_found(tmp_path):
    result = leak_test.blind(*folders(tmp_path, 9, False))
    assert "size" in result["clue"] and result["auc"] > 0.9 and result["at_chance"] is False


def test_a_leak_by_time_is_found(tmp_path):
    result = leak_test.blind(*folders(tmp_path, 0, True))
    assert result["clue"] == "001.png time" and result["auc"] == 1.0 and result["p_value"] <= 0.002


def test_stored_pictures_are_at_chance(tmp_path):
    result = leak_test.blind(*folders(tmp_path, 0, False))
    assert result["at_chance"] is True


def test_false_alarms_come_at_their_rate():
    """p ≤ 0.05 in 60 trials of noise: 10 or more by chance in one of 1500 seeds (binomial, 0.05)."""
    rng = np.random.default_rng(2)
    low = 0
    for k in range(60):
        found = [dict(zip("abcdef", rng.random(6), strict=True)) for _ in range(24)]
        low += leak_test.blind(found, rng.random(24) < 0.5, seed=k)["p_value"] <= 0.05
    assert low < 10


def test_too_few_cases_say_nothing():
    assert leak_test.blind([{"a": 1.0}] * 6, [True] * 3 + [False] * 3)["at_chance"] is None
