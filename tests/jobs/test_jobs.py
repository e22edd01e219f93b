"""The commands write what the design says, print what a terminal or a program can take, and start at once."""

import csv
import json
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchsim import jobs, trace

HEADER = "exposure,ridge,s_mm,u_px,v_px,y_mm,z_mm,sigma_mm,width_mm,flux,skewness,saturated"


def strict(text):
    """JSON without the NaN and Infinity that Python would write and no other program reads."""

    def refuse(word):
        pytest.fail(f"{word} is no JSON")

    return json.loads(text, parse_constant=refuse)


def shell(*args, cwd):
    script = Path(sys.executable).with_name("benchsim")
    command = [str(script)] if script.exists() else [sys.executable, "-m", "benchsim"]
    return subprocess.run([*command, *map(str, args)], cwd=cwd, capture_output=True, text=True, timeout=300)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.fixture(scope="module")
def told():
    """What `ran` tells of its progress."""
    return []


@pytest.fixture(scope="module")
def ran(rendered, tmp_path_factory, told):
    folder = tmp_path_factory.mktemp("ran") / "out"
    return jobs.run(rendered, folder, progress=lambda what, done: told.append((what, done)))


def check_trace(file, exposures):
    lines = file.read_text().splitlines()
    assert lines[0] == HEADER
    rows = list(csv.DictReader(lines))
    assert {row["exposure"] for row in rows} == set(exposures)
    main = [row for row in rows if row["ridge"] == "0"]
    assert len(main) > 100
    for row in rows:
        values = [float(row[key]) for key in HEADER.split(",")[1:]]
        assert np.isfinite(values).all() and float(row["sigma_mm"]) > 0
        assert abs(float(row["y_mm"])) <= 350 and abs(float(row["z_mm"])) <= 350
    for exposure in exposures:
        s = [float(row["s_mm"]) for row in main if row["exposure"] == exposure]
        assert all(a < b for a, b in pairwise(s)), "arc length increases along the trace"


def check_conics(data, exposures):
    assert data["format"] == "benchsim-conics/1"
    assert {row["exposure"] for row in data["conics"]} == set(exposures)
    for row in data["conics"]:
        assert {"ridge", "curve_sigma_mm", "coefficients", "covariance", "kind", "invariants"} <= set(row)
        assert np.shape(row["covariance"]) == (6, 6) and len(row["coefficients"]) == 6
        assert row["curve_sigma_mm"] > 0
        for invariant in row["invariants"].values():
            assert set(invariant) == {"value", "low95", "high95", "determined"}
    assert all("cone" in row for row in data["conics"] if row["ridge"] == 0)


def check_validation(data, exposures):
    assert data["format"] == "benchsim-validation/1"
    assert [row["exposure"] for row in data["exposures"]] == exposures
    for row in data["exposures"]:
        assert {"before", "after", "polygon_mm", "radius_mm", "agrees", "pulls"} <= set(row)
        assert row["agrees"] in (True, False, None)
        for side in (row["before"], row["after"]):
            assert set(side) == {"rms_mm", "rms_mrad", "chi2", "dof", "p_value"}
            assert 0 <= side["p_value"] <= 1
        assert row["after"]["chi2"] < row["before"]["chi2"]


def check_stamp(folder, command, inputs):
    stamp = strict((folder / "benchsim.json").read_text())
    assert stamp["command"] == command and set(stamp["inputs"]) == set(inputs)
    assert all(len(digest) == 64 for digest in stamp["inputs"].values())
    assert {"benchsim", "numpy", "mitsuba"} <= set(stamp["versions"]) and "defaults_used" in stamp


def test_render_writes_a_recording_and_nothing_else(rendered):
    assert names(rendered) == ["001-dark.png", "001.png", "benchsim.json", "marks.csv", "recording.toml"]
    check_stamp(rendered, "render", ["small.toml", "marks.csv"])
    text = (rendered / "recording.toml").read_text()
    assert "[render]" not in text and "setting_errors" not in text
    picture = cv2.imread(str(rendered / "001.png"), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (750, 1000) and picture.dtype == np.uint16


def test_the_pages_curves_lie_where_light_and_model_are(ran, rendered):
    """In the photograph's pixels: the trace on the line, the prediction after on it too, before where the model is."""
    x = strict((ran.folder / "page.json").read_text())["exposures"][0]
    measured, before, after = (np.array(x[f"{which}_px"]) for which in ("measured", "before", "after"))
    photograph = cv2.imread(str(rendered / "001.png"), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)

    def light(points):
        u, v = np.rint(points).astype(int).T
        return np.median(photograph[v, u])

    assert light(measured) > 2 * light(measured + np.array([8, 0]))
    assert np.abs(after - measured).max() < 0.2
    stated = trace.to_pixels(ran.fit.fitted[0].trace.pose, ran.validation.exposures[0].stated.points)
    apart = np.linalg.norm(before[:, None] - stated[None], axis=2).min(axis=1)
    step = np.linalg.norm(np.diff(stated, axis=0), axis=1).max()
    assert np.linalg.norm(before - measured, axis=1).max() > 2, "settings were off by what is seen"
    assert apart.max() < 0.3 + step / 2


def test_run_on_a_recording_writes_the_designs_files(ran):
    folder = ran.folder
    assert names(folder) == [
        "benchsim.json", "conics.json", "fig8.png", "overlay-001.png", "page.json", "photographs", "report.html",
        "residuals.png", "summary.txt", "trace.csv", "validation.json",
    ]  # fmt: skip
    check_trace(folder / "trace.csv", ["001.png"])
    check_conics(strict((folder / "conics.json").read_text()), ["001.png"])
    check_validation(strict((folder / "validation.json").read_text()), ["001.png"])
    check_stamp(folder, "run", ["recording.toml", "marks.csv", "001.png", "001-dark.png"])
    for name in ("fig8.png", "overlay-001.png", "residuals.png"):
        assert cv2.imread(str(folder / name)).shape[1] > 500


def test_progress_names_every_picture_and_never_goes_back(ran, told):
    done = [d for _, d in told]
    assert done == sorted(done) and done[-1] == 1
    late = [what for what, d in told if 0.9 <= d < 1]
    assert late == [
        "drawing 001.png", "drawing the residuals", "drawing the traces", "photographs for the page",
        "writing the page",
    ]  # fmt: skip
    assert len({d for d in done if d >= 0.9}) >= 5


def test_the_page_says_how_far_settings_were_off_in_mm_and_mrad(ran):
    x = strict((ran.folder / "page.json").read_text())["exposures"][0]
    found = ran.validation.exposures[0]
    azimuth = x["departures"]["laser_azimuth"]
    assert azimuth["unit"] == "mrad" and azimuth["value"] == pytest.approx(1e3 * found.bench.theta[5])
    assert x["departures"].keys() == found.bench.pulls.keys()
    assert x["profiles"] / len(x["s_mm"]) >= 4
    html = (ran.folder / "report.html").read_text()
    assert "laser&#39;s azimuth" in html and "neighbouring profiles" in html and "laser_azimuth" not in html


def test_the_vector_model_agrees_with_a_rendered_recording(ran):
    """The settings were drawn from [uncertainty]: mm before, and afterwards explained (p > 1e-4, false alarm 1e-4)."""
    row = ran.validation.as_dict()["exposures"][0]
    assert row["converged"] and row["after"]["p_value"] > 1e-4
    assert row["before"]["rms_mm"] > 0.5 and row["after"]["rms_mm"] < 0.05
    # Fig. 7(a): what the radius is worth, both ways (design: 8.0 mm rms, at most 0.12 mm).
    assert row["radius_mm"] == pytest.approx(8.0, abs=0.1) and 0 < row["radius_own_aim_mm"] < 0.12


def test_the_summary_fits_a_terminal(ran):
    text = ran.summary()
    assert max(map(len, text.replace(str(ran.folder), "out").splitlines())) <= 80
    assert (ran.folder / "summary.txt").read_text() == text + "\n"


def test_a_run_on_a_bench_replaces_the_folder_of_an_earlier_run(small_bench, ran, tmp_path, monkeypatch):
    """A bench file is rendered into the folder first; the default folder is named after the file."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ran.folder, "small-run")
    (tmp_path / "small-run" / "left-over.txt").write_text("from before")
    done = jobs.run(small_bench)
    assert str(done.folder) == "small-run" and done.rendered and not ran.rendered
    assert "left-over.txt" not in names(tmp_path / "small-run") and names(tmp_path) == ["small-run"]
    assert names(tmp_path / "small-run" / "recording") == ["001-dark.png", "001.png", "marks.csv", "recording.toml"]
    check_stamp(tmp_path / "small-run", "run", ["small.toml", "marks.csv"])
    # One seed, one recording: only the order of threads moves the last bits.
    before, after = (np.median(r.fit.fitted[0].trace.points, axis=0) for r in (ran, done))
    assert after == pytest.approx(before, abs=0.01)


def test_a_piped_command_prints_strict_json_and_no_progress(recording):
    done = shell("validate", "recording", "--json", cwd=recording.parent)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "\x1b" not in done.stdout
    check_validation(strict(done.stdout), ["001.png"])
    assert names(recording.parent) == ["recording", "recording-validate"]
    assert names(recording.parent / "recording-validate") == [
        "benchsim.json", "fig8.png", "overlay-001.png", "residuals.png", "validation.json"
    ]  # fmt: skip


def test_a_lost_exposure_is_dropped_and_said(recording, tmp_path):
    """Two exposures, one of them without light: the other is fitted, the loss is in the result, the files, the text."""
    text = (recording / "recording.toml").read_text()
    block = text[text.index("[[exposure]]") :]
    (recording / "recording.toml").write_text(text + "\n" + block.replace("001", "002"))
    for name in ("001-dark.png", "001.png"):
        (recording / name.replace("001", "002")).write_bytes((recording / "001-dark.png").read_bytes())
    done = jobs.fit(recording, tmp_path / "out")
    assert len(done.lost) == 1 and done.lost[0].startswith("002.png: no trace")
    assert "lost: 002.png" in done.summary()
    data = strict((tmp_path / "out" / "conics.json").read_text())
    check_conics(data, ["001.png"])
    assert data["lost"] == list(done.lost)
    assert names(tmp_path / "out") == ["benchsim.json", "conics.json", "overlay-001.png", "trace.csv"]
    (recording / "001.png").write_bytes((recording / "001-dark.png").read_bytes())
    with pytest.raises(ValueError, match="no exposure gives a trace"):
        jobs.fit(recording, tmp_path / "out")
    assert "overlay-001.png" in names(tmp_path / "out"), "the older result stays"


def test_a_single_image_is_fitted_in_pixels(rendered, ran, tmp_path):
    """Pixels of the ridge are those of the full fit; nothing is said in mm."""
    done = jobs.fit(rendered / "001.png", tmp_path / "out", pixels=True)
    data = strict((tmp_path / "out" / "conics.json").read_text())
    assert data["unit"] == "px" and len(data["conics"]) == 1
    assert "_mm" not in json.dumps(data) and data["conics"][0]["curve_sigma_px"] > 0
    lines = (tmp_path / "out" / "trace.csv").read_text().splitlines()
    assert lines[0].startswith("ridge,s_px,u_px,v_px,sigma_px")
    full = ran.fit.fitted[0].trace
    rows = np.array([[float(x) for x in line.split(",")] for line in lines[1:]])
    inside = (rows[:, 3] > full.v_px.min()) & (rows[:, 3] < full.v_px.max())
    order = np.argsort(full.v_px)
    off = rows[inside, 2] - np.interp(rows[inside, 3], full.v_px[order], full.u_px[order])
    # Without the dark picture a mark's print is in the way; most of the ridge is not.
    assert np.median(np.abs(off)) < 0.1
    assert names(tmp_path / "out") == ["benchsim.json", "conics.json", "overlay-001.png", "trace.csv"]
    assert "px" in done.summary() and "mm" in done.summary()


def test_help_answers_at_once(tmp_path):
    """Under 1.5 s of CPU, and without what only the work needs."""
    code = (
        "import resource, sys, typer\n"
        "from benchsim import cli\n"
        "sys.argv = ['benchsim', '--help']\n"
        "try:\n    cli.main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "heavy = {'mitsuba', 'drjit', 'cv2', 'matplotlib', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
        "used = resource.getrusage(resource.RUSAGE_SELF)\n"
        "print('CPU', used.ru_utime + used.ru_stime)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert all(f" {command} " in done.stdout for command in ("run", "render", "fit", "validate"))
    assert float(done.stdout.rsplit("CPU", 1)[1]) < 1.5


def test_the_default_is_both_settings_of_figure_7():
    from benchsim.jobs.running import _figure7

    both, inputs = _figure7()
    assert [e.setting for e in both.exposures] == ["7a", "7b"]
    assert [e.mirror_position[1] for e in both.exposures] == [-160.0, -450.0]
    assert {p.name for p in inputs} == {"fig7a.toml", "fig7b.toml", "marks.csv"}


@pytest.mark.slow
def test_the_main_job_at_full_size(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = jobs.run()
    check_trace(tmp_path / "fig7-run" / "trace.csv", ["001.png", "002.png"])
    check_validation(done.validation.as_dict(), ["001.png", "002.png"])
