"""The pages of a plant's flux, detectors and drone in headless Chromium: whole on phone and desk, sorted, unaided.

Screenshots are kept in ``out/report/``. Without Chromium these tests skip; ``test_plant_pages.py`` still runs.
"""

import pytest
from chromium import WIDTHS, asked, needs_chromium

pytestmark = needs_chromium

PAGES = ("detectors", "record", "drone", "axes", "nothing", "flux", "engines")

COLUMNS = "[...document.querySelectorAll('#rows tbody tr')].map(r => r.cells[{}].textContent)"


@pytest.mark.parametrize("place", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_it_is_seen_whole_without_network(browser, plant_pages, name, place):
    browser.show(plant_pages[name], WIDTHS[place])
    assert browser.value("document.documentElement.scrollWidth") <= WIDTHS[place], "nothing hangs over the side"
    assert all(browser.value("[...document.images].map(i => i.complete && i.naturalWidth > 0)"))
    browser.picture(f"plant-{name}-{place}")
    assert asked(browser) == ([], [])


@pytest.mark.parametrize("name", PAGES)
def test_every_head_sorts_the_table_and_what_is_not_known_comes_last(browser, plant_pages, name):
    browser.show(plant_pages[name])
    heads = browser.value("[...document.querySelectorAll('#rows button')].map(b => b.dataset.number)")
    for k, number in enumerate(heads):
        for down in (False, True):
            browser.value(f"document.querySelectorAll('#rows button')[{k}].click()")
            cells = browser.value(COLUMNS.format(k))
            known = [c for c in cells if c]
            assert cells[: len(known)] == known
            values = [float(c.split()[0]) for c in known] if number == "1" else known
            assert values == sorted(values, reverse=down), (k, down)
    assert asked(browser) == ([], [])


@pytest.mark.parametrize("name", PAGES)
def test_a_wide_table_scrolls_in_its_own_box_and_says_so(browser, plant_pages, name):
    """On a phone: the heliostat's name stays, a shade shows that there is more, and the last column is reached."""
    browser.show(plant_pages[name], 390)
    box = "document.querySelector('#rows').parentElement"
    assert browser.value(f"getComputedStyle({box}).backgroundImage").count("gradient") == 4
    browser.value(f"{box}.scrollLeft = 1e4")
    sides = browser.value(
        f"[{box}, ...['th:first-child', 'td:last-child'].map(c => document.querySelector('#rows tbody ' + c))]"
        ".map(e => (r => [r.left, r.right])(e.getBoundingClientRect()))"
    )
    (left, right), name_of, last = sides
    assert name_of[0] == pytest.approx(left, abs=1) and last[1] == pytest.approx(right, abs=12)
    assert right <= 390


@pytest.mark.parametrize("place", WIDTHS)
def test_short_names_of_heliostats_stand_on_one_line(browser, plant_pages, place):
    browser.show(plant_pages["flux"], WIDTHS[place])
    boxes = browser.value(
        "[...document.querySelectorAll('#rows tbody tr')].map(r => r.getBoundingClientRect().height)"
        ".concat(parseFloat(getComputedStyle(document.querySelector('#rows')).fontSize))"
    )
    *heights, letter = boxes
    assert max(heights) < 3.5 * letter, "two lines of text and the cell's padding"


def test_what_errors_cost_is_seen_on_a_phone_before_anything_is_scrolled(browser, plant_pages):
    browser.show(plant_pages["flux"], 390)
    heads = browser.value(
        "[...document.querySelectorAll('#rows thead th')].filter(e => e.getBoundingClientRect().right <= 390)"
        ".map(e => e.textContent)"
    )
    assert "errors lose (kWh)" in heads
