"""The diagnosis in sentences: each verdict says what a person at the bench asks."""

from dataclasses import replace

import pytest

from benchsim.bench.settings import NAMES
from benchsim.diagnosis.problem import Effect, Parameter
from benchsim.diagnosis.result import Limit, Location, Size
from benchsim.instruments.bench.effects import CATALOGUE, SIZE
from benchsim.reports.diagnosis_text import About, odds, percent, place_text, summary
from benchsim.reports.quantities import rounded, words_of

LONE = (("001.png", 4), ("001.png", 7), ("003.png", 9))


def about(made, **changes):
    return replace(About("six recordings", 6, 3, "bench", made.problem.catalogue), **changes)


@pytest.mark.parametrize("verdict", ["named", "nothing-missing", "class", "located", "unexplained"])
def test_every_verdict_fits_a_terminal_and_begins_with_whether_anything_is_missing(made, verdicts, verdict):
    text = summary(verdicts[verdict], about(made))
    assert max(map(len, text.splitlines())) <= 100
    head = text.split("\n\n")[1]
    assert head.startswith("NOTHING IS MISSING" if verdict == "nothing-missing" else "SOMETHING IS MISSING")
    assert ("screen-bow" in head) == (verdict == "named")


def test_a_named_effect_comes_with_size_unit_remedy_place_and_gain(made):
    text = summary(made.diagnosis, about(made))
    for words in (
        "screen-bow (screen; named; probability above 99.99 %)",
        "Size: bow along y (bow_y) 0.03120 ± 0.00091 1/m, bow along z (bow_z) -0.0121 ± 0.0013 1/m (1 sigma).",
        "Put a straightedge across the board",
        "It shows in marks (21.4 sigma) and centre line (11.3 sigma), all exposures together.",
        "001.png: from 10 to 120 mm along the trace, 7.1 sigma",
        "centre line 0.131 → 0.031 mm",
        "from 5120 to 60 (± 41): 98.8 %",
        "Roll the screen by 180°",
        "s2: laser's azimuth (-3.4 sigma)",
    ):
        assert words in " ".join(text.split()), words


def test_nothing_missing_lists_every_limit_and_says_which_effects_could_not_be_seen(made, verdicts):
    text = summary(verdicts["nothing-missing"], about(made))
    table = text.split("had it been as large as:")[1].split("\n\n")[0]
    for name, limit in made.diagnosis.limits.items():
        assert (name in table) == limit.reachable
    blind = next(p for p in text.split("\n\n") if p.startswith("Not visible in these recordings at any plausible"))
    assert "window" in blind and "canting" not in blind


SWITCHES = tuple(
    Effect(name, "source", (Parameter(name, "1", 0.5, one_sided=True),), whole=True)
    for name in ("facets", "finite-beam", "diffraction")
)


def test_physics_in_doubt_comes_with_its_limit_where_it_was_not_found(made, verdicts):
    """Against the vector model each of the three is told with a size or with a limit, whatever the verdict."""
    limits = {
        "canting": Limit("pyr", 0.37, "mrad", True),
        "facets": Limit("facets", 0.11, "1", True),
        "finite-beam": Limit("beam", 0.22, "1", True),
        "diffraction": Limit("fresnel", 1.4, "1", False),
    }
    known = about(made, against="vector", catalogue=(*made.problem.catalogue, *SWITCHES))
    for verdict in ("named", "class", "located", "unexplained"):
        text = " ".join(summary(replace(verdicts[verdict], limits=limits), known).split())
        start = "Not found, and would have been seen at five sigma had it been as large as: "
        assert f"{start}facets (share of the facets: 0.11), finite-beam (share of the beam: 0.22)." in text
        assert "size: diffraction (share of the diffraction)." in text and "lean of every facet" not in text
    rivals = replace(verdicts["class"].classes[0], members=(("facets",), ("finite-beam", "drift")))
    text = summary(replace(verdicts["class"], limits=limits, classes=(rivals,)), known)
    assert "Not found" not in text, "what may be there is not said to be absent"
    nothing = summary(replace(verdicts["nothing-missing"], limits=limits), known)
    assert "Not found" not in nothing and "share of the beam 0.22" in " ".join(nothing.split())


def test_a_limit_that_holds_at_one_place_says_so(made, verdicts):
    grid = (Parameter("plume", "mrad", 1.0), Parameter("plume_z", "mm", 1.0, grid=(-600.0, 0.0)))
    known = about(made, catalogue=(*made.problem.catalogue, Effect("plume", "air", grid)))
    for reachable in (True, False):
        limits = {"canting": Limit("pyr", 0.3, "mrad", True), "plume": Limit("plume", 0.1, "mrad", reachable)}
        text = " ".join(summary(replace(verdicts["nothing-missing"], limits=limits), known).split())
        start = "What is said here of plume (place in z) holds at one point of these only, the most probable "
        assert start + "that was tried." in text
    assert "What is said here of" not in summary(verdicts["nothing-missing"], known), "no limit of it is printed"
    assert "What is said here of" not in summary(made.diagnosis, known)


def test_a_place_in_several_elements_is_no_question_of_odds(made):
    both = Location("mirror + screen", "", False, 0.0, ())
    text = summary(replace(made.diagnosis, location=both), about(made))
    assert "Where: in the mirror and the screen, by what explains it best." in text and "odds" not in text
    assert place_text("camera", "image row") == "in the camera, as a function of image row"


def test_a_class_lists_its_members_and_what_would_split_it(made, verdicts):
    text = " ".join(summary(verdicts["class"], about(made)).split())
    assert "- screen-tilt (turn about y" in text and "- tangential-distortion with drift:" in text
    assert "Print marks. It separates them by 12.0 sigma." in text


def test_what_is_open_beside_nothing_is_not_in_the_amended_file(made, verdicts):
    d = verdicts["class"]
    text = " ".join(summary(d, about(made)).split())
    assert "amended.toml states the first" in text
    assert "screen-tilt (turn about y 2.00 ± 0.10 mrad, IA = -1.00 ± 0.20 mrad):" in text
    doubted = replace(d, classes=(replace(d.classes[0], members=(("coma",), ()), stated=False),))
    assert "amended.toml states none of it" in " ".join(summary(doubted, about(made)).split())


def test_few_settings_are_said_and_a_gain_within_scatter_is_no_gain(made):
    d = replace(made.diagnosis, held_out=None, notes=("Fewer than three settings: none can be left out.",))
    text = summary(d, about(made))
    assert text.count("Fewer than three settings") == 1 and "Left out in turn" not in text
    held = replace(made.diagnosis.held_out, excess_chi2_before=50.0, excess_chi2_after=10.0)
    text = " ".join(summary(replace(made.diagnosis, held_out=held), about(made)).split())
    assert "show no gain" in text and "80.0 %" not in text


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        (8891.0, 137.0, "falls from 8891 to 137 (± 20): 98.5 % of it is removed."),
        (60195.0, 12.0, "falls from 60195 to 12 (± 20): more than 99.9 % of it is removed."),
        (8891.0, 13771.0, "rises from 8891 to 13771 (± 20): what was found predicts settings left out no better."),
        (9000.0, -90.0, "falls from 9000 to -90 (± 20): all of it is removed (below zero: the noise"),
        (300.0, -90.0, "below zero by more than its scatter: the noise is overstated, and no gain can be given."),
    ],
)
def test_what_prediction_gained_is_told_by_its_sign(made, before, after, said):
    held = replace(made.diagnosis.held_out, excess_chi2_before=before, excess_chi2_after=after, sigma=20.0)
    assert said in " ".join(summary(replace(made.diagnosis, held_out=held), about(made)).split())


def test_several_lost_exposures_are_a_list(made):
    text = summary(made.diagnosis, about(made, lost=("004.png: no trace", "005.png: no trace")))
    assert "Dropped:\n- 004.png: no trace\n- 005.png: no trace" in text


def test_lost_exposures_remarks_and_defaults_are_said(made):
    text = summary(
        made.diagnosis, about(made, lost=("004.png: no trace",), remarks=("One setting.",), defaults=("a.b = 1.0",))
    )
    assert "Dropped: 004.png: no trace" in text and "One setting." in text and "a.b = 1.0." in text


def test_numbers_read_as_numbers():
    assert rounded(0.0312, 0.00091, "1/m") == "0.03120 ± 0.00091 1/m"
    assert rounded(12.34, 3.2, "1e-3") == "12.3 ± 3.2 mm/m"
    assert rounded(0.00335, 0.0002, "1e-3") == "3.35 ± 0.20 µm/m"
    assert rounded(0.02, 0.004, "mrad") == "20.0 ± 4.0 µrad"
    assert rounded(6.2e-5, 1e-6, "1") == "62.0 ± 1.0 ×10⁻⁶"
    assert rounded(0.97, 0.0, "1") == "0.97"
    assert percent(1.0) == "above 99.99 %" and percent(0.0) == "below 0.01 %" and percent(0.5) == "50 %"
    assert odds(50) == "odds of more than a million to 1" and odds(0.0) == "odds of 1 to 1"


def test_every_number_of_the_catalogue_and_of_a_setting_has_words():
    terms = {t.name for e in CATALOGUE for t in (*e.terms, SIZE)}
    assert [n for n in (*terms, *NAMES, "tilt_11", "s1.mirror_axis_2") if words_of(n) == n] == []
    assert words_of("seat1.screen_angle_x") == "seat1: screen turned about x" and words_of("IA") == "IA"


def test_what_an_effect_moves_stands_beside_its_size(made):
    moves = {"bow_y": (Size(1.91, 0.06, "mm"), "at the edges"), "screen-bow": (Size(0.052, 0.002, "mm"), "rms")}
    text = " ".join(summary(made.diagnosis, about(made, moves=moves)).split())
    assert "0.03120 ± 0.00091 1/m, which is 1.910 ± 0.060 mm at the edges; bow along z" in text
    assert "Alone it moves the trace by 52.0 ± 2.0 µm rms." in text


def test_marks_that_were_left_out_are_one_remark_with_the_cause(made):
    lone = tuple(f"{p}: mark {m} lies off its neighbours and is left out" for p, m in LONE)
    text = " ".join(summary(made.diagnosis, about(made, remarks=("One setting.", *lone, "Last."))).split())
    assert "- One setting. - 3 marks lie off their neighbours, taken as mismeasured (a fault of the board" in text
    assert "and left out: 4, 7 in 001.png; 9 in 003.png. - Last." in text
    assert "1 mark lies off its neighbours" in summary(made.diagnosis, about(made, remarks=lone[:1]))


def test_a_negative_excess_is_explained(made):
    held = replace(made.diagnosis.held_out, excess_chi2_after=-100.0)
    text = " ".join(summary(replace(made.diagnosis, held_out=held), about(made)).split())
    assert "is removed (below zero: the noise was estimated larger than that of the settings left out)." in text
    assert "below zero" not in summary(made.diagnosis, about(made))


def test_stretches_name_their_observable(made):
    text = summary(made.diagnosis, about(made))
    assert "  001.png: from 10 to 120 mm along the trace, 7.1 sigma, logarithm of the flux\n" in text
