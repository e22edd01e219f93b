"""Table 1 of Lara-Cerecedo et al. 2016: what it says, whether it agrees with itself, and what it determines.

Mirror size, target size, irradiance, total error and hour are not printed. In the paraxial model of `collado` mirror,
target and σ enter by their ratios alone, so the table cannot give a length: fitted are L/σ, T/σ, the irradiance (times
reflectance) and the hour, with square mirror and target, the summer solstice, and the mirrors' centres 32 m below the
target's (the layout's receiver is at (0, 0, 32)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchsim.fluxes.collado import flux
from benchsim.fluxes.heliostat import Heliostat, Target, ideal_normal
from benchsim.vector import solar_vector, sun_angles

Array = NDArray[np.float64]

LATITUDE = math.radians(29.0)
"""The paper's; Hermosillo."""
SOLSTICE = 172
"""Day of the year."""
TOWER = 32_000.0
"""Height of the target's centre above the mirrors' [mm]."""


@dataclass(frozen=True)
class Row:
    """A heliostat of Table 1: place [m], fluxes [W/m²] and differences [%] as printed.

    Which of east and west the paper counts as positive x is not said; the hours found for the two signs lie
    symmetrically about noon.
    """

    x: float
    y: float
    peak_mc: float
    peak: float
    peak_difference: float
    average_mc: float
    average: float
    average_difference: float


TABLE = (
    Row(-6.8, 27.5, 6936, 6946, 0.14, 410.0, 410.1, 0.04),
    Row(15.9, 30.2, 5674, 5581, 1.65, 401.7, 401.8, 0.04),
    Row(0, 34.1, 6288, 6260, 0.44, 400.6, 401.8, 0.28),
    Row(0, 49.9, 4213, 4169, 1.05, 383.7, 383.5, 0.04),
    Row(8.1, 56.3, 3513, 3464, 1.41, 377.4, 377.3, 0.02),
    Row(14.2, 66.7, 2701, 2616, 0.77, 367.9, 368.6, 0.19),
    Row(0, 88.5, 1765, 1716, 2.78, 354.9, 354.1, 0.27),
    Row(-67.5, 167.0, 463, 438, 5.57, 248.2, 242.1, 2.46),
    Row(-23.5, 205.7, 379, 361, 4.73, 223.4, 218.4, 2.25),
    Row(-7.8, 206.9, 381, 363, 4.65, 224.1, 219.1, 2.25),
)


def least_gap(monte_carlo: float, approximate: float, printed: float, last_digit: float) -> float:
    """How far a printed difference lies outside of what its two fluxes allow [percentage points]; 0: consistent.

    The fluxes are known to half their last digit, the difference to 0.005, and it may be relative to the one or to
    the other.
    """
    half = last_digit / 2
    gaps = []
    for base in (monte_carlo, approximate):
        values = [100 * abs(monte_carlo + a - approximate - b) / base for a in (-half, half) for b in (-half, half)]
        crosses = abs(monte_carlo - approximate) <= last_digit
        low, high = (0.0 if crosses else min(values)), max(values)
        gaps.append(max(low - printed - 0.005, printed - 0.005 - high, 0.0))
    return min(gaps)


def contradictions() -> list[tuple[Row, str, float]]:
    """Rows whose printed difference does not follow from their own fluxes: the row, which, and the least gap [%]."""
    out = []
    for row in TABLE:
        for what, mc, approximate, printed, digit in (
            ("peak", row.peak_mc, row.peak, row.peak_difference, 1.0),
            ("average", row.average_mc, row.average, row.average_difference, 0.1),
        ):
            gap = least_gap(mc, approximate, printed, digit)
            if gap > 1e-9:
                out.append((row, what, gap))
    return out


@dataclass(frozen=True)
class Field:
    """What the table leaves open.

    Attributes
    ----------
    mirror, target : float
        Edge over the total error, L/σ and T/σ [mm/rad].
    irradiance : float
        Times reflectance [W/m²].
    hour : float
        True solar time [h].
    """

    mirror: float
    target: float
    irradiance: float
    hour: float

    def heliostat(self, row: Row, sigma: float, slope_share: float = 0.0) -> Heliostat:
        """A row's heliostat if the total error is ``sigma`` [rad], of whose variance the slopes have a share."""
        return Heliostat(
            (1e3 * row.x, 1e3 * row.y, 0.0),
            self.mirror * sigma,
            self.mirror * sigma,
            sigma * math.sqrt(1 - slope_share),
            sigma * math.sqrt(slope_share) / 2,
        )

    def receiver(self, sigma: float) -> Target:
        """The target for that total error."""
        return Target((0.0, 0.0, TOWER), self.target * sigma, self.target * sigma)

    def sun(self) -> Array:
        """Unit vector toward the sun, (3,) east-north-up."""
        return sun_at(self.hour)


def sun_at(hour: float, day: int = SOLSTICE, latitude: float = LATITUDE) -> Array:
    """Unit vector toward the sun at true solar time [h], (3,) east-north-up."""
    azimuth, elevation = sun_angles(latitude, day, hour)
    north, west, up = solar_vector(azimuth, elevation)
    return np.array([-west, north, up])


def analytic(field: Field, row: Row, sigma: float = 4e-3, cells: int = 31) -> tuple[float, float]:
    """Peak and average flux of a row [W/m²], by `collado`; the peak of an aligned heliostat is at the centre.

    ``sigma``, the total error [rad], is of no consequence: mirror and target grow with it.
    """
    heliostat, target, sun = field.heliostat(row, sigma), field.receiver(sigma), field.sun()
    normal = ideal_normal(heliostat.position, target.centre, sun)
    x, z = target.grid(cells)
    peak = flux(heliostat, target, sun, normal, 0.0, 0.0)
    average = flux(heliostat, target, sun, normal, x[:, None], z[None, :]).mean()
    return field.irradiance * float(peak), field.irradiance * float(average)


@dataclass(frozen=True)
class Fit:
    """The table fitted.

    Attributes
    ----------
    field : Field
    sigma : (4,)
        1 σ of ln(L/σ), ln(T/σ), ln(irradiance) and the hour [h], from the scatter of the residuals: the model, not the
        printed digits, limits the fit.
    correlation : (4, 4)
    peak, average : (10,)
        Model over printed, less 1.
    """

    field: Field
    sigma: Array
    correlation: Array
    peak: Array
    average: Array


START = Field(650e3, 560e3, 310.0, 12.2)
"""Where the fit begins; others lead to the same end or its mirror image about noon."""


def fit_table(start: Field = START) -> Fit:
    """Fit the analytic columns, peaks and averages, by their logarithms with equal weights."""
    printed = np.log([(r.peak, r.average) for r in TABLE]).ravel()

    def field(p: Array) -> Field:
        return Field(math.exp(p[0]), math.exp(p[1]), math.exp(p[2]), float(p[3]))

    def off(p: Array) -> Array:
        return np.log([analytic(field(p), r) for r in TABLE]).ravel() - printed

    p0 = np.array([math.log(start.mirror), math.log(start.target), math.log(start.irradiance), start.hour])
    found = least_squares(off, p0, x_scale=[0.1, 0.1, 0.1, 0.3])
    covariance = np.linalg.inv(found.jac.T @ found.jac) * (found.fun @ found.fun) / (len(printed) - 4)
    sigma = np.sqrt(np.diag(covariance))
    residual = np.expm1(found.fun.reshape(-1, 2))
    return Fit(field(found.x), sigma, covariance / np.outer(sigma, sigma), residual[:, 0], residual[:, 1])
