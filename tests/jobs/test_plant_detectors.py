"""``benchsim detectors``: planned, a record simulated, and the same record read back by the command alone."""

import csv
import json

import h5py
import numpy as np
import pytest
from scipy.io import wavfile
from typer.testing import CliRunner

import benchsim as bs
from benchsim.cli import app

NOON = "2026-03-21T12:00"
TEXT = """\
format = "benchsim-plant/1"
title = "Six"
[site]
latitude_deg = 37.0
longitude_deg = -2.0
time_zone = "Europe/Madrid"
[[receiver]]
name = "receiver"
centre_m = [0.0, 0.0, 40.0]
width_m = 2.0
height_m = 2.0
[optics]
slope_mrad = 1.0
reflectance = 0.9
[heliostats]
width_m = 4.0
height_m = 3.0
[errors]
IA_sigma_mrad = 1.0
IE_sigma_mrad = 1.0
[prisms]
record_s = 2.5
longest_s = 8
"""
ARRAY = '[[detector]]\nname = "{}"\nalong = "{}"\noffset_m = 3\nfrom_m = -8\nto_m = 8\npitch_m = 0.35\n'
PLACES = ((0, 70), (20, 80), (-35, 90), (45, 60), (-10, 110), (60, 100))


def run(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    folder = tmp_path_factory.mktemp("detectors") / "plant"
    folder.mkdir()
    text = TEXT + ARRAY.format("above", "horizontal") + ARRAY.format("left", "vertical")
    (folder / "plant.toml").write_text(text)
    rows = [f"H{k},{e},{n},2.5" for k, (e, n) in enumerate(PLACES)]
    (folder / "heliostats.csv").write_text("\n".join(["id,east_m,north_m,up_m", *rows]))
    return folder


@pytest.fixture(scope="module")
def planned(plant, tmp_path_factory):
    """Written with `plan` left out."""
    out = tmp_path_factory.mktemp("detectors") / "out"
    done = run("detectors", plant, "--at", NOON, "--record", NOON, "--seed", 3, "-o", out)
    assert done.exit_code == 0, done.output
    return out, done.output


def test_a_plan_says_who_is_seen_and_what_a_record_gives(planned):
    out, said = planned
    assert "none beat or share a harmonic" in said and "measured 6" in said and "next: benchsim detectors read" in said
    plain = json.loads((out / "detectors.json").read_text())
    assert plain["share_seen"] == 1 and plain["record"]["outcomes"] == {"measured": 6}
    assert plain["record"]["largest_after_mrad"] < 0.1 < plain["record"]["largest_before_mrad"]
    rows = list(csv.DictReader((out / "heliostats.csv").open()))
    assert len(rows) == 6 and all(float(r["sigma_azimuth_mrad"]) < 0.1 for r in rows)
    assert sum(a["along"] == "vertical" for a in plain["arrays"]) == 1 and (out / "plan.png").stat().st_size > 10_000


def test_who_is_never_seen_is_told_why(plant, tmp_path):
    """One that aims at a receiver that looks south, and one close behind another; of the six before all are seen."""
    (tmp_path / "heliostats.csv").write_text((plant / "heliostats.csv").read_text())
    south = '[[receiver]]\nname = "south"\ncentre_m = [0, 0, 40]\nwidth_m = 2\nheight_m = 2\nazimuth_deg = 180\n'
    file = tmp_path / "plant.toml"
    file.write_text((plant / "plant.toml").read_text().replace("[optics]", f"{south}[optics]"))
    with (tmp_path / "heliostats.csv").open("a") as table:
        table.write("\nS,0,-60,2.5\nH8,0,72.5,2.5")
    result = bs.detectors(tmp_path, at=NOON)
    says = {r["id"]: r["says"] for r in result.rows()}
    assert says["S"] == "aimed at another receiver than the arrays'" and says["H3"] == "seen"
    assert says["H8"] == "not seen: hidden by another mirror"
    never = next(x for x in result.text().splitlines() if "never seen" in x)
    assert "never seen: 2 (" in never and "1 aimed at another receiver" in never
    file.write_text(file.read_text().replace("latitude_deg = 37.0", "latitude_deg = 62.0"))
    assert "never stands high enough for a plant: 2026-12-21" in bs.detectors(tmp_path, step=6.0).text()


def test_errors_are_as_large_as_their_sigma_says(planned):
    """12 angles: the chance of an rms beyond these bounds is 1e-4, were they independent and normal."""
    rows = json.loads((planned[0] / "detectors.json").read_text())["record"]["heliostats"]
    kinds = ("elevation", "azimuth")
    pulls = np.array([[(r[f"{k}_mrad"] - r[f"true_{k}_mrad"]) / r[f"sigma_{k}_mrad"] for k in kinds] for r in rows])
    assert 0.35 < np.sqrt((pulls**2).mean()) < 2.0


def test_a_record_is_read_back_by_the_command_alone(plant, planned, tmp_path):
    out, _ = planned
    done = run(
        "detectors", "read", out / "record.wav", plant, "--at", NOON, "--labels", out / "heliostats.csv",
        "-o", tmp_path / "r",
    )  # fmt: skip
    assert done.exit_code == 0 and "measured 6" in done.output, done.output
    with (tmp_path / "r" / "measured.csv").open() as a, (out / "measured.csv").open() as b:
        for read, simulated in zip(csv.DictReader(a), csv.DictReader(b), strict=True):
            assert float(read["raise_mrad"]) == pytest.approx(float(simulated["raise_mrad"]), abs=2e-4)


def test_a_table_of_some_detectors_is_read_too(plant, planned, tmp_path):
    """Any unit, a detector that never changes, others that are missing; the other way round in time all is lost."""
    rate, data = wavfile.read(planned[0] / "record.wav")
    kept = [k for k in range(data.shape[1]) if k % 7]
    table = np.column_stack([np.arange(len(data)) / rate, 1e3 * data[:, kept]])
    table[:, 5] = 1.0
    head = "time_s," + ",".join(f"detector_{k + 1}" for k in kept)
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header=head, comments="", fmt="%.7g")
    result = bs.detectors_read(tmp_path / "r.csv", plant, at=NOON)
    assert {r["outcome"] for r in result.rows} == {"measured"}
    assert "never change" in result.summary() and "are not in the record" in result.summary()
    late = bs.detectors_read(tmp_path / "r.csv", plant, at="2026-03-21T14:30")
    assert {r["outcome"] for r in late.rows} != {"measured"} and late.remarks
    # Nobody should turn mirrors by what contradicts.
    assert "turn nothing" in late.summary() and "turn normals" not in late.summary()
    assert "turn normals" in result.summary() and "clipped" not in result.summary()
    flat = np.minimum(table, np.r_[np.inf, np.quantile(table[:, 1:], 0.9, axis=0)])
    np.savetxt(tmp_path / "f.csv", flat, delimiter=",", header=head, comments="", fmt="%.7g")
    assert "clipped" in bs.detectors_read(tmp_path / "f.csv", plant, at=NOON).summary()
    assert result._repr_html_().count("data:image/png;base64,") == 1


@pytest.mark.parametrize("layout", ["samples", "columns"])
def test_hdf5_says_what_the_wav_says(plant, planned, tmp_path, layout):
    rate, data = wavfile.read(planned[0] / "record.wav")
    with h5py.File(tmp_path / "r.h5", "w", userblock_size=512 if layout == "samples" else 0) as file:
        if layout == "samples":
            file.create_dataset("samples", data=data, compression="gzip").attrs["rate_hz"] = rate
        else:
            file["time_s"] = np.arange(len(data)) / rate
            for k in reversed(range(data.shape[1])):
                file[f"detector_{k + 1}"] = data[:, k]
        file["operator"] = "not a column"
    files = planned[0] / "record.wav", tmp_path / "r.h5"
    expected, found = (bs.detectors_read(file, plant, at=NOON).rows for file in files)
    for a, b in zip(expected, found, strict=True):
        assert a["outcome"] == b["outcome"] and b["raise_mrad"] == pytest.approx(a["raise_mrad"], abs=1e-6)


def put_link(file, elsewhere):
    file["detector_1"] = h5py.ExternalLink(str(elsewhere), "detector_1")


def put_raw(file, elsewhere):
    file.create_dataset("detector_1", (300,), "f8", external=[(str(elsewhere), 0, 2400)])


def put_view(file, elsewhere):
    layout = h5py.VirtualLayout((300,), "f8")
    layout[:] = h5py.VirtualSource(str(elsewhere), "detector_1", (300,))
    file.create_virtual_dataset("detector_1", layout)


def put_bomb(file, elsewhere):
    file.create_dataset("samples", (2**40, 3), "u1", chunks=(1024, 3), compression="gzip")


def put_chunk(file, elsewhere):
    file.create_dataset("samples", (300, 3), "u1", maxshape=(None, 3), chunks=(2**25, 3), compression="gzip")


def put(rate=None, **datasets):
    def into(file, elsewhere):
        for name, values in datasets.items():
            file[name] = values
        if rate is not None:
            file.attrs["rate_hz"] = rate

    return into


def put_nothing(file, elsewhere):
    file["detector_1"] = np.arange(300.0)


@pytest.mark.parametrize(
    ("put", "says"),
    [
        (put_link, "lies elsewhere"),
        (put_raw, "lies elsewhere"),
        (put_view, "lies elsewhere"),
        (put_bomb, "cut the record"),
        (put_chunk, "cut the record"),
        (put_nothing, "states no sampling rate"),
        (put(samples=np.ones((300, 3)), rate=0.0), "rate_hz: is 0; give samples a second"),
        (put(samples=np.ones((300, 3)), rate=np.nan), "rate_hz: is nan; give samples a second"),
        (put(**{"detector_1/x": np.ones(300)}), "'detector_1' is a group; put a dataset"),
        (put(detector_1=["1.5"] * 300), "'detector_1' holds no numbers; save it as"),
        (put(samples="none"), "'samples' holds no numbers; save it as"),
        (put(time_s=np.ones((300, 2))), "'time_s' has 2 dimensions; give"),
        (put(samples=np.ones(300), rate=500.0), "'samples' has 1 dimension; give samples by detectors"),
        (put(samples=np.ones((3, 300)), rate=500.0), "'samples' has 3 rows and 300 columns"),
        (put(samples=np.ones((300, 3)), detector_1=np.ones(300), rate=500.0), "leave one of both out"),
    ],
)
def test_an_hdf5_that_is_no_record_is_refused_in_a_sentence(plant, tmp_path, put, says):
    """Links, raw storage and views of others' files, whose numbers a page would show; what fills the memory; and what
    is not laid out as a record, of which the sentence names the key and what mends it."""
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["detector_1"] = np.arange(300.0)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        put(file, tmp_path / "secret.h5")
    done = run("detectors", "read", tmp_path / "r.h5", plant, "--at", NOON, "-o", tmp_path / "o")
    assert done.exit_code == 1 and says in done.output and not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("head", "rows", "says"),
    [
        ("t,detector_1", 300, "names no columns time_s"),
        ("time_s,detector_9999", 300, "is none of detector_1 to detector_"),
        ("time_s,detector_1", 300, "fewer than 3 detectors of an array"),
        ("time_s,detector_1", 20, "give 200 or more"),
    ],
)
def test_a_record_that_cannot_be_used_is_told_in_a_sentence(plant, tmp_path, head, rows, says):
    file = tmp_path / "r.csv"
    lines = [f"{k / 500:.6f},{k % 7}" for k in range(rows)]
    file.write_text("\n".join([head, *lines]))
    done = run("detectors", "read", file, plant, "--at", NOON, "-o", tmp_path / "o")
    assert done.exit_code == 1 and says in done.output and not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--at", NOON, "--record", "2026-03-21T01:00"], "--record: the sun is below the horizon"),
        (["--at", "2026-03-21T01:00"], "deg below the horizon; name another time"),
        (["--day", "2026-03-21", "--step", "6", "--record", "2026-03-21T01:00"], "--record: the sun is below"),
        (["--day", "2026-03-21", "--record", "soon"], "--record: 'soon' is no time"),
    ],
)
def test_what_cannot_be_planned_is_told_in_a_sentence(plant, tmp_path, words, says):
    done = run("detectors", "plan", plant, *words, "-o", tmp_path / "o")
    assert done.exit_code == 1 and says in done.output


def test_a_reading_does_not_replace_a_plan(plant, tmp_path):
    (tmp_path / "o").mkdir()
    (tmp_path / "o" / "benchsim.json").write_text('{"command": "detectors"}')
    (tmp_path / "r.csv").write_text("time_s,detector_1\n0,1\n")
    done = run("detectors", "read", tmp_path / "r.csv", plant, "--at", NOON, "-o", tmp_path / "o")
    assert done.exit_code == 1 and "not written by 'benchsim detectors read'" in done.output


@pytest.mark.parametrize(("word", "command"), [("raed", "read"), ("plann", "plan")])
def test_a_command_that_is_mistyped_is_named(plant, tmp_path, word, command):
    (tmp_path / "r.csv").write_text("time_s,detector_1\n")
    for group in ("detectors", "drone"):
        done = run(group, word, tmp_path / "r.csv", plant)
        assert done.exit_code == 2 and f"'{command}' may be meant" in done.output, done.output
