"""The reading of the contract against traces that other code computed: first principles held before they hold."""

import json
from pathlib import Path

import numpy as np
import pytest
from camera_principles import printed
from first_principles import Errors, Tracer

from benchsim.bench.files import read

OTHER = Path(__file__).resolve().parents[2].parent / "shared" / "recordings" / "bench-other-code"
NAMES = [
    "clean-f7",
    "clean-six",
    "known-six",
    "tilt-rotation",
    "coma-tilt",
    "drift-rotation",
    "scale-curvature",
    "curvature",
    "offset",
]


@pytest.mark.parametrize("name", NAMES)
def test_true_traces(name):
    """Expects the mean of the spot at each of their turns within 1 µm across the trace, its light within 1e-5 and its
    covariance within 1e-4, at the stated truth: setting errors, re-seating and effects. Their re-seating slopes and
    turns add to the tilt and rotation of the board, in its rolled frame."""
    if not OTHER.is_dir():
        pytest.skip("../shared/recordings/bench-other-code is not there")
    recording = read(OTHER / name)
    truth = json.loads((OTHER / "truth" / f"{name}.json").read_text())
    stated = {key: p["value"] for e in truth["effects"] for key, p in e["parameters"].items()}
    traces = np.load(OTHER / "truth" / f"{name}.npz")
    for i, exposure in enumerate(recording.exposures):
        s = truth["setting_errors"][exposure.setting]
        seat = truth["seat_errors"][str(truth["seats"][i])]
        effects = dict(stated)
        for key, of_seat in (("st_y", "r_ty"), ("st_z", "r_tz"), ("srot", "r_rot")):
            effects[key] = stated.get(key, 0.0) + seat.get(of_seat, 0.0)
        errors = Errors(
            (s["n_cx"], s["n_cy"], s["n_cz"]),
            (1e-3 * s["n_a1"], 1e-3 * s["n_a2"]),
            (1e-3 * s["n_saz"], 1e-3 * s["n_sel"]),
            tuple(seat.get(key, 0.0) for key in ("r_x", "r_y", "r_z")),
        )
        tracer = Tracer(recording, exposure, errors, effects)
        y, z, _, _, light, yy, yz, zz = traces[f"trace_{i}"][:, ::12]
        grid = {key: stated[key] for key in ("gs", "ga", "gsh") if key in stated}
        places = printed(np.column_stack([y, z]), **grid)  # they are coordinates as the marks define them
        mean, ours, covariance, left = spots(tracer, places)
        assert np.abs(((places - mean) * left).sum(1)).max() < 1e-3
        ratio = ours / light
        assert np.abs(ratio / ratio.mean() - 1.0).max() < 1e-5
        theirs = np.moveaxis(np.array([[yy, yz], [yz, zz]]), -1, 0)
        if not grid:
            assert np.abs(covariance - theirs).max() < 1e-4 * np.abs(theirs).max()


def spots(tracer, places):
    """Mean, light and covariance of the spots nearest to places, and the left normals of their path."""
    grid = np.linspace(-0.25, 0.25, 401)
    coarse = tracer.spot(grid, 8, 4)[0]
    turned = grid[np.argmin(((places[:, None] - coarse) ** 2).sum(-1), axis=1)]
    for _ in range(4):
        path = (tracer.spot(turned + 1e-5)[0] - tracer.spot(turned - 1e-5)[0]) / 2e-5
        turned = turned + ((places - tracer.spot(turned)[0]) * path).sum(1) / (path**2).sum(1)
    left = np.stack([-path[:, 1], path[:, 0]], 1) / np.linalg.norm(path, axis=1, keepdims=True)
    return *tracer.spot(turned), left
