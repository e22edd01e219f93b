"""``benchsim flux`` and what belongs to it: plants begun, checked, computed, on a terminal and in Python."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import benchsim as bs
from benchsim.bench.errors import BenchsimError
from benchsim.cli import app
from benchsim.fluxes.day import Errors, clear_sky, deviated_normals, flux_at
from benchsim.fluxes.heliostat import Heliostat, Target
from benchsim.jobs import plant_flux
from benchsim.plant import files
from benchsim.plant.moment import Noise

PLANTS = Path(__file__).resolve().parents[2] / "scenes" / "plants"
NOON = "2026-06-21T12:00"


def run(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


def test_the_papers_five_heliostats_make_the_flux_that_the_room_computes():
    """Through the command's function against `flux_at`, which tests of the room hold, at the same sun."""
    result = bs.flux(PLANTS / "five", at=NOON, errors="drawn", seed=4, cells=81)
    m, f = result.moments[0], result.plant.field
    rng = np.random.default_rng(4)
    errors = {k: f.sigmas[k] * rng.standard_normal(5) for k in f.sigmas}
    target = Target((0.0, 0.0, 32e3), 6e3, 6e3)
    helios = [Heliostat(tuple(p), 6e3, 6e3, 2.5e-3, 1e-3, 0.9) for p in f.position]
    normals = []
    for k, h in enumerate(helios):
        e = {n: float(v[k]) for n, v in errors.items()}
        by_paper = Errors(e["IA"], e["IE"], e["CA"], np.hypot(e["AN"], e["AW"]), np.arctan2(e["AW"], e["AN"]))
        normals.append(deviated_normals(h.position, target, m.sun, by_paper)[0])
    expected = flux_at(helios, target, m.sun, normals, float(clear_sky(m.sun, 200.0)[0]), 81).values
    assert m.shaded.max() == m.blocked.max() == 0
    np.testing.assert_allclose(result.maps()[0], expected / 1e3, rtol=2e-3, atol=2e-3 * expected.max() / 1e3)
    assert result.maps()[0].max() == pytest.approx(expected.max() / 1e3, rel=1e-3)


def test_a_day_over_a_scheduler_of_ones_own_is_that_of_this_process(dask_of_tls, tmp_path):
    """By the command, with two workers that speak TLS alone: sums, maps and what errors cost."""
    words = ["flux", PLANTS / "five", "--day", "2026-06-21", "--step", 2, "--errors", "drawn", "--rank", "--cells", 20]
    tls = ["--scheduler", dask_of_tls.address, "--tls", *dask_of_tls.tls]
    for name, more in (("here", ["--workers", 0]), ("there", tls)):
        done = run(*words, *more, "-o", tmp_path / name)
        assert done.exit_code == 0, done.output
    for name in ("flux.json", "heliostats.csv", "flux-target.csv"):
        assert (tmp_path / "there" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_plant_is_begun_checked_and_computed(tmp_path):
    plant, out = tmp_path / "plant", tmp_path / "out"
    assert "30 heliostats" in run("new", plant, "--plant", "--heliostats", 30).output
    checked = run("check", plant)
    assert checked.exit_code == 0 and "30 heliostats" in checked.output
    done = run("flux", plant, "--at", NOON, "-o", out, "--level", 10, "--level", 50)
    assert done.exit_code == 0, done.output
    assert f"written: {out}/; open {out}/report.html" in done.output.splitlines()
    assert done.output.splitlines()[-1].startswith("next: --engine both")
    names = {p.name for p in out.iterdir()}
    assert names == {
        "benchsim.json", "flux.json", "heliostats.csv", "summary.txt", "flux-receiver.csv", "flux-receiver.png",
        "field.png", "report.html",
    }  # fmt: skip
    options = json.loads((out / "benchsim.json").read_text())["options"]
    assert options["levels"] == [10, 50] and {"cells", "rank", "variant"} < set(options)
    plain = json.loads((out / "flux.json").read_text())
    rows = list(csv.DictReader((out / "heliostats.csv").open()))
    assert sum(float(r["power_kw"]) for r in rows) == pytest.approx(plain["receivers"][0]["on_it_kw"], rel=1e-4)
    cells = list(csv.DictReader((out / "flux-receiver.csv").open()))
    assert max(float(c["flux_kw_m2"]) for c in cells) == pytest.approx(plain["receivers"][0]["peak_kw_m2"], rel=1e-4)
    assert "not empty" in run("flux", plant, "--at", NOON, "-o", plant).output
    assert "holds a plant already" in run("new", plant, "--plant").output


def test_a_plant_that_is_not_ready_says_why(tmp_path):
    run("new", tmp_path / "p", "--plant", "--heliostats", 3)
    file = tmp_path / "p" / "plant.toml"
    file.write_text(file.read_text().replace("slope_mrad = 1.0", 'slope_mrad = "one"\ncoating = 1'))
    done = run("check", tmp_path / "p")
    assert done.exit_code == 1 and "optics.coating: unknown key" in done.output and "optics.slope_mrad" in done.output
    done = run("flux", tmp_path / "p", "--at", NOON)
    assert done.exit_code == 1 and done.output.startswith("benchsim: plant.toml: optics.coating")


def test_sums_through_a_day_hardly_depend_on_the_step():
    coarse, fine = (bs.flux(PLANTS / "five", day="2026-06-21", step=s) for s in (1.0, 0.25))
    assert coarse.total("power").sum() == pytest.approx(fine.total("power").sum(), rel=0.01)
    assert len(fine.moments) == pytest.approx(4 * len(coarse.moments), abs=3)
    energy = coarse.maps()[0]
    assert float(energy.ravel() @ coarse.moments[0].meshes[0].weights) / 1e6 == pytest.approx(
        coarse.total("power").sum(), rel=1e-9
    )


def test_a_year_is_a_quarter_of_each_of_four_days():
    year = bs.flux(PLANTS / "five", year=2026, step=3.0)
    days = [bs.flux(PLANTS / "five", day=f"2026-{d}", step=3.0) for d in ("03-21", "06-21", "09-22", "12-21")]
    expected = 365.25 / 4 * sum(d.total("power") for d in days)
    np.testing.assert_allclose(year.total("power"), expected, rtol=1e-12)
    assert "the year by 2026-03-21, 2026-06-21" in year.summary()


def test_days_on_which_the_sun_does_not_rise_are_said_and_heights_have_one_sign():
    five = files.read(PLANTS / "five")
    polar = replace(five, site=replace(five.site, latitude=np.radians(72.0)))
    year = bs.flux(polar, year=2026, step=6.0, cells=10)
    assert "the sun does not rise on 2026-12-21: nothing is added" in year.text()
    assert year.as_dict()["days_without_sun"] == ["2026-12-21"]
    assert not bs.flux(PLANTS / "five", year=2026, step=6.0, cells=10).dark
    with pytest.raises(BenchsimError, match=r"^--day: the sun is \d+\.\d deg below the horizon at its highest"):
        bs.flux(polar, day="2026-12-21")


def test_what_errors_cost_is_ranked_with_its_sigma():
    """A heliostat with a large error comes first and loses what it does not catch any more."""
    result = bs.flux(PLANTS / "five", day="2026-03-21", errors="drawn", seed=2, rank=True, step=4.0, cells=40)
    none = bs.flux(PLANTS / "five", day="2026-03-21", errors="none", step=4.0, cells=40)
    np.testing.assert_allclose(result.rank.lost, none.total("power") - result.total("power"), atol=1e-9)
    order = [r["id"] for r in result.as_dict()["rank"]]
    assert order[0] == f"H{np.argmax(result.rank.lost) + 1}" and "costliest: cost" in result.summary()
    assert (result.rank.sigma > 0).all()


def test_where_no_calibration_pays_that_is_said_and_losses_are_called_so():
    """Errors drawn from sigmas that a calibration leaves: of these five, by this seed, each rather stays."""
    result = bs.flux(PLANTS / "five", day="2026-03-21", errors="drawn", seed=2, rank=True, step=6.0, cells=20)
    worse = replace(result.rank, recalibrated=-0.1 - np.arange(5.0), reaimed=np.full(5, -0.25))
    none, gain = replace(result, rank=worse).text(), replace(result, rank=replace(worse, reaimed=np.ones(5))).text()
    assert "to calibrate pays for none" in none and "to shift all aims by constants loses another 1.25 kWh" in none
    assert "0 of 5" not in none and "below 0 more is lost" in none
    assert "to shift all aims by constants brings back 5 kWh" in gain
    some = replace(result, rank=replace(worse, recalibrated=np.array([2.0, -1, -1, -1, 1]), reaimed=np.ones(5))).text()
    assert "to calibrate the 2 of 5 that gain by it brings back 3 kWh" in some


def test_errors_that_are_not_stated_are_not_called_stated():
    five = files.read(PLANTS / "five")
    off = {"IA": np.full(5, 1e-3)}
    says = [
        bs.flux(replace(five, field=replace(five.field, **x)), at=NOON, cells=10).text().splitlines()[0]
        for x in ({}, {"sigmas": {}}, {"errors": off})
    ]
    assert "of which only sigmas are stated" in says[0] and "as none are stated" in says[1]
    assert says[2].endswith("errors of the mounts as stated")


def test_errors_are_as_diagnosed_where_a_diagnosis_is_named(tmp_path):
    file = (PLANTS / "five" / "plant.toml").read_text()
    (tmp_path / "plant.toml").write_text(file.replace("[heliostats]", '[heliostats]\ndiagnosed = "field.csv"'))
    (tmp_path / "heliostats.csv").write_text((PLANTS / "five" / "heliostats.csv").read_text())
    (tmp_path / "field.csv").write_text("id,east_m,north_m,up_m,sizes\nH1,0,0,0,IA = 4 ± 0.2 mrad\n")
    found, stated = (bs.flux(tmp_path, at=NOON, errors=e) for e in (None, "stated"))
    assert found.errors == "diagnosed" and "as diagnosed" in found.summary()
    away = np.linalg.norm(found.moments[0].landing, axis=1)
    assert away[0] > 300 and away[1:].max() < 1e-6 and np.abs(stated.moments[0].landing).max() < 1e-6


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--at", "noon"], "--at: 'noon' is no time"),
        (["--at", "2026-06-21"], "--at: '2026-06-21' is no time from 1950 to 2100; write it like 2026-06-21T12:00"),
        (["--at", "2026-06-21T01:00"], "below the horizon"),
        (["--day", "2026-02-30"], "--day, --year: '2026-02-30' is no date"),
        (["--day", "2026-06-21", "--step", "20"], "--step: 20 h is out of range"),
        (["--at", NOON, "--errors", "diagnosed"], "heliostats.diagnosed: is missing"),
        ([], "give one of --at, --day and --year"),
        (["--at", NOON, "--rank"], "give --day or --year"),
        (["--at", NOON, "--aligned", "2026-06-21T00:00"], "--aligned: the sun is below the horizon"),
        (["--at", NOON, "--tls", "a", "b", "c"], "give --scheduler too"),
        (["--at", NOON, "--scheduler", "tcp://127.0.0.1:9"], "without TLS"),
    ],
)
def test_what_cannot_be_computed_is_told_in_a_sentence(words, says, tmp_path):
    done = run("flux", PLANTS / "five", *words, "-o", tmp_path / "out")
    assert done.exit_code in (1, 2) and says in " ".join(done.output.replace("│", " ").split())
    assert not (tmp_path / "out").exists()


def test_times_are_the_sites_unless_they_say_their_zone():
    """Hermosillo keeps UTC−7 all year."""
    local, utc = (bs.flux(PLANTS / "five", at=t, errors="none") for t in (NOON, "2026-06-21T19:00Z"))
    assert local.times[0] == utc.times[0] and local.times[0].utcoffset().total_seconds() == -7 * 3600
    np.testing.assert_array_equal(local.moments[0].sun, utc.moments[0].sun)


def test_results_show_themselves():
    result = bs.flux(PLANTS / "five", at=NOON)
    assert len(repr(result)) < 200 and result._repr_html_().count("data:image/png;base64,") == 2
    assert "written" not in result.summary()


def test_both_engines_say_where_they_part_and_why(tmp_path, monkeypatch):
    """Of a Gaussian sun only slopes and what is left are causes; the page and the map hold both."""
    from benchsim.fluxes import traced

    monkeypatch.setattr(traced, "BATCH", 2**17)
    out = tmp_path / "out"
    done = run(
        "flux", PLANTS / "five", "--at", NOON, "-o", out, "--engine", "both", "--accuracy", 5, "--cells", 30,
        "--variant", "llvm_ad_mono",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    plain = json.loads((out / "flux.json").read_text())
    (parting,) = plain["partings"]
    assert parting["power_kw"]["product"] == pytest.approx(parting["power_kw"]["monte_carlo"], rel=0.02)
    assert [c["says"].split()[0] for c in parting["causes"]] == ["slopes", "the"]
    # Twelve seeds of many rays: by the slopes the peak is 3.20 ± 0.13 % low; a false alarm in 10⁴.
    slopes = parting["causes"][0]
    assert abs(slopes["peak"] + 0.032) < 4 * slopes["peak_sigma"] < 0.1 and abs(slopes["power"]) < 0.005
    total = np.prod([1 + c["peak"] for c in parting["causes"]])
    assert total == pytest.approx(parting["peak_kw_m2"]["product"] / parting["peak_kw_m2"]["monte_carlo"], rel=1e-9)
    cells = list(csv.DictReader((out / "flux-target.csv").open()))
    assert {"flux_kw_m2", "monte_carlo_flux_kw_m2", "sigma_flux_kw_m2"} < set(cells[0])
    away = [(float(c["flux_kw_m2"]) - float(c["monte_carlo_flux_kw_m2"])) for c in cells]
    assert np.sqrt(np.mean(np.square(away))) < 0.05 * max(float(c["flux_kw_m2"]) for c in cells)
    page = (out / "report.html").read_text()
    assert (
        "Where the engines part" in page
        and page.count("data:image/png;base64,") == 3
        and "where the engines" in done.output
    )


def test_monte_carlo_alone_gives_the_same_sums(monkeypatch):
    from benchsim.fluxes import traced

    monkeypatch.setattr(traced, "BATCH", 2**17)
    result = bs.flux(PLANTS / "five", at=NOON, engine="carlo", accuracy=5, cells=20, variant="llvm_ad_mono")
    product = bs.flux(PLANTS / "five", at=NOON, cells=20)
    assert result.total("power").sum() == pytest.approx(product.total("power").sum(), rel=0.01)
    assert "Monte Carlo" in result.summary() and result.as_dict()["engine"] == "Monte Carlo"
    assert result.on_receivers()[0] == pytest.approx(result.total("power").sum(), rel=1e-4)


def test_the_accuracy_of_a_day_is_that_of_all_its_times_together():
    """Errors are independent from time to time, so that their squares add, weighed by power."""
    day = bs.flux(PLANTS / "five", day="2026-06-21", step=4.0, cells=10)
    relative = np.linspace(0.02, 0.04, len(day.moments))
    noisy = [
        replace(m, noise=Noise(0 * m.power, 0 * m.received, tuple(0 * x for x in m.flux), 1000, float(a)))
        for m, a in zip(day.moments, relative, strict=True)
    ]
    power = np.array([m.power.sum() for m in day.moments])
    result = replace(day, moments=tuple(noisy), engine="carlo")
    said = result.as_dict()["monte_carlo"]
    assert said["accuracy"] == pytest.approx(np.sqrt(np.sum((relative * power) ** 2)) / power.sum(), rel=1e-3)
    assert said["accuracy"] < 0.03 and said["accuracy_at_worst_time"] == pytest.approx(0.04)
    assert (
        f"power or brightest cell, the larger: {100 * said['accuracy']:.2g} % of all times together, 4 % at the worst"
        in result.text()
    )
    dark = replace(noisy[0], received=np.zeros(1), noise=replace(noisy[0].noise, accuracy=float("inf")))
    assert replace(result, moments=(dark, *noisy[1:])).as_dict()["monte_carlo"]["accuracy"] < 0.04
    assert "no receiver is lit" in replace(result, moments=(dark,), times=result.times[:1]).text()


def test_progress_goes_on_where_rays_and_what_errors_cost_are_wanted(monkeypatch):
    """The product, which costs are compared to, is computed as well."""
    real = plant_flux.moments
    monkeypatch.setattr(plant_flux, "moments", lambda *a: real(*a[:4], replace(a[4], name="product"), *a[5:]))
    heard = []
    bs.flux(
        PLANTS / "five", day="2026-06-21", step=6.0, cells=10, engine="carlo", rank=True,
        progress=lambda _, done: heard.append(done),
    )  # fmt: skip
    assert heard == sorted(heard) and len(set(heard)) == len(heard) > 6 and heard[-1] == 1.0
