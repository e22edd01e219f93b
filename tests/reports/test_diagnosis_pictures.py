"""The pictures of a diagnosis: drawn whole for every verdict, and true to the numbers."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchsim.reports import diagnosis_pictures as pictures


def drawn(path):
    picture = cv2.imread(str(path))
    assert picture is not None
    # More than a frame: several colours of ink.
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    return picture


def near(picture, colour):
    """Pixels of a colour given as #rrggbb."""
    bgr = [int(colour[i : i + 2], 16) for i in (5, 3, 1)]
    return np.abs(picture.astype(int) - bgr).max(axis=2) < 30


@pytest.mark.parametrize("held_out", [True, False])
def test_residuals_are_drawn_with_and_without_left_out_settings(made, tmp_path, held_out):
    d = made.diagnosis
    if not held_out:
        none = np.full(len(made.problem.data), np.nan)
        d = replace(d, residuals=replace(d.residuals, held_out_before=none, held_out_after=none))
    (path,) = pictures.residuals(tmp_path, made.problem, d, "six")
    tall = drawn(path).shape[0]
    assert (tall > 1000) == held_out
    assert not list(tmp_path.glob(".*"))


def test_observables_are_drawn(made, tmp_path):
    pictures.observables(tmp_path / "observables.png", made.problem, made.diagnosis, "six")
    drawn(tmp_path / "observables.png")
    assert not list(tmp_path.glob(".*"))


def test_more_exposures_than_fit_go_to_a_second_page(made, tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "PER_PAGE", 4)
    pages = pictures.residuals(tmp_path, made.problem, made.diagnosis, "six")
    assert [p.name for p in pages] == ["residuals.png", "residuals-2.png"]
    assert all(p.is_file() for p in pages)


def test_the_longest_bar_is_the_named_effect_s(made, tmp_path):
    """The screen's colour reaches as far right as its probability; the camera's stays left of the prior."""
    pictures.save(pictures.probability(made.diagnosis, made.problem.catalogue, "six"), tmp_path / "p.png")
    picture = drawn(tmp_path / "p.png")
    reach = {}
    for element in ("screen", "camera"):
        # Labels are thin; a bar is several pixels high.
        ink = near(picture, pictures.ELEMENT_COLOURS[element]) | near(picture, _faded(element))
        bars = cv2.erode(ink.astype(np.uint8), np.ones((7, 7), np.uint8))
        reach[element] = np.flatnonzero(bars.any(axis=0)).max(initial=0)
    assert reach["screen"] > 0.8 * picture.shape[1] > 2 * reach["camera"] * 0.8 > 0


def _faded(element, alpha=0.85):
    colour = pictures.ELEMENT_COLOURS[element]
    return "#" + "".join(f"{round(alpha * int(colour[i : i + 2], 16) + (1 - alpha) * 255):02x}" for i in (1, 3, 5))


def test_the_located_stretch_lies_where_the_trace_lies(made, tmp_path):
    light = np.full((600, 800), 20.0)
    s = np.linspace(0, 620, 400)
    pixels = np.column_stack([np.linspace(100, 700, 400), np.full(400, 300.0)])
    ridge = pictures.Ridge("001.png", light, s, pixels)
    stretches = [replace(made.diagnosis.location.along_trace[0], kind="c")]
    pictures.located(tmp_path / "with.png", ridge, stretches, made.problem, made.diagnosis, "six")
    pictures.located(tmp_path / "without.png", ridge, (), made.problem, made.diagnosis, "six")
    a, b = drawn(tmp_path / "with.png"), drawn(tmp_path / "without.png")
    assert a.shape == b.shape
    upper = (np.abs(a.astype(int) - b).max(axis=2) > 10)[: int(0.55 * len(a))]
    columns = np.flatnonzero(upper.any(axis=0))
    # 10 … 120 of 620 mm of a trace that runs over the picture from left to right.
    assert columns.min() > 0.08 * a.shape[1] and columns.max() < 0.45 * a.shape[1]
