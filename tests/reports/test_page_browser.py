"""The report page in a real browser, headless Chromium: seen on a phone and a desk, by keyboard, without network.

Keys are pressed and not simulated by a script, and every request is seen. Screenshots are kept in ``out/report/``.
Without Chromium these tests skip; the parser's in ``test_page.py`` still run.
"""

import base64
import json
import re
import time

import cv2
import numpy as np
import pytest
from chromium import ROOT, WIDTHS, asked, needs_chromium

from benchsim import jobs
from benchsim.bench.files import complaints, read
from benchsim.bench.writing import write_text
from benchsim.reports import page

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def report(made, tmp_path_factory):
    """The page of the diagnosis made by hand, with one grey photograph for all."""
    jpeg = cv2.imencode(".jpg", np.full((300, 400), 90, np.uint8))[1].tobytes()
    extra = made.beside()
    photographs = {x["photograph"]: jpeg for x in extra["exposures"]}
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_text(path, page.diagnosis_page(made.plain(made.diagnosis), extra, photographs, {}))
    return path


@pytest.fixture(scope="module")
def opened(trial, tmp_path_factory):
    """The page of the trial made by hand."""
    path = tmp_path_factory.mktemp("trial") / "report.html"
    write_text(path, page.trial_page(trial, {}))
    return path


@pytest.fixture(params=["diagnosis", "trial"])
def either(request, report, opened):
    return request.param, {"diagnosis": report, "trial": opened}[request.param]


@pytest.mark.parametrize("place", WIDTHS)
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_is_seen_whole_without_network(browser, either, place, scheme):
    name, path = either
    browser.show(path, WIDTHS[place], scheme)
    assert asked(browser) == ([], [])
    assert browser.value("document.documentElement.scrollWidth") <= WIDTHS[place], "nothing hangs over the side"
    small = (
        "[...document.querySelectorAll('main p, main td, main th, main li, main dd, main text')]"
        ".filter(e => e.getClientRects().length && !e.closest('small, [aria-hidden]'))"
        ".map(e => parseFloat(getComputedStyle(e).fontSize) * (e.closest('svg.plot')"
        " ? e.closest('svg').getBoundingClientRect().width / 360 : 1))"
    )
    assert min(browser.value(small)) > 9, "letters can be read"
    picture = browser.picture(f"{name}-{place}-{scheme}")
    assert picture.shape[1] == WIDTHS[place] and (picture[2, 2].mean() < 60) == (scheme == "dark")
    top = picture[:200].reshape(-1, 3).astype(int)
    assert np.ptp(top.mean(axis=1)) > 150, "the verdict stands out from the paper"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_what_is_behind_it(browser, either, scheme):
    """The contrast that WCAG 2 asks of text, 4.5 : 1."""
    browser.show(either[1], 1280, scheme)
    pairs = browser.value(
        """[...document.querySelectorAll('main *, footer *')].filter(e => e.getClientRects().length
          && !e.closest('svg') && [...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())).map(e => {
            let behind = e;
            const paper = e => getComputedStyle(e).backgroundColor;
            while (behind !== document.body && paper(behind) === 'rgba(0, 0, 0, 0)') behind = behind.parentElement;
            return [getComputedStyle(e).color, paper(behind), e.textContent.trim()];
          })"""
    )

    def parts(css):
        values = [float(x) for x in re.findall(r"[\d.]+", css)]
        return np.array(values[:3]) / 255, (values[3] if len(values) > 3 else 1.0)

    def luminance(c):
        return float(np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])

    paper, _ = parts(browser.value("getComputedStyle(document.body).backgroundColor"))
    assert len(pairs) > 80
    for front, back, words in pairs:
        behind, share = parts(back)
        a, b = sorted((luminance(parts(front)[0]), luminance(share * behind + (1 - share) * paper)))
        assert (b + 0.05) / (a + 0.05) >= 4.5, (words, front, back)


def test_every_control_is_reached_and_moved_by_keyboard(browser, report):
    browser.show(report)
    cut = "getComputedStyle([...document.querySelectorAll('.two .last')].find(e => e.offsetParent)).clipPath"
    start = browser.value(cut)
    assert "50%" in start
    reached = []
    for _ in range(12):
        browser.press("Tab", 9)
        reached.append(browser.value("document.activeElement.type || document.activeElement.tagName"))
    assert {"SUMMARY", "A", "radio", "range"} <= set(reached)
    while browser.value("document.activeElement.type") != "range":
        browser.press("Tab", 9)
    outline = browser.value("getComputedStyle(document.activeElement).outlineStyle")
    assert outline != "none", "who presses keys sees where"
    for _ in range(5):
        browser.press("ArrowRight", 39)
    assert "55%" in browser.value(cut) and "55 %" in browser.value("document.activeElement.ariaValueText")
    browser.press("Home", 36)
    assert "0px 0px 0px 0%" in browser.value(cut) or browser.value(cut) == "inset(0px)"
    before = browser.value("document.querySelector('.viewer input:checked').id")
    browser.value("document.querySelector('.viewer input:checked').focus()")
    browser.press("ArrowRight", 39)
    after = browser.value("document.querySelector('.viewer input:checked').id")
    shown = browser.value("[...document.querySelectorAll('.panel')].filter(e => e.offsetParent).length")
    assert after != before and shown == 1


def test_a_finger_moves_the_slider_on_the_picture(browser, report):
    browser.show(report, 390)
    browser.value("document.querySelector('.viewer').scrollIntoView()")
    box = browser.value(
        "(r => [r.left, r.top, r.width, r.height])(document.querySelector('.pictures').getBoundingClientRect())"
    )
    at = {"x": box[0] + 0.2 * box[2], "y": box[1] + 0.5 * box[3]}
    browser("Input.dispatchTouchEvent", type="touchStart", touchPoints=[at])
    browser("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert float(browser.value("document.querySelector('.slide input').value")) == pytest.approx(20, abs=1)


def test_the_two_halves_of_the_picture_are_before_and_after(browser, report):
    """Blue is the prediction before, green the one after, in the pixels that a person sees."""
    browser.show(report)
    clip = browser.value(
        "(r => ({x: r.left + scrollX, y: r.top + scrollY, width: r.width, height: r.height, scale: 1}))"
        "(document.querySelector('.pictures').getBoundingClientRect())"
    )

    def coloured(value):
        slider = "document.querySelector('.slide input')"
        browser.value(f"{slider}.value = {value}; {slider}.dispatchEvent(new Event('input'))")
        data = base64.b64decode(browser("Page.captureScreenshot", captureBeyondViewport=True, clip=clip)["data"])
        b, g, r = np.moveaxis(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int), 2, 0)
        return int(((b - r > 120) & (b > g + 30)).sum()), int(((g - r > 90) & (g > b + 40)).sum())

    blue, green = coloured(100)
    assert blue > 200 and green == 0
    blue, green = coloured(0)
    assert blue == 0 and green > 200
    half = coloured(50)
    assert min(half) > 50


def test_without_scripts_both_pictures_stand_there(browser, report):
    browser.show(report, 1280, scripts=False)
    picture = browser.picture("diagnosis-desk-no-script")
    b, g, r = np.moveaxis(picture.astype(int), 2, 0)
    rows = slice(0, picture.shape[0] // 2)
    left = (np.abs(b - 0xFF) < 30) & (np.abs(g - 0xB4) < 30) & (np.abs(r - 0x58) < 40)
    right = (np.abs(b - 0x8A) < 30) & (np.abs(g - 0xE0) < 30) & (np.abs(r - 0x4F) < 40)
    assert left[rows].sum() > 100 and right[rows].sum() > 100
    assert np.median(np.nonzero(left[rows])[1]) + 200 < np.median(np.nonzero(right[rows])[1])


ANSWERS = {
    "wavelength_nm": "650", "beam_diameter_mm": "7,5", "divergence_mrad": "1.5", "shape": "polygon", "facets": "12",
    "diameter_mm": "35", "height_mm": "2.0", "stands_for": "elevation", "size_mm": "700, 700",
    "laser_azimuth_deg": "101", "laser_elevation_deg": "50", "mirror_position_mm": "1500 -160 -1430",
}  # fmt: skip


@pytest.fixture
def begun(tmp_path):
    """A recording of a grey photograph and its dark picture, begun with its form."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in (1, 2):
        cv2.imwrite(str(photos / f"{k}.jpg"), np.full((240, 320), 60 * k, np.uint8))
    marks = ROOT / "scenes" / "marks.csv"
    return jobs.new(tmp_path / 'a "bench"', [photos], marks=marks, form=True).folder


def put(browser, key, value, which=""):
    """Write a value into every field of a key, as typing does, and return what is said beside them."""
    return browser.value(
        f"""[...document.querySelectorAll(".field{which}")].filter(f => f.innerText.startsWith("{key}")).map(f => {{
          const control = f.querySelector("input, select");
          control.value = {json.dumps(value)};
          control.dispatchEvent(new Event("input", {{bubbles: true}}));
          return f.querySelector("strong").textContent;
        }})"""
    )


def test_a_form_that_is_filled_in_downloads_a_file_that_is_read(browser, begun, tmp_path):
    browser.show(begun / "form.html")
    assert asked(browser) == ([], [])
    open_ = [key for key, mend in complaints(begun / "recording.toml") if "not filled in" in mend]
    state = "document.getElementById('state').textContent"
    assert browser.value(state) == f"{len(open_)} open"
    # Nothing is lost of what was begun: the file as it is downloaded untouched reads alike.
    (begun / "recording.toml").write_text(browser.value("assembled()"), encoding="utf-8")
    assert [key for key, mend in complaints(begun / "recording.toml") if "not filled in" in mend] == open_
    for key, value in ANSWERS.items():
        said = put(browser, key, value, ".open-field")
        assert said and set(said) == {""}, key
    # A text and a focal length that no photograph without EXIF tells.
    put(browser, "title", 'five "settings"')
    put(browser, "focal_px", "300")
    assert browser.value(state) == "all filled in"
    browser("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path / "down"))
    browser.value("document.getElementById('download').click()")
    file = tmp_path / "down" / "recording.toml"
    end = time.monotonic() + 20
    while not file.exists() and time.monotonic() < end:
        time.sleep(0.05)
    (begun / "recording.toml").write_bytes(file.read_bytes())
    assert complaints(begun / "recording.toml") == []
    recording = read(begun, images=True)
    assert recording.title == 'five "settings"' and recording.laser.beam_diameter == 7.5
    assert [e.laser_azimuth for e in recording.exposures] == pytest.approx([np.radians(101)])


def test_a_form_says_what_the_reader_would(browser, begun):
    browser.show(begun / "form.html", 390)
    assert browser.value("document.documentElement.scrollWidth") <= 390
    assert put(browser, "wavelength_nm", "99") == [" ✗ must be at least 100 nm"]
    assert put(browser, "laser_elevation_deg", "91") == [" ✗ must be at most 90 deg"]
    assert put(browser, "facets", "12.5") == [" ✗ write a whole number"]
    assert put(browser, "size_mm", "700") == [" ✗ 2 numbers, as 1.5, 2, 3"]
    assert put(browser, "beam_diameter_mm", "wide") == [" ✗ write a number, with a point"]
    assert "5 to be mended" in browser.value("document.getElementById('state').textContent")
    assert put(browser, "shape", "cylinder") == [""] and put(browser, "facets", "-") == [""]
    assert "facets" not in browser.value("assembled()").split("[screen]")[0].replace("facets,", "")
    browser.picture("form-phone")


def line_of(browser, key, value):
    """What stands in the file for a value of a key that occurs once; None: no line."""
    put(browser, key, value)
    found = [x for x in browser.value("assembled()").split("\n") if x.startswith(f"{key} =")]
    return found[0].split("#")[0].strip() if found else None


def test_a_form_writes_what_toml_takes_and_a_dash_leaves_a_line_out(browser, begun):
    browser.show(begun / "form.html")
    assert line_of(browser, "shape", "-") is None and line_of(browser, "shape", "") == 'shape = "?"'
    assert line_of(browser, "facets", "05") == "facets = 5" and line_of(browser, "facets", "+012") == "facets = 12"
    assert line_of(browser, "wavelength_nm", "0632.8") == "wavelength_nm = 632.8"
    assert put(browser, "gamma", "sRBG") == [" ✗ write a number, or srgb, unknown"]
    assert line_of(browser, "gamma", "srgb") == 'gamma = "srgb"' and line_of(browser, "gamma", "2.2") == "gamma = 2.2"
    offered = "[...document.querySelectorAll('datalist option')].map(o => o.value)"
    assert browser.value(offered) == ["srgb", "unknown"]
    bits = "[...document.querySelectorAll('select')].map(s => [...s.options].map(o => o.value))"
    assert ["", "-", "8", "16"] in browser.value(bits) and line_of(browser, "bit_depth", "16") == "bit_depth = 16"
