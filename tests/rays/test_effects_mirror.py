"""Effects of the mirror: radius, leans, axis, glass, curvature, and what is there only in part."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.curve import signed_distance
from benchsim.bench.fields import field
from benchsim.bench.model import Exposure, Physics
from benchsim.rays import ghost, mirror, predict, trace_curve
from benchsim.rays.curve import tangents
from benchsim.rays.curve import trace as trace_of
from benchsim.rays.prediction import bench_of
from benchsim.rays.sweep import cuts
from benchsim.rays.width import placed


def rotate(v, axis, angle):
    """Rodrigues' formula."""
    axis = np.asarray(axis, float)
    return np.cos(angle) * v + np.sin(angle) * np.cross(axis, v) + (1 - np.cos(angle)) * (axis @ v) * axis


def reflected_hit(x, n, d):
    """Where d off the point x of a surface with normal n meets the plane x = 0, by a Householder matrix."""
    out = (np.eye(3) - 2 * np.outer(n, n)) @ d
    return (x - x[0] / out[0] * out)[1:]


def test_pivot_offset_is_a_larger_cylinder(lab):
    """The pencil on a cylinder of radius r + dr about the same axis."""
    r = lab.recording
    larger = replace(r.mirror, shape="cylinder", diameter=2 * (r.mirror.radius + 5.0))
    expected = trace_curve(r.laser, larger, lab.pencil, r.screen, lab.placement, samples=24)
    lab.same(lab.trace({"pivot-offset": {"dr": 5.0}}, physics=lab.pencil), expected, 1e-9)


def test_pivot_offset_keeps_the_facets_width(lab):
    """The light that N facets of the same width catch: the beam's share of it falls as the facets pass further off."""
    parts = bench_of(lab.bench({"pivot-offset": {"dr": 5.0}}), lab.exposure)
    assert parts.radius == lab.recording.mirror.radius + 5.0
    assert parts.mirror.facet_width == lab.recording.mirror.facet_width


@pytest.mark.parametrize("way", ["canting", "lean"])
def test_canting_is_a_normal_turned_by_hand(lab, way):
    """The pencil off P(ε) with the normal turned by 3 mrad toward +axis."""
    if way == "canting":
        curve = lab.trace({"canting": {"pyr": 3.0}}, physics=lab.pencil, errors=None)
    else:
        constant = field([[-1.0, 1.0], [0.0, 11.0]], np.full((1, 2, 2), 3e-3))
        curve = lab.trace(fields={"lean": constant}, physics=lab.pencil, errors=None)
    p = bench_of(lab.recording, lab.exposure).placement
    for point, e in zip(curve.points, curve.phase, strict=True):
        n = rotate(p.normal, p.axis, e)
        leaning = np.cos(3e-3) * n + np.sin(3e-3) * p.axis
        hit = reflected_hit(p.centre + lab.recording.mirror.radius * n, leaning, p.laser_direction)
        np.testing.assert_allclose(point, hit, atol=1e-9)


def test_lean_field_goes_by_phase_and_facet(lab):
    """A gated facet takes its own row; a lean that grows with the phase is met at the phase of each point."""
    phases, facets = np.linspace(-1.0, 1.0, 5), np.arange(12.0)
    f = field([phases, facets], (1e-3 * phases[:, None] + 1e-4 * facets[None, :])[None])
    gated = replace(lab.exposure, facet=7)
    curve = lab.trace(fields={"lean": f}, physics=lab.pencil, exposure=gated, errors=None)
    p = bench_of(lab.recording, lab.exposure).placement
    for point, e in zip(curve.points, curve.phase, strict=True):
        n = rotate(p.normal, p.axis, e)
        lean = 1e-3 * e + 7e-4
        leaning = np.cos(lean) * n + np.sin(lean) * p.axis
        hit = reflected_hit(p.centre + lab.recording.mirror.radius * n, leaning, p.laser_direction)
        np.testing.assert_allclose(point, hit, atol=1e-9)


def test_pedestal_turns_axis_and_body(lab):
    """Axis and normal turned about the world's z, then about x, by hand; C, laser and board stay."""
    r, p = lab.recording, lab.placement
    for table, about in (
        ({"azimuth-offset": {"az_enc": 4.0}}, [0, 0, 1]),
        ({"axis-tilt": {"ped_x": 4.0}}, [1, 0, 0]),
        ({"axis-tilt": {"ped_y": 4.0}}, [0, 1, 0]),
    ):
        turned = replace(p, axis=rotate(p.axis, about, 4e-3), normal=rotate(p.normal, about, 4e-3))
        expected = trace_curve(r.laser, r.mirror, r.physics, r.screen, turned, samples=24)
        lab.same(lab.trace(table), expected, 1e-9)


TILTS = [2.0, -1.0, 0.5, -1.5, 1.0, 0.0, -0.5, 0.7, -1.2, 0.3, -0.8, 0.5]


UNEVEN = field([np.linspace(-0.3, 0.3, 9), np.arange(12.0)], 2e-4 * np.random.default_rng(0).normal(size=(1, 9, 12)))
LEANING = {
    "tilts": ({"facet-tilts": {f"tilt_{k}": t for k, t in enumerate(TILTS)}}, {}),
    "lean field": ({}, {"lean": UNEVEN}),
}


@pytest.mark.parametrize("diffraction", [False, True])
@pytest.mark.parametrize("leaning", LEANING)
def test_tilted_facets_sum_to_the_ungated_exposure(lab, leaning, diffraction):
    """Flux, mean and width of all facets' light against the twelve gated exposures laid over each other.

    Rationale: the ungated trace is worked out at three leans and interpolated. Set-up: each facet's nodes on the
    ungated trace's own lines. Expectation: flux 1e-4, mean 1e-4 mm, width 2e-3 mm without diffraction; with it the
    mean is the same. One profile's light straddles a knot of the field: 5e-4 and 5e-3 mm there.
    """
    effects, fields = LEANING[leaning]
    physics = Physics(True, True, diffraction)
    curve = lab.trace(effects, fields, physics=physics)
    tangent = np.gradient(curve.points, curve.arc_length(), axis=0, edge_order=2)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    each = []
    for k in range(12):
        bench = bench_of(lab.bench(effects, fields, physics), replace(lab.exposure, facet=k), lab.off)
        each.append(cuts(bench, curve.points, tangent, curve.phase[:, None, None], 12, 12, kicks=False))
    q, light = (np.concatenate([getattr(n, a).reshape(24, -1) for n in each], axis=1) for a in ("q", "weight"))
    inner = slice(2, -2)
    np.testing.assert_allclose(light.sum(axis=1), curve.flux, rtol=1e-4)
    off = np.abs((light * q).sum(axis=1) / light.sum(axis=1))[inner]
    assert np.sort(off)[-2] < 1e-4 and off.max() < 5e-4
    if not diffraction:
        width, centre = placed(q, light)
        assert np.abs(curve.aside - centre)[inner].max() < 5e-3
        off = np.abs(curve.width - width)[inner]
        assert np.sort(off)[-2] < 2e-3 and off.max() < 5e-3


def test_gated_facet_leans_by_its_own_tilt(lab):
    gated = replace(lab.exposure, facet=3)
    lab.same(
        lab.trace({"facet-tilts": {"tilt_3": 1.5, "tilt_4": -1.5}}, exposure=gated),
        lab.trace({"canting": {"pyr": 1.5}}, exposure=gated),
        1e-9,
    )
    lab.same(lab.trace({"facet-tilts": {"tilt_rms": 1.5}}, exposure=gated), lab.trace(exposure=gated), 1e-12)


def test_wobble_is_the_tilts_first_harmonic(lab):
    turn = 2 * np.pi * np.arange(12) / 12
    tilts = {f"tilt_{k}": 0.7 * np.cos(a) - 0.4 * np.sin(a) for k, a in enumerate(turn)}
    lab.same(lab.trace({"axis-wobble": {"wob_c": 0.7, "wob_s": -0.4}}), lab.trace({"facet-tilts": tilts}), 1e-9)


def test_tilt_rms_widens_as_its_name_says(lab):
    """A single ray: the rms across the trace is the way of a canting of one rms; the mean stays."""
    ray = Physics(True, False, False)
    base, canted = lab.trace(physics=ray), lab.trace({"canting": {"pyr": 0.5}}, physics=ray)
    tilted = lab.trace({"facet-tilts": {"tilt_rms": 0.5}}, physics=ray)
    d, s = lab.apart(canted, tilted)
    width = np.interp(s, canted.arc_length(), tilted.width)
    np.testing.assert_allclose(np.abs(d), width, rtol=2e-2)
    assert np.abs(lab.apart(base, tilted)[0]).max() < 1e-3


def test_curved_facet_is_a_sphere(lab):
    """Points at 1/c from a centre behind the facet, normals away from it."""
    p, c = lab.placement, 2e-4
    t, h = np.meshgrid(np.linspace(-4.5, 4.5, 7), np.linspace(-1, 1, 3))
    x, normal, area = mirror.surface(p, 17.0, c, np.full(t.shape, 0.05), 2e-3, t, h)
    n = rotate(p.normal, p.axis, 0.05)
    centre = p.centre + 17.0 * n - (np.cos(2e-3) * n + np.sin(2e-3) * p.axis) / c
    np.testing.assert_allclose(np.linalg.norm(x - centre, axis=-1), 1 / c, atol=1e-6)
    np.testing.assert_allclose((x - centre) * c, normal, atol=1e-9)
    np.testing.assert_allclose(area, 1.0, atol=1e-6)


def test_curved_facets_spread_like_the_mirror_equation(lab):
    """A facet of curvature c adds 2 c cos i, tangentially, or 2 c / cos i, to the wavefront: the width follows.

    Set-up: a symmetric bench, where the plane of incidence at the screen's centre holds x and z and the axis is y.
    Across the trace, that is along the axis, light spreads as if the beam had 2 c cos i more curvature.
    """
    exposure = Exposure("A", "s", 0.0, np.radians(50.0), (1500.0, 0.0, -1000.0))
    p = bench_of(lab.recording, exposure).placement
    incidence = -p.normal @ p.laser_direction
    curved = lab.trace({"facet-curvature": {"fcurv": 0.1}}, exposure=exposure, errors=None, physics=lab.geometric)
    spread = lab.trace(
        {"wavefront-curvature": {"curv": 0.2 * incidence}}, exposure=exposure, errors=None, physics=lab.geometric
    )
    plain = lab.trace(exposure=exposure, errors=None, physics=lab.geometric)
    middle = len(plain.points) // 2
    gained, expected = (c.width[middle] - plain.width[middle] for c in (curved, spread))
    assert expected > 0.1
    assert gained == pytest.approx(expected, rel=0.02)


def test_glass_obeys_snell(lab):
    """Light bends by Snell's law on its way to the coating, and leaves as it came, mirrored, as far beyond its foot."""
    rng = np.random.default_rng(3)
    n = np.array([0.0, 0.0, 1.0])
    entry = np.column_stack([rng.uniform(-4, 4, (20, 2)), np.zeros(20)])
    g = np.column_stack([rng.uniform(-0.7, 0.7, (20, 2)), np.full(20, -1.0)])
    leave, passed = mirror.through_glass(2.0, entry, np.broadcast_to(n, (20, 3)), g)
    np.testing.assert_allclose(leave[:, 2], 0.0, atol=1e-12)
    sine = np.linalg.norm(g[:, :2], axis=1) / np.linalg.norm(g, axis=1) / 1.515
    along = g[:, :2] / np.linalg.norm(g[:, :2], axis=1)[:, None]
    np.testing.assert_allclose((leave - entry)[:, :2], (4.0 * np.tan(np.arcsin(sine)))[:, None] * along, atol=1e-12)
    head_on = mirror.refracted(-n, n)[2]
    assert head_on == pytest.approx((0.515 / 2.515) ** 2, abs=1e-12)
    assert (passed < (1 - head_on) ** 2 + 1e-3).all()


@pytest.mark.parametrize("glass", [0.3, 2.0])
def test_light_enters_glass_through_the_facet(lab, glass):
    """Rays of the plate by hand: the front face is the facet, with its edges; the light leaves 2 T tan θ′ further on.

    Set-up: profiles over the board, each of 5 × 5 points of the facet. Expectation: each point's light hits within
    1e-9 mm of where its profile says, wherever it leaves; of a trace, the flux of the bare mirror less what the front
    face reflects.
    """
    changed = lab.bench({"second-surface": {"glass": glass}})
    b = bench_of(changed, lab.exposure, lab.off)
    p, r = b.placement, lab.recording.mirror
    curve, bare = trace_of(b, 24), trace_of(bench_of(lab.recording, lab.exposure, lab.off), 24)
    tangent = tangents(curve.points)[::5]
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    nodes = cuts(b, curve.points[::5], tangent, curve.phase[::5, None, None], 5, 5, last_step=1e-9)
    u = np.polynomial.legendre.leggauss(5)[0] / 2
    for profile, start in enumerate(curve.points[::5]):
        for i, j in np.ndindex(5, 5):
            n = rotate(p.normal, p.axis, nodes.phase[profile, i, j])
            x = p.centre + r.radius * n + u[i] * r.facet_width * np.cross(p.axis, n) + u[j] * r.height * p.axis
            # A homocentric beam's rays run from its virtual source.
            g = p.laser_direction + b.laser.curvature * (x - p.laser_point)
            g = g / np.linalg.norm(g)
            flat = g - (g @ n) * n
            sine = np.linalg.norm(flat) / 1.515
            leave = x + 2 * glass * sine / np.sqrt(1 - sine**2) * flat / np.linalg.norm(flat)
            out = g - 2 * (g @ n) * n
            at, to = (p.screen_rotation.T @ v for v in (leave - p.screen_origin, out))
            said = start + nodes.q[profile, i, j] * left[profile]
            np.testing.assert_allclose(said, (at - at[0] / to[0] * to)[1:], atol=1e-9)
    share = np.interp(curve.phase, bare.phase, bare.flux * np.gradient(bare.arc_length(), bare.phase))
    share = curve.flux * np.gradient(curve.arc_length(), curve.phase) / share
    assert (share[2:-2] > 0.88).all() and (share[2:-2] < 0.93).all()


def test_ghost_is_the_bare_mirrors_trace(lab):
    """The front face stands where the bare mirror does; its light is Fresnel's share, some 4 to 6 % here.

    The reflectance differs a little over a facet, which moves the mean by 5e-5 mm.
    """
    glass = lab.bench({"second-surface": {"glass": 2.0}})
    assert ghost(lab.recording, lab.exposure) is None
    seen = ghost(glass, lab.exposure, lab.off, 24)
    bare = lab.trace()
    assert np.abs(lab.apart(bare, seen)[0]).max() < 2e-4
    share = seen.flux / np.interp(seen.arc_length(), bare.arc_length(), bare.flux)
    assert (share > 0.038).all() and (share < 0.06).all()
    np.testing.assert_allclose(seen.width, bare.width, atol=1e-5)


def test_ghost_pulls_where_it_merges(lab):
    """The line is placed by the mean of both lights, weighted, however far the ghost stands off within its window."""
    for thickness in (0.05, 0.2, 2.0):
        glass = lab.bench({"second-surface": {"glass": thickness}})
        alone = trace_of(bench_of(glass, lab.exposure, lab.off), 24)
        seen, merged = ghost(glass, lab.exposure, lab.off, 24), predict(glass, lab.exposure, lab.off, 24)
        d, s = lab.apart(seen, alone)
        share = np.interp(s, seen.arc_length(), seen.flux) / np.interp(s, alone.arc_length(), alone.flux)
        pull = -lab.apart(alone, merged)[0]
        np.testing.assert_allclose(pull, share / (1 + share) * d, rtol=0.02, atol=1e-7)


LEFT_OUT = {"facets": ("facets", "facets"), "finite-beam": ("beam", "beam"), "diffraction": ("fresnel", "diffraction")}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_is_left_out_mixes_in(lab, name):
    """Amplitude 0 is the trace without, 1 the trace with, 1/2 half way between; where it is not left out, nothing."""
    key, switch = LEFT_OUT[name]
    base = Physics(False, name == "diffraction", False)
    without, whole = lab.trace(physics=base), lab.trace(physics=replace(base, **{switch: True}))
    lab.same(lab.trace({name: {key: 0.0, "size_mm": 1.0}}, physics=base), without, 1e-12)
    full, half = (lab.trace({name: {key: a}}, physics=base) for a in (1.0, 0.5))
    assert np.abs(lab.apart(whole, full)[0]).max() < 1e-5
    d, _ = lab.apart(without, full)
    e, _ = lab.apart(without, half)
    np.testing.assert_allclose(e, 0.5 * d, atol=1e-5)
    at = slice(3, -3)
    mixed = np.sqrt(0.5 * (without.width**2 + full.width**2))
    np.testing.assert_allclose(half.width[at], mixed[at], atol=1e-6)
    place = signed_distance(whole, full.points)[1]
    np.testing.assert_allclose(full.flux[at], np.interp(place, whole.arc_length(), whole.flux)[at], rtol=5e-3)
    lab.same(lab.trace({name: {key: 1.0}}), lab.trace(), 1e-12)
    assert max(np.abs(d).max(), np.abs(full.width - without.width).max()) > 1e-3


def test_all_that_is_left_out_at_once(lab):
    effects = {name: {key: 1.0} for name, (key, _) in LEFT_OUT.items()}
    full, whole = lab.trace(effects, physics=lab.pencil), lab.trace()
    d, s = lab.apart(whole, full)
    assert np.abs(d).max() < 1e-5
    width = np.interp(s, whole.arc_length(), whole.width)
    np.testing.assert_allclose(full.width[(len(full.width) - len(s)) // 2 :][: len(s)], width, atol=2e-3)
