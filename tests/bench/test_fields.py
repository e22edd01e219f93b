"""Free fields: what a file says is what the models get, and a bad table ends in one sentence."""

import re

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import FORMS, evaluate, field
from benchsim.bench.files import read, write

TABLE = """
[fields.pixel]
u_px = [0.0, 1000.0]
v_px = [0.0, 500.0, 1000.0]
du_px = [[0.0, 1.0, 2.0], [0.0, 1.0, 2.0]]
dv_px = [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]

[fields.time]
t_h = [0.0, 2.0]
dy_mm = [0.0, 1.0]
dz_mm = [0.0, -1.0]
"""


def bench(tmp_path, scenes, table):
    text = (scenes / "campaign12.toml").read_text()
    path = tmp_path / "bench.toml"
    path.write_text(text.replace("[render]", table + "\n[render]"))
    (tmp_path / "marks.csv").write_text((scenes / "marks.csv").read_text())
    return path


@pytest.fixture
def scenes(request):
    return request.config.rootpath / "scenes"


def test_a_file_gives_the_field_it_states(tmp_path, scenes):
    fields = read(bench(tmp_path, scenes, TABLE)).fields
    np.testing.assert_allclose(evaluate(fields["pixel"], 500.0, 250.0), [0.5, 0.5])
    # An hour in seconds; beyond the last knot the field is held.
    np.testing.assert_allclose(evaluate(fields["time"], np.array([3600.0, 9e9])), [[0.5, 1.0], [-0.5, -1.0]])


def test_a_written_field_is_read_back_unchanged(tmp_path, scenes):
    recording = read(bench(tmp_path, scenes, TABLE))
    (tmp_path / "again").mkdir()
    write(recording, tmp_path / "again" / "bench.toml")
    assert read(tmp_path / "again" / "bench.toml").fields == recording.fields


@pytest.mark.parametrize(
    ("table", "key"),
    [
        ("[fields.colour]\nu_px = [0.0, 1.0]", "fields.colour"),
        ("[fields.time]\nt_h = [0.0, 1.0]\ndy_mm = [0.0, 1.0]", "fields.time.dz_mm"),
        ("[fields.time]\nt_h = [1.0, 0.0]\ndy_mm = [0.0, 1.0]\ndz_mm = [0.0, 1.0]", "fields.time.t_h"),
        ("[fields.time]\nt_h = [0.0, 1.0]\ndy_mm = [0.0]\ndz_mm = [0.0, 1.0]", "fields.time.dy_mm"),
        ("[fields.time]\nt_s = [0.0, 1.0]\ndy_mm = [0.0, 1.0]\ndz_mm = [0.0, 1.0]", "fields.time.t_h"),
    ],
)
def test_a_bad_table_is_one_sentence_that_names_the_key(tmp_path, scenes, table, key):
    with pytest.raises(BenchsimError, match=re.escape(key)):
        read(bench(tmp_path, scenes, table))


def test_multilinear_interpolation_is_exact_for_a_plane():
    rng = np.random.default_rng(1)
    y, z = np.linspace(-300, 300, 7), np.linspace(-200, 200, 5)
    f = field([y, z], [2 * y[:, None] - 3 * z[None, :]])
    at = rng.uniform(-200, 200, (50, 2))
    np.testing.assert_allclose(evaluate(f, at[:, 0], at[:, 1])[0], 2 * at[:, 0] - 3 * at[:, 1], atol=1e-9)


def test_every_form_has_the_design_s_element():
    assert {f.element for f in FORMS.values()} == {"source", "mirror", "air", "screen", "camera", "time"}
