"""Effects of the source, and what holds for all effects: nothing at zero, refused where unknown."""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.fields import field
from benchsim.bench.place import SettingErrors
from benchsim.rays import EFFECTS, predict, trace_curve
from benchsim.rays.laser import Beam, SourceEffects, section

SHAPES = ("plume_width", "rs_period")


def test_nothing_at_zero(lab):
    """Every effect with all parameters 0 (of tilts the mirror's own): the trace as without, to the last bits."""
    zero = {
        name: {k: 0.0 for k in keys[: 1 + lab.recording.mirror.facets] if k not in SHAPES}
        for name, keys in EFFECTS.items()
    }
    lab.same(lab.trace(zero), lab.trace(), 1e-12)


def test_what_acts_on_the_camera_does_not_act_on_light(lab):
    effects = {"grid-scale": {"gs": 5.0}, "radial-distortion": {"k1": 0.1}, "saturation": {"sat": 3.0}}
    flat = field([[-300.0, 300.0]] * 2, np.ones((2, 2, 2)))
    fields = {"pixel": flat, "shift": flat, "brightness": field([[0.0, 1.0]], np.ones((2, 2)))}
    lab.same(lab.trace(effects, fields), lab.trace(), 0.0)


@pytest.mark.parametrize(
    "effects, says",
    [
        ({"cantin": {"pyr": 1.0}}, r"fig7a\.toml: effects\.cantin: there is no such effect"),
        ({"canting": {"pir": 1.0}}, r"fig7a\.toml: effects\.canting\.pir: canting has no such parameter; give pyr"),
        ({"facet-tilts": {"tilt_12": 1.0}}, r"fig7a\.toml: effects\.facet-tilts\.tilt_12: the mirror has 12 facets"),
        ({"facet-tilts": {"tilt_1": 1.0, "tilt_rms": 1.0}}, "not both"),
        ({"plume": {"plume": 1.0, "plume_width": 0.0}}, r"fig7a\.toml: effects\.plume\.plume_width: 0 mm"),
        ({"window": {"win": -1.0}}, r"fig7a\.toml: effects\.window\.win: -1 mm"),
        ({"second-surface": {"glass": -1.0}}, r"fig7a\.toml: effects\.second-surface\.glass: -1 mm"),
        ({"vibration": {"amp": 300.0}}, "spread so far that its diffraction cannot be drawn"),
    ],
)
def test_what_does_not_exist_is_refused(lab, effects, says):
    with pytest.raises(BenchsimError, match=says):
        lab.trace(effects)


def test_beam_direction_is_the_dials(lab):
    turned = SettingErrors(
        lab.off.mirror_position, lab.off.mirror_axis, lab.off.laser_direction + np.array([4e-3, -3e-3])
    )
    by_dials = predict(lab.recording, lab.exposure, turned, 24)
    lab.same(lab.trace({"beam-direction": {"saz": 4.0, "sel": -3.0}}), by_dials, 1e-9)
    stage = field([[0.0, 4.0], [0.0, 1.5]], [np.full((2, 2), 4e-3), np.full((2, 2), -3e-3)])
    lab.same(lab.trace(fields={"stage": stage}), by_dials, 1e-9)


def test_stage_field_goes_by_the_stated_dials(lab):
    """A ramp over azimuth and elevation, read at this exposure's."""
    ramp = field([[0.0, 4.0], [0.0, 1.5]], [[[0.0, 1e-3], [4e-3, 5e-3]], np.zeros((2, 2))])
    saz = 1e3 * (1e-3 * lab.exposure.laser_azimuth + 1e-3 * lab.exposure.laser_elevation / 1.5)
    lab.same(lab.trace(fields={"stage": ramp}), lab.trace({"beam-direction": {"saz": saz}}), 1e-9)


def test_beam_offset_moves_the_beam_in_its_section(lab):
    """Along u and v of the table: v the axis less its part along d, u = v × d."""
    p = lab.placement
    d = p.laser_direction
    v = np.cross(d, np.cross(p.axis, d))
    v /= np.linalg.norm(v)
    moved = replace(p, laser_point=p.laser_point + 2.0 * np.cross(v, d) - 1.0 * v)
    r = lab.recording
    expected = trace_curve(r.laser, r.mirror, r.physics, r.screen, moved, samples=24)
    lab.same(lab.trace({"beam-offset": {"bu": 2.0, "bv": -1.0}}), expected, 1e-9)


def test_curvature_adds_to_the_divergence(lab):
    laser = replace(
        lab.recording.laser, divergence=lab.recording.laser.divergence + 0.2e-3 * lab.recording.laser.beam_diameter
    )
    expected = predict(replace(lab.recording, laser=laser), lab.exposure, lab.off, 24)
    lab.same(lab.trace({"wavefront-curvature": {"curv": 0.2}}), expected, 1e-9)
    k = np.linspace(-40.0, 40.0, 5)
    u, v = np.meshgrid(k, k, indexing="ij")
    lab.same(lab.trace(fields={"angle": field([k, k], [0.2e-3 * u, 0.2e-3 * v])}), expected, 1e-6)


def test_astigmatism_at_45_degrees_is_a_linear_angle(lab):
    k = np.linspace(-40.0, 40.0, 5)
    u, v = np.meshgrid(k, k, indexing="ij")
    linear = field([k, k], [1e-4 * u + 2e-4 * v, 2e-4 * u - 1e-4 * v])
    lab.same(lab.trace({"astigmatism": {"astig0": 0.1, "astig45": 0.2}}), lab.trace(fields={"angle": linear}), 1e-6)


def test_constant_angle_is_a_direction(lab):
    """Along u by δ and along v by ε: the beam turned about L; single rays and the beam alike."""
    p = lab.placement
    u, v = section(p)
    turned = p.laser_direction + 2e-3 * u - 1e-3 * v
    turned /= np.linalg.norm(turned)
    flat = field([[-9.0, 9.0]] * 2, [np.full((2, 2), 2e-3), np.full((2, 2), -1e-3)])
    r = lab.recording
    for facets, beam in ((True, True), (True, False), (False, False)):
        physics = replace(lab.geometric, facets=facets, beam=beam)
        moved = replace(p, laser_direction=turned)
        expected = trace_curve(r.laser, r.mirror, physics, r.screen, moved, samples=24)
        # A turned beam also shows another section: ρ differs by 5e-6 of itself.
        np.testing.assert_allclose(
            lab.trace(fields={"angle": flat}, physics=physics).points, expected.points, atol=2e-3
        )


ABERRATED = SourceEffects(
    astigmatism=(3e-4, -2e-4),
    coma=(1e-4, -0.5e-4),
    angle=lambda u, v: np.stack([1e-3 * np.sin(u / 3.0) + 0.0 * v, 5e-4 * np.cos(v / 4.0) + 0.0 * u]),
)


def aberrated(lab):
    p = lab.placement
    return Beam(p.laser_point, p.laser_direction, 5.0, 4e-4, section(p), ABERRATED)


def test_aberrated_rays_are_the_tables(lab):
    """Rays drawn through (u, v) by the table's formulas, met 6 mm down the beam: the model finds them again."""
    beam = aberrated(lab)
    u, v = np.random.default_rng(1).uniform(-7, 7, (2, 40))
    du = (4e-4 + 3e-4) * u - 2e-4 * v + 1e-4 * (3 * u**2 + v**2) - 1e-4 * u * v + 1e-3 * np.sin(u / 3)
    dv = -2e-4 * u + (4e-4 - 3e-4) * v + 2e-4 * u * v - 0.5e-4 * (u**2 + 3 * v**2) + 5e-4 * np.cos(v / 4)
    across, up = beam.section
    g = beam.axis + du[:, None] * across + dv[:, None] * up
    x = beam.point + u[:, None] * across + v[:, None] * up + 6.0 * g
    np.testing.assert_allclose(beam.light(x)[0], g, atol=1e-9)


def test_aberrated_beam_keeps_its_power(lab):
    """Through a plane tilted by 50°, 20 mm down the beam: what is missing from 1 is the quadrature's."""
    beam = aberrated(lab)
    across, up = beam.section
    normal = -(np.cos(0.87) * beam.axis + np.sin(0.87) * across)
    e1 = np.cos(0.87) * across - np.sin(0.87) * beam.axis
    g = np.linspace(-28, 28, 561)
    x = beam.point + 20.0 * beam.axis + g[:, None, None] * e1 + g[None, :, None] * up
    x = x[(np.abs(g) < 28)[:, None] & (np.abs(g) < 15)[None, :]]
    total = beam.light(x)[1](normal).sum() * (g[1] - g[0]) ** 2
    assert total == pytest.approx(1.0, abs=2e-5)


def test_profile_shape_is_the_formula():
    beam = Beam(
        np.zeros(3),
        np.array([0.0, 0.0, -1.0]),
        5.0,
        0.0,
        (np.eye(3)[0], np.eye(3)[1]),
        SourceEffects(shape=(0.1, 0.2, -0.3)),
    )
    plain = Beam(np.zeros(3), np.array([0.0, 0.0, -1.0]), 5.0, 0.0)
    x, up = np.array([[2.0, -3.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    s = 2 * 13.0 / 25.0
    expected = 0.1 * (s * s - 2 * s) + (0.2 * (4.0 - 9.0) + -0.3 * 2 * 2.0 * -3.0) / 25.0
    assert np.log(beam.light(x)[1](up) / plain.light(x)[1](up)) == pytest.approx(expected, abs=1e-12)


def test_profile_shape_moves_flux_and_width_together(lab):
    """A profile that is broader along v lights the facet's height and the line's flanks more evenly: 1e-2 at most."""
    broad = lab.trace(shape=(0.05, 0.0, 0.0))
    assert 1e-5 < np.abs(broad.width - lab.trace().width).max() < 0.05
    assert np.ptp(broad.flux / lab.trace().flux) > 1e-5
