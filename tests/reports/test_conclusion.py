"""What is concluded is said once, and nothing that is said contradicts another thing."""

import json
import tarfile
from pathlib import Path

import pytest

from benchsim.reports.conclusion import SETTINGS, headline, leftover

KEPT = Path(__file__).parents[2] / "analysis" / "trial" / "kept.tar.xz"


def effect(name, confidence="named", **parameters):
    sizes = {k: {"value": v, "sigma": abs(v) / 10, "unit": "1"} for k, v in parameters.items()}
    return {
        "name": name,
        "element": "x",
        "confidence": confidence,
        "probability": 0.99,
        "parameters": sizes,
        "says": "",
    }


def diagnosis(verdict, effects=(), classes=(), left=(), **also):
    return {
        "verdict": verdict,
        "effects": list(effects),
        "classes": [{"members": [list(m) for m in c]} for c in classes],
        "location": None,
        "left": list(left),
        "notes": [],
        "limits": {},
        "probability": {},
        **also,
    }


BOW, TILT = effect("screen-bow"), effect("screen-tilt", "provisional")
HANDS = effect("setting-errors", scale=2.9)
HERE = {"element": "camera", "claimed": True}

SAID = [
    (diagnosis("nothing-missing"), "Nothing is missing that these recordings could show."),
    (diagnosis("named", [BOW]), "Something is missing from the simulation, and it has a name: screen-bow."),
    (
        diagnosis("named", [BOW, TILT]),
        "Something is missing from the simulation: screen-bow and screen-tilt (provisional).",
    ),
    (
        diagnosis("named", [HANDS]),
        "Nothing but the settings explains the difference. The settings were off by 2.9 ± 0.3 times what the file "
        "states as their uncertainty (named).",
    ),
    (
        diagnosis("class", [], [[[], ["beam-offset"], ["setting-errors"]]]),
        "These recordings cannot tell whether something is missing: nothing, or beam-offset or setting-errors.",
    ),
    (
        diagnosis("class", [BOW], [[["coma"], ["astigmatism"]]]),
        "Something is missing from the simulation, and these recordings leave a choice of what it is. In any case: "
        "screen-bow.",
    ),
    (
        # One of the classes says that something is there, whatever the other leaves open.
        diagnosis("class", [], [[["axis-tilt"], ["clock"]], [["coma"], []]]),
        "Something is missing from the simulation, and these recordings leave a choice of what it is.",
    ),
    (
        diagnosis("located", [TILT], location=HERE),
        "Something is missing from the simulation: screen-tilt (provisional). Beside it, what has no name in the "
        "catalogue sits in the camera.",
    ),
    (
        diagnosis("unexplained", [BOW]),
        "Something is missing from the simulation: screen-bow. What is left beside it has neither a name nor a place.",
    ),
    (
        diagnosis("unexplained"),
        "Something is missing from the simulation; neither its name nor its place can be told.",
    ),
]


def contradictions(d):
    """Statements of a diagnosis that cannot all hold, in sentences; empty where there is none."""
    out = []
    found = {f["name"]: f["confidence"] for f in d["effects"]}
    members = {n for c in d["classes"] for m in c["members"] for n in m}
    verdict, names = d["verdict"], [f["name"] for f in d["effects"]]
    if verdict == "nothing-missing" and (found or d["classes"]):
        out.append("nothing is missing, and something was found")
    if verdict == "nothing-missing" and d["probability"].get(SETTINGS, 0.0) >= 0.05:
        out.append("nothing is missing, and the settings are further off than stated")
    if verdict == "named" and not found:
        out.append("named, and nothing has a name")
    if verdict in ("named", "nothing-missing") and d["classes"]:
        out.append(f"{verdict}, and alternatives are open")
    if verdict == "class" and not d["classes"]:
        out.append("alternatives are open, and there are none")
    if verdict == "located" and not (d["location"] or {}).get("claimed"):
        out.append("located, and no place is claimed")
    out += [f"{n} is in a class and said for itself" for n in members & set(found)]
    out += [f"{n} is said twice" for n in set(names) if names.count(n) > 1]
    out += [f"{n} was found and its limit is stated" for n in d["limits"] if n.split(".")[0] in {*found}]
    text = " ".join([headline(d), leftover(d), *d["notes"], *(f["says"] for f in d["effects"])])
    out += [f"'{word}' in a sentence" for word in (" nan", " inf", "-inf") if word in f" {text}"]
    suspected = [n.split(" is suspected")[0] for n in d["notes"] if " is suspected" in n]
    out += [f"{n} is suspected and was found" for n in suspected if n in found]
    return out


@pytest.mark.parametrize(("d", "said"), SAID, ids=[d["verdict"] for d, _ in SAID])
def test_the_headline_says_what_was_found_and_what_is_left(d, said):
    assert headline(d) == said
    assert contradictions(d) == []


def test_what_is_left_comes_with_its_size():
    left = [
        {"family": "m", "p": 0.008, "rms": 0.014, "rms_mm": 0.0042},
        {"family": "c", "p": 1e-4, "rms": 0.02, "rms_mm": 0.02},
        {"family": "f", "p": 1e-4, "rms": 0.003, "rms_mm": None},
        {"family": "pulls", "p": 1e-4, "rms": None, "rms_mm": None},
    ]
    text = leftover(diagnosis("named", [BOW], left=left))
    assert text.startswith(
        "Left: 0.0042 mm of something smooth in the marks, 0.02 mm of something smooth in the centre"
    )
    assert "0.003 of something smooth in the logarithm of the flux" in text and "all settings share" in text
    assert leftover(diagnosis("named", [BOW])) == ""


@pytest.mark.parametrize(
    "d",
    [
        diagnosis("nothing-missing", [BOW]),
        diagnosis("nothing-missing", probability={"setting-errors": 0.3}),
        diagnosis("named"),
        diagnosis("class"),
        diagnosis("named", [BOW], [[["coma"], ["astigmatism"]]]),
        diagnosis("class", [BOW], [[["screen-bow"], ["coma"]]]),
        diagnosis("located", location={"element": "camera", "claimed": False}),
        diagnosis("named", [BOW], limits={"screen-bow": {}}),
        diagnosis("named", [BOW], notes=["screen-bow is suspected, at a probability of 0.60."]),
        diagnosis("named", [BOW], notes=["a margin of -inf"]),
    ],
)
def test_a_contradiction_is_one(d):
    assert contradictions(d)


def test_no_case_of_the_published_trial_contradicts_itself():
    """The kept verdicts of 150 concealed cases, told again by today's sentences."""
    with tarfile.open(KEPT) as tar:
        files = [m for m in tar if m.name.startswith("kept/verdicts/") and m.name.endswith("/diagnosis.json")]
        kept = {m.name: json.load(tar.extractfile(m)) for m in files}
    assert len(kept) == 150
    for name, d in kept.items():
        assert [c for c in contradictions(d) if "further off" not in c] == [], name
        assert "nan" not in headline(d) and headline(d)[-1] == ".", name
