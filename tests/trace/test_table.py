"""The trace's table: what is written, and nothing half-written; covariance and selections."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.trace.table import HEADER, RidgeNoise, Trace, covariance, only_ridge, unsaturated, write_table


def a_trace(n=12, exposure="001.png"):
    rng = np.random.default_rng(1)
    columns = [rng.normal(size=n) for _ in HEADER[2:]]
    columns[5] = np.full(n, 0.02)  # sigma_mm
    ridge = np.repeat([0, 1], [n - 4, 4])
    noise = RidgeNoise(1.0, 0.1, np.array([1.0, 0.4]), 0.5, 0.6, 3.0)
    return Trace(
        exposure,
        ridge,
        *columns,
        profile=np.concatenate([np.arange(n - 4), np.arange(4)]),
        pose_mm=rng.normal(size=(n, 6)) * 1e-3,
        shape_mm=rng.normal(size=(n, 2)) * 1e-3,
        noise=(noise, noise),
    )


def test_header_is_the_contract():
    assert ",".join(HEADER) == ("exposure,ridge,s_mm,u_px,v_px,y_mm,z_mm,sigma_mm,width_mm,flux,skewness,saturated")


def test_what_is_written_reads_back(tmp_path):
    traces = [a_trace(), a_trace(exposure="002, a.png")]
    write_table(tmp_path / "trace.csv", traces)
    with (tmp_path / "trace.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["exposure"] for row in rows] == ["001.png"] * 12 + ["002, a.png"] * 12
    for name in HEADER[1:]:
        written = np.concatenate([getattr(trace, name) for trace in traces])
        np.testing.assert_allclose([float(row[name]) for row in rows], written, rtol=1e-8)
    assert [p.name for p in tmp_path.iterdir()] == ["trace.csv"]


def test_nothing_is_written_where_it_cannot_be(tmp_path):
    with pytest.raises(BenchsimError, match="cannot be written"):
        write_table(tmp_path / "missing" / "trace.csv", [a_trace()])


def test_covariance_is_the_sum_of_its_parts():
    trace = a_trace()
    c = covariance(trace)
    want = 0.02**2 + trace.pose_mm[0] @ trace.pose_mm[0] + trace.shape_mm[0] @ trace.shape_mm[0]
    assert c[0, 0] == pytest.approx(want)
    beside = 0.4 * 0.02**2 + trace.pose_mm[0] @ trace.pose_mm[1] + trace.shape_mm[0] @ trace.shape_mm[1]
    assert c[0, 1] == pytest.approx(beside)
    across = trace.pose_mm[0] @ trace.pose_mm[-1] + trace.shape_mm[0] @ trace.shape_mm[-1]
    assert c[0, -1] == pytest.approx(across)
    assert np.linalg.eigvalsh(c).min() > 0


def test_selections_keep_the_parts_together():
    trace = a_trace()
    ghost = only_ridge(trace, 1)
    assert len(ghost) == 4 and len(ghost.pose_mm) == 4 and covariance(ghost).shape == (4, 4)
    np.testing.assert_allclose(covariance(ghost), covariance(trace)[-4:, -4:])


@pytest.mark.parametrize(("cut", "left"), [(0, 10), (3, 7), (8, 10)])
def test_profiles_with_saturated_pixels_are_left_out_unless_little_would_be_left(cut, left):
    trace = only_ridge(a_trace(14))
    trace = replace(trace, saturated=np.repeat([0.0, 0.2], [10 - cut, cut]))
    kept = unsaturated(trace)
    assert len(kept) == left and len(kept.pose_mm) == left
    if cut == 3:
        assert np.array_equal(kept.s_mm, trace.s_mm[:7]) and covariance(kept).shape == (7, 7)
