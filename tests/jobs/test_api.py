"""What somebody at a prompt or in a notebook does with ``import benchsim as bs``, without naming a file to write."""

import copy
import inspect
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import benchsim as bs
from benchsim import jobs


@pytest.fixture(scope="module")
def fitted(rendered):
    return bs.fit(bs.load(rendered))


def test_every_command_is_a_function_of_its_name():
    assert set(jobs.__all__) <= set(bs.__all__) <= set(dir(bs))
    for name in jobs.__all__:
        assert inspect.signature(getattr(bs, name)).parameters
    with pytest.raises(AttributeError, match="no attribute 'wing'"):
        getattr(bs, "wing")  # noqa: B009


def test_no_function_hides_behind_a_room():
    """A room that is imported becomes an attribute of the package, and would take the place of a function."""
    rooms = {p.name for p in Path(bs.__file__).parent.iterdir() if p.is_dir()}
    assert not rooms & set(bs.__all__)


def test_the_import_brings_nothing_heavy():
    heavy = "numpy scipy cv2 matplotlib mitsuba drjit pandas dask typer rich".split()
    code = f"import sys, benchsim; print([m for m in {heavy!r} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_a_bench_changed_in_hand_is_rendered_without_a_file(small_bench, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    bench = bs.load(small_bench)
    wider = replace(bench, laser=replace(bench.laser, beam_diameter=12.0))
    made = bs.render(wider, seed=3, noise=False, setting_errors=False)
    assert made.laser.beam_diameter == 12.0 and (made.folder / made.exposures[0].image).is_file()
    assert not list(tmp_path.iterdir())
    kept = made.save(tmp_path / "kept")
    assert bs.load(tmp_path / "kept").exposures == kept.exposures == made.exposures
    with pytest.raises(bs.BenchsimError, match="not empty"):
        made.save(tmp_path / "kept")


def test_a_bench_is_saved_as_one(small_bench, tmp_path):
    bench = bs.load(small_bench)
    again = bs.load(bench.save(tmp_path / "bench").path)
    assert replace(again, path=bench.path, defaults_used=()) == replace(bench, defaults_used=())
    assert repr(bench).startswith("<Bench '") and "350" not in repr(bench) and len(repr(bench)) < 200


def test_pictures_from_elsewhere_are_saved_at_home(recording, tmp_path):
    made = bs.load(recording)
    (tmp_path / "there").mkdir()
    away = replace(made.exposures[0], image="../recording/001.png", dark="../recording/001-dark.png")
    moved = replace(made, exposures=(away,), path=tmp_path / "there" / "recording.toml")
    moved.save(tmp_path / "kept")
    assert {p.name for p in (tmp_path / "kept").iterdir()} == {"recording.toml", "marks.csv", "001.png", "001-dark.png"}
    bs.load(tmp_path / "kept")


def test_a_trace_is_a_table_and_a_picture(fitted):
    trace = fitted[0].trace
    table = trace.to_pandas()
    assert list(table.columns[:4]) == ["exposure", "ridge", "s_mm", "u_px"] and len(table) == len(trace)
    assert np.array_equal(table["z_mm"], trace.z_mm)
    axes = trace.plot()
    assert axes.get_xlabel() == "board y (mm)" and trace.plot(axes) is axes
    assert "profiles" in repr(trace) and len(repr(trace)) < 200


def test_results_are_said_in_a_line_and_shown_whole_in_a_notebook(fitted):
    assert len(fitted) == 1 and fitted[0].free[0].kind in ("ellipse", "hyperbola", "not determined")
    checked = bs.validate(fitted.recording)
    for result in (fitted, fitted[0], checked):
        assert len(repr(result)) < 200 and repr(result).startswith(f"<{type(result).__name__}: ")
    html = checked._repr_html_()
    assert "settings fitted" in html and html.count("data:image/png;base64,") == 2
    assert fitted.folder is None and "written" not in fitted.summary()


def test_results_can_be_pickled_and_copied(fitted):
    for result in (fitted, bs.validate(fitted.recording), fitted.recording):
        assert repr(pickle.loads(pickle.dumps(result))) == repr(copy.deepcopy(result)) == repr(result)


def test_progress_may_be_a_function_or_a_truth_value(rendered):
    told = []
    bs.fit(rendered, progress=lambda what, done: told.append(done))
    assert told == sorted(told) and told[-1] == 1.0
    bs.fit(rendered, progress=True)
