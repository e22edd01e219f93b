"""The trace: what every later room is handed, and its file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.writing import write_csv
from benchsim.trace.pose import Pose

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

Array = NDArray[np.float64]

CUT = 0.7
"""Share of profiles with saturated pixels above which they are kept: what is left would be too little of a line."""

HEADER = (
    "exposure",
    "ridge",
    "s_mm",
    "u_px",
    "v_px",
    "y_mm",
    "z_mm",
    "sigma_mm",
    "width_mm",
    "flux",
    "skewness",
    "saturated",
)


@dataclass(frozen=True)
class RidgeNoise:
    """Noise of one ridge's centres, measured on themselves.

    Attributes
    ----------
    scale : float
        Scatter of the centres over what the pixels' noise alone predicts; already in ``sigma_mm``. Above 1 with
        speckle or JPEG, whose pixels are correlated.
    scale_sigma : float
        1 σ of ``scale``.
    correlation : (m,) array
        Correlation between profiles 0, 1, 2 … steps apart; only what is significant, the rest 0.
    correlation_mm : float
        Length over which errors are correlated: the step times the sum of the correlation over both sides; 0: white.
    step_mm : float
        Mean distance of neighbouring profiles, one pixel.
    window_mm : float
        Half width of the window, about the centre, of flux and skewness.
    blur_mm : float
        rms of the camera's blur across the ridge.
    """

    scale: float
    scale_sigma: float
    correlation: Array
    correlation_mm: float
    step_mm: float
    window_mm: float
    blur_mm: float = 0.0


def _none(*shape: int) -> Array:
    return np.zeros(shape)


@dataclass(frozen=True, repr=False)
class Trace:
    """The ridges of one exposure, one entry per kept profile across a ridge, (n,) each.

    Attributes
    ----------
    exposure : str
        The exposure's image.
    ridge : int
        0 is the trace, 1 … are fainter ridges (ghosts, facets that part).
    s_mm : mm
        Arc length along the ridge from its first profile, in the direction of the larger of growing y and z.
    u_px, v_px : px
        Centre in the picture.
    y_mm, z_mm : mm
        The same point on the board as its marks define it: the `centre.centre` of the light across the curve, behind
        the camera's blur.
    sigma_mm : mm
        1 sigma across the curve of the trace noise alone: independent of the other profiles but for
        ``noise[ridge].correlation``; the pose and the line's shape, common to all profiles, come on top, see
        `covariance`.
    width_mm : mm
        Adaptive (Gaussian-weighted) rms width across the curve about the centre, the camera's blur and pixel
        included; nan where the camera's gamma is unknown, as are flux and skewness.
    flux : counts · mm
        Linear light across the curve within the window.
    skewness
        Third standardised moment within the window; smooth along the curve.
    saturated
        Fraction of saturated pixels within the window; they are not used.
    normal : (n, 2)
        Unit vector on the board (y, z) across the curve: the direction of growing s turned by +90 degrees.
    profile : (n,) int
        Number of the profile along its ridge; neighbours differ by one.
    pose_mm : (n, p) mm
        Shift along ``normal`` of all profiles together by 1 sigma of each of p independent parts of the camera's pose.
    shape_mm : (n, r) mm
        The same for the line's mean shape and the background's slope, which the profiles share.
    noise : of `RidgeNoise`, by ridge.
    dropped : mapping
        Why profiles were dropped, and how many, all ridges together (see `line.STATUS`).
    dropped_px : (m, 2) px
        Where.
    linear : bool
        Whether the camera's gamma is known.
    pose : Pose or None
        Of the camera; None where it is not known.
    """

    exposure: str
    ridge: NDArray[np.intp]
    s_mm: Array
    u_px: Array
    v_px: Array
    y_mm: Array
    z_mm: Array
    sigma_mm: Array
    width_mm: Array
    flux: Array
    skewness: Array
    saturated: Array
    normal: Array = field(default_factory=lambda: _none(0, 2))
    profile: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    pose_mm: Array = field(default_factory=lambda: _none(0, 0))
    shape_mm: Array = field(default_factory=lambda: _none(0, 0))
    noise: tuple[RidgeNoise, ...] = ()
    dropped: Mapping[str, int] = field(default_factory=dict)
    dropped_px: Array = field(default_factory=lambda: _none(0, 2))
    linear: bool = True
    pose: Pose | None = None

    def __len__(self) -> int:
        return len(self.s_mm)

    @property
    def points(self) -> Array:
        """y, z of the centres, (n, 2) mm."""
        return np.stack([self.y_mm, self.z_mm], axis=1)

    def __repr__(self) -> str:
        ridges = f", {count} ridges" if (count := len(np.unique(self.ridge))) > 1 else ""
        sigma = f", ±{1e3 * np.median(self.sigma_mm):.1f} µm each" if len(self) else ""
        return f"<Trace of {self.exposure}: {len(self)} profiles{ridges}{sigma}>"

    def to_pandas(self) -> DataFrame:
        """A row for every profile, with the columns of ``trace.csv``."""
        import pandas as pd

        return pd.DataFrame({"exposure": self.exposure, **{name: getattr(self, name) for name in HEADER[1:]}})

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the centres on the board as it is seen from the mirror's side, each ridge in a colour of its own."""
        from matplotlib.figure import Figure

        ax = Figure(layout="constrained").add_subplot() if ax is None else ax
        for ridge in np.unique(self.ridge):
            mine = self.ridge == ridge
            ax.plot(self.y_mm[mine], self.z_mm[mine], ".", markersize=2, label=f"ridge {ridge}")
        ax.set(xlabel="board y (mm)", ylabel="board z (mm)", title=self.exposure, aspect="equal")
        return ax


def only_ridge(trace: Trace, ridge: int = 0) -> Trace:
    """The profiles of one ridge; ridge 0 is the trace."""
    return _selected(trace, trace.ridge == ridge)


def unsaturated(trace: Trace) -> Trace:
    """The same without profiles that hold saturated pixels; all of it where those are more than `CUT` of it.

    They are placed by their flanks, in the shape that the others have. Where charge spills from bright pixels, the
    crest leans, and the more the brighter it is: centres in such profiles were 0.07 mm off, five of their sigma.
    """
    free = trace.saturated == 0
    return trace if free.mean() < 1 - CUT else _selected(trace, free)


def _selected(trace: Trace, mask: NDArray[np.bool_]) -> Trace:
    n = len(trace)
    chosen: dict[str, Any] = {
        f.name: value[mask]
        for f in fields(trace)
        if f.name != "dropped_px" and isinstance(value := getattr(trace, f.name), np.ndarray) and len(value) == n
    }
    return replace(trace, **chosen)


def covariance(trace: Trace) -> Array:
    """Covariance (n, n) [mm²] of the centres' shifts along ``normal``.

    σ_i σ_j ρ(i − j) + pose + shape; what the trace does not hold of these is taken as none.

    Parameters
    ----------
    trace : Trace
        Usually of `only_ridge`; ridges share the pose.
    """
    c = np.diag(trace.sigma_mm**2)
    for number, noise in enumerate(trace.noise):
        at = np.flatnonzero(trace.ridge == number)
        reach = len(noise.correlation) - 1
        if reach < 1 or not len(at):
            continue
        lag = np.minimum(np.abs(trace.profile[at][:, None] - trace.profile[at][None, :]), reach + 1)
        rho = np.append(noise.correlation, 0.0)[lag]
        c[np.ix_(at, at)] = rho * np.outer(trace.sigma_mm[at], trace.sigma_mm[at])
    for factor in (trace.pose_mm, trace.shape_mm):
        if len(factor) == len(trace):
            c += factor @ factor.T
    return c


def write_table(path: str | Path, traces: Iterable[Trace]) -> None:
    """Write ``trace.csv``: whole or not at all.

    Parameters
    ----------
    path : path
    traces : of Trace
        One after the other, in this order.

    Raises
    ------
    BenchsimError
        If the file cannot be written.
    """
    path = Path(path)
    try:
        rows = (
            (trace.exposure, int(trace.ridge[i]), *(float(getattr(trace, c)[i]) for c in HEADER[2:]))
            for trace in traces
            for i in range(len(trace))
        )
        write_csv(path, HEADER, rows, 9)
    except OSError as error:
        raise BenchsimError(
            f"{path}: cannot be written ({error.strerror}); choose a folder that exists and is writable"
        ) from None
