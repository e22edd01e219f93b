"""Every effect and free field of the light, held against the ray model: two realisations that share no formula.

Scenario. Fig. 7(a), geometric optics unless said, the whole board. Both rooms draw the bench with an effect and
without; three stretches of 50 mm of the trace give the light's mean across the predicted curve, its width (the ray
model's own measure, of the traced rays) and its flux per mm. So what is compared is how far the effect moves, widens
and brightens the trace, at two magnitudes: one small, one near the catalogue's cap, where its second order shows.

Noise. The kernel's rays come in 16 independently shifted lattices; their scatter gives the standard error of each
number, and Student's t with 15 degrees of freedom the threshold. The whole file compares some 1100 numbers and rejects
by chance once in a hundred runs (Bonferroni); its seeds are fixed. To the noise are added 1 % of what the effect does
to that observable, since the ray model takes means over curves of 96 points and facets' leans to first order, and
0.3 µm or 0.03 % of flux.

Each comparison must also be able to fail: the effect, near its cap, is at least five times what would be tolerated.
"""

from dataclasses import replace
from functools import lru_cache

import drjit as dr
import numpy as np
import pytest
from light_settings import bench
from scipy import stats

from benchsim import rays
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.fields import field
from benchsim.bench.place import place
from benchsim.rays.curve import trace
from benchsim.rays.prediction import bench_of
from benchsim.rays.profile import adaptive
from benchsim.renderer import EFFECTS, backend, effects, facet, tracer
from benchsim.renderer.irradiance import irradiance
from benchsim.renderer.mirror import from_facet
from benchsim.renderer.partial_physics import mixture
from benchsim.renderer.sweep import sweep
from benchsim.renderer.tracer import Tracer

LATTICES, RAYS = 16, 1 << 15
HALF, PARTS = 25.0, 3
REACH = 15.0
THRESHOLD = stats.t.ppf(1 - 0.5 * 0.01 / 1100, LATTICES - 1)
SYSTEMATIC, FLOOR = 0.01, 3e-4


def recording(**physics):
    """Fig. 7(a) twice, the second exposure two hours after the first; the second is looked at."""
    made = bench(**({"diffraction": False} | physics))
    first = made.exposures[0]
    return replace(made, exposures=(first, replace(first, time=7200.0)))


def light(r, seed=1):
    """The kernel's hits (n, 2) [mm] and their light, one pair per lattice."""
    backend.use()
    e = r.exposures[-1]
    s = sweep(r, e, place(r.mirror, e))
    t, rng, out = Tracer(s), np.random.default_rng(seed), []
    for _ in range(LATTICES):
        y, z, w, on, _ = t(t.points(RAYS, rng))
        dr.eval(y, z, w, on)
        y, z, w, on = (np.broadcast_to(np.array(v), (RAYS,)) for v in (y, z, w, on))
        out.append((np.stack([y[on], z[on]], axis=1).astype(float), w[on] * (s.measure / RAYS)))
    return out


def stretches(hits, curve):
    """What the curve itself says of each stretch, its width, flux and parting, and of each lattice q and light."""
    along = curve.arc_length()
    parting = np.zeros(len(along)) if curve.parting is None else curve.parting
    for j in range(PARTS):
        m = len(along) * (j + 1) // (PARTS + 1)
        part = slice(max(0, m - 12), m + 13)
        s = np.linspace(along[m] - HALF, along[m] + HALF, 101)
        of_hits = []
        for p, w in hits:
            near = np.hypot(*(p - curve.points[m]).T) < HALF + REACH
            q, at = signed_distance(Curve(curve.points[part]), p[near])
            on = (np.abs(at - along[m] + along[part][0]) < HALF) & (np.abs(q) < REACH)
            of_hits.append((q[on], w[near][on]))
        yield [np.interp(s, along, v).mean() for v in (curve.width, curve.flux, parting)], of_hits


def measure(hits, curve):
    """Mean, width and log flux less the curve's: (lattices, stretches, 3)."""
    out = np.empty((len(hits), PARTS, 3))
    for j, ((width, flux, _), of_hits) in enumerate(stretches(hits, curve)):
        for i, (q, w) in enumerate(of_hits):
            mean = np.average(q, weights=w)
            wide = adaptive(q[None], w[None], np.array([mean]))[1][0] if width else 0.0
            out[i, j] = mean, wide - width, np.log(w.sum() / (2 * HALF) / flux)
    return out


@lru_cache(maxsize=8)
def without(**physics):
    r = recording(**physics)
    curve = rays.predict(r, r.exposures[-1])
    return r, curve, measure(light(r), curve)


def compare(effects=None, fields=None, **physics):
    """Disagreement of the two rooms about an effect, its standard error, and the effect itself; (stretches, 3) each."""
    r, before, base = without(**physics)
    changed = replace(r, effects=effects or {}, fields=fields or {})
    after = rays.predict(changed, r.exposures[-1])
    d = measure(light(changed), after) - base
    at, was = (np.linspace(0, 1, 96)[:, None] * c.arc_length()[-1] for c in (after, before))
    shift = signed_distance(before, after.points)[0][8:-8]
    wider = np.interp(at, after.arc_length(), after.width) - np.interp(was, before.arc_length(), before.width)
    brighter = np.interp(at, after.arc_length(), after.flux) / np.interp(was, before.arc_length(), before.flux)
    wider, brighter = np.abs(wider).max(), np.abs(np.log(brighter)).max()
    # A trace that is spread is displaced as far as it is spread.
    size = np.array([max(np.abs(shift).max(), wider), wider, brighter])
    return d.mean(axis=0), d.std(axis=0, ddof=1) / np.sqrt(LATTICES), size


def agree(effects=None, fields=None, **physics):
    """Assert that the rooms agree; the largest effect in units of what is tolerated."""
    d, error, size = compare(effects, fields, **physics)
    tolerated = THRESHOLD * error + SYSTEMATIC * size + FLOOR
    print(f"{effects or list(fields)}: disagree by {np.abs(d).max(axis=0)} of {size}, noise {error.max(axis=0)}")
    assert (np.abs(d) <= tolerated).all(), f"mean, width [mm], log flux: {d} exceed {tolerated}"
    return (size / tolerated).max()


TILTS = np.array([1.0, -0.4, 0.2, -1.0, 0.7, -0.3, 0.5, -0.9, 0.6, -0.2, 0.4, -0.6])

CASES = {
    "beam-direction": [{"saz": 0.5}, {"saz": 10.0}, {"sel": 0.5}, {"sel": -10.0}],
    "beam-offset": [{"bu": 0.3}, {"bu": 3.0}, {"bv": 0.3}, {"bv": -3.0}],
    "wavefront-curvature": [{"curv": 0.05}, {"curv": 0.4}],
    "astigmatism": [{"astig0": 0.05}, {"astig0": -0.4}, {"astig45": 0.05}, {"astig45": 0.4}],
    "coma": [{"coma_u": 0.01}, {"coma_u": 0.1}, {"coma_v": 0.01}, {"coma_v": 0.1}],
    "pivot-offset": [{"dr": 0.5}, {"dr": 10.0}],
    "canting": [{"pyr": 0.5}, {"pyr": -10.0}],
    "facet-tilts": [{f"tilt_{k}": s * t for k, t in enumerate(TILTS)} for s in (0.2, 1.0)],
    "axis-wobble": [{"wob_c": 0.2}, {"wob_c": 1.0, "wob_s": -0.5}],
    "axis-tilt": [{"ped_x": 0.5}, {"ped_x": 10.0}, {"ped_y": 0.5}, {"ped_y": -10.0}],
    "azimuth-offset": [{"az_enc": 0.5}, {"az_enc": 10.0}],
    "facet-curvature": [{"fcurv": 0.02}, {"fcurv": 0.2}, {"fcurv": -0.1}],
    "window": [{"win": 1.0}, {"win": 10.0}],
    "window-tilt": [{"wty": 2.0}, {"wty": 20.0}, {"wtz": 2.0}, {"wtz": -20.0}],
    "air-gradient": [{"air": 50.0}, {"air": 400.0}, {"airh": 50.0}, {"airh": -400.0}],
    "plume": [{"plume": a, "plume_y": -50.0, "plume_z": -650.0, "plume_width": 60.0} for a in (0.2, 2.0)],
    "screen-distance": [{"sx": 1.0}, {"sx": -20.0}],
    "screen-tilt": [{"st_y": 1.0}, {"st_y": 20.0}, {"st_z": 1.0}, {"st_z": -20.0}],
    "screen-rotation": [{"srot": 1.0}, {"srot": 20.0}],
    "screen-bow": [{"bow_y": 0.03}, {"bow_y": 0.2}, {"bow_z": 0.03}, {"bow_z": -0.2}],
    "drift": [{"dry": 0.1, "drz": -0.05}, {"dry": -0.7, "drz": 1.0}],
    "vibration": [{"amp": 0.2}, {"amp": 1.0, "freq": 50.0}],
}

ELSEWHERE = {"facet-tilts": ("tilt_rms",), "second-surface": ("glass",), "window-tilt": ("win",)}
"""Parameters that tests of their own look at."""


@pytest.mark.parametrize("name", CASES)
def test_an_effect_is_the_same_in_both_rooms(name):
    """Shift, width and flux at every magnitude; the last of each parameter is plain to see."""
    plain = max(agree({name: own}) for own in CASES[name])
    assert plain > 5


def test_every_effect_of_the_light_is_compared():
    """An effect added to `renderer` has to be added here, parameter by parameter."""
    not_light = {"facets", "finite-beam", "diffraction", "setting-errors"}
    camera = set(rays.camera.EFFECTS)
    assert set(EFFECTS) - not_light - camera == set(CASES) | {"second-surface"}
    for name, cases in CASES.items():
        seen = {p for case in cases for p in case} | set(ELSEWHERE.get(name, ()))
        for p in EFFECTS[name]:
            assert any(q.startswith(p.rstrip("*")) for q in seen), f"{name}.{p}"
    assert set(EFFECTS) == set(rays.EFFECTS)
    assert {"angle", "stage", "lean", "kick", "height", "time"} <= effects.gather()[1]


def smooth(name, size):
    """A field of a few long waves, tabled so finely that its knots do not show."""

    def of(coordinates, *waves):
        grid = np.meshgrid(*coordinates, indexing="ij")
        phases = [sum(a * g for a, g in zip(w, grid, strict=True)) for w in waves]
        return field(coordinates, [size * np.sin(p + 0.3 * k) for k, p in enumerate(phases)])

    section, board = np.linspace(-8, 8, 161), np.linspace(-360, 360, 241)
    return {
        "angle": lambda: of([section, section], (1 / 4, 1 / 5), (1 / 6, -1 / 5)),
        "stage": lambda: of([np.linspace(0, 3, 31), np.linspace(0, 1.5, 31)], (1.0, 2.0), (2.0, -1.0)),
        "lean": lambda: of([np.linspace(-0.4, 0.4, 161), np.arange(12.0)], (9.0, 0.8)),
        "kick": lambda: of(
            [np.linspace(-300, 300, 151), np.linspace(-1200, 200, 351)], (1 / 90, 1 / 120), (1 / 70, -0.01)
        ),
        "height": lambda: of([board, board], (1 / 90, 1 / 120)),
        "time": lambda: of([np.linspace(0, 1e4, 21)], (1e-4,), (2e-4,)),
    }[name]()


@pytest.mark.parametrize(
    ("name", "small", "large"),
    [
        ("angle", 1e-4, 1e-3),
        ("stage", 3e-4, 1e-2),
        ("lean", 1e-4, 8e-4),
        ("kick", 2e-4, 2e-3),
        ("height", 0.5, 6.0),
        ("time", 0.1, 2.0),
    ],
)
def test_a_free_field_is_the_same_in_both_rooms(name, small, large):
    assert max(agree(None, {name: smooth(name, s)}) for s in (small, large)) > 5


@pytest.mark.parametrize(
    "own",
    [
        {"canting": {"pyr": 5.0}},
        {"facet-curvature": {"fcurv": 0.2}},
        {"astigmatism": {"astig0": 0.3, "astig45": -0.2}},
        {"coma": {"coma_v": 0.05}},
        {"coma": {"coma_u": 0.1, "coma_v": 0.1}},
        {"screen-bow": {"bow_y": 0.2, "bow_z": -0.1}},
        {"vibration": {"amp": 0.3}},
    ],
    ids=str,
)
def test_with_diffraction(own):
    """Rationale: what bends the light over the facet's height changes the Fresnel pattern, in `renderer` by a table of
    patterns, in `rays` by an integral over the facet of its own. The larger coma brings part of the beam to a focus on
    the board."""
    assert agree(own, diffraction=True) > 5


@pytest.mark.parametrize("physics", [{"beam": False}, {"facets": False}, {"facets": False, "beam": False}], ids=str)
def test_with_less_physics(physics):
    """A single ray or a cylinder meets all elements too; the ray has no width and no beam to bend."""
    own = {
        "canting": {"pyr": 4.0},
        "pivot-offset": {"dr": 2.0},
        "beam-direction": {"saz": 2.0},
        "window": {"win": 5.0},
        "air-gradient": {"air": 200.0},
        "screen-bow": {"bow_y": 0.1},
        "screen-tilt": {"st_z": 10.0},
    }
    assert agree(own, **physics) > 5


@pytest.mark.parametrize("glass", [0.5, 2.0])
def test_second_surface(glass, monkeypatch):
    """The coating's light and the front face's ghost, each against the ray model's; the ghost's flux too.

    The kernel follows one of the two per ray at random; here all rays follow one.
    """
    r = recording()
    changed = replace(r, effects={"second-surface": {"glass": glass}})
    e = r.exposures[-1]
    main, ghost = trace(bench_of(changed, e)), rays.ghost(changed, e)
    for share, curve in ((-1.0, main), (2.0, ghost)):
        monkeypatch.setattr(tracer, "GHOST", share)
        d = measure(light(changed), curve)
        d[..., 2] += np.log(2.0)  # both shares halve the rays' weights
        error = d.std(axis=0, ddof=1) / np.sqrt(LATTICES)
        assert (np.abs(d.mean(axis=0)) <= THRESHOLD * error + np.array([1e-3, 1e-3, 2e-3])).all(), d.mean(axis=0)
    assert np.abs(signed_distance(main, ghost.points)[0][8:-8]).max() > 0.02
    assert 0.03 < np.median(ghost.flux) / np.median(main.flux) < 0.12


@pytest.mark.parametrize("glass", [1.0, 2.0])
@pytest.mark.parametrize("share", [pytest.param(-1.0, id="coating"), pytest.param(2.0, id="ghost")])
def test_second_surface_with_diffraction(share, glass, monkeypatch):
    """The front face stands where it does whatever the glass, and the beam is as far off its middle as it is there."""
    r, _, base = without(diffraction=True)
    changed = replace(r, effects={"second-surface": {"glass": glass}})
    e = r.exposures[-1]
    curve = trace(bench_of(changed, e)) if share < 0 else rays.ghost(changed, e)
    monkeypatch.setattr(tracer, "GHOST", share)
    d = measure(light(changed), curve) - base
    d[..., 2] += np.log(2.0)  # both shares halve the rays' weights
    error = d.std(axis=0, ddof=1) / np.sqrt(LATTICES)
    assert (np.abs(d.mean(axis=0)) <= THRESHOLD * error + np.array([1e-3, 1e-3, 2e-3])).all(), d.mean(axis=0)


@pytest.mark.parametrize(
    ("scene", "number", "glass"),
    [
        ("fig7a", 0, 1.0),
        ("fig7a", 0, 2.0),
        ("campaign12", 3, 1.0),
        ("campaign12", 3, 2.0),
    ],
)
def test_the_ghost_pulls_the_line_as_the_ray_model_says(scene, number, glass, monkeypatch):
    """How far the centroid of coating's and ghost's light together lies from the coating's alone, of the traced rays.

    It is by the centroid that `trace.line` places a line. The campaign's fourth setting parts the two lights the
    farthest. Tolerated are noise and 0.3 µm.
    """
    r = bench(scene, diffraction=False)
    e = r.exposures[number]
    changed = replace(r, exposures=(e,), effects={"second-surface": {"glass": glass}})
    alone, merged = trace(bench_of(changed, e)), rays.predict(changed, e)
    both = measure(light(changed), alone)[..., 0]
    monkeypatch.setattr(tracer, "GHOST", -1.0)
    seen = both - measure(light(changed), alone)[..., 0]
    pull, at = signed_distance(alone, merged.points)
    along = alone.arc_length()
    middles = along[len(along) * np.arange(1, PARTS + 1) // (PARTS + 1)]
    want = np.array([np.interp(np.linspace(m - HALF, m + HALF, 101), at, pull).mean() for m in middles])
    error = seen.std(axis=0, ddof=1) / np.sqrt(LATTICES)
    tolerated = THRESHOLD * error + FLOOR
    print(f"{scene} {glass}: pull {seen.mean(axis=0)}, predicted {want}, noise {error}")
    assert np.abs(want / tolerated).max() > 3
    assert (np.abs(seen.mean(axis=0) - want) <= tolerated).all(), (seen.mean(axis=0), want, tolerated)


def test_facets_of_an_rms():
    """Leans drawn for an rms have exactly that rms and zero sum; the same recording has the same leans always."""
    r = replace(recording(), effects={"facet-tilts": {"tilt_rms": 2.0}})
    lean = facet.leans(r)
    assert lean.sum() == pytest.approx(0, abs=1e-15)
    assert np.sqrt(np.mean(lean**2)) == pytest.approx(2e-3)
    np.testing.assert_array_equal(lean, facet.leans(r))
    assert not np.allclose(lean, facet.leans(replace(r, render=replace(r.render, seed=2))))
    each = {f"tilt_{k}": 1e3 * x for k, x in enumerate(lean)}
    one, other = (
        irradiance(replace(r, effects={"facet-tilts": own}), r.exposures[0], seed=3, rays=1 << 18, pitch=1.0).values
        for own in (r.effects["facet-tilts"], each)
    )
    np.testing.assert_allclose(one, other, atol=1e-3 * one.max())


def second_moments(hits, curve):
    """Mean square of the light across the curve about its mean, less the curve's parting: (lattices, stretches)."""
    out = np.empty((len(hits), PARTS))
    for j, ((_, _, parting), of_hits) in enumerate(stretches(hits, curve)):
        for i, (q, w) in enumerate(of_hits):
            out[i, j] = np.average((q - np.average(q, weights=w)) ** 2, weights=w) - parting
    return out


def drawn(rms, seed):
    """The recording with leans of an rms, as `renderer` draws them from a seed, and with the same leans one by one."""
    r = recording()
    of_rms = replace(r, effects={"facet-tilts": {"tilt_rms": rms}}, render=replace(r.render, seed=seed))
    each = {f"tilt_{k}": 1e3 * x for k, x in enumerate(facet.leans(of_rms))}
    return of_rms, replace(of_rms, effects={"facet-tilts": each})


@pytest.mark.parametrize("rms", [0.2, 1.0])
def test_tilts_of_an_rms_spread_the_light_alike(rms):
    """What `tilt_rms` means is the mean square of the leans, and so how far the light of all facets is spread.

    `renderer` draws one pattern of that rms from the seed, the ray model takes the quantiles of a normal distribution.
    Set-up: three patterns. Expectation: mean, flux and the second moment that is added to the light's are those of the
    ray model given the rms alone; of the leans one by one it gives the width of the very pattern, too.
    """
    r, before, base = without()
    plain = second_moments(light(r), before)
    for seed in (1, 2, 3):
        of_rms, each = drawn(rms, seed)
        hits = light(of_rms)
        alone, exact = (rays.predict(x, x.exposures[-1]) for x in (of_rms, each))
        spread = second_moments(hits, alone) - plain
        d = np.concatenate([measure(hits, exact) - base, measure(hits, alone)[..., ::2] - base[..., ::2]], axis=2)
        d = np.concatenate([d, spread[..., None]], axis=2)
        error = d.std(axis=0, ddof=1) / np.sqrt(LATTICES)
        wider = np.abs(exact.width - before.width).max()
        far = np.sqrt(alone.parting.max())
        size = np.array([far, wider, 0.0, far, 0.0, alone.parting.max()])
        tolerated = THRESHOLD * error + SYSTEMATIC * size + np.array([FLOOR] * 5 + [FLOOR * far])
        print(f"{rms} {seed}: {d.mean(axis=0)} of {size}, noise {error}")
        assert (np.abs(d.mean(axis=0)) <= tolerated).all(), (d.mean(axis=0), tolerated)
        assert size[5] / tolerated[:, 5].max() > 5


@pytest.mark.xfail(
    strict=True,
    raises=AssertionError,
    reason="two patterns of one rms are not equally wide: at 0.3 mrad the ray model's quantiles add 0.56 mm to the "
    "adaptive width, six drawn patterns 0.33 … 0.61 mm and 0.45 mm in the mean",
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_tilts_of_an_rms_are_as_wide_as_the_ray_model_says(seed):
    _, _, base = without()
    of_rms, _ = drawn(0.3, seed)
    alone = rays.predict(of_rms, of_rms.exposures[-1])
    d = (measure(light(of_rms), alone) - base)[..., 1]
    error = d.std(axis=0, ddof=1) / np.sqrt(LATTICES)
    assert (np.abs(d.mean(axis=0)) <= THRESHOLD * error + SYSTEMATIC * alone.width.max()).all(), d.mean(axis=0)


def test_a_gated_facet_shows_its_own_lean():
    """Gated to facet 3 the trace is that of all facets leaning as facet 3 does, at a twelfth of the light."""
    r = recording()
    e = replace(r.exposures[0], facet=3)
    own = replace(r, effects={"facet-tilts": {f"tilt_{k}": t for k, t in enumerate(TILTS)}})
    all_so = replace(r, effects={"canting": {"pyr": TILTS[3]}})
    one = irradiance(own, e, seed=3, rays=1 << 18, pitch=1.0)
    other = irradiance(all_so, r.exposures[0], seed=3, rays=1 << 18, pitch=1.0)
    np.testing.assert_allclose(12 * one.values, other.values, atol=0.02 * other.values.max())


def test_window_s_thickness():
    """`win` of either table is the slab's; a turned slab of no stated thickness has 4 mm."""
    r = recording()
    thick = {"window-tilt": {"wty": 10.0, "win": 8.0}}
    together = {"window-tilt": {"wty": 10.0}, "window": {"win": 8.0}}
    maps = [
        irradiance(replace(r, effects=own), r.exposures[0], seed=3, rays=1 << 18, pitch=1.0).values
        for own in (thick, together, {"window-tilt": {"wty": 10.0}})
    ]
    np.testing.assert_allclose(maps[0], maps[1], atol=1e-5 * maps[0].max())
    assert np.abs(maps[0] - maps[2]).max() > 0.05 * maps[0].max()


LEFT_OUT = [("facets", "facets", "facets"), ("finite-beam", "beam", "beam"), ("diffraction", "fresnel", "diffraction")]


@pytest.mark.parametrize(("name", "parameter", "switch"), LEFT_OUT)
def test_physics_in_part_is_a_mixture(name, parameter, switch):
    """A share a of the light is that with the physics, the rest that without; where it is there anyway, a is idle."""
    r = recording(**{"diffraction": True} | {switch: False})

    def lit(own, **physics):
        changed = replace(r, effects=own, physics=replace(r.physics, **physics))
        return irradiance(changed, r.exposures[0], seed=3, rays=1 << 18, pitch=1.0).values

    off, on = lit({}), lit({}, **{switch: True})
    tolerance = 1e-5 * max(off.max(), on.max())
    np.testing.assert_allclose(lit({name: {parameter: 0.3}}), 0.7 * off + 0.3 * on, atol=tolerance)
    np.testing.assert_allclose(lit({name: {parameter: 1.0}}), on, atol=tolerance)
    np.testing.assert_allclose(lit({name: {parameter: 0.3}}, **{switch: True}), on, atol=tolerance)
    assert np.abs(on - off).max() > 0.02 * on.max()


@pytest.mark.parametrize(("name", "parameter", "switch"), LEFT_OUT)
def test_physics_put_in_is_the_same_in_both_rooms(name, parameter, switch):
    """Rationale: against the vector model the three are effects, of amplitude 1 where the bench has them.

    There both rooms agree as about any other effect. A share between is no light that nature makes: the ray model mixes
    centres, second moments and fluxes, while centre and width of a mixed profile are not quite those of its moments:
    6 µm and 12 µm are let pass there, and no width is asked of a mixture with a line that has none.
    """
    r = recording(**{"diffraction": True} | {switch: False})
    before = rays.predict(r, r.exposures[-1])
    base = measure(light(r), before)
    for amount in (0.3, 1.0):
        changed = replace(r, effects={name: {parameter: amount}})
        after = rays.predict(changed, r.exposures[-1])
        mixed = [[(p, w * share) for p, w in light(replace(r, physics=has))] for share, has in mixture(changed)]
        hits = [tuple(np.concatenate(of) for of in zip(*lattice, strict=True)) for lattice in zip(*mixed, strict=True)]
        d = measure(hits, after) - base
        error = d.std(axis=0, ddof=1) / np.sqrt(LATTICES)
        shift = np.abs(signed_distance(before, after.points)[0][8:-8]).max()
        wider = np.abs(after.width.mean() - before.width.mean())
        # Of the flux: diffraction's tails reach beyond what is summed across.
        inexact = [SYSTEMATIC * shift, SYSTEMATIC * wider, 1e-2] if amount == 1 else [6e-3, 12e-3, 1e-2]
        tolerated = THRESHOLD * error + np.array(inexact) + FLOOR
        compared = [0, 2] if amount < 1 and name == "finite-beam" else [0, 1, 2]
        print(f"{name} {amount}: disagree by {np.abs(d.mean(axis=0)).max(axis=0)}, shift {shift}, wider {wider}")
        assert (np.abs(d.mean(axis=0)) <= tolerated)[:, compared].all(), d.mean(axis=0)
    assert max(shift, wider) > 0.03


def test_what_is_the_camera_s_leaves_the_light_alone():
    r = recording()
    own = {"grid-scale": {"gs": 5.0}, "radial-distortion": {"k1": 0.1}, "rolling-shutter": {"rs_s": 3.0}}
    plain, same = (
        irradiance(replace(r, effects=x), r.exposures[0], seed=3, rays=1 << 16, pitch=1.0).values for x in ({}, own)
    )
    np.testing.assert_allclose(same, plain, atol=1e-5 * plain.max())


def test_effects_keep_float32_s_accuracy():
    """Rationale: a trace read to some µm. All effects that bend a ray at once, 32768 rays in float32 and the same rays
    in float64: every hit within 3 µm."""
    own = {
        "canting": {"pyr": 3.0},
        "facet-curvature": {"fcurv": 0.1},
        "astigmatism": {"astig0": 0.2},
        "coma": {"coma_v": 0.05},
        "window-tilt": {"wty": 10.0},
        "air-gradient": {"air": 200.0},
        "plume": {"plume": 1.0, "plume_z": -650.0},
        "screen-bow": {"bow_y": 0.1},
        "beam-offset": {"bu": 1.0},
        "axis-tilt": {"ped_y": 5.0},
    }
    fields = {"height": smooth("height", 2.0), "kick": smooth("kick", 1e-3), "angle": smooth("angle", 1e-3)}
    r = replace(recording(), effects=own, fields=fields)
    backend.use()
    s = sweep(r, r.exposures[0], place(r.mirror, r.exposures[0]))
    t = Tracer(s)
    y, z, w, on, sample = t(t.points(RAYS, np.random.default_rng(5)))
    dr.eval(y, z, w, on, sample)
    y, z, on, delta, u, h = (np.broadcast_to(np.array(v), (RAYS,)) for v in (y, z, on, *sample))
    exact = from_facet(s.optics, delta.astype(float), u.astype(float), h.astype(float), np)
    on = on & (np.abs(y) < 360) & (np.abs(z) < 360)
    assert on.sum() > 5000
    assert np.hypot(y - exact.y, z - exact.z)[on].max() < 3e-3
