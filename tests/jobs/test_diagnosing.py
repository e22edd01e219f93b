"""The diagnose and effects commands: what they write and when, what they say of poor recordings, and what they refuse.

Plumbing is tested with a diagnosis that finds a stated effect without looking, so that it is quick; what the diagnosis
itself finds is tested where it lives, and end to end below on a recording of one exposure.
"""

import json
import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from benchsim import jobs
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read, write
from benchsim.cli import app
from benchsim.diagnosis.result import (
    Class,
    Diagnosis,
    Found,
    HeldOut,
    Law,
    Limit,
    Location,
    Residuals,
    Size,
    SplitBy,
    Stretch,
)
from benchsim.jobs import diagnosing, diagnosis_drawing, effect_catalogue
from benchsim.jobs.workers import Workers

SHARED = Path(__file__).resolve().parents[3] / "shared" / "recordings" / "bench-other-code"


def bowed(problem, progress=None):
    """A diagnosis that names a bow of the board and looks at nothing."""
    n = len(problem.data)
    s = problem.position[(problem.block == 0) & (problem.kind == "c")]
    sigma = np.sqrt(np.concatenate([np.diag(c) for c in problem.covariance]))
    bow = Found("screen-bow", "screen", 0.999, "named", {"bow_z": Size(0.03, 0.001, "1/m")}, "It is bent.", "Brace it.")
    return Diagnosis(
        verdict="named", effects=(bow,), classes=(), law=None, rms={"c": (0.3, 0.04)}, held_out=None, pulls={},
        location=Location(
            "screen", "place on the board", True, 9.0, (Stretch(problem.names[0], s[2], s[9], 7.1, "c"),)
        ),
        limits={"beam-offset": Limit("bu", 1.3, "mm", True)}, next=(), sigma_scale=1.0, correlation=0.0,
        setting_scale=1.0, probability={"screen-bow": 0.999}, values={"bow_z": 0.03},
        residuals=Residuals(3 * sigma, sigma, np.full(n, np.nan), np.full(n, np.nan), sigma),
    )  # fmt: skip


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(diagnosing.diagnosis, "diagnose", bowed)
    monkeypatch.setattr(diagnosis_drawing, "draw_pixels", lambda *_: ())


def edit(folder, old, new):
    file = folder / "recording.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def doubled(folder, setting, **changes):
    """The recording with its exposure a second time, under another image's name."""
    for name in ("001.png", "001-dark.png"):
        shutil.copy(folder / name, folder / name.replace("001", "002"))
    stated = read(folder)
    again = replace(stated.exposures[0], setting=setting, image="002.png", dark="002-dark.png", **changes)
    write(replace(stated, exposures=(*stated.exposures, again)), folder / "recording.toml")


def test_the_folder_holds_json_text_amended_and_pictures(recording, tmp_path, quick):
    result = jobs.diagnose(recording, tmp_path / "out")
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {
        "diagnosis.json", "summary.txt", "amended.toml", "marks.csv", "benchsim.json",
        "residuals.png", "observables.png", "probability.png", "located-001.png",
        "page.json", "photographs", "report.html",
    }  # fmt: skip
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert written == json.loads(json.dumps(result.as_dict()))
    assert written["format"] == "benchsim-diagnosis/1" and written["effects"][0]["parameters"]["bow_z"]["value"] == 0.03
    assert written["against"] == "bench" and "exposure[1].facet" not in str(written["defaults_used"])
    text = (tmp_path / "out" / "summary.txt").read_text()
    assert "screen-bow" in text and "One exposure alone" in text and "amended.toml holds" in text
    stamp = json.loads((tmp_path / "out" / "benchsim.json").read_text())
    assert stamp["command"] == "diagnose" and stamp["options"]["against"] == "bench"


@pytest.fixture
def no_mitsuba(monkeypatch):
    """Neither Mitsuba nor Dr.Jit can be imported, and nothing that has imported them is known."""
    for name in [m for m in sys.modules if m.startswith("benchsim.renderer")]:
        monkeypatch.delitem(sys.modules, name)
    for name in ("mitsuba", "drjit"):
        monkeypatch.setitem(sys.modules, name, None)


def test_without_mitsuba_all_is_said_but_the_pixels(recording, tmp_path, monkeypatch, no_mitsuba):
    monkeypatch.setattr(diagnosing.diagnosis, "diagnose", bowed)
    result = jobs.diagnose(recording, tmp_path / "out")
    (sentence,) = result.not_drawn
    assert sentence.startswith("nothing can be rendered here: Mitsuba cannot be loaded")
    assert (tmp_path / "out" / "report.html").exists() and not (tmp_path / "out" / "pixels.png").exists()
    jobs.validate(recording)
    with pytest.raises(BenchsimError, match="Mitsuba cannot be loaded"):
        jobs.render(recording, tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_a_diagnosis_without_a_folder_is_all_in_hand(recording, tmp_path, quick, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = jobs.diagnose(read(recording))
    assert result.verdict == "named" and result.effects[0].parameters["bow_z"].value == 0.03
    assert result.amended.effects == {"screen-bow": {"bow_z": 0.03}} and "written" not in result.summary()
    assert len(result.plot_residuals().axes) == 1 and len(result.figures()) == 2
    assert "screen-bow" in result._repr_html_() and len(repr(result)) < 200
    assert repr(pickle.loads(pickle.dumps(result))) == repr(result)
    assert {p.name for p in tmp_path.iterdir()} == {"recording"}


def test_the_amended_file_is_diagnosed_as_it_stands(recording, tmp_path, quick):
    jobs.diagnose(recording, tmp_path / "deep" / "out", pictures=False)
    amended = tmp_path / "deep" / "out" / "amended.toml"
    assert read(amended).effects == {"screen-bow": {"bow_z": 0.03}}
    again = jobs.diagnose(amended, tmp_path / "again", pictures=False)
    assert again.amended.effects["screen-bow"]["bow_z"] == pytest.approx(0.06)
    assert read(tmp_path / "again" / "amended.toml", images=True).exposures[0].image == "../recording/001.png"
    with pytest.raises(BenchsimError, match=r"holds the input amended\.toml"):
        jobs.diagnose(amended, tmp_path / "deep" / "out")


def test_results_lie_in_the_folder_before_pictures_are_begun(recording, tmp_path, quick, monkeypatch):
    """A picture that fails, or a person who stops it, costs no result; nothing is half-written."""
    seen = []

    def stopped(path, *_):
        seen.extend(sorted(p.name for p in Path(path).iterdir()))
        raise KeyboardInterrupt

    monkeypatch.setattr(diagnosing.pictures, "residuals", stopped)
    with pytest.raises(KeyboardInterrupt):
        jobs.diagnose(recording, tmp_path / "out")
    assert seen == ["amended.toml", "benchsim.json", "diagnosis.json", "marks.csv", "summary.txt"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == seen
    assert not list(tmp_path.glob(".out*"))


def test_a_render_that_is_not_to_be_had_costs_a_picture_only(recording, tmp_path, quick, monkeypatch):
    def refuse(*_):
        raise BenchsimError("no usable back end; install LLVM")

    monkeypatch.setattr(diagnosis_drawing, "draw_pixels", refuse)
    result = jobs.diagnose(recording, tmp_path / "out")
    assert "not drawn: no usable back end" in result.summary() and (tmp_path / "out" / "probability.png").is_file()


def test_against_vector_writes_its_physics(recording, tmp_path, quick):
    result = jobs.diagnose(recording, tmp_path / "out", against="vector", pictures=False)
    assert "facets" in {e.name for e in result.problem.catalogue}
    physics = read(tmp_path / "out" / "amended.toml").physics
    assert not (physics.facets or physics.beam or physics.diffraction)
    with pytest.raises(BenchsimError, match="--against paper"):
        jobs.diagnose(recording, tmp_path / "other", against="paper")
    assert not (tmp_path / "other").exists()


def test_facets_that_were_found_come_with_millimetres(recording, tmp_path, quick, monkeypatch):
    def faceted(problem, progress=None):
        found = Found("facets", "mirror", 0.999, "named", {"facets": Size(0.98, 0.01, "1")}, "It is cut.", "State it.")
        return replace(bowed(problem), effects=(found,), values={"facets": 0.98})

    monkeypatch.setattr(diagnosing.diagnosis, "diagnose", faceted)
    result = jobs.diagnose(recording, tmp_path / "out", against="vector", pictures=False)
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())["effects"][0]["parameters"]
    size = written["size_mm"]
    assert size["unit"] == "mm" and 0.001 < size["value"] < 5
    assert size["sigma"] == pytest.approx(size["value"] * 0.01 / 0.98)
    text = " ".join((tmp_path / "out" / "summary.txt").read_text().split())
    assert "share of the facets (facets) 0.980 ± 0.010, shift of the trace, rms (size_mm) " in text
    assert "Alone it moves" not in text, "it is said once"
    assert read(tmp_path / "out" / "amended.toml").effects == {"facets": {"facets": 0.98}}
    edit(recording, "[[exposure]]", f"[effects.facets]\nfacets = 0.98\nsize_mm = {size['value']}\n\n[[exposure]]")
    assert jobs.diagnose(recording, tmp_path / "again", pictures=False).recording.effects["facets"]["size_mm"] > 0
    assert result.diagnosis.effects[0].parameters["size_mm"].unit == "mm"


def test_a_bow_that_was_found_comes_with_millimetres_at_the_edge_and_on_the_trace(recording, tmp_path, quick):
    """A board of 700 mm with 0.03 1/m stands ½ · 0.03 · 0.35² m off at its edge; the trace moves by a part of that."""
    result = jobs.diagnose(recording, tmp_path / "out", pictures=False)
    text = " ".join(result.text().split())
    assert "0.0300 ± 0.0010 1/m, which is 1.837 ± 0.061 mm at the board's upper and lower edges" in text
    size, how = result.moves["screen-bow"]
    assert 0.01 < size.value < 1.8 and size.sigma == pytest.approx(size.value / 30, rel=0.01) and how.startswith("rms")
    page = json.loads((tmp_path / "out" / "page.json").read_text())
    assert page["moves"]["screen-bow"] == {"value": size.value, "sigma": size.sigma, "unit": "mm", "how": how}
    setting = next(p for p in result.problem.nuisances if p.name.endswith(".laser_azimuth"))
    assert page["priors"][setting.name] == {"sigma": setting.sigma, "unit": "mrad"}
    html = (tmp_path / "out" / "report.html").read_text()
    assert "1.837 ± 0.061 mm at the board" in html and "alone, on the trace" in html


def test_effects_that_the_recording_cannot_show_are_said_with_the_reason(recording, tmp_path, quick):
    edit(recording, "gamma = 1.0", 'gamma = "unknown"')
    result = jobs.diagnose(recording, tmp_path / "out", pictures=False)
    words = " ".join(result.text().split())
    assert "Not judged here: facets, finite-beam and diffraction (already in the simulation), " in words
    assert "saturation and vibration (no camera's gamma is known)" in words
    assert "drift (all exposures are of one time)" in words
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [r for r in written["remarks"] if r.startswith("Not judged here: ")]


def keys(plain, named=frozenset({"parameters", "limits", "probability", "pulls", "rms", "terms", "by_kind"})):
    """Every key of a JSON value that the format fixes; what stands under those of ``named`` are names of things."""
    found = set()
    for key, value in plain.items() if isinstance(plain, dict) else ():
        of_things = key in named and isinstance(value, dict)
        found |= {key}.union(*map(keys, value.values() if of_things else (value,)))
    for value in plain if isinstance(plain, list) else ():
        found |= keys(value)
    return found


def test_the_page_of_the_method_lists_every_key(recording, tmp_path, quick):
    """Every key of a diagnosis.json that holds all there can be stands in the table of diagnosis/README.md."""
    page = (Path(diagnosing.__file__).parents[1] / "diagnosis" / "README.md").read_text()
    table = [row for row in page.split("## What `diagnosis.json` holds")[1].splitlines() if row.startswith("|")]
    result = jobs.diagnose(recording, tmp_path / "out", pictures=False)
    split = SplitBy("recording", "Roll the screen.", 9.0)
    knots = np.zeros((1, 1))
    full = replace(
        result.diagnosis,
        classes=(Class((("canting",), ()), 0.99, split),),
        law=Law("screen.height", "z", {"z": 1.0}, 0.9, 0.1, knots, np.zeros(1, int), np.zeros(1)),
        held_out=HeldOut(3, 816, 5120.0, 60.0, 41.0),
        next=(split,),
    )
    written = json.loads(json.dumps(replace(result, diagnosis=full).as_dict()))
    assert written["law"] and written["classes"] and written["next"] and written["fit"]["held_out"]
    missing = {key for key in keys(written) if f"`{key}`" not in "\n".join(table)}
    assert not missing


def test_equal_settings_are_said(recording, tmp_path, quick):
    doubled(recording, "another name")
    text = jobs.diagnose(recording, tmp_path / "out", pictures=False).text()
    assert "All settings are equal" in text and "2 exposures of 2 settings" in text


def test_one_setting_in_two_boards_is_said(recording, tmp_path, quick):
    doubled(recording, read(recording).exposures[0].setting, screen_shift=5.0, time=60.0)
    assert "All exposures are of one setting" in jobs.diagnose(recording, tmp_path / "out", pictures=False).text()


def test_a_lost_trace_is_dropped_and_said(recording, tmp_path, quick):
    doubled(recording, "s2", laser_azimuth=read(recording).exposures[0].laser_azimuth + 0.02)
    shutil.copy(recording / "002-dark.png", recording / "002.png")
    result = jobs.diagnose(recording, tmp_path / "out")
    assert result.problem.names == ("001.png",) and len(result.lost) == 1
    assert "Dropped: 002.png: no trace" in result.text()
    assert json.loads((tmp_path / "out" / "diagnosis.json").read_text())["lost"] == list(result.lost)


def test_marks_that_are_missing_in_an_image_are_said(recording, tmp_path, quick):
    marks = read(recording).screen.marks
    for name in ("001.png", "001-dark.png"):
        picture = cv2.imread(str(recording / name), cv2.IMREAD_UNCHANGED)
        picture[:, : int(0.42 * picture.shape[1])] = 4000
        assert cv2.imwrite(str(recording / name), picture)
    result = jobs.diagnose(recording, tmp_path / "out", pictures=False)
    (said,) = [r for r in result.remarks if "Marks are missing" in r]
    assert "001.png" in said and f"of {len(marks.ids)}" in said


def test_uncertainties_left_out_are_listed(recording, tmp_path, quick):
    text = (recording / "recording.toml").read_text()
    head, _, rest = text.partition("[uncertainty]")
    (recording / "recording.toml").write_text(head + rest[rest.index("[[exposure]]") :])
    result = jobs.diagnose(recording, tmp_path / "out", pictures=False)
    for key in ("mirror_position_mm = 1.0", "mirror_axis_mrad = 1.745", "laser_direction_mrad = 1.745"):
        assert f"uncertainty.{key}" in " ".join(result.text().split())


def test_an_unknown_effect_in_the_file_names_the_nearest(recording, tmp_path):
    edit(recording, "[[exposure]]", "[effects.screen-bend]\nbow_y = 0.01\n\n[[exposure]]")
    with pytest.raises(BenchsimError, match=r"recording.toml: effects.screen-bend: no such effect.*screen-bow"):
        jobs.diagnose(recording, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_to_diagnose_exits_with_one_sentence(recording, tmp_path):
    shutil.copy(recording / "001-dark.png", recording / "001.png")
    done = CliRunner().invoke(app, ["diagnose", str(recording), "-o", str(tmp_path / "out")])
    assert done.exit_code == 1 and not (tmp_path / "out").exists()
    assert done.stderr.count("\n") == 1 and "001.png" in done.stderr and "no trace" in done.stderr


def test_the_command_takes_its_options(recording, tmp_path, quick):
    arguments = ["diagnose", str(recording), "-o", str(tmp_path / "out"), "--against", "vector", "--no-pictures"]
    done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["against"] == "vector"
    assert not list((tmp_path / "out").glob("*.png"))
    assert CliRunner().invoke(app, ["diagnose", str(recording), "--against", "paper"]).exit_code == 2


def test_the_catalogue_fits_a_terminal_and_names_every_effect():
    done = CliRunner().invoke(app, ["effects"])
    assert done.exit_code == 0 and max(map(len, done.stdout.splitlines())) <= 100
    plain = json.loads(CliRunner().invoke(app, ["effects", "--json"]).stdout)
    assert len(plain["effects"]) == len(effect_catalogue.bench_effects.CATALOGUE)
    words = " ".join(done.stdout.split())
    for effect in plain["effects"]:
        assert effect["name"] in words and effect["says"] in words and effect["drawn"] in words
        for parameter, own in effect["parameters"].items():
            assert f"{parameter} " in words and own["cap"] > 0


@pytest.fixture(scope="module")
def plan(small_bench):
    """The isolability of one setting, in this process."""
    return jobs.effects(small_bench)


def test_isolability_before_any_data(plan, small_bench, tmp_path):
    text = plan.summary()
    assert max(map(len, text.splitlines())) <= 100
    # Both only widen a trace that is not gated; marks tell a bow from a beam's direction.
    assert plan.separation["facet-tilts", "axis-wobble"] < 3 < 9 < plan.separation["screen-bow", "beam-direction"]
    words = " ".join(text.split("Not told apart")[1].split())
    assert "axis-wobble / facet-tilts" in words or "facet-tilts / axis-wobble" in words
    for (a, _), apart in plan.separation.items():
        assert 0 <= apart <= min(effect_catalogue.TOLD_AT, 1e6 * plan.at_cap[a]) * (1 + 1e-6)
    for name, sigma in plan.at_cap.items():
        own = [v for k, v in plan.limits.items() if k.split(".")[0] == name]
        assert own and (sigma > 5) == all(v.reachable for v in own), name
    plain = json.loads(json.dumps(plan.as_dict(), allow_nan=False))
    assert plain["at_cap_sigma"].keys() == plain["separation_sigma"].keys()
    blind = {n for n in plan.at_cap if not any(v.reachable for k, v in plan.limits.items() if k.split(".")[0] == n)}
    assert blind and all(n in text.split("Not visible at any plausible size")[1] for n in blind)


def test_workers_and_this_process_give_the_same_limits(plan, small_bench, monkeypatch):
    monkeypatch.setattr(Workers, "spread", lambda self, *a: list(map(*a)))
    alone = effect_catalogue.isolability(read(small_bench, images=False))
    assert {k: v.five_sigma for k, v in alone.limits.items()} == pytest.approx(
        {k: v.five_sigma for k, v in plan.limits.items()}, rel=1e-6
    )


def test_one_exposure_from_photograph_to_diagnosis_and_back(recording, tmp_path):
    """End to end: a clean exposure alone is not accused, and renders like its photograph. What seven numbers set once
    say of how well they are set leaves that open."""
    result = jobs.diagnose(recording, tmp_path / "out")
    assert not result.diagnosis.effects and result.diagnosis.held_out is None
    assert {m for c in result.diagnosis.classes for m in c.members} <= {(), ("setting-errors",)}
    assert result.diagnosis.limits and "One exposure alone" in result.text()
    pixels = json.loads((tmp_path / "out" / "pixels.json").read_text())
    assert pixels["exposures"][0]["pixels"] > 1000 and 0.85 < pixels["pooled"]["after"] < 1.2
    assert (tmp_path / "out" / "pixels.png").is_file()


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="recordings of other code are not here")
@pytest.mark.parametrize("name", ["clean-f7", "known-six"])
def test_recordings_made_by_other_code(name, tmp_path):
    """A clean recording is not accused; a bow is named, with the size that it has."""
    result = jobs.diagnose(SHARED / name, tmp_path / "out")
    d = result.diagnosis
    if name == "clean-f7":
        assert d.verdict == "nothing-missing" and len(d.limits) > 20
        return
    assert d.verdict == "named" and [f.name for f in d.effects] == ["screen-bow"]
    assert len(json.loads((tmp_path / "out" / "pixels.json").read_text())["exposures"]) == 1
    (bow,) = json.loads((SHARED / "truth" / "known-six.json").read_text())["effects"]
    for key, size in d.effects[0].parameters.items():
        assert abs(size.value - bow["parameters"][key]["value"]) < 3 * size.sigma
