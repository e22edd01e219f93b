"""The float32 trace against a float64 trace of the same rays in the world frame."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from light_settings import bench, errors, world_trace

from benchsim.bench.place import place
from benchsim.renderer import backend
from benchsim.renderer.sweep import sweep
from benchsim.renderer.tracer import Tracer


def traced(recording, placement, n=1 << 16, seed=0):
    """Hits, weights and samples of the kernel, as float64 arrays; phases as turns of the reflecting normal."""
    backend.use()
    s = sweep(recording, recording.exposures[0], placement)
    tracer = Tracer(s)
    y, z, weight, arrives, sample = tracer(tracer.points(n, np.random.default_rng(seed)))
    dr.eval(y, z, weight, arrives, sample)
    y, z, weight, delta, t, h = (np.broadcast_to(np.array(v, float), (n,)) for v in (y, z, weight, *sample))
    on = np.broadcast_to(np.array(arrives), (n,)) & (np.abs(y) < 360) & (np.abs(z) < 360)
    return tuple(v[on] for v in (y, z, weight, s.middle + delta, t, h))


@pytest.mark.parametrize(
    "physics",
    [
        {},
        {"diffraction": False},
        {"facets": False},
        {"beam": False},
        {"facets": False, "beam": False},
    ],
    ids=str,
)
@pytest.mark.parametrize("name", ["fig7a", "fig7b"])
def test_hits_are_within_a_micrometre_of_float64(name, physics):
    """Rationale: a trace read to some µm must not come from a kernel that rounds by tens.

    Set-up: both settings of Fig. 7 with setting errors, 65536 rays, every physics; the same phases and facet points in
    float64 vectors of the world frame. Expectation: every hit within 1 µm (0.25 µm is seen), so no bias beyond.
    """
    recording = bench(name, **physics)
    placement = place(recording.mirror, recording.exposures[0], errors(np.random.default_rng(3)))
    y, z, _, phase, t, h = traced(recording, placement)
    assert len(y) > 10000
    parallel = not recording.physics.beam
    expected_y, expected_z, _ = world_trace(recording, placement, phase, t, h, parallel=parallel)
    assert np.hypot(y - expected_y, z - expected_z).max() < 1e-3


@pytest.mark.parametrize("divergence", [4e-3, 0.0, -1e-3, 3e-2])
def test_weights_are_the_beam_s_power_on_the_facet(divergence):
    """Diverging, parallel and converging beams: power per facet area as in float64, to 1e-5 of the peak."""
    recording = bench(diffraction=False)
    recording = replace(recording, laser=replace(recording.laser, divergence=divergence))
    placement = place(recording.mirror, recording.exposures[0], errors(np.random.default_rng(5)))
    y, z, weight, phase, t, h = traced(recording, placement)
    expected_y, expected_z, density = world_trace(recording, placement, phase, t, h)
    assert np.hypot(y - expected_y, z - expected_z).max() < 1e-3
    assert np.abs(weight - density).max() < 1e-5 * density.max()


def test_the_single_ray_stays_on_the_laser_s_axis():
    """With facets and no beam the ray meets the turning facet on the laser's axis."""
    recording = bench(beam=False)
    placement = place(recording.mirror, recording.exposures[0], errors(np.random.default_rng(7)))
    _, _, _, phase, t, h = traced(recording, placement)
    a, n0 = placement.axis, placement.normal
    n = np.cos(phase)[:, None] * n0 + np.sin(phase)[:, None] * np.cross(a, n0)
    x = placement.centre + recording.mirror.radius * n + t[:, None] * np.cross(a, n) + h[:, None] * a
    off = np.cross(x - placement.laser_point, placement.laser_direction)
    assert np.abs(off).max() < 1e-5


def test_the_test_sees_a_wrong_radius():
    """A facet 20 µm farther out moves the hits by more than rounding does: the comparison above can fail."""
    recording = bench(diffraction=False)
    placement = place(recording.mirror, recording.exposures[0])
    y, z, _, phase, t, h = traced(recording, placement)
    wrong = replace(recording, mirror=replace(recording.mirror, diameter=recording.mirror.diameter + 4e-2))
    wrong_y, wrong_z, _ = world_trace(wrong, placement, phase, t, h)
    assert np.hypot(y - wrong_y, z - wrong_z).max() > 1e-3
