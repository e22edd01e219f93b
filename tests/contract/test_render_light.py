"""Every effect of the light, `renderer` against first principles: mean across, variance and light of its irradiance.

Five maps of a million rays each; a z-test per smooth stretch of the trace, with the scatter among seeds (fixed) as its
error, some hundredths of a µm. The rate of false alarms of a test is below 1e-4 by the normal law. By default every
effect stands at its cap in one setting; the other setting and small sizes are slow.
"""

from dataclasses import replace

import numpy as np
import pytest
from first_principles import Errors, Tracer
from holding import bench
from landing import CHANCE, PITCH, SEEDS, across, expectation, land, stretches

from benchsim.renderer import irradiance

pytestmark = pytest.mark.usefixtures("backend")

SLOW = [("a", "small"), ("b", "small"), ("b", "cap")]


def sizes(small, cap, *more):
    """The cap in Fig. 7(a); slow: small and the other setting, and more tables in both."""
    tables = {"small": small, "cap": cap}
    slow = [(letter, tables[name], f"{name}-{letter}") for letter, name in SLOW]
    slow += [(letter, table, f"other{i}-{letter}") for letter in "ab" for i, table in enumerate(more)]
    cases = [pytest.param("a", cap, id="cap-a")]
    cases += [pytest.param(letter, table, id=name, marks=pytest.mark.slow) for letter, table, name in slow]
    return pytest.mark.parametrize("letter, size", cases)


@pytest.mark.parametrize("letter", ["a", "b"])
def test_stated_bench(letter):
    """Expects centre, spread and light of the beam on turning facets; setting errors move it as they say."""
    land(bench(letter))
    land(
        bench(letter, screen_shift=60.0, screen_roll=0.6),
        errors=Errors((1.0, -2.0, 1.5), (2e-3, -3e-3), (3e-3, -2e-3), (0.3, 0.2, -0.4), (1e-3, -2e-3, 2e-3)),
    )


@pytest.mark.parametrize("letter", ["a", "b"])
def test_pencil(letter):
    """Expects "that pencil weighted with the beam's density at P(ε), widened by its local direction and height"."""
    land(bench(letter, facets=False), amount=False)


def test_gated_facet():
    """Expects the line of the one facet: "exposure gated to one facet"."""
    land(bench("a", facet=5), {"facet-tilts": {"tilt_0": 2.0, "tilt_5": -2.0}})


@sizes({"dr": 0.3}, {"dr": 17.5}, {"dr": -8.0})
def test_pivot_offset(letter, size):
    """Expects the facet dr further out: "further from the axis of rotation (its width unchanged)"."""
    land(bench(letter), {"pivot-offset": size})


@sizes({"pyr": 0.1}, {"pyr": -10.0})
def test_canting(letter, size):
    """Expects "every facet's normal leans toward +axis"."""
    land(bench(letter), {"canting": size})


@sizes({"tilt_0": 0.2, "tilt_4": -0.2}, {"tilt_0": 3.0, "tilt_1": -1.0, "tilt_5": -2.0})
def test_facet_tilts(letter, size):
    """Expects the mean of all facets' light: "lean of facet k beyond the mean"."""
    land(bench(letter), {"facet-tilts": size}, samples=13)


@sizes({"wob_c": 0.1, "wob_s": -0.05}, {"wob_c": -1.0, "wob_s": 2.0})
def test_axis_wobble(letter, size):
    """Expects "tilt_k = wob_c cos(2πk/N) + wob_s sin(2πk/N)", its sign and phase on gated facets."""
    for facet in (2, 5):
        land(bench(letter, facet=facet), {"axis-wobble": size}, samples=19)


@sizes({"ped_x": 0.1, "ped_y": -0.05}, {"ped_x": -10.0, "ped_y": 6.0}, {"ped_y": 10.0})
def test_axis_tilt(letter, size):
    """Expects "axis turned about world x, y"."""
    land(bench(letter), {"axis-tilt": size})


@sizes({"az_enc": 0.1}, {"az_enc": -10.0})
def test_azimuth_offset(letter, size):
    """Expects the axis turned "about z"."""
    land(bench(letter), {"azimuth-offset": size})


@sizes({"glass": 0.1}, {"glass": 2.0})
def test_second_surface(letter, size):
    """Expects the coating's light "2 `glass` tan θ′ further on, unclipped" (the ghost of some per cent left aside)."""
    land(bench(letter), {"second-surface": size}, amount=False)


@sizes({"fcurv": 0.02}, {"fcurv": 0.2}, {"fcurv": -0.2})
def test_facet_curvature(letter, size):
    """Expects facets bent alike in both directions: "> 0 convex"."""
    land(bench(letter), {"facet-curvature": size})


@sizes({"saz": 0.1, "sel": 0.05}, {"saz": -10.0, "sel": 10.0})
def test_beam_direction(letter, size):
    """Expects dials off by that much, the beam still through P."""
    land(bench(letter), {"beam-direction": size})


@sizes({"bu": 0.1, "bv": 0.05}, {"bu": -3.0, "bv": 3.0})
def test_beam_offset(letter, size):
    """Expects the beam moved "along u, v"."""
    land(bench(letter), {"beam-offset": size})


@sizes({"curv": 0.02}, {"curv": 0.4}, {"curv": -0.39})
def test_wavefront_curvature(letter, size):
    """Expects it "added to divergence/diameter"."""
    land(bench(letter), {"wavefront-curvature": size})


@sizes({"astig0": 0.02, "astig45": -0.02}, {"astig0": -0.4, "astig45": 0.3}, {"astig45": 0.4})
def test_astigmatism(letter, size):
    """Expects "curvature matrix in (u, v): [[c + a0, a45], [a45, c − a0]]"."""
    land(bench(letter), {"astigmatism": size})


@sizes({"coma_u": 0.01, "coma_v": 0.005}, {"coma_u": -0.1, "coma_v": 0.07}, {"coma_v": 0.1})
def test_coma(letter, size):
    """Expects "direction + u (cu (3u² + v²) + 2 cv u v) + v (2 cu u v + cv (u² + 3v²))"."""
    land(bench(letter), {"coma": size})


@sizes({"win": 0.5}, {"win": 10.0})
def test_window(letter, size):
    """Expects "slab n 1.515 parallel to the screen, between mirror and screen"."""
    land(bench(letter), {"window": size})


@sizes({"wty": 0.5}, {"wty": -20.0}, {"wtz": 20.0}, {"wty": 3.0, "win": 10.0})
def test_window_tilt(letter, size):
    """Expects it "turned about y, z (4 mm thick unless `win`)"."""
    land(bench(letter), {"window-tilt": size})


@sizes({"air": 20.0, "airh": 10.0}, {"air": -200.0, "airh": 150.0}, {"airh": 200.0})
def test_air_gradient(letter, size):
    """Expects parabolas toward the cold side."""
    land(bench(letter), {"air-gradient": size})


def plume(kick, y=-40.0, z=-700.0, width=100.0):
    return {"plume": kick, "plume_y": y, "plume_z": z, "plume_width": width}


@sizes(plume(0.05), plume(2.0), plume(-2.0, y=-150.0, z=-650.0, width=60.0))
def test_plume(letter, size):
    """Expects "kick in y, Gaussian about that point of the plane half way", x = (C_x + shift)/2."""
    land(bench(letter, screen_shift=100.0), {"plume": size})


@sizes({"sx": 0.2}, {"sx": -20.0})
def test_screen_distance(letter, size):
    """Expects the board moved "along +x"."""
    land(bench(letter), {"screen-distance": size})


@sizes({"st_y": 0.2, "st_z": -0.3}, {"st_y": 20.0}, {"st_z": -20.0})
def test_screen_tilt(letter, size):
    """Expects "the board turned rigidly so that its plane is x = sx + st_z y + st_y z"."""
    land(bench(letter), {"screen-tilt": size})


@sizes({"srot": 0.2}, {"srot": -20.0})
def test_screen_rotation(letter, size):
    """Expects the board turned "about +x"."""
    land(bench(letter), {"screen-rotation": size})


@sizes({"bow_y": 0.002, "bow_z": 0.001}, {"bow_y": -0.2, "bow_z": 0.1}, {"bow_z": 0.2})
def test_screen_bow(letter, size):
    """Expects ½ (bow_y y² + bow_z z²) "along its normal", rolled with the board."""
    land(bench(letter, screen_roll=2.0), {"screen-bow": size})


@sizes({"dry": 0.02, "drz": -0.01}, {"dry": -1.0, "drz": 1.0})
def test_drift(letter, size):
    """Expects "the light on the screen, world y, z, from the first exposure on"."""
    recording = bench(letter, time=600.0)
    later = replace(recording.exposures[0], time=7800.0, screen_roll=1.0)
    land(replace(recording, exposures=(later, *recording.exposures)), {"drift": size})


@sizes({"amp": 0.1, "freq": 50.0}, {"amp": 1.0, "freq": 50.0})
def test_vibration(letter, size):
    """Expects the variance across to grow by amp²: "rms on the screen", the same in every direction."""
    recording = bench(letter)
    exposure = recording.exposures[0]
    line, length, reach, variance, _ = expectation(Tracer(recording, exposure))
    bent = replace(recording, effects={"vibration": size})
    reach = reach + 6.0 * size["amp"] + 1.0
    found = np.array(
        [
            stretches(irradiance(bent, exposure, seed=seed, rays=1_000_000, pitch=0.5), line, length, reach)[:2]
            for seed in SEEDS
        ]
    )
    error = np.sqrt(found.var(0, ddof=1).mean(1) / len(SEEDS))
    plain = np.interp(np.linspace(0.1, 0.9, 12), np.linspace(0.0, 1.0, 101), variance(np.linspace(0.0, length, 101)))
    mean, grown = found.mean(0)
    assert np.abs(mean).max() < CHANCE * error[0] + 1e-3
    assert abs(grown.mean() - plain.mean() - size["amp"] ** 2) < CHANCE * error[1] + 5e-3 * plain.mean()


@pytest.mark.parametrize("letter, how", [("a", "physics"), ("b", "effect")])
def test_diffraction(letter, how):
    """Expects the Fresnel integral across the trace, `[physics]` or amplitude 1: light within Gaussian windows (0.5, 1
    and 2 mm) and its first moments [mm], within 5e-4 beyond the scatter of the seeds."""
    recording = bench(letter, diffraction=how == "physics")
    exposure = recording.exposures[0]
    bent = replace(recording, effects={"diffraction": {"fresnel": 1.0}} if how == "effect" else {})
    tracer = Tracer(recording, exposure)
    line, length = expectation(tracer, 19)[:2]
    middle = np.array([0.5 * length])
    tangent = line(middle, 1) / np.linalg.norm(line(middle, 1))
    q = np.linspace(-6.0, 6.0, 601)
    profile = tracer.fresnel(line(middle), tangent, q, along=16, across=64)[0]
    maps = (irradiance(bent, exposure, seed=seed, rays=1_000_000, pitch=PITCH) for seed in SEEDS[:3])
    found = np.array([across(light, line, length, 6.0) for light in maps])
    error = found.std(0, ddof=1) / np.sqrt(len(found))
    assert np.abs(found.mean(0) - across_profile(q, profile, PITCH)).max() < 5e-4 + CHANCE * error.max()


def across_profile(q, profile, pitch):
    """What `landing.across` makes of a profile seen through a map's tents."""
    tent = np.exp(-0.5 * q * q / (pitch**2 / 6.0))
    seen = np.convolve(profile, tent / tent.sum(), "same")
    windows = [np.exp(-0.5 * (q / w) ** 2) for w in (0.5, 1.0, 2.0)]
    return np.array(
        [(seen * w).sum() / seen.sum() for w in windows] + [(seen * w * q).sum() / seen.sum() for w in windows]
    )


@pytest.mark.parametrize("name, key", [("facets", "facets"), ("finite-beam", "beam")])
def test_amplitude_of_left_out_physics(name, key):
    """Expects amplitude 1 to be the bench with that physics: "only where `[physics]` has it false"."""
    full = bench("a")
    lacking = replace(full, physics=replace(full.physics, **{key: False}))
    land(lacking, {name: {key: 1.0}}, truth=full)
