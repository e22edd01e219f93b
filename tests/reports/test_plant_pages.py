"""The pages of a plant as text: the sentences of the summary, what contradicts it first, and no address but data."""

import json
import math
import re
from html import unescape

import pytest

import benchsim as bs
from benchsim.bench.errors import BenchsimError

WRITTEN = ("detectors", "record", "drone", "nothing", "flux", "engines")


def words(html):
    return " ".join(unescape(re.sub("<[^>]*>", " ", html)).split())


@pytest.mark.parametrize("name", WRITTEN)
def test_a_page_says_what_the_summary_says_and_fetches_nothing(plant_pages, name):
    html = plant_pages[name].read_text()
    summary = (plant_pages[name].parent / "summary.txt").read_text().splitlines()
    shown = words(html)
    deep = [x.startswith("    ") for x in [*summary[1:], ""]]
    told = [x.strip() for x, own, below in zip(summary[1:], deep, deep[1:], strict=False) if not own and not below]
    told = [x for x in told if not x.startswith("turn") and not x.endswith(":")]
    assert all(" ".join(x.split()) in shown for x in told) and " ".join(summary[0].split(": ")[-1].split()) in shown
    assert all(x.startswith("data:image/png;base64,") for x in re.findall(r'(?:src|href)="([^"]*)"', html))
    assert "default-src 'none'" in html and "<b>" not in html and html.count("<h1>") == 1


@pytest.mark.parametrize("name", WRITTEN)
def test_the_folder_leads_to_its_page(plant_pages, name):
    with pytest.raises(BenchsimError, match=r"has written its page; open \S*report\.html$"):
        bs.report(plant_pages[name].parent)


@pytest.mark.parametrize(("name", "says"), [("nothing", "beside the planned pattern"), ("axes", "2 of 9 pictures lie")])
def test_what_contradicts_the_plan_is_said_first_and_once(plant_pages, name, says):
    shown = words(plant_pages[name].read_text().partition("<main>")[2])
    assert shown.count(says) == 1 and shown.index("Contradicts the plan") < shown.index(says) < shown.index(
        "From above"
    )


def test_pages_hold_what_their_command_is_for(plant_pages):
    shown = {name: words(path.read_text()) for name, path in plant_pages.items()}
    assert "Hour by hour" in shown["detectors"] and "2026-03-21 12:" in shown["detectors"]
    assert "samples a second" in shown["detectors"] and "true (mrad)" in shown["detectors"]
    assert shown["record"].count("both traces cross an array: both angles") == 1, "not once for each"
    assert "4 of 4 heliostats measured" in shown["record"] and "raise the normal (mrad)" in shown["record"]
    assert "errors of the virtual flight, each angle" in shown["drone"] and "camera point" in shown["drone"]
    assert "-0.400 ± 0.250" in shown["axes"] and "1.200 ± 0.210" in shown["axes"]
    assert "axes of 0 of 4 heliostats" in shown["nothing"] and "uncertainty is made of" not in shown["nothing"]
    (parting,) = json.loads((plant_pages["engines"].parent / "flux.json").read_text())["partings"]
    peak, apart = parting["peak_kw_m2"], 1e3 * math.hypot(*parting["centroid_apart_m"])
    assert f"Monte Carlo {peak['monte_carlo']:.4g} ± {peak['sigma']:.2g} kW/m²" in shown["engines"]
    assert f"centroids {apart:.0f} mm apart" in shown["engines"] and "at 2026-03-21 12:00" in shown["engines"]
    assert "The costliest first." in shown["flux"] and "calibration brings back" in shown["flux"]
