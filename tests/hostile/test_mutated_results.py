"""Files from strangers: a finished folder in which one value was changed gives its page or one sentence, never more."""

import copy
import json
import random

import pytest

from benchsim import jobs
from benchsim.bench.errors import BenchsimError

SEEDS = range(4)
EACH = 100

MEASURE = {"rms_mm": 0.02, "rms_mrad": 0.004, "p_value": 0.09}
INTERVAL = {"value": 2.1, "low95": 1.2, "high95": 3.0, "determined": True}
SHAPE = {"curve_sigma_mm": 0.002, "invariants": {"kind": {**INTERVAL, "value": "hyperbola"}, "eccentricity": INTERVAL}}

FOLDER = {
    "page.json": {
        "format": "benchsim-page/1",
        "title": "a page", "settings": 1, "states": {"before": "b", "after": "a"},
        "catalogue": [{"name": "screen-bow", "element": "screen", "says": "The board is bent."}],
        "exposures": [{
            "exposure": "001.png", "setting": "s1", "photograph": "photographs/1.jpg", "size_px": [2000, 1500],
            "same": False, "s_mm": [1.0, 2.0], "sigma_mm": [1.0, 1.0], "sigma_alone_mm": [1.0, 1.0],
            **{key: [[1.0, 1.0], [2.0, 2.0]] for key in ("measured_px", "before_px", "after_px")},
            "residual_mm": {key: [1.0, 2.0] for key in ("before", "after", "held_out_before", "held_out_after")},
        }],
    },
    "validation.json": {
        "format": "benchsim-validation/1", "level": 0.01, "lost": ["002.png: dark"], "defaults_used": [],
        "exposures": [{
            "exposure": "001.png", "before": MEASURE, "after": MEASURE, "vector_alone": {"after": MEASURE},
            "agrees": True, "polygon_mm": 0.02, "radius_mm": 8.0, "radius_own_aim_mm": 0.05,
            "pulls": {"laser_azimuth": -0.6},
        }],
    },
    "conics.json": {"conics": [{"exposure": "001.png", "ridge": 0, **SHAPE, "cone": SHAPE}]},
    "benchsim.json": {
        "command": "run", "written": "2026-01-01T00:00:00+00:00", "versions": {"benchsim": "0.1.0", "numpy": "2"},
        "inputs": {"recording.toml": "0" * 64}, "defaults_used": ["mirror.facets = 12"],
    },
}  # fmt: skip

VALUES = (
    None, True, -1, 0, 1e308, float("nan"), float("inf"), 10**400, "", "x" * 5000, "\0", "../../etc/passwd", "\ud800",
    [], [[]], {}, {"a": 1},
)  # fmt: skip


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "photographs").mkdir()
    (tmp_path / "photographs" / "1.jpg").write_bytes(b"a picture")
    for name, value in FOLDER.items():
        (tmp_path / name).write_text(json.dumps(value))
    return tmp_path


def places(value, at=()):
    """Every place of a JSON value."""
    if at:
        yield at
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inner:
        yield from places(one, (*at, key))


def mutant(rng, value):
    """One value left out, or another in its place."""
    value = copy.deepcopy(value)
    *way, last = rng.choice(list(places(value)))
    at = value
    for key in way:
        at = at[key]
    if rng.random() < 0.25:
        del at[last]
    else:
        at[last] = rng.choice(VALUES)
    return value


def test_the_folder_as_it_is_has_a_page(folder):
    assert jobs.report(folder).of == "validation"


@pytest.mark.parametrize("seed", SEEDS)
def test_every_mutant_is_a_page_or_one_sentence_that_names_its_file(folder, seed):
    rng, said = random.Random(seed), 0
    for _ in range(EACH):
        name = rng.choice(list(FOLDER))
        (folder / name).write_text(json.dumps(mutant(rng, FOLDER[name])))
        try:
            jobs.report(folder)
        except BenchsimError as error:
            assert str(error).isprintable() and name in str(error), (name, error)
            said += 1
        (folder / name).write_text(json.dumps(FOLDER[name]))
    assert said > EACH / 4


@pytest.mark.parametrize("name", FOLDER)
@pytest.mark.parametrize("value", ["1", "[]", "[" * 10_000, '{"format": 1}', "", "\x00"])
def test_a_file_that_is_something_else_altogether(folder, name, value):
    (folder / name).write_text(value)
    with pytest.raises(BenchsimError, match=name):
        jobs.report(folder)
