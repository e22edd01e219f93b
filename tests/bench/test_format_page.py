"""The page on the recording file names every key that a file may hold, with the default that the code uses."""

import json
import re
from pathlib import Path

import pytest
from pydantic_core import PydanticUndefined

import benchsim.bench.schema as schema

PAGE = Path(schema.__file__).with_name("README.md").read_text(encoding="utf-8")

TABLES = {
    "laser": schema.LaserTable,
    "mirror": schema.MirrorTable,
    "screen": schema.ScreenTable,
    "cameras.NAME": schema.CameraTable,
    "physics": schema.PhysicsTable,
    "uncertainty": schema.UncertaintyTable,
    "exposure": schema.ExposureTable,
    "render": schema.RenderTable,
    "expander": schema.ExpanderTable,
}


def rows():
    """(table, key) → default as the page prints it."""
    out, table = {}, ""
    for line in PAGE.splitlines():
        if heading := re.match(r"\| (?:\*\*)?`\[+([\w.]+)\]+`", line):
            table = heading.group(1)
        elif row := re.match(r"\| `(\w+)` \| (.*?) \|", line):
            out[table, row.group(1)] = row.group(2)
    return out


def expected():
    """(table, key) → default as the schema holds it, in the page's notation."""
    out = {}
    for table, model in TABLES.items():
        for key, field in model.model_fields.items():
            required = field.default is PydanticUndefined
            out[table, key] = "–" if required else "none" if field.default is None else json.dumps(field.default)
    return out


def test_the_page_lists_exactly_the_keys_of_the_schema_with_their_defaults():
    assert rows() == expected()


@pytest.mark.parametrize("table", schema.RecordingFile.model_fields)
def test_every_table_of_the_file_is_on_the_page(table):
    assert f"`{table}" in PAGE or f"`[{table}" in PAGE or f"`[[{table}" in PAGE
