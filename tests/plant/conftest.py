"""benchsim before drjit and mitsuba, whichever test module comes first; and small plants."""

from pathlib import Path

import pytest

import benchsim  # noqa: F401

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "plants"


@pytest.fixture
def shipped():
    """Folders of the plants that come with the package."""
    return SCENES


@pytest.fixture
def written(tmp_path):
    """Writes a plant's file, with pieces of it exchanged, and its table; gives the folder."""

    def write(*changes, table="id,east_m,north_m,up_m\nA,0,60,0\nB,15,80,0\n", text=PLANT):
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "plant.toml").write_text(text)
        (tmp_path / "heliostats.csv").write_text(table)
        return tmp_path

    return write


PLANT = """\
format = "benchsim-plant/1"
[site]
latitude_deg = 37.0
longitude_deg = -2.0
elevation_m = 500.0
time_zone = "Europe/Madrid"
[[receiver]]
name = "target"
centre_m = [0.0, 0.0, 30.0]
width_m = 3.0
height_m = 3.0
[sun]
shape = "pillbox"
[optics]
slope_mrad = 1.0
reflectance = 0.9
soiling = 0.1
[heliostats]
width_m = 4.0
height_m = 3.0
"""
