"""The parts of the ridge's measurement, each against a case with a known answer."""

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.stats import exponnorm, norm

from benchsim.rays.width import placed
from benchsim.trace.band import band_along
from benchsim.trace.noise import centre_noise, fit_pixel_noise, spline_basis
from benchsim.trace.profile import fit_profiles
from benchsim.trace.ridge import best_curve, ridge_points
from benchsim.trace.shape import fit_shape


def arc_picture(shape=(600, 800), radius=1500.0, sigma=3.0, peak=20.0):
    """A Gaussian line along a circle about (radius + 300, 200); distance of every pixel from it; peak over noise 1."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    distance = np.hypot(u - radius - 300, v - 200) - radius
    return peak * np.exp(-0.5 * (distance / sigma) ** 2), distance


def test_noise_alone_raises_hardly_any_ridge_point():
    """At most one false point is expected per picture of noise; more than 25 in 8 pictures has p < 1e-6."""
    found = sum(len(ridge_points(np.random.default_rng(seed).normal(size=(400, 500))).uv) for seed in range(8))
    assert found <= 25


def test_the_curve_is_found_among_clutter():
    """Rationale: the coarse search must not need a clean picture. Set-up: an arc of peak 6 sigma, 60 bright strokes.

    Expectation: every point of the curve lies within a reduced pixel and a half of the arc, over most of the picture.
    """
    rng = np.random.default_rng(3)
    picture, _ = arc_picture(peak=6.0)
    picture = picture + rng.normal(size=picture.shape)
    for _ in range(60):
        v, u = rng.integers(20, 560), rng.integers(20, 760)
        picture[v : v + 3, u : u + 20] += 8.0
    points = ridge_points(picture)
    curve = best_curve(points, seed=1)
    assert curve is not None
    off = np.abs(np.hypot(curve.points[:, 0] - 1800, curve.points[:, 1] - 200) - 1500)
    assert off.max() < 1.5 * points.reduction + 2.0
    assert np.ptp(curve.points[:, 1]) > 540


def test_unusable_pixels_raise_no_ridge():
    picture, _ = arc_picture()
    picture[:, 600:640] += 50.0  # a bright bar, which is no board
    usable = np.ones(picture.shape, bool)
    usable[:, 590:650] = False
    rng = np.random.default_rng(0)
    uv = ridge_points(picture + rng.normal(size=picture.shape), usable).uv
    assert np.mean((uv[:, 0] > 570) & (uv[:, 0] < 670)) < 0.02


def test_the_band_holds_every_pixel_once_at_its_true_distance():
    _, distance = arc_picture()
    turn = np.linspace(-0.12, 0.25, 400)
    points = np.stack([1800 - 1500 * np.cos(turn), 200 + 1500 * np.sin(turn)], axis=1)
    length = 1500 * (turn - turn[0])
    band = band_along(make_interp_spline(length, points), (0.0, length[-1]), 12.0, distance.shape)
    v, u = band.v[band.inside], band.u[band.inside]
    assert len(np.unique(v * 10000 + u)) == len(v)
    true = distance[v, u]
    sign = np.sign(np.sum(true * band.n[band.inside]))
    assert np.abs(sign * band.n[band.inside] - true).max() < 2e-4
    middle = band.inside[50:-50].sum(axis=1)
    assert middle.mean() == pytest.approx(24.0, rel=0.01)


def profile_pixels(rng, count=400, half=15.0):
    """Places (count, 30) of the pixels of profiles at random phase."""
    return np.arange(-half + 0.5, half)[None, :] + rng.uniform(-0.5, 0.5, (count, 1))


def lopsided(x):
    """A line without symmetry, two Gaussians, whose mean is 0."""
    first, second = 0.6, 0.4
    return first * np.exp(-0.5 * ((x + 0.8) / 1.2) ** 2) / (1.2 * np.sqrt(2 * np.pi)) + second * np.exp(
        -0.5 * ((x - 1.2) / 2.0) ** 2
    ) / (2.0 * np.sqrt(2 * np.pi))


def test_shape_and_profiles_find_a_lopsided_line():
    """Set-up: 400 noisy profiles of a line without symmetry, shifted by known amounts with mean 0, flux 100, noise 1.

    Expectation: the shape's centre within 5 sigmas of the light's, sigma twice the mean shift's; shifts with pulls of
    unit variance (400 values: the std lies within 0.86 … 1.14 with false-alarm rate 1e-4); fluxes unbiased.
    """
    rng = np.random.default_rng(5)
    x = profile_pixels(rng)
    t = np.arange(400.0)
    shift = rng.normal(0, 0.05, 400)
    shift -= shift.mean()
    y = 100 * lopsided(x - shift[:, None]) + 7.0 + rng.normal(size=x.shape)
    row = np.repeat(np.arange(400), x.shape[1])
    shape = fit_shape(
        x.ravel(), t[row], (y.ravel() - 7.0) / 100, np.full(x.size, 1e4), (0.0, 399.0), core=8.0, half_width=15.0
    )
    centre = centre_of(lopsided)
    fit = fit_profiles(x, y, np.ones_like(x), t, shape)
    own = 2 * fit.shift_sigma.mean() / np.sqrt(len(t))
    assert abs(shape.centre(200.0) - centre) < 5 * own + 1e-3
    pull = (fit.shift + shape.centre(t) - centre - shift) / fit.shift_sigma
    assert 0.86 < pull.std() < 1.14
    assert abs(fit.flux.mean() - 100) < 5 * fit.flux_sigma.mean() / 20 + 0.5
    assert np.abs(fit.background.mean() - 7.0) < 0.1


def with_tail(share, far, kind):
    """A Gaussian line of 1.53 px, 1.15 mm of a board at 0.75 mm/px, with a share of its light on one side as a function
    of x [px]: a copy of the line ``far`` sigma beside it, or an exponential tail of that length."""
    sigma = 1.53
    line = norm(0, sigma).pdf
    tail = norm(far * sigma, sigma).pdf if kind == "copy" else exponnorm(far, 0, sigma).pdf
    return lambda x: (1 - share) * line(x) + share * tail(x)


def photographed(light):
    """Centre of a shape that is fitted to 400 profiles of a light, almost without noise [px]."""
    rng = np.random.default_rng(3)
    x = profile_pixels(rng)
    y = light(x) + 1e-6 * rng.normal(size=x.shape)
    t = np.repeat(np.arange(400.0), x.shape[1])
    shape = fit_shape(x.ravel(), t, y.ravel(), np.full(x.size, 1e12), (0.0, 399.0), core=5.8, half_width=15.0)
    return float(shape.centre(200.0))


def centre_of(light):
    """What `rays` gives as the centre of a light [px]."""
    x = np.arange(-40, 120, 0.02)
    return float(placed(x[None], light(x)[None])[1][0])


@pytest.mark.parametrize("share", [0.005, 0.01, 0.02, 0.05])
@pytest.mark.parametrize(
    ("far", "kind", "bar"),
    [(2, "copy", 10.0), (4, "copy", 0.8), (8, "copy", 0.4), (2, "tail", 5.5), (4, "tail", 4.0), (8, "tail", 2.5)],
)
def test_a_faint_tail_hardly_moves_the_centre(far, kind, bar, share):
    """Rationale: what only the photograph has, a ghost or haze, is not to move whole traces; the mean of the light is
    moved by 23 to 92 µm for every per cent of it, and what is measured must be what is predicted where both have it.

    Expectation: ``bar`` µm on the board per per cent in the photograph alone; in both 0.3 µm, which the spline's knots
    of half a pixel leave.
    """
    light = with_tail(share, far, kind)
    seen = photographed(light)
    assert 750 * abs(seen) < 100 * bar * share
    assert 750 * abs(seen - centre_of(light)) < 0.3 + 20 * share


def test_pixel_noise_is_found_from_residuals():
    """Read 20, shot 2 per unit of light, speckle 0.01 of the signal squared: variance at three levels within 5 %."""
    rng = np.random.default_rng(8)
    signal = np.abs(rng.normal(0, 150, 40000))
    level = signal + 100
    true = 20 + 2 * level + 0.01 * signal**2
    noise = fit_pixel_noise(rng.normal(size=40000) * np.sqrt(true), level, signal, np.zeros(40000))
    for s in (0.0, 100.0, 300.0):
        want = 20 + 2 * (s + 100) + 0.01 * s**2
        assert noise.variance(np.array(s + 100), np.array(s)) == pytest.approx(want, rel=0.05)


@pytest.mark.parametrize("mixing", [0.0, 0.5])
def test_scatter_and_correlation_of_centres(mixing):
    """White noise, and noise mixed with its neighbour: scale within 5 sigmas, correlation at lag 1 within 0.1."""
    rng = np.random.default_rng(4)
    t = np.arange(1500.0)
    white = rng.normal(size=1501)
    true = (white[1:] + mixing * white[:-1]) / np.sqrt(1 + mixing**2)
    offset = 1.3 * 0.02 * true + 1e-7 * (t - 700) ** 2
    noise = centre_noise(t, offset, np.full(1500, 0.02), spline_basis(t, (0, 1499.0), 40.0))
    assert abs(noise.scale - 1.3) < 5 * noise.scale_sigma
    first = noise.correlation[1]
    assert first == 0 if mixing == 0 else abs(first - 0.4) < 0.1


@pytest.mark.parametrize("period", [9.0, 14.0, 60.0])
def test_correlation_of_a_ripple_is_that_of_some_noise(period):
    """Centres that a ripple of the screen moves by ten times their noise, in a period shorter than the smooth curve can
    follow: the measured correlation is high where it ceases to be looked at or to be positive. Laid out for the
    profiles it must be a covariance, positive definite, and it must still say that neighbours err together."""
    rng = np.random.default_rng(11)
    t = np.arange(900.0)
    offset = 0.2 * np.sin(2 * np.pi * t / period) + 0.02 * rng.normal(size=900)
    noise = centre_noise(t, offset, np.full(900, 0.02), spline_basis(t, (0, 899.0), 40.0))
    rho = np.zeros(900)
    rho[: len(noise.correlation)] = noise.correlation
    assert np.linalg.eigvalsh(rho[np.abs(np.subtract.outer(t, t)).astype(int)]).min() > 0
    assert noise.correlation[1] > 0.3
