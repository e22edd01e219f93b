"""Plants as files: what is read, in which units, and what is refused in which sentence."""

import math
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount import paint
from benchsim.instruments.mount.geodesy import geodetic
from benchsim.plant import begun, files, tables


def test_keys_and_columns_are_in_their_units(written):
    table = "id,east_m,north_m,up_m,width_m,IA_mrad,IA_sigma_mrad,facets_across\nA,1,60,2,,1.5,0.2,2\nB,15,80,0,5,,,\n"
    p = files.read(written(("[sun]", "[errors]\nIA_mrad = 0.5\nIE_mrad = -1.0\n[sun]"), table=table))
    f = p.field
    np.testing.assert_allclose(f.position, [[1e3, 60e3, 2e3], [15e3, 80e3, 0]])
    np.testing.assert_allclose([f.width, f.height], [[4e3, 5e3], [3e3, 3e3]])
    np.testing.assert_allclose(f.errors["IA"], [1.5e-3, 0.5e-3])
    np.testing.assert_allclose(f.errors["IE"], -1e-3)
    np.testing.assert_allclose(f.sigmas["IA"], [0.2e-3, 0])
    assert f.facets.tolist() == [[2, 1], [1, 1]] and p.optics.soiling == 0.1
    assert p.site.latitude == pytest.approx(math.radians(37)) and str(p.site.zone) == "Europe/Madrid"
    np.testing.assert_allclose(f.aim, [[0, 0, 30e3]] * 2)


def test_geographic_places_are_those_about_the_site(written):
    folder = written()
    origin = np.array([37.0, -2.0, 500.0])
    there = [geodetic(np.array(p), origin) for p in ([0.0, 60e3, 0.0], [15e3, 80e3, 1e3])]
    table = "id,latitude_deg,longitude_deg,elevation_m\n"
    table += "".join(f"{n},{a:.12f},{b:.12f},{c:.9f}\n" for n, (a, b, c) in zip("AB", there, strict=True))
    (folder / "heliostats.csv").write_text(table)
    np.testing.assert_allclose(files.read(folder).field.position, [[0, 60e3, 0], [15e3, 80e3, 1e3]], atol=0.01)


def test_each_heliostat_aims_at_the_receiver_that_faces_it_or_that_it_names(written):
    south, east = (
        f'[[receiver]]\nname = "{name}"\ncentre_m = [0.0, 0.0, 20.0]\nwidth_m = 3.0\nheight_m = 3.0\n'
        f"azimuth_deg = {a}\n[sun]"
        for name, a in (("south", 180.0), ("east", 90.0))
    )
    table = "id,east_m,north_m,up_m,receiver\nA,1,60,0,\nB,1,-60,0,\nC,20,60,0,east\n"
    p = files.read(written(("[sun]", south), ("[sun]", east), table=table))
    assert [p.receivers[k].name for k in p.field.receiver] == ["target", "south", "east"]


LAYOUTS = {
    "solarpilot": "0,10,60,1\n0,-10,70,1.5\n",
    "solarpilot with a header": "id,x_location,y_location,z_location,x_aimpoint\n7,10,60,1,0\n9,-10,70,1.5,0\n",
    "soltrace": "".join(
        f"{used}\t{place}\t0\t0\t30\t0\tr\t5\t6\n"
        for used, place in ((1, "10\t60\t1"), (0, "9\t9\t9"), (1, "-10\t70\t1.5"))
    ),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_tables_of_other_programs(written, name):
    folder = written(("[heliostats]", f'[heliostats]\ntable = "l.csv"\nformat = "{name.split()[0]}"'))
    (folder / "l.csv").write_text(LAYOUTS[name])
    p = files.read(folder)
    np.testing.assert_allclose(p.field.position, [[10e3, 60e3, 1e3], [-10e3, 70e3, 1.5e3]])
    assert p.field.width.tolist() == ([5e3, 5e3] if name == "soltrace" else [4e3, 4e3])
    assert "names no heliostat" in p.remarks[0]


FOUND = "id,east_m,north_m,up_m,records,sizes\n"
FOUND += "A,0,60,0,9,IA = 1.5 ± 0.2 mrad; IE = -0.5 ± 0.1 mrad; target_e_1 = 30 ± 4 mm\n"


def test_a_diagnosis_is_attached_by_id(written):
    folder = written(("[heliostats]", '[heliostats]\ndiagnosed = "field.csv"\nkinematics = "east-west"'))
    (folder / "field.csv").write_text(FOUND)
    p = files.read(folder)
    errors, sigmas = p.diagnosed
    np.testing.assert_allclose([errors["IA"], errors["IE"]], [[1.5e-3, 0], [-0.5e-3, 0]])
    np.testing.assert_allclose(sigmas["IA"], [0.2e-3, 0])
    assert "1 of 2 heliostats are not in field.csv" in p.remarks[0] and "target_e_1 (1)" in p.remarks[1]


def test_digits_without_end_are_read_in_a_blink(written):
    """Scenario: a size of two times a thousand digits and no unit, which a pattern that may part digits in two ways
    takes half a minute to refuse."""
    folder = written(("[heliostats]", '[heliostats]\ndiagnosed = "field.csv"\nkinematics = "east-west"'))
    (folder / "field.csv").write_text(FOUND.replace("IA = 1.5 ± 0.2 mrad", f"IA = {'1' * 1000} ± {'1' * 1000}"))
    start = time.process_time()
    assert files.read(folder).diagnosed[0]["IA"][0] == 0
    assert time.process_time() - start < 2


def test_the_table_of_a_diagnosis_is_a_field_too(written):
    folder = written(("[heliostats]", '[heliostats]\ntable = "field.csv"\nformat = "field"\ndiagnosed = "field.csv"'))
    (folder / "field.csv").write_text(FOUND)
    p = files.read(folder)
    assert p.field.ids == ("A",) and p.field.kinematics == "east-west" and p.diagnosed[0]["IA"][0] == 1.5e-3


def test_a_folder_of_paint_files_is_a_field_of_its_mounts(written):
    corpus = Path(__file__).resolve().parents[1] / "hostile" / "corpus" / "paint"
    folder = written(
        ('name = "target"', 'name = "target"\nkind = "cylinder"'),
        ("width_m = 3.0", "diameter_m = 3.0"),
        ("[heliostats]", '[heliostats]\ntable = "paint"\nformat = "paint"'),
    )
    shutil.copytree(corpus, folder / "paint")
    p = files.read(folder)
    stated = paint.bare(corpus / "AA01").mount.position
    assert p.field.ids == ("AA01",) and p.field.kinematics == "east-west"
    np.testing.assert_allclose(p.field.position, [stated], atol=1e-6)


def test_what_field_writes_is_read(tmp_path):
    """Its columns by name, so that a change there is seen here."""
    from benchsim.jobs.field_diagnosis import COLUMNS

    assert {"id", *tables.LOCAL, "sizes"} <= set(COLUMNS)


def test_a_measured_sun(written):
    folder = written(('shape = "pillbox"', 'shape = "table"\ntable = "sun.csv"'))
    (folder / "sun.csv").write_text("angle_mrad,radiance\n0,1\n4.65,1\n")
    assert files.read(folder).sun.sigma == pytest.approx(4.65e-3 / 2)


BAD = {
    "latitude_deg: '37' is not a number": [("latitude_deg = 37.0", 'latitude_deg = "37"')],
    "site.time_zone: 'Mars/Olympus' is no time zone": [("Europe/Madrid", "Mars/Olympus")],
    "did you mean 'reflectance'": [("reflectance = 0.9", "reflectence = 0.9")],
    "receiver[1]: a cylinder has diameter_m and no width_m": [
        ('name = "target"', 'name = "target"\nkind = "cylinder"')],
    "receiver[1]: A of heliostats.csv aims at target and is behind it": [
        ("height_m = 3.0\n[sun]", "height_m = 3.0\nazimuth_deg = 180.0\n[sun]")],
    "sun.csr: the shape pillbox has none": [('shape = "pillbox"', 'shape = "pillbox"\ncsr = 0.1')],
    "sun.csr: the shape buie needs it": [('shape = "pillbox"', 'shape = "buie"')],
    "errors.IB_mrad: no error of an az-el mount": [("[sun]", "[errors]\nIB_mrad = 1.0\n[sun]")],
    "heliostats.table: '../x.csv' leads out of": [("[heliostats]", '[heliostats]\ntable = "../x.csv"')],
    "heliostats.width_m: required, as heliostats.csv does not say it of A": [
        ("[heliostats]\nwidth_m = 4.0", "[heliostats]")],
}  # fmt: skip


@pytest.mark.parametrize("says", BAD)
def test_a_file_that_cannot_be_used_is_told_by_key_and_mend(written, says):
    with pytest.raises(BenchsimError) as told:
        files.read(written(*BAD[says]))
    assert says in str(told.value) and ";" in str(told.value) and str(told.value).startswith("plant.toml: ")


BAD_TABLES = {
    "line 3: east_m: 'x' is no number": "id,east_m,north_m,up_m\nA,0,60,0\nB,x,60,0\n",
    "line 2: east_m: 1e+06 is out of range": "id,east_m,north_m,up_m\nA,1e6,60,0\n",
    "line 3: id: 'A' is there twice": "id,east_m,north_m,up_m\nA,0,60,0\nA,20,60,0\n",
    "line 2: column 3: the line has 3 cells": "id,east_m,north_m,up_m\nA,0,60\n",
    "line 1: north: is no column": "id,east_m,north,up_m\nA,0,60,0\n",
    "line 1: up_m: this column is missing": "id,east_m,north_m\nA,0,60\n",
    "lists no heliostat": "id,east_m,north_m,up_m\n",
    "line 2: up_m: is empty": "id,east_m,north_m,up_m\nA,0,60,\n",
    "within one another": "id,east_m,north_m,up_m\nA,0,60,0\nB,0.5,60,0\n",
    "less than its own size": "id,east_m,north_m,up_m\nA,0,1,30\n",
}  # fmt: skip


@pytest.mark.parametrize("says", BAD_TABLES)
def test_a_table_that_cannot_be_used_is_told_by_line_and_column(written, says):
    with pytest.raises(BenchsimError) as told:
        files.read(written(table=BAD_TABLES[says]))
    assert says in str(told.value)


def test_the_shipped_field_in_radial_stagger_is_the_one_that_is_made(shipped, tmp_path):
    begun.radial(tmp_path, 100)
    for file in ("plant.toml", "heliostats.csv"):
        made, kept = (f / file for f in (tmp_path, shipped / "radial100"))
        assert made.read_text(encoding="utf-8") == kept.read_text(encoding="utf-8")
    assert len(files.read(shipped / "radial100").field) == 100


def test_what_is_more_often_a_slip_is_remarked(tmp_path):
    begun.radial(tmp_path, 30)
    text = (tmp_path / "plant.toml").read_text(encoding="utf-8")
    (tmp_path / "plant.toml").write_text(
        re.sub(
            r"slope_mrad = \S+", "slope_mrad = 0.001", re.sub(r"centre_m = \[[^]]*\]", "centre_m = [0, 0, -25]", text)
        )
    )
    said = " ".join(files.read(tmp_path).remarks)
    assert "receiver[1] lies below all mirrors" in said and "0.001 is smoother than any heliostat" in said
