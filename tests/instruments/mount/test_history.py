"""What hangs on a mount's history, found and predicted: the way in which an actuator or an axis came to its reading,
the season, the temperature of a night; and a stated increment that is wrong.

Heliostats are made by hand (`hand_made`) under the sun of `test_sun`'s almanac, telescopes of the readings themselves:
an actuator is longer by thermal × cos(2π (t − 200 d) / 365.2425 d), in the south shorter, and by half of its backlash
shorter where its reading grew and longer where it fell.
"""

from datetime import UTC, datetime, timedelta

import hand_made as hand
import numpy as np
import pytest
from test_readers import write
from test_sun import almanac, lifted

from benchsim.instruments.mount import problem, stated
from benchsim.jobs import aim, diagnose, predict

NEW = ("encoder-increment", "backlash", "thermal-growth")

NOISE = 0.3e-3
"""Of a spot, as seen from the mirror [rad of the beam], in either direction."""

SIZES = {
    "encoder-increment": {"increment_1": 0.008, "increment_2": -0.01},
    "backlash": {"backlash_1": 1.6, "backlash_2": 1.2},
    "thermal-growth": {"thermal_1": 0.9, "thermal_2": -0.7},
}
"""Some mrad of the normal each, ten times the error of a record."""

ON_AXES = {
    "backlash": {"backlash_A": 20.0, "backlash_E": 16.0},
    "thermal-growth": {"thermal_A": 12.0, "thermal_E": -15.0},
}
"""Of telescopes [arcsec], ten times the error of a star."""


def on_days(days, minutes=(-90, -85, 40, 45), begin=(2023, 1, 20)):
    """Times in minutes from 11:30 UTC, the plant's noon, on days counted from one."""
    noon = datetime(*begin, 11, 30, tzinfo=UTC)
    return [noon + timedelta(days=int(d), minutes=int(m)) for d in days for m in minutes]


YEAR = on_days(range(0, 360, 30))
"""Twelve days over a year, four records on each."""


def season(time):
    since = (time - datetime(1970, 7, 20, tzinfo=UTC)).total_seconds() / 86400
    return np.cos(2 * np.pi * since / 365.2425) * (1 if hand.LATITUDE > 0 else -1)


def recorded(times, e=None, noise=0.0, seed=1):
    """Rows of records, aimed without errors at places of the target that go to and fro, so that either actuator goes
    both ways; and the signs of the ways, (n, 2)."""
    rng, e = np.random.default_rng(seed), e or {}
    rows, signs = [], []
    for k, time in enumerate(times):
        azimuth, elevation = almanac(time, hand.LATITUDE)
        sun = (float(azimuth) % 360, float(lifted(elevation)))
        source = hand.direction(*sun)
        aim = hand.TARGET + np.array([2.8 * rng.choice([-1, 1]), 0.0, 2.8 * rng.choice([-1, 1])])
        way = aim - hand.PLACE
        normal = source + way / np.linalg.norm(way)
        steps = hand.steps_for(normal / np.linalg.norm(normal)).round()
        same_day = k > 0 and times[k - 1].date() == time.date()
        signs.append(np.sign(steps - rows[-1][0]) if same_day else np.zeros(2))
        grown = {
            f"step_{j + 1}": e.get(f"thermal_{j + 1}", 0.0) * season(time)
            - 0.5 * e.get(f"backlash_{j + 1}", 0.0) * signs[-1][j]
            for j in (0, 1)
        }
        spot = hand.hit(steps, source, {**e, **grown})
        far = np.linalg.norm(spot - hand.PLACE)
        way, error = (spot - hand.PLACE) / far, noise * rng.standard_normal(3)
        rows.append((steps, sun, spot + far * (error - error @ way * way)))
    return rows, np.array(signs)


def stamps(times):
    return [t.isoformat() for t in times]


def heliostat(folder, times, e=None, noise=0.0, seed=1, stamped=True, first=1000):
    """A folder of records; with stamps or without."""
    rows, _ = recorded(times, e, noise, seed)
    return hand.write_heliostat(folder, rows, first, stamps(times) if stamped else ())


HEADER = "! az alt az_read alt_read"


def night(count, e=None, noise=0.0, seed=1, header=f"{HEADER} temp", span=16.0):
    """The text of a telescope's run with zeros of 900 and 30 arcsec, and the signs of the axes' ways, (n, 2).

    The fifth column's temperature falls by a span [K] and goes up again for a while.
    """
    rng, e = np.random.default_rng(seed), e or {}
    read = np.column_stack([rng.uniform(0, 360, count), rng.uniform(25, 75, count)]).round(6)
    ways = np.diff(read, axis=0, prepend=read[:1])
    signs = np.where(np.abs(ways) > 180, 0.0, np.sign(ways))
    temperature = 8.0 - 0.5 * span * np.cos(4.0 * np.arange(count) / count).round(4)
    warm = (temperature - 10) / 10
    off = np.array([900.0, 30.0]) + noise * rng.standard_normal((count, 2))
    # An error on the sky; azimuths err by more the higher a star stands.
    off[:, 0] += (1 / np.cos(np.radians(read[:, 1])) - 1) * (off[:, 0] - 900.0)
    for k, axis in enumerate("AE"):
        off[:, k] += e.get(f"thermal_{axis}", 0.0) * warm - 0.5 * e.get(f"backlash_{axis}", 0.0) * signs[:, k]
    table = np.column_stack([read + off / 3600, read, temperature])
    return header + "\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in table) + "\n", signs


def told(found, name):
    """Parameters of an effect with their sizes, where it is named or in a class that holds it; None where neither."""
    d = found.diagnosis
    for effect in d.effects:
        if effect.name == name:
            return effect.parameters
    return next(
        (sizes for c in d.classes for member, sizes in zip(c.members, c.sizes, strict=True) if name in member), None
    )


def held_to(found, name, true):
    """The effect is there, and its size within 4 sigma, which are a third of it at most."""
    sizes = told(found, name)
    assert sizes is not None, found.text()
    for parameter, value in true.items():
        size = sizes[parameter]
        assert abs(size.value - value) < 4 * size.sigma, (parameter, size)
        assert size.sigma < abs(value) / 3, (parameter, size)


def candidates(source):
    """Parameters that are looked for, by name."""
    built = problem.build(stated.read(source), attached=False)
    return {p.name: p for e in built.problem.catalogue for p in e.parameters}


@pytest.mark.parametrize("name", SIZES)
def test_a_heliostat_s_is_found_with_its_size(tmp_path, name):
    """And what is written of it predicts the year after to less than a record's error, free of errors as that is."""
    found = diagnose(heliostat(tmp_path / "AA01", YEAR, SIZES[name], NOISE), tmp_path / "out", pictures=False)
    held_to(found, name, SIZES[name])
    heliostat(tmp_path / "late", on_days(range(365, 725, 40)), SIZES[name], seed=2, first=2000)
    later = predict(tmp_path / "out" / "amended.toml", tmp_path / "late", tmp_path / "p", draw=False).as_dict()
    # Of the normal, which turns by half of the beam.
    assert later["rms_mrad"] < 1e3 * NOISE / 2
    assert later["stated_rms_mrad"] > 1.0


@pytest.mark.parametrize("name", ON_AXES)
def test_a_telescope_s_is_found_with_its_size(tmp_path, name):
    text, _ = night(60, ON_AXES[name], noise=1.0)
    held_to(diagnose(write(tmp_path, "run.dat", text)), name, ON_AXES[name])


@pytest.mark.parametrize("e", [{}, {"tilt_n": -9.0, "tilt_u": 5.0}])
def test_a_heliostat_without_them_is_not_named_so(tmp_path, e):
    source = heliostat(tmp_path / "AA01", YEAR, e, NOISE)
    # They are looked for.
    assert {p for terms in SIZES.values() for p in terms} <= set(candidates(source))
    found = diagnose(source)
    assert [told(found, name) for name in NEW] == [None] * 3, found.text()
    assert (told(found, "axis-tilt") is not None) == bool(e)


def test_a_telescope_without_them_is_not_named_so(tmp_path):
    source = write(tmp_path, "run.dat", night(60, noise=1.0)[0])
    assert {p for terms in ON_AXES.values() for p in terms} <= set(candidates(source))
    found = diagnose(source)
    assert [told(found, name) for name in NEW] == [None] * 3, found.text()


def agrees(folder, name, parameter, value, times, stamped=True):
    """Largest miss [mrad] of a few later records by a file that states a parameter, and largest without."""
    heliostat(folder / "early", [t + timedelta(hours=1) for t in times[:4]], stamped=stamped)
    heliostat(folder / "late", times, {parameter: value}, seed=2, stamped=stamped, first=2000)
    hand.write_amended(folder / "amended.toml", "early", {name: {parameter: value}})
    done = predict(folder / "amended.toml", folder / "late", folder / "out", draw=False)
    assert not any(r.learnt for r in done.records)
    return max(r.miss_mrad for r in done.records), max(r.stated_mrad for r in done.records)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("name", "parameter"), [(n, p) for n, terms in SIZES.items() for p in terms])
def test_what_is_stated_of_a_heliostat_predicts_to_a_microradian(tmp_path, name, parameter, sign):
    """Two days of four seasons: either way on either axis, and no way at a day's begin."""
    times = on_days([0, 1, 95, 97, 180, 182, 270, 275])
    signs = recorded(times, seed=2)[1]
    assert all((signs == s).any(axis=0).all() for s in (-1, 0, 1))
    missed, plain = agrees(tmp_path, name, parameter, sign * abs(SIZES[name][parameter]), times)
    assert missed < 1e-3
    assert plain > 1.0


@pytest.mark.parametrize("time", ["2024-01-20T11:40:00Z", "2024-07-20T11:40:00Z"])
def test_an_aim_knows_its_season(tmp_path, time):
    """Actuators that grow by 0.9 mm from the year's mean to its warmest day: the beam hits in winter and in summer."""
    heliostat(tmp_path / "early", YEAR[:4])
    hand.write_amended(tmp_path / "amended.toml", "early", {"thermal-growth": {"thermal_1": 0.9, "thermal_2": 0.9}})
    found = aim(tmp_path / "amended.toml", "upper", time)
    grown = 0.9 * season(datetime.fromisoformat(time))
    spot = hand.hit(found.motor, hand.direction(*found.sun), {"step_1": grown, "step_2": grown})
    assert np.linalg.norm(spot - hand.TARGET) < 1e-6
    assert np.linalg.norm(hand.hit(found.motor, hand.direction(*found.sun)) - hand.TARGET) > 0.1


def test_without_stamps_days_are_told_by_the_sun(tmp_path):
    """Backlash of the records of four days in spring, of which the sun's place alone tells where one begins."""
    missed, plain = agrees(tmp_path, "backlash", "backlash_2", 1.2, on_days([50, 57, 64, 78]), stamped=False)
    assert missed < 1e-3 < 1.0 < plain


@pytest.mark.parametrize("days", [[148, 149, 150, 151], [50, 51, 52, 53]])
def test_each_day_s_record_has_no_way_however_late_it_is(tmp_path, days):
    """One record a day, each later by the clock than the one before; at the solstice the sun hardly tells the days."""
    times = [on_days([d], [15 * k - 60])[0] for k, d in enumerate(days)]
    missed, plain = agrees(tmp_path, "backlash", "backlash_2", 1.2, times)
    assert missed < 1e-3
    # Nothing is done by it at all.
    assert plain < 1e-3


def test_few_later_records_are_predicted_though_they_are_no_witnesses(tmp_path):
    """Three of a day: two ways are known, and no season."""
    for name in ("backlash", "thermal-growth"):
        (tmp_path / name).mkdir()
        parameter = next(iter(SIZES[name]))
        missed, plain = agrees(tmp_path / name, name, parameter, 1.6, on_days([170], (-60, -40, -20)))
        assert missed < 1e-3 < 1.0 < plain


@pytest.mark.parametrize("parameter", ["thermal_1", "thermal_2", "backlash_1"])
def test_in_the_south_summer_is_in_january(tmp_path, monkeypatch, parameter):
    """A plant at 23 deg south whose heliostat stands where it stands at Jülich, under a sun to the north."""
    monkeypatch.setattr(hand, "LATITUDE", -23.0)
    times = on_days([0, 1, 40, 200, 260, 300], (-60, -40, 20, 50))
    assert season(datetime(2023, 1, 20, tzinfo=UTC)) > 0.99
    name = "backlash" if parameter.startswith("backlash") else "thermal-growth"
    missed, plain = agrees(tmp_path, name, parameter, 1.3, times)
    assert missed < 1e-3 < 1.0 < plain


ZEROS = """[prediction]
sigma_mrad = [0.003, 0.003]
parameters = ["IA", "IE"]
covariance = [[0.0, 0.0], [0.0, 0.0]]
zeros_arcsec = [900.0, 30.0]
"""


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("name", "parameter"), [(n, p) for n, terms in ON_AXES.items() for p in terms])
def test_what_is_stated_of_a_telescope_predicts_to_a_microradian(tmp_path, name, parameter, sign):
    """200 arcsec, as much as a milliradian, of which a wrong sign of one star would be seen."""
    text, signs = night(24, {parameter: 200.0 * sign})
    assert all((signs == s).any(axis=0)[0] for s in (-1, 0, 1)) and (signs[1:, 0] == 0).any()
    write(tmp_path, "run.dat", text)
    hand.write_amended(tmp_path / "a.toml", "run.dat", {name: {parameter: 200.0 * sign}}, ZEROS)
    done = predict(tmp_path / "a.toml", tmp_path / "run.dat", tmp_path / "out", draw=False)
    assert max(r.miss_mrad for r in done.records) < 1e-3
    hand.write_amended(tmp_path / "b.toml", "run.dat", {}, ZEROS)
    without = predict(tmp_path / "b.toml", tmp_path / "run.dat", tmp_path / "out", draw=False)
    assert max(r.miss_mrad for r in without.records) > 0.1


def test_three_records_to_either_side_are_needed_on_an_axis(tmp_path):
    """A telescope whose azimuth grows but for two stars, or for three, while its elevation goes to and fro."""
    for back, wanted in ((2, {"backlash_E"}), (3, {"backlash_A", "backlash_E"})):
        read = np.column_stack([10.0 + 8.0 * np.arange(20), 45.0 + 9.0 * (-1.0) ** np.arange(20)])
        read[3 : 3 + 4 * back : 4, 0] -= 12.0
        assert (np.diff(read[:, 0]) < 0).sum() == back
        path = write(tmp_path, "run.dat", "\n".join(f"{a + 0.1} {h} {a} {h}" for a, h in read) + "\n")
        assert {p for p in candidates(path) if p.startswith("backlash")} == wanted


def test_a_season_and_a_temperature_have_to_change(tmp_path):
    """Both flanks of the season, or 5 K; and somebody has to state the stamps or the temperature."""
    # Three quarters of a year are 274 days.
    for days, wanted in ((270, False), (276, True)):
        times = on_days(np.linspace(60, 60 + days, 6).round())
        source = heliostat(tmp_path / f"H{days}", times)
        assert ({"thermal_1", "thermal_2"} <= set(candidates(source))) == wanted
    assert not {"thermal_1", "thermal_2"} & set(candidates(heliostat(tmp_path / "AA01", YEAR, stamped=False)))
    for header, span, wanted in (
        (f"{HEADER} temp", 6.5, True),
        (f"{HEADER} temperature", 6.5, True),
        (f"{HEADER} temp", 5.0, False),
        # More names than columns, and fewer: which is which is not told.
        (f"{HEADER} temp focus", 6.5, False),
        ("! az alt az_read temp", 6.5, False),
        (f"{HEADER} focus", 6.5, False),
        (HEADER, 6.5, False),
    ):
        path = write(tmp_path, "run.dat", night(24, header=header, span=span)[0])
        assert ({"thermal_A", "thermal_E"} <= set(candidates(path))) == wanted, (header, span)


def test_a_heliostat_s_ways_are_counted_within_days(tmp_path):
    """Of sixteen records on four days the second actuator goes back once to four times; of single days none goes."""
    times, seen = on_days([50, 57, 64, 78]), []
    for seed in range(1, 9):
        signs = recorded(times, seed=seed)[1]
        either = np.minimum((signs > 0).sum(axis=0), (signs < 0).sum(axis=0))
        wanted = {f"backlash_{k + 1}" for k in (0, 1) if either[k] >= 3}
        assert {p for p in candidates(heliostat(tmp_path / f"H{seed}", times, seed=seed)) if "backlash" in p} == wanted
        seen += either.tolist()
    assert {2, 3} <= set(seen)
    alone = candidates(heliostat(tmp_path / "alone", on_days(range(0, 120, 10), [0])))
    assert not any("backlash" in p for p in alone)


@pytest.mark.parametrize(
    ("off", "sigma"),
    [
        (lambda k: 0.0, 60.0),
        # One of twelve.
        (lambda k: 50.0 * (k == 4), 60.0),
        (lambda k: 75.0 * (k == 4), 2700.0),
        (lambda k: 6.0, 2700.0),
        (lambda k: 7200.0, 2700.0),
        (None, 2700.0),
    ],
)
def test_a_clock_that_agrees_with_the_sun_is_believed_to_a_minute(tmp_path, off, sigma):
    """Stamps off by some seconds, or none."""
    times = on_days([50, 57, 64])
    rows, _ = recorded(times)
    late = () if off is None else stamps([t + timedelta(seconds=off(k)) for k, t in enumerate(times)])
    clock = candidates(hand.write_heliostat(tmp_path / "AA01", rows, stamps=late))["dt"]
    assert clock.sigma == pytest.approx(sigma)


def test_a_minute_and_a_half_is_found_though_sun_and_stamps_agree(tmp_path):
    """One clock gave both, and was late: by 0.4 deg of the sun's way, twenty errors of a record."""
    late = [t + timedelta(seconds=90) for t in YEAR]
    rows, _ = recorded(late, noise=NOISE)
    told_sun = [sun for _, sun, _ in recorded(YEAR)[0]]
    rows = [(steps, sun, spot) for (steps, _, spot), sun in zip(rows, told_sun, strict=True)]
    found = diagnose(hand.write_heliostat(tmp_path / "AA01", rows, stamps=stamps(YEAR)))
    held_to(found, "clock", {"dt": 90.0})


def test_a_flank_of_the_season_is_not_told_from_age(tmp_path):
    """Actuators that grow by 1 mm in a hundred days: from February to May alone that is no season."""
    spring = on_days(range(20, 120, 10))
    assert "thermal_1" not in candidates(heliostat(tmp_path / "spring", spring))
    assert "thermal_1" in candidates(heliostat(tmp_path / "year", YEAR))


def test_growth_and_play_that_later_records_do_not_show_are_said(tmp_path):
    heliostat(tmp_path / "early", YEAR[:4])
    terms = {"thermal-growth": {"thermal_1": 0.9}, "backlash": {"backlash_1": 1.0}}
    hand.write_amended(tmp_path / "a.toml", "early", terms)
    single = [YEAR[k] for k in range(0, 48, 4)]
    told = predict(tmp_path / "a.toml", heliostat(tmp_path / "late", single, stamped=False, first=2000)).remarks
    assert any("no season" in r for r in told) and any("amid the play" in r for r in told)
    shown = predict(tmp_path / "a.toml", heliostat(tmp_path / "all", YEAR, first=3000)).remarks
    assert not any("is stated, but" in r for r in shown)


@pytest.mark.parametrize(
    ("temperatures", "how"),
    [("nan", "at the median"), ("-999", "at the median"), (None, "is not used")],
)
def test_temperatures_of_no_air_are_not_believed(tmp_path, temperatures, how):
    """One that is missing or a mark for it, or all in kelvin: the run is read as ever."""
    text, _ = night(40, noise=1.0)
    head, *rows = text.splitlines()
    if temperatures is None:
        rows = [" ".join([*row.split()[:4], str(float(row.split()[4]) + 273.15)]) for row in rows]
    else:
        rows[3] = " ".join([*rows[3].split()[:4], temperatures])
    found = diagnose(write(tmp_path, "run.dat", "\n".join([head, *rows]) + "\n"))
    assert any("temperatures" in r and how in r for r in found.remarks)
    assert not found.claimed & set(NEW)
    assert found.encoder_zeros[0][0] == pytest.approx(900, abs=4 * found.encoder_zeros[0][1])
