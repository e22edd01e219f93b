"""What a plant does at one moment: conservation, closed forms, and the engine of one heliostat."""

import math
from dataclasses import replace
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from benchsim.fluxes import collado
from benchsim.fluxes.day import Errors, deviated_normals
from benchsim.fluxes.heliostat import Heliostat, unit
from benchsim.instruments.mount.axes import reflected
from benchsim.plant import sunshape
from benchsim.plant.model import Field, Optics, Plant, Receiver, Site
from benchsim.plant.moment import moment, normals, transmitted

SITE = Site(0.6, 0.0, 0.0, ZoneInfo("UTC"), "none")
SUN = unit(np.array([0.4, -0.5, 0.9]))


def plant(receiver, places=((0, 60e3, 0), (40e3, 90e3, 0), (-50e3, 70e3, 2e3)), sun=None, optics=None, **field):
    places = np.array(places, float)
    n = len(places)
    nan = np.full(n, np.nan)
    f = Field(
        tuple("ABCDEFGH"[:n]), places, np.full(n, 4e3), np.full(n, 3e3), np.ones((n, 2), int), nan, nan,
        np.zeros(n, int), receiver.aim(places),
    )  # fmt: skip
    return Plant(
        "", None, (), SITE, (receiver,), replace(f, **field), sun or sunshape.gaussian(2.5e-3), optics or Optics(1e-3)
    )


PLANE = Receiver("r", "plane", (0.0, 0.0, 30e3), 3e3, 3e3)
CYLINDER = Receiver("c", "cylinder", (0.0, 0.0, 30e3), 4e3, 5e3)


def test_the_cosine_is_that_of_half_the_angle_between_sun_and_aim():
    p = plant(PLANE)
    m = moment(p, SUN, 1000.0)
    to_aim = unit(p.field.aim - p.field.position)
    np.testing.assert_allclose(m.cosine, np.cos(np.arccos(to_aim @ SUN) / 2), rtol=1e-12)


@pytest.mark.parametrize(
    "receiver", [PLANE, replace(PLANE, elevation=-0.3, azimuth=0.2), CYLINDER], ids=lambda r: r.kind
)
def test_what_is_caught_and_what_is_spilled_is_what_was_reflected(receiver):
    """The map's sum is the power, and with what is spilled it is what the mirrors reflect."""
    p = plant(replace(receiver, width=1.5e3, height=1.2e3))
    m = moment(p, SUN, 1000.0)
    mesh = m.meshes[0]
    assert float(m.flux[0].ravel() @ mesh.weights) / 1e6 == pytest.approx(m.power.sum(), rel=1e-9)
    assert m.power.sum() + (m.reflected * m.spillage).sum() == pytest.approx(m.reflected.sum(), rel=1e-12)
    np.testing.assert_allclose(m.reflected, 1000 * 12 * m.cosine)
    assert m.spillage.min() > 1e-4


def test_a_receiver_that_takes_all_spills_nothing():
    assert moment(plant(replace(PLANE, width=20e3, height=20e3, elevation=-0.3)), SUN, 1000.0).spillage.max() < 1e-9


@pytest.mark.parametrize("receiver", [PLANE, replace(PLANE, elevation=-0.4), CYLINDER], ids=lambda r: r.kind)
def test_the_share_caught_is_that_of_cells_ten_times_as_fine(receiver):
    """The error of the grid, which the page states: 2e-4 of the light, on receivers that cut the spots."""
    p = plant(replace(receiver, width=1.5e3, height=1.2e3))
    own = moment(p, SUN, 1000.0)
    fine = moment(p, SUN, 1000.0, grids=(p.receivers[0].mesh(1.0, 600, 600),))
    np.testing.assert_allclose(own.caught, fine.caught, atol=2e-4)


def test_a_gaussian_that_a_square_cuts_is_caught_by_the_product_of_two_error_functions():
    """The sun behind the receiver: no incidence, so that the image is a point and only the Gaussian is left."""
    receiver = Receiver("r", "plane", (0.0, 0.0, 0.0), 700.0, 500.0)
    p = plant(receiver, ((0, 100e3, 0),), sunshape.gaussian(3e-3), Optics(0.0))
    m = moment(p, np.array([0.0, -1.0, 0.0]), 1000.0)
    expected = math.erf(350 / 300 / math.sqrt(2)) * math.erf(250 / 300 / math.sqrt(2))
    assert m.caught == pytest.approx([expected], abs=1e-5)
    assert m.image_rms == pytest.approx([math.sqrt(2) * 300], rel=1e-9)


def test_heliostats_add_up_as_one_by_one():
    """Against `collado` on the same points, with errors of the mounts."""
    rng = np.random.default_rng(1)
    p = plant(PLANE)
    errors = {k: rng.normal(0, 2e-3, 3) for k in ("IA", "IE", "CA", "AN", "AW")}
    m = moment(p, SUN, 900.0, errors)
    mesh = m.meshes[0]
    total = 0.0
    for k in range(3):
        h = Heliostat(tuple(p.field.position[k]), 4e3, 3e3, 2.5e-3, 1e-3)
        e = {n: float(v[k]) for n, v in errors.items()}
        by_paper = Errors(e["IA"], e["IE"], e["CA"], math.hypot(e["AN"], e["AW"]), math.atan2(e["AW"], e["AN"]))
        n = deviated_normals(h.position, PLANE.target, SUN, by_paper)[0]
        total = total + 900 * collado.flux(h, PLANE.target, SUN, n, mesh.u[:, None], mesh.v[None, :])
    np.testing.assert_allclose(m.flux[0], total, rtol=1e-4, atol=1e-4 * total.max())


def test_an_east_west_mount_without_errors_points_where_it_should_and_turns_by_them():
    p = plant(PLANE)
    ideal = normals(p.field, SUN)
    tilted = replace(p.field, kinematics="east-west")
    np.testing.assert_allclose(normals(tilted, SUN, {"IA": np.full(3, 1e-12)}), ideal, atol=1e-11)
    turned = normals(tilted, SUN, {"IE": np.full(3, 2e-3)})
    # About east: what lies along it stays, all else turns by the angle.
    np.testing.assert_allclose(turned[:, 0], ideal[:, 0], atol=1e-12)
    angle = np.arctan2(turned[:, 2], turned[:, 1]) - np.arctan2(ideal[:, 2], ideal[:, 1])
    np.testing.assert_allclose(angle, 2e-3, rtol=1e-9)


def test_an_error_moves_the_image_to_where_the_central_ray_lands():
    p = plant(PLANE)
    errors = {"IA": np.array([1e-3, 0, 0])}
    m = moment(p, SUN, 1000.0, errors)
    n = normals(p.field, SUN, errors)
    assert abs(m.landing[0, 0]) > 50 and np.abs(m.landing[1:]).max() < 1e-6
    ray = reflected(n, SUN)
    way = (30e3 * 0 - p.field.position[:, 1]) / ray[:, 1]
    x = p.field.position[:, 0] + way * ray[:, 0]
    np.testing.assert_allclose(m.landing[:, 0], PLANE.target.axes[0][0] * x, atol=1e-6)


def test_a_cylinder_is_lit_from_where_the_heliostat_stands():
    p = plant(CYLINDER, ((60e3, 60e3, 0),))
    m = moment(p, SUN, 1000.0)
    flux, mesh = m.flux[0], m.meshes[0]
    at = mesh.u[np.argmax(flux.sum(axis=1))] / CYLINDER.radius
    assert at == pytest.approx(math.pi / 4, abs=0.06)
    assert not flux[np.abs(mesh.u / CYLINDER.radius - math.pi / 4) > 1.7].any()
    np.testing.assert_allclose(m.landing, [[CYLINDER.radius * math.pi / 4, 0]], atol=1e-6)


def test_soiled_mirrors_and_air_take_their_part():
    clean, dirty = (plant(PLANE, optics=Optics(1e-3, 0, 0.9, s)) for s in (0.0, 0.2))
    a, b = (moment(p, SUN, 1000.0).power for p in (clean, dirty))
    np.testing.assert_allclose(b, 0.8 * a)
    d = np.array([1e5, 5e5, 1e6, 1.0001e6, 2e6])
    assert np.all(np.diff(transmitted(d, "clear")) < 0) and transmitted(d, "none").min() == 1
    # The two branches of the fit meet to half a per mille.
    near, beyond = transmitted(np.array([1e6, 1e6 + 1]), "clear")
    assert near == pytest.approx(beyond, abs=5e-4)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [(sunshape.pillbox(4.65e-3), 4.65e-3 / 2), (sunshape.gaussian(2e-3), 2e-3)],
    ids=["pillbox", "gaussian"],
)
def test_the_suns_sigma_in_closed_form(shape, expected):
    assert shape.sigma == pytest.approx(expected, rel=1e-12)


def test_a_table_of_a_gaussian_has_its_sigma():
    angle = np.linspace(0, 0.03, 3000)
    assert sunshape.SunShape("table", angle, np.exp(-(angle**2) / 2 / 3e-3**2)).sigma == pytest.approx(3e-3, rel=1e-5)


def test_more_aureole_spreads_more():
    """And the profile has about the circumsolar ratio that it is named by."""
    shapes = [sunshape.buie(csr) for csr in (0.05, 0.2, 0.4)]
    assert np.all(np.diff([s.sigma for s in shapes]) > 0)
    for shape, csr in zip(shapes, (0.05, 0.2, 0.4), strict=True):
        a, y = shape.angle, shape.radiance * shape.angle
        power = np.r_[0, np.cumsum(np.diff(a) * (y[1:] + y[:-1]) / 2)]
        assert 1 - np.interp(sunshape.DISC, a, power) / power[-1] == pytest.approx(csr, rel=0.25)


def test_facets_out_of_focus_spread_by_their_size():
    """A flat mirror seen from far off: a strip of length l spreads by l/√12, its facets by less."""
    p = plant(PLANE, ((0, 100e3, 0),))
    d = float(p.field.distance[0])
    base = p.spread[0]
    flat = replace(p, field=replace(p.field, focal=np.array([1e12])))
    assert flat.spread[0] ** 2 - base**2 == pytest.approx((16e6 + 9e6) / 24 / d**2, rel=1e-6)
    canted = replace(flat, field=replace(flat.field, facets=np.array([[4, 3]])))
    assert canted.spread[0] ** 2 - base**2 == pytest.approx((1e6 + 1e6) / 24 / d**2, rel=1e-6)
    focused = replace(p, field=replace(p.field, focal=np.array([d]), canting=np.array([d]), facets=np.array([[4, 3]])))
    assert focused.spread[0] == pytest.approx(base, rel=1e-12)
