"""The report page as text: whole, self-contained, readable by machines that read aloud, and true to the results.

A parser stands for the browser where there is none: `Page` notes what a browser would fetch, what it could not find,
and what has no name for a person who does not see it.
"""

import json
import re
import tomllib
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from benchsim import jobs
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.cli import app
from benchsim.diagnosis.result import Law
from benchsim.jobs import exhibits
from benchsim.reports import forms, page, page_plots, page_trial, page_words

VOID = {"meta", "link", "img", "input", "br", "hr", "col", "source", "wbr"}


class Page(HTMLParser):
    """Walks a page and collects what is wrong with it in ``faults``."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.open, self.faults, self.ids, self.refs = [], [], Counter(), []
        self.headings, self.texts, self.labels, self.inputs, self.images = [], [], set(), [], 0
        self.feed(html)
        self.close()
        self.faults += [f"<{tag}> is never closed" for tag, _ in self.open]
        self.faults += [f"id {i} twice" for i, n in self.ids.items() if n > 1]
        self.faults += [f"#{r} leads nowhere" for r in self.refs if r not in self.ids]
        if [h for h, _ in self.headings].count(1) != 1:
            self.faults.append("not one h1")
        levels = [h for h, _ in self.headings]
        self.faults += [f"h{a} is followed by h{b}" for a, b in pairwise(levels) if b > a + 1]
        for i in self.inputs:
            if i.get("id") not in self.labels and "aria-label" not in i:
                self.faults.append(f"an input without a label: {i}")
        self.text = " ".join(" ".join(self.texts).split())

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_starttag(self, tag, attributes):
        a = dict(attributes)
        if "id" in a:
            self.ids[a["id"]] += 1
        for key in ("src", "href", "srcset", "data", "action", "poster"):
            value = a.get(key)
            if value is None:
                continue
            if value.startswith("#"):
                self.refs.append(value[1:])
            elif value.startswith("data:image/jpeg;base64,"):
                self.images += 1
            else:
                self.faults.append(f"<{tag}> fetches {value[:60]}")
        if tag in ("link", "iframe", "object", "embed") or (tag == "script" and "src" in a):
            self.faults.append(f"<{tag}> fetches")
        if tag == "svg" and a.get("role") != "img" and a.get("aria-hidden") != "true":
            self.faults.append("a drawing without a role")
        if tag == "label" and "for" in a:
            self.labels.add(a["for"])
            self.refs.append(a["for"])
        if tag == "input":
            self.inputs.append(a)
        if tag not in VOID:
            self.open.append((tag, a))

    def handle_endtag(self, tag):
        if not self.open or self.open[-1][0] != tag:
            self.faults.append(f"</{tag}> closes {self.open[-1][0] if self.open else 'nothing'}")
        if self.open:
            self.open.pop()

    def handle_data(self, data):
        here = [t for t, _ in self.open]
        if "style" in here and re.search(r"url\(|@import", data):
            self.faults.append("the style sheet fetches")
        if not {"style", "script"} & set(here):
            self.texts.append(data)
        if here and re.fullmatch("h[1-6]", here[-1]):
            self.headings.append((int(here[-1][1]), data))


STAMP = {
    "command": "diagnose", "written": "2026-01-02T03:04:05+00:00", "versions": {"benchsim": "0.1.0"},
    "inputs": {"recording.toml": "ab" * 32}, "defaults_used": ["screen.reflectance = 0.8"],
}  # fmt: skip


@pytest.fixture(scope="module")
def photographs():
    dark = np.linspace(0, 1, 300 * 400).reshape(300, 400)
    return {f"photographs/{k}.jpg": exhibits.jpeg(dark) for k in range(1, 41)}


def diagnosed(made, d, photographs, **changes):
    return Page(page.diagnosis_page({**made.plain(d), **changes}, made.beside(d), photographs, STAMP))


@pytest.mark.parametrize("verdict", ["named", "nothing-missing", "class", "located", "unexplained"])
def test_the_page_of_every_verdict_is_whole_and_fetches_nothing(made, verdicts, photographs, verdict):
    p = diagnosed(made, verdicts[verdict], photographs)
    assert p.faults == []
    assert p.images == 6 and sum(i["type"] == "range" for i in p.inputs) == (0 if verdict == "nothing-missing" else 6)
    first = p.headings[0]
    assert first[0] == 1 and first[1].startswith("Nothing is" if verdict == "nothing-missing" else "Something is")
    assert p.text.startswith(f"six: {first[1]} six, diagnosed {first[1]}"), "the verdict stands on top"


@pytest.mark.parametrize(
    ("html", "fault"),
    [
        ("<h1>a</h1><img src='https://example.org/a.png'>", "fetches"),
        ("<h1>a</h1><style>@import 'a.css'</style>", "style sheet"),
        ("<h1>a</h1><link rel=stylesheet href=a.css>", "fetches"),
        ("<h1>a</h1><script src=a.js></script>", "fetches"),
        ("<h1>a</h1><p><b>x</p></b>", "closes"),
        ("<h1>a</h1><a href='#b'>b</a>", "nowhere"),
        ("<h1>a</h1><svg></svg>", "role"),
        ("<h1>a</h1><input type=range>", "label"),
        ("<h1>a</h1><h3>b</h3>", "followed by"),
        ("<p>a</p>", "h1"),
    ],
)
def test_the_parser_sees_what_would_be_wrong(html, fault):
    assert any(fault in f for f in Page(html).faults)


def test_a_named_effect_comes_with_size_remedy_place_and_what_settings_left_out_say(made, photographs):
    text = diagnosed(made, made.diagnosis, photographs).text
    for words in (
        "it has a name: screen-bow",
        "6 exposures of 3 settings, against the bench as the file states it.",
        "probability above 99.99 %; sizes ± 1 sigma",
        "bow along y bow_y 0.03120 ± 0.00091 1/m",
        "bow along z bow_z −0.0121 ± 0.0013 1/m",
        "Put a straightedge across the board",
        "In the screen, as a function of board y, z: odds of more than a million to 1",
        "3 folds, 816 data",
        "from 5120 to 60 (± 41): 98.8 % of it is removed",
        "Roll the screen by 180° and repeat setting s1. It separates what is still open by 9.4 sigma",
        "Not visible in these recordings at any plausible size: window (win_1).",
    ):
        assert words in text, words


def test_a_gain_within_its_scatter_is_not_called_one(made, photographs):
    held = replace(made.diagnosis.held_out, excess_chi2_before=50.0, excess_chi2_after=10.0)
    text = diagnosed(made, replace(made.diagnosis, held_out=held), photographs).text
    assert "these recordings show no gain" in text and "of it is removed" not in text
    assert "none could be left out" in diagnosed(made, replace(made.diagnosis, held_out=None), photographs).text


def test_a_class_says_its_members_and_what_would_split_it(made, verdicts, photographs):
    text = diagnosed(made, verdicts["class"], photographs).text
    assert "One of these 2 together 99.1 %; amended.toml states the first" in text
    assert "screen-tilt (turn about y 2.00 ± 0.10 mrad, IA = −1.00 ± 0.20 mrad)" in text
    assert "tangential-distortion with drift : What tangential-distortion does. What drift does." in text
    assert "To tell them apart: Print marks. It separates them by 12.0 sigma." in text
    assert text.count("in a class") == 3


def test_a_law_stands_in_for_a_cause_without_a_name(made, verdicts, photographs):
    none = np.zeros(0)
    law = Law("screen.height", "board z", {"z^2": 1.2e-5}, 0.97, 0.02, none, none.astype(np.intp), none)
    text = diagnosed(made, replace(verdicts["located"], law=law), photographs).text
    assert "a law in board z (1.2e−05 · z^2) stands in for it" in text and "removes 97.0 ± 2.00 %" in text


def test_probabilities_are_in_the_order_of_the_light_and_never_0_or_1(made):
    d = made.plain(
        replace(made.diagnosis, probability={**made.diagnosis.probability, "canting": 0.0, "screen-bow": 1.0})
    )
    rows = page_words.probabilities(d, made.beside())
    assert [e for e, _ in rows] == ["source", "mirror", "air", "screen", "camera", "time"]
    assert all(a["p"] >= b["p"] for _, of in rows for a, b in pairwise(of))
    flat = {r["name"]: r for _, of in rows for r in of}
    assert flat["screen-bow"]["at"] == pytest.approx(100, abs=1e-3) and flat["screen-bow"]["word"] == "named"
    assert page_words.chance(1.0) == "above 99.99 %" and page_words.chance(0.0) == "below 0.01 %"
    assert page_words.place(0.02) == pytest.approx(28.87, abs=0.01), "where the template draws the prior"
    assert page_words.place(0.9) == pytest.approx(61.93, abs=0.01)
    assert page_words.place(0.99) == pytest.approx(74.95, abs=0.01)


def test_names_that_hold_markup_stay_text(made, photographs):
    evil = "<script>alert(1)</script>"
    d = made.plain(made.diagnosis)
    d["remarks"], extra = [evil], made.beside()
    extra["title"] = extra["exposures"][0]["exposure"] = evil
    html = page.diagnosis_page(d, extra, photographs, STAMP)
    assert evil not in html and html.count("&lt;script&gt;alert(1)") >= 4 and Page(html).faults == []


def test_distances_are_enlarged_by_one_round_factor_that_is_said(made, photographs):
    extra = made.beside()
    factor = page.enlarged(extra["exposures"])
    widest = max(np.max(np.abs(x["residual_mm"]["before"])) for x in extra["exposures"])
    assert factor * widest / 500 == pytest.approx(page.APART, rel=0.6) and factor * widest / 500 <= page.APART
    assert factor in (50.0, 100.0)
    html = page.diagnosis_page(made.plain(made.diagnosis), extra, photographs, STAMP)
    assert f"is drawn {factor:g} times as large as it is" in Page(html).text
    drawn = np.array([p.split() for p in re.search(r'class="before" d="M([^"]+)"', html)[1].split("L")], float)
    strongest = max(made.diagnosis.location.along_trace, key=lambda s: s.z)
    worst = next(x for x in extra["exposures"] if x["exposure"] == strongest.exposure)
    away = np.linalg.norm(drawn - np.array(worst["measured_px"]), axis=1)
    assert away == pytest.approx(factor * np.abs(worst["residual_mm"]["before"]), abs=0.15)


def test_a_trace_far_off_is_drawn_to_scale(made):
    extra = made.beside()
    for x in extra["exposures"]:
        x["before_px"] = (np.array(x["measured_px"]) + 30).tolist()
    assert page.enlarged(extra["exposures"]) == 1.0


def test_many_exposures_show_those_of_the_largest_misfit(made, photographs):
    extra = made.beside()
    one = extra["exposures"][0]
    extra["exposures"] = [
        {**one, "exposure": f"{k:03d}.png", "photograph": f"photographs/{k}.jpg",
         "before_px": (np.array(one["measured_px"]) + 0.01 * k).tolist()}
        for k in range(1, 41)
    ]  # fmt: skip
    html = page.diagnosis_page(made.plain(made.diagnosis), extra, photographs, STAMP)
    p = Page(html)
    assert p.images == page.MOST_SHOWN and "28 more photographs, of smaller misfit" in p.text
    assert html.index(">040.png") < html.index(">039.png") and html.count("<figcaption>") == 40


def test_without_photographs_residuals_are_still_there(made):
    p = Page(page.diagnosis_page(made.plain(made.diagnosis), made.beside(photographs=False), {}, {}))
    assert p.faults == [] and p.images == 0 and "Photograph and prediction" not in p.text
    assert p.text.count("distance of the trace from its prediction") == 6


def test_the_residual_drawing_holds_every_point_and_says_its_rms(made):
    x = made.beside()["exposures"][0]
    x["residual_mm"]["held_out_after"][3] = None
    svg = str(page_plots.residuals(x, page_plots.reach([x])))
    dots = re.findall(r'class="after dot" d="([^"]+)"', svg)
    assert [d.count("M") for d in dots] == [64, 63]
    before = float(np.sqrt(np.mean(np.square(x["residual_mm"]["before"]))))
    assert f"fitted: rms {before:.2g} before, " in svg and "left out: rms" in svg


def test_traces_that_are_compared_are_drawn_on_one_scale(made, photographs):
    extra = made.beside()
    far = extra["exposures"][4]["residual_mm"]
    far["before"] = [5 * v for v in far["before"]]
    html = page.diagnosis_page(made.plain(made.diagnosis), extra, photographs, STAMP)
    plots = re.findall(r'<svg class="plot".*?</svg>', html)
    assert len(plots) == 6
    heights = {tuple(re.findall(r'text-anchor="end">([^<]+)<', p)) for p in plots}
    assert len(heights) == 1 and len(set(heights.pop())) > 2, "the same numbers at every panel's axis"


def test_what_an_effect_moves_and_how_far_settings_were_off_stand_in_mm_and_mrad(made, photographs):
    extra = made.beside()
    extra["moves"] = {
        "bow_y": {"value": 1.91, "sigma": 0.06, "unit": "mm", "how": "at the board's edges"},
        "screen-bow": {"value": 0.052, "sigma": 0.002, "unit": "mm", "how": "rms over all traces"},
    }
    extra["priors"] = {"s2.laser_azimuth": {"sigma": 1.5, "unit": "mrad"}}
    text = Page(page.diagnosis_page(made.plain(made.diagnosis), extra, photographs, STAMP)).text
    assert "0.03120 ± 0.00091 1/m 1.910 ± 0.060 mm at the board's edges bow along z" in text
    assert "alone, on the trace 52.0 ± 2.0 µm rms over all traces" in text
    assert "s2: laser's azimuth −5.1 1.5 mrad −3.40" in text, "pull times what was stated"
    bare = diagnosed(made, made.diagnosis, photographs).text
    assert "s2: laser's azimuth −3.40" in bare and "alone, on the trace" not in bare, "a folder of before"


def test_marks_that_were_left_out_are_one_remark(made, photographs):
    lone = [f"{p}.png: mark {m} lies off its neighbours and is left out" for p, m in (("001", 4), ("001", 7))]
    text = diagnosed(made, made.diagnosis, photographs, remarks=lone).text
    assert text.count("neighbours") == 1 and "2 marks lie off their neighbours" in text and "4, 7 in 001.png." in text


def test_numbers_of_the_limits_are_read_without_powers_of_ten(made, photographs):
    limits = {"grid-scale": {"parameter": "gs", "five_sigma": 0.00335, "unit": "1e-3", "reachable": True}}
    text = diagnosed(made, made.diagnosis, photographs, limits=limits).text
    assert "grid-scale too far apart by gs 3.35 µm/m" in text


@pytest.fixture
def validated():
    """Page, validation and conics of a run that is kept."""
    folder = Path(__file__).parents[1] / "hostile" / "corpus" / "validation"
    return [json.loads((folder / f"{name}.json").read_text()) for name in ("validation", "conics", "page")]


def test_a_validation_says_settings_in_mm_and_mrad_and_what_its_dots_are(validated):
    found, conics, extra = validated
    first, row = extra["exposures"][0], found["exposures"][0]
    per = len(first["s_mm"])
    first["profiles"] = 17 * per
    first["departures"] = {"mirror_axis_2": {"value": -4.81, "sigma": 0.47, "unit": "mrad"}}
    row["pulls"] = {"mirror_axis_2": -2.75}
    p = Page(page.validation_page(found, conics, extra, {}, STAMP))
    assert p.faults == []
    for words in (
        "rms distance of the trace's single profiles",
        "Each dot is the mean of 17 neighbouring profiles",
        "mirror's normal leaning toward its axis mrad −4.81 ± 0.47 −2.75 sigma",
        "Without r it would reflect on that axis",
    ):
        assert words in p.text, words
    del first["profiles"], first["departures"]
    before = Page(page.validation_page(found, conics, extra, {}, STAMP)).text
    assert "Each dot" not in before and "leaning toward its axis −2.75 sigma" in before, "a folder of before"


def test_ticks_are_round_and_within():
    rng = np.random.default_rng(2)
    for low, width in zip(rng.normal(0, 10, 300), 10 ** rng.uniform(-4, 4, 300), strict=True):
        at = page_plots.ticks(low, low + width, 5)
        assert 1 <= len(at) <= 6 and low - 1e-9 <= min(at) and max(at) <= low + width + 1e-9 * (1 + width)
        step = np.diff(at)
        if len(step):
            assert np.allclose(step, step[0]) and f"{step[0]:.0e}"[0] in "125"


def test_a_trial_shows_its_table_its_misses_and_its_ledger(trial):
    p = Page(page.trial_page(trial, {}))
    assert p.faults == [] and p.headings[0][1] == "5 of 8 concealed causes were named."
    for words in (
        "✗ wrong",
        "○ missed",
        "◐ class",
        "judged twice",
        f"{9:064x}",
        "○ open",
        "0 … 30 %",
    ):
        assert words in p.text, words
    assert "cause 5 1 1 1 1" in p.text, "cases by outcome: right, class, missed, wrong, does not apply"
    assert "stated 0.99: 7 of 8 there" in p.text and p.text.count("at 5: 1 of 3; at 40: 3 of 3") == 3


def test_a_matrix_that_would_be_wide_is_a_list_first(trial):
    many = [f"effect-{k}" for k in range(page_trial.WIDE + 1)]
    counts = 2 * np.eye(len(many), dtype=int)
    counts[0, 3] = 1
    score = {**trial, "confusion": {"concealed": many, "said": many, "counts": counts.tolist()}}
    p = Page(page.trial_page(score, {}))
    assert p.faults == [] and "effect-0 3 ✓ effect-0 × 2, effect-3 effect-1 2 ✓ effect-1 × 2" in p.text
    assert "The same as a matrix" in p.text and "The same as a matrix" not in Page(page.trial_page(trial, {})).text


@pytest.mark.parametrize(("chance", "words"), [(True, "scores at chance"), (False, "scores ✗ better than chance")])
def test_a_trial_says_what_guards_it(trial, chance, words):
    leak = {"clue": "001.png size", "auc": 0.53, "p_value": 0.4, "at_chance": chance}
    guards = {"leak": leak, "withheld": ["coma", "drift"], "certificate": {"passed": chance}}
    text = Page(page.trial_page({**trial, **guards}, {})).text
    assert words in text and "“001.png size”" in text and "catalogue: coma and drift." in text
    assert ("failed its certificate" in text) != chance


def test_a_trial_that_does_not_verify_says_so_first(trial):
    text = Page(page.trial_page({**trial, "verified": False}, {})).text
    assert text.index("does not verify") < text.index("Scored apart")


def test_an_empty_trial_is_a_page_too():
    bare = {"format": page_trial.FORMAT, "title": "none", "headline": "No case was judged.", "cases": []}
    assert Page(page.trial_page(bare, {})).faults == []


@pytest.mark.parametrize("turn", [1, -1])
def test_a_prediction_is_drawn_on_the_side_where_it_lies(turn):
    """Distances are positive to the left of the way that the model's light takes, whichever way a trace is listed."""
    s = np.linspace(0, 600, 65)
    model = np.stack([s - 300, 20 + 2e-4 * (s - 250) ** 2], axis=1)
    points = np.stack([s - 300, 5 + 1e-4 * (s - 250) ** 2], axis=1)[5:-5]
    travel = model[::turn]
    away = signed_distance(Curve(travel), points)[0]
    drawn = exhibits._Drawn(points, exhibits._left(points, travel), away, 0 * away)
    _, before, after = drawn.lines()
    assert np.abs(signed_distance(Curve(model), before)[0]).max() < 0.2, "15 mm off, put back up to the curves' angle"
    assert after == pytest.approx(points)


def folder_of(made, photographs, path):
    path.mkdir()
    for name, value in (("diagnosis", made.plain(made.diagnosis)), ("page", made.beside()), ("benchsim", STAMP)):
        (path / f"{name}.json").write_text(json.dumps(value))
    (path / "photographs").mkdir()
    for k in range(1, 7):
        (path / f"photographs/{k}.jpg").write_bytes(photographs[f"photographs/{k}.jpg"])
    return path


def test_the_command_writes_one_file_beside_the_results_or_where_it_is_told(made, trial, photographs, tmp_path):
    folder = folder_of(made, photographs, tmp_path / "out")
    done = CliRunner().invoke(app, ["report", str(folder), "--json"])
    assert done.exit_code == 0 and json.loads(done.output)["of"] == "diagnosis"
    html = (folder / "report.html").read_text()
    assert Page(html).faults == [] and Page(html).images == 6
    again = jobs.report(folder, tmp_path / "page.html")
    assert again.path.read_text() == html and "the page of a diagnosis" in again.summary()
    (folder / "score.json").write_text(json.dumps(trial))
    assert jobs.report(folder, tmp_path / "trial.html").of == "trial"


def test_the_templates_are_in_the_wheel():
    root = Path(page.__file__).parents[2]
    globs = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"][
        "benchsim.reports"
    ]
    here = Path(page.__file__).parent
    packed = {p for g in globs for p in here.glob(g)}
    assert packed == {p for p in here.rglob("*") if p.is_file() and p.suffix not in (".py", ".pyc")} != set()


def test_a_folder_that_cannot_be_shown_is_told_with_the_mend(made, photographs, tmp_path):
    folder = folder_of(made, photographs, tmp_path / "out")
    with pytest.raises(BenchsimError, match=r"no such folder; name one"):
        jobs.report(tmp_path / "nowhere")
    with pytest.raises(BenchsimError, match=r"holds no diagnosis\.json"):
        jobs.report(tmp_path)
    with pytest.raises(BenchsimError, match=r"nothing/report\.html: cannot be written"):
        jobs.report(folder, tmp_path / "nothing" / "report.html")
    (folder / "page.json").write_text('{"format": "benchsim-page/0"}')
    with pytest.raises(BenchsimError, match=r"page\.json: format: 'benchsim-page/0' is not"):
        jobs.report(folder)
    (folder / "page.json").unlink()
    with pytest.raises(BenchsimError, match=r"no page\.json.*benchsim diagnose"):
        jobs.report(folder)
    (folder / "diagnosis.json").write_text("{")
    (folder / "page.json").write_text("{}")
    with pytest.raises(BenchsimError, match=r"diagnosis\.json: is no JSON"):
        jobs.report(folder)
    assert not (folder / "report.html").exists()


def test_photographs_come_in_the_order_in_which_stretches_are_listed(made, photographs):
    html = page.diagnosis_page(made.plain(made.diagnosis), made.beside(), photographs, STAMP)
    listed = re.findall(r"<tr><td>(\d+\.png)</td>", html)
    shown = re.findall(r'<label for="picture-\d+">(\S+)', html)
    assert listed == ["001.png", "003.png"] == shown[:2]


def beside_most(made, kind):
    """``page.json`` of what a kind of datum shows most, as the job writes it."""
    extra, problem = made.beside(), made.problem
    for b, row in enumerate(extra["exposures"]):
        at = np.flatnonzero((problem.block == b) & (problem.kind == kind))
        marks = np.column_stack([np.linspace(20, 380, 20), np.linspace(10, 290, 20)])
        row["most"] = exhibits._of_kind(problem, made.diagnosis, b, kind, marks, np.ones(problem.rows(b).stop))
        assert len(at) == (2 * len(row["most"]["at_px"]) if kind == "m" else len(row["most"]["s_mm"]))
    return {**extra, "most": kind}


@pytest.mark.parametrize(("kind", "words"), [("f", "logarithm of the flux"), ("m", "marks")])
def test_the_first_picture_is_of_what_shows_most(made, photographs, kind, words):
    extra = json.loads(json.dumps(beside_most(made, kind)))
    shown = {"c": 1.0, kind: 21.4}
    d = replace(made.diagnosis, location=replace(made.diagnosis.location, by_kind=shown))
    assert exhibits.most(d) == kind
    forms.checked(forms.Page, Path("page.json"), extra)
    html = page.diagnosis_page(made.plain(d), extra, photographs, STAMP)
    p = Page(html)
    assert p.faults == []
    assert html.index(f"Where it shows most: {words}") < html.index('class="viewer"') < html.index('id="residuals"')
    assert f"{words} {'show' if kind == 'm' else 'shows'} most of what was found, 21.4 sigma" in p.text
    assert html.count("<figcaption>") == 12, "and the centre line further down"
    assert "<td>001.png</td><td>logarithm of the flux</td>" in html


def test_a_verdict_that_the_centre_line_shows_most_begins_with_the_photographs(made):
    d = made.diagnosis
    assert exhibits.most(replace(d, location=replace(d.location, by_kind={"c": 11.0, "f": 4.0}))) == "c"
    assert exhibits.most(replace(d, location=None)) == "c"


def test_a_folder_without_a_page_says_what_to_open(tmp_path):
    (tmp_path / "benchsim.json").write_text(json.dumps({"command": "flux"}))
    for name in ("summary.txt", "field.png", "flux-tower.png", "flux.json"):
        (tmp_path / name).write_text("")
    with pytest.raises(
        BenchsimError, match=r"of 'benchsim flux' no page is made; open field\.png, flux-tower\.png, sum"
    ):
        jobs.report(tmp_path)


def test_a_folder_that_has_its_page_says_to_open_that(tmp_path):
    (tmp_path / "benchsim.json").write_text(json.dumps({"command": "flux"}))
    for name in ("summary.txt", "field.png", "report.html"):
        (tmp_path / name).write_text("")
    with pytest.raises(BenchsimError, match=r"'benchsim flux' has written its page; open \S*report\.html$"):
        jobs.report(tmp_path)
