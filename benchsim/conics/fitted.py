"""What every fit of a conic says, whatever it was fitted with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchsim.bench import conic
from benchsim.conics.data import Frame

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A conic through points, with its uncertainty.

    Attributes
    ----------
    coefficients : (6,) ndarray
        A … F in ``frame``, unit Euclidean norm.
    covariance : (6, 6) ndarray
        Of the coefficients, rank 5 at most (their length is fixed); rank 3 if ``shallow``.
    frame : Frame
    points : (n, 2) ndarray [mm]
        As given.
    feet : (n, 2) ndarray [mm]
        The points' most likely places on the curve.
    residual : (n,) ndarray
        Distance of the points from the curve [their sigma]; of unknown sigma: [the estimated sigma].
    curve_sigma : (n,) ndarray [mm]
        1 sigma of the curve along its normal at the feet.
    chi2 : float
        Of the points used, with the common errors' own and the parameters' priors, where there are any; equals ``dof``
        where sigma was estimated.
    dof : int
    used : (n,) bool ndarray
        Points that the fit used.
    common : (k,) ndarray
        Estimated common errors of the points, in their prior sigmas.
    converged : bool
        False if the iteration stopped at its limit; the curve is then the best one met.
    sigma_estimated : bool
        No covariance was given: sigma comes from the residuals and intervals are Student's.
    straight : bool
        A straight line fits within the noise: a parabola is not better at the 1 % level.
    shallow : bool
        The arc is straight, or so shallow that every conic through it has a second sheet within the noise, where a
        point does not know its side. The curve is then a parabola w = α + β u + γ u² of the frame and no invariant
        but the radius of curvature is known.
    """

    coefficients: Array
    covariance: Array
    frame: Frame
    points: Array
    feet: Array
    residual: Array
    curve_sigma: Array
    chi2: float
    dof: int
    used: NDArray[np.bool_]
    common: Array
    converged: bool
    sigma_estimated: bool = False
    straight: bool = False
    shallow: bool = False

    @property
    def kind(self) -> str:
        """Ellipse, hyperbola or not determined, at 95 %; `invariants` says it with the rest."""
        from benchsim.conics.invariants import invariants

        return str(invariants(self)["kind"].value)

    @property
    def curve_rms(self) -> float:
        """rms of ``curve_sigma`` along the used points [mm]."""
        return float(np.sqrt(np.mean(self.curve_sigma[self.used] ** 2)))

    @property
    def board_coefficients(self) -> Array:
        """A … F (6,) in y, z of the board [mm], unit norm: badly scaled, for display and exchange only."""
        return conic.transform(self.coefficients, np.linalg.inv(self.frame.matrix), self.frame.origin)
