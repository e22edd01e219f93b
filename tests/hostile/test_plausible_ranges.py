"""Files from strangers: numbers that no bench has are refused, by ranges that the format's page lists."""

import re
from pathlib import Path

import pytest

from benchsim.bench import schema
from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import complaints, read

ROOT = Path(__file__).resolve().parents[2]
PAGE = Path(schema.__file__).with_name("README.md").read_text(encoding="utf-8")

LOWER, UPPER = ("minimum", "exclusiveMinimum"), ("maximum", "exclusiveMaximum")


def limits(value):
    """From and to of a JSON schema, of the numbers in it where it is a list or a choice."""
    for inner in (value, *value.get("anyOf", ()), value.get("items", {})):
        low, high = (next((inner[k] for k in keys if k in inner), None) for keys in (LOWER, UPPER))
        if low is not None or high is not None:
            return low, high
    return None


def ranges():
    """Key → from and to, of every number that has both."""
    definitions = schema.RecordingFile.model_json_schema()["$defs"]
    out = {}
    for name, table in definitions.items():
        for key, value in table["properties"].items():
            found = limits(value)
            if found and None not in found:
                out[f"{name.removesuffix('Table').lower()}.{key}"] = found
    return out


def test_the_page_lists_every_range():
    listed = re.findall(r"^\| `(\w+\.\w+)` \| (\S+) \| (\S+) \|$", PAGE, re.MULTILINE)
    assert {key: (float(low), float(high)) for key, low, high in listed} == ranges()


NONSENSE = {
    "laser.beam_diameter_mm": ("beam_diameter_mm = 10.0", "beam_diameter_mm = 1e-8"),
    "cameras.A.focal_px": ("focal_px = 2200.0", "focal_px = 1e-9"),
    "cameras.A.gamma": ("gamma = 1.0", "gamma = 1e9"),
    "cameras.A.resolution_px": ("resolution_px = [2000, 1500]", "resolution_px = [40000, 40000]"),
    "exposure[1].mirror_position_mm": ("mirror_position_mm = [1500.0,", "mirror_position_mm = [15e20,"),
    "render.relative_error": ("seed = 1", "relative_error = 1e-12"),
}


@pytest.mark.parametrize("key", NONSENSE)
def test_nonsense_is_told_by_file_key_and_mend(key, tmp_path):
    text = (ROOT / "scenes" / "fig7a.toml").read_text(encoding="utf-8")
    old, new = NONSENSE[key]
    assert old in text
    (tmp_path / "recording.toml").write_text(text.replace(old, new), encoding="utf-8")
    (tmp_path / "marks.csv").write_bytes((ROOT / "scenes" / "marks.csv").read_bytes())
    with pytest.raises(BenchsimError, match=r"^recording\.toml: [^\n]*(out of range|more than)[^\n]*$") as caught:
        read(tmp_path)
    assert key in str(caught.value)


def test_every_scene_is_plausible():
    for scene in sorted((ROOT / "scenes").glob("*.toml")):
        assert complaints(scene) == []
