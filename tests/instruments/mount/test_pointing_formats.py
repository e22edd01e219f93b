"""Pointing runs as telescopes write them: either way of counting azimuth gives the same stars, and the file's own words
count. The nights are made here, of vectors, without the package's axes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from test_axes import TERMS
from test_readers import write

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import pointing, stated
from benchsim.instruments.mount.records import angles
from benchsim.jobs import diagnose

RECORDINGS = Path(__file__).resolve().parents[4] / "shared" / "recordings"
real = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not beside the project")

LATITUDE = np.radians(31.7)
RUNNING = {
    "from north through east": lambda a: a,
    "from south through east": lambda a: 180 - a,
    "from north through west": lambda a: -a,
    "from south through west": lambda a: a + 180,
}
"""How an azimuth from north through east is written."""


def sky(n=24, seed=3):
    """Hour angle and declination of stars that are up [deg], and their directions east, north, up."""
    rng = np.random.default_rng(seed)
    hour, declination = np.radians(rng.uniform(-75, 75, 4 * n)), np.radians(rng.uniform(-25, 80, 4 * n))
    star = np.stack(
        [
            -np.cos(declination) * np.sin(hour),
            np.sin(declination) * np.cos(LATITUDE) - np.cos(declination) * np.cos(hour) * np.sin(LATITUDE),
            np.sin(declination) * np.sin(LATITUDE) + np.cos(declination) * np.cos(hour) * np.cos(LATITUDE),
        ],
        axis=-1,
    )
    up = np.flatnonzero(star[:, 2] > 0.3)[:n]
    return np.degrees(hour[up]), np.degrees(declination[up]), star[up]


def places(star):
    """Azimuth from north through east and altitude [deg]."""
    return np.degrees(np.arctan2(star[:, 0], star[:, 1])), np.degrees(np.arcsin(star[:, 2]))


def night(tilt=(0.002, -0.001), noise=0.0, n=24):
    """Hour angle, declination; azimuth and altitude of stars, and as a mount with a tilted axis reads them [deg]."""
    hour, declination, star = sky(n)
    leaning = star - np.cross([*tilt, 0.0], star) + noise * np.random.default_rng(5).standard_normal(star.shape)
    leaning /= np.linalg.norm(leaning, axis=1, keepdims=True)
    return hour, declination, np.column_stack([*places(star), *places(leaning)])


def rows(table, running=RUNNING["from north through east"], extra=None):
    out = []
    for k, (a, h, r, g) in enumerate(table):
        numbers = [running(a), h, running(r), g, *([] if extra is None else extra[k])]
        out.append(" ".join(f"{v:.12f}" for v in numbers))
    return "\n".join(out) + "\n"


def log(table, hour, declination, running=RUNNING["from north through east"]):
    return "".join(
        f"CAT: {k}\nRAA: {g:.12f} {running(r):.12f}\nTAA: {h:.12f} {running(a):.12f}\n"
        f"LST: 06:00:00\nARD: {(6 - t / 15) % 24:.12f} {d:.12f}\n"
        for k, ((a, h, r, g), t, d) in enumerate(zip(table, hour, declination, strict=True))
    )


def holds(session, table, convention):
    """Whether a session has a night's directions, and says which way its file counts azimuth."""
    a, e = np.radians(table[:, 0::2]), np.radians(table[:, 1::2])
    wanted = np.stack([np.sin(a) * np.cos(e), np.cos(a) * np.cos(e), np.sin(e)], axis=-1)
    r, s = session.records.reading.T
    read = np.stack([np.sin(r) * np.cos(s), np.cos(r) * np.cos(s), np.sin(s)], axis=-1)
    np.testing.assert_allclose(session.records.source, wanted[:, 0], atol=1e-9)
    np.testing.assert_allclose(read, wanted[:, 1], atol=1e-9)
    assert sum(r.startswith(f"Azimuths are {convention}") for r in session.remarks) == 1


HEADERS = [
    ("from north through east", "! Azimuth uses the convention: N=0, E=90 (unlike the TCC, which uses S=0, E=90)"),
    ("from south through east", "! transformed AZ into tpoint convention (South = 0, East=90)"),
    ("from south through east", "Run of 3 May, azimuth from SOUTH through EAST"),
    ("from south through east", ": AZIMUTH SOUTH"),
    ("from south through east", ": SOUTH"),
    ("from south through west", ": SOUTH WEST"),
    ("from north through east", ": AZIMUTH NORTH EAST"),
    ("from south through east", "# azimuth measured from the south, positive eastward"),
    ("from south through east", "# azimuth not from north but from south"),
    ("from south through west", "! azimuth 0 deg = S, 90 deg = W"),
    ("from north through west", "! azimuth counter-clockwise from north"),
    ("from south through east", "31 42 00.0  ! latitude, azimuths S->E"),
]


@pytest.mark.parametrize(("convention", "line"), HEADERS)
def test_columns_are_read_as_their_header_counts_azimuth(tmp_path, convention, line):
    *_, table = night()
    text = f"A telescope\n{line}\n: ALTAZ\n" + rows(table, RUNNING[convention])
    session = pointing.read(write(tmp_path, "run.dat", text))
    holds(session, table, convention)
    assert any("(line 2)" in r for r in session.remarks)


@pytest.mark.parametrize("convention", RUNNING)
def test_where_the_header_is_silent_the_stars_tell(tmp_path, convention):
    """A log with sidereal times, and columns that are named, whichever way either counts azimuth."""
    hour, declination, table = night()
    raw = pointing.read(write(tmp_path, "log.dat", log(table, hour, declination, RUNNING[convention])))
    times = np.column_stack([np.full(len(hour), 6.0), (6 - hour / 15) % 24, declination])
    named = "# az el az_read el_read lst ra_h dec\n" + rows(table, RUNNING[convention], times)
    columns = pointing.read(write(tmp_path, "columns.dat", named))
    degrees = "# az el az_read el_read lst_deg ra_deg dec_deg\n" + rows(table, RUNNING[convention], times * [15, 15, 1])
    for session in (raw, columns, pointing.read(write(tmp_path, "degrees.dat", degrees))):
        holds(session, table, convention)
        assert session.mount.latitude == pytest.approx(LATITUDE, abs=1e-6)


def test_where_nothing_tells_the_assumption_is_said_with_what_it_would_turn(tmp_path):
    *_, table = night()
    session = pointing.read(write(tmp_path, "run.dat", "31 42 00\n: ALTAZ\n" + rows(table)))
    (said,) = (r for r in session.remarks if r.startswith("Azimuths are taken from north through east"))
    assert "AN, NPAE, CA and IA would have the other sign" in said
    assert ": AZIMUTH SOUTH EAST" in said


def test_the_terms_that_the_other_reading_turns():
    """Of a mirrored sky TPOINT's forms fit as well, with IA, CA, NPAE and AN turned and the others as they are."""
    a, e = (v.ravel() for v in np.meshgrid(np.radians(np.arange(5, 360, 20)), np.radians([20, 40, 60, 75])))
    size = {name: k + 1.0 for k, name in enumerate(TERMS)}

    def columns(azimuth):
        return np.column_stack([np.concatenate(form(azimuth, e)) for form in TERMS.values()])

    apart = columns(a) @ list(size.values())
    apart[: len(a)] *= -1
    mirrored, *_ = np.linalg.lstsq(columns(np.pi - a), apart, rcond=None)
    turned = {n for n, value in zip(TERMS, mirrored, strict=True) if abs(value + size[n]) < 1e-6}
    kept = {n for n, value in zip(TERMS, mirrored, strict=True) if abs(value - size[n]) < 1e-6}
    assert turned == {"IA", "CA", "NPAE", "AN"}
    assert kept == {"IE", "AW", "TF", "TX"}


def test_azimuths_that_fit_the_sky_in_no_convention_are_refused(tmp_path):
    hour, declination, table = night()
    wrong = table + np.array([70.0, 0, 70.0, 0])
    with pytest.raises(BenchsimError, match=r"neither from north through east .* nor from south through east"):
        pointing.read(write(tmp_path, "log.dat", log(wrong, hour, declination)))
    above = ": AZIMUTH NORTH EAST\n"
    said = pointing.read(write(tmp_path, "stated.dat", above + log(wrong, hour, declination))).remarks
    assert any("header states (line 1)" in r and "fit no convention" in r for r in said)


def test_a_header_that_the_stars_or_another_line_contradict_is_refused(tmp_path):
    hour, declination, table = night()
    text = log(table, hour, declination)
    with pytest.raises(BenchsimError, match=r"line 1: azimuths from south through east are stated.*from north through"):
        pointing.read(write(tmp_path, "a.dat", "azimuth from south through east\n" + text))
    both = "! azimuth from south through east\n! azimuth from north through east\n"
    with pytest.raises(BenchsimError, match=r"south through east \(line 1\) and from north through east \(line 2\)"):
        pointing.read(write(tmp_path, "b.dat", both + rows(table)))


@pytest.mark.parametrize(
    ("line", "degrees"),
    [
        ("+31 41 19.6 2021 8 21 13.0 741 2608.0 0.75", 31.688778),
        ("-30 14 40.7", -30.244639),
        ("49 48 0 2004-01-13 22:11:12.123", 49.8),
        ("-00 14 40.7", -0.244639),
        ("! latitude 50.9134 deg", 50.9134),
        ("! Lat (deg) = -30.244639", -30.244639),
        ("LATITUDE 32d46m49.3s N", 32.780361),
        ("! Lat. 30.244639 south", -30.244639),
        ("# Latitude: 50 deg 54 min 48 s N, longitude 6", 50.913333),
        ("# Latitude: 30:14:40.7 S, longitude 70 44 57 W", -30.244639),
    ],
)
def test_a_stated_latitude_is_used_and_said(tmp_path, line, degrees):
    *_, table = night()
    session = pointing.read(write(tmp_path, "run.dat", f"A run\n: ALTAZ\n{line}\n" + rows(table)))
    assert len(session.records.names) == len(table)
    assert np.degrees(session.mount.latitude) == pytest.approx(degrees, abs=1e-5)
    assert any(r.startswith(f"Latitude {degrees:.4f} deg, as the header states (line 3)") for r in session.remarks)


STARS = "120.5 45.25 119.7 45.0\n200.5 30.25 199.7 30.0\n300.5 60.25 299.7 60.0\n"
PARTS = """120 30 00.0 45 15 00.0 119 42 00.0 45 00 00.0
200 30 00.0 30 15 00.0 199 42 00.0 30 00 00.0
300 30 00.0 60 15 00.0 299 42 00.0 60 00 00.0
"""
COLONS = re.sub(r"(\d+) (\d+) (\d+\.\d)", r"\1:\2:\3", PARTS)


@pytest.mark.parametrize(
    "text",
    [
        STARS.replace(".", ","),
        STARS.replace(".", ",").replace(" ", ";"),
        STARS.replace(".", ",").replace(" ", ", "),
        STARS.replace(" ", "\t"),
        STARS.replace(" ", ","),
        STARS.replace("\n", "\n\n"),
        STARS.replace("\n", " 12.5\n"),
        STARS.replace("\n", " * Vega\n"),
        STARS.replace("45.0\n", "45.0 61 Cyg\n"),
        STARS.replace("\n", " & \\\n +0.1 +0.2 \\\n -0.3\n"),
        "! comment\n\n# comment\n" + STARS.replace("\n", " ! seen\n") + "END\n1 2 3 4 5 lies beyond\n",
        "A caption\r\n: ALTAZ\r\n: ROTNR\r\n" + STARS.replace("\n", " -3.2\r\n"),
        "GBT\n: NODA\n: ALLSKY\n: ALTAZ\n+38 25 59\n" + STARS,
        "A caption\n! Option record\nAZALT ROTL\n32 46 49.3\n" + STARS,
        PARTS,
        PARTS.replace("\n", " 12.5 ok\n"),
        COLONS,
        COLONS.replace(":", "d", 1),
        COLONS.replace(".0", ",0"),
        STARS.replace(" ", "° "),
    ],
)
def test_the_same_stars_however_they_are_written(tmp_path, text):
    path = tmp_path / "run.dat"
    path.write_bytes(text.encode())
    assert stated.recognises(path)
    records = pointing.read(path).records
    azimuth, altitude = (np.degrees(v) for v in angles(records.source))
    np.testing.assert_allclose(azimuth, [120.5, 200.5, 300.5], atol=1e-9)
    np.testing.assert_allclose(altitude, [45.25, 30.25, 60.25], atol=1e-9)
    np.testing.assert_allclose(np.degrees(records.reading), [[119.7, 45], [199.7, 30], [299.7, 60]], atol=1e-9)


def test_whole_degrees_with_eight_flags_are_no_degrees_minutes_and_seconds(tmp_path):
    records = pointing.read(
        write(tmp_path, "run.dat", "120 45 119 44 1 0 0 1 0 0 0 0\n200 30 199 29 1 0 0 1 0 0 0 0\n")
    ).records
    np.testing.assert_allclose(np.degrees(records.reading), [[119, 44], [199, 29]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (STARS + "120.5 45.25 119.7\n", "line 4, column 4: is missing"),
        (STARS + "120.5 45.25 xx 45.0\n", "line 4, column 3: 'xx'"),
        (STARS + "120.5 nan 119.7 45.0\n", "line 4, column 2: 'nan'"),
        (STARS.replace("\n", " 7\n") + "120.5 45.25 119.7 45.0\n", "line 4, column 5: is missing"),
        (STARS + PARTS, "line 4, column 5: degrees, minutes and seconds"),
        (PARTS + STARS, "line 4, column 5: is missing"),
        (PARTS.replace("199 42", "199 61"), "line 2, column 7: '199 61 00.0'"),
        (COLONS.replace("199:42", "199:61"), "line 2, column 3: '199:61:00.0'"),
        (STARS + "\0", "line 4: .*NUL"),
        (": EQUAT\n" + STARS, "line 1: option EQUAT states an equatorial mount"),
        ("A caption\n: NODA\n31 41 19\n" + STARS, "line 2: option NODA .* equatorial mount"),
        (": GIMBAL\n" + STARS, "line 1: option GIMBAL states a gimbal"),
        ("15 23 43.71 -01 01 20.66 0.005 -0.03 2000.0 15 22 50.1 12 30 43.0 14 23.2\n", "line 1: .*equatorial mount"),
        (": ALTAZ\n31 61 19\n" + STARS, "line 2: '31 61 19' is no latitude"),
    ],
)
def test_what_cannot_be_read_is_said_with_line_and_column(tmp_path, text, wanted):
    path = write(tmp_path, "run.dat", text)
    with pytest.raises(BenchsimError, match=wanted) as error:
        pointing.read(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_words_about_latitude_and_azimuth_state_none(tmp_path):
    above = "! latitude terms left out, 7 stars\n! telescope latitude deg min sec\nGemini South, azimuth drive 2\n"
    remarks = pointing.read(write(tmp_path, "run.dat", above + STARS)).remarks
    assert remarks[0].startswith("The file states no latitude")
    assert any(r.startswith("Azimuths are taken from north through east") for r in remarks)


def test_an_unknown_option_is_left_aside_and_said(tmp_path):
    remarks = pointing.read(write(tmp_path, "run.dat", "A run\n: ALTAZ WIDGET\n" + STARS)).remarks
    assert any(r.startswith("Option WIDGET (line 2)") for r in remarks)


def test_the_convention_in_force_reaches_summary_json_and_page(tmp_path):
    *_, table = night(tilt=(1e-4, -2e-4), noise=3e-6, n=40)
    path = write(
        tmp_path, "run.dat", "azimuth from south through east\n" + rows(table, RUNNING["from south through east"])
    )
    found = diagnose(path, tmp_path / "out", pictures=False)
    sentence = "Azimuths are from south through east, as the header states (line 1)."
    summary = " ".join((tmp_path / "out" / "summary.txt").read_text(encoding="utf-8").split())
    assert sentence in summary
    assert sentence in json.loads((tmp_path / "out" / "diagnosis.json").read_text(encoding="utf-8"))["remarks"]
    assert sentence in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    # Turned about east by AN, and about north by -AW.
    sizes = {k: s for f in found.diagnosis.effects for k, s in f.parameters.items()}
    assert set(sizes) == {"AN", "AW"}
    for name, value in (("AN", 1e-4), ("AW", 2e-4)):
        assert abs(sizes[name].value - np.degrees(value) * 3600) < 4 * sizes[name].sigma < 1.0


def columns_of(log_text):
    """Azimuth and altitude, true and as read, of the stars of an MMT log."""
    found = {k: re.findall(rf"^{k}:\s+(\S+)\s+(\S+)", log_text, re.MULTILINE) for k in ("TAA", "RAA")}
    return np.array([[*t[::-1], *r[::-1]] for t, r in zip(found["TAA"], found["RAA"], strict=True)], float)


@real
@pytest.mark.parametrize("name", ["point_20210821.dat", "point_20230702.dat"])
def test_the_mmt_s_logs_are_read_either_way_about(tmp_path, name):
    text = (RECORDINGS / "telescope-mmt" / name).read_text(encoding="utf-8")
    table = columns_of(text)
    mirrored = re.sub(r"^([RT]AA:\s+\S+\s+)(\S+)", lambda m: f"{m[1]}{180 - float(m[2]):.7f}", text, flags=re.MULTILINE)
    header = "! transformed AZ into tpoint convention (South = 0, East=90)\n: ALTAZ\n+31 41 19.6\n"
    for convention, written in (
        ("from north through east", text),
        ("from south through east", mirrored),
        ("from south through east", header + rows(table, RUNNING["from south through east"])),
    ):
        session = pointing.read(write(tmp_path, "run.dat", written))
        holds(session, table, convention)
        assert np.degrees(session.mount.latitude) == pytest.approx(31.689, abs=0.01)


@real
def test_the_observatory_s_terms_come_out_of_columns_from_south(tmp_path):
    """MMT, 2021-08-21, as TPOINT's file of that night counts: each term within 3 sigma of the observatory's."""
    table = columns_of((RECORDINGS / "telescope-mmt" / "point_20210821.dat").read_text(encoding="utf-8"))
    header = "MMT\n: ALTAZ\n: AZIMUTH SOUTH EAST\n+31 41 19.6 2021 8 21 13.0 741 2608.0 0.75\n"
    path = write(tmp_path, "run.dat", header + rows(table, RUNNING["from south through east"]))
    found = diagnose(path, tmp_path / "out", pictures=False)
    sizes = {k: s for f in found.diagnosis.effects for k, s in f.parameters.items()}
    published = {"NPAE": -8.35, "AN": 2.47, "AW": -10.32, "TF": 21.42, "TX": -2.72}
    assert set(sizes) == set(published)
    for term, value in published.items():
        assert abs(sizes[term].value - value) < 3 * sizes[term].sigma, term
    assert "IA = 1204" in " ".join(found.remarks)
