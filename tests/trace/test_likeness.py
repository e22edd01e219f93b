"""What looks like a laser's line, and what can be traced without being one."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import norm

sys.path.insert(0, str(Path(__file__).parent))
from without_a_line import pictures

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.trace import extract_pixels
from benchsim.trace.likeness import LIMIT

SMALL = (300, 400)
WITHOUT = pictures(1, SMALL)


def bowed(path, peak, width, seed):
    """A bowed Gaussian line on a lit board, 16 bits, with shot noise."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: SMALL[0], : SMALL[1]].astype(float)
    n = v - 150 - rng.uniform(-40, 40) - rng.uniform(-0.2, 0.2) * u - rng.uniform(-6e-4, 6e-4) * (u - 200) ** 2
    light = 3000 + 2000 * u / SMALL[1] + peak * width * np.sqrt(2 * np.pi) * (
        norm.cdf((n + 0.5) / width) - norm.cdf((n - 0.5) / width)
    )  # fmt: skip
    cv2.imwrite(str(path), np.clip(rng.poisson(light / 5) * 5, 0, 65535).astype(np.uint16))


@pytest.mark.parametrize("name", WITHOUT)
def test_a_picture_without_a_line_is_refused(name, tmp_path):
    assert len(WITHOUT) >= 20
    cv2.imwrite(str(tmp_path / "p.png"), WITHOUT[name])
    with pytest.raises(BenchsimError, match=r"^p\.png: ") as caught:
        jobs.fit(tmp_path / "p.png", tmp_path / "out", pixels=True)
    assert not (tmp_path / "out").exists() and str(caught.value).isprintable()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("peak", "width"), [(20000, 1.0), (20000, 4.0), (2000, 1.5)])
def test_a_line_is_not(peak, width, seed, tmp_path):
    bowed(tmp_path / "p.png", peak, width, seed)
    assert extract_pixels(tmp_path / "p.png").likeness.score > LIMIT


def test_the_likeness_is_told_and_written(tmp_path):
    bowed(tmp_path / "p.png", 20000, 1.5, 1)
    found = jobs.fit(tmp_path / "p.png", tmp_path / "out", pixels=True)
    assert "looks like a line: 0." in found.summary() and f"{LIMIT} and more" in found.summary()
    written = json.loads((tmp_path / "out" / "conics.json").read_text())["likeness"]
    assert written["limit"] == LIMIT < written["score"] <= 1
    assert set(written) == {"score", "limit", "contrast", "continuity", "unevenness", "single"}
