"""Refractive indices of the glasses of beam expanders, relative to air."""

from __future__ import annotations

import math

from benchsim.bench.errors import BenchsimError

# n² = 1 + Σ B λ²/(λ² − C), λ in µm, at 20 °C. Schott, optical glass data sheets 2017 (catalogue melts differ by 5e-4 at
# most); fused silica: Malitson 1965, J. Opt. Soc. Am. 55, 1205 (± 1e-5).
_SELLMEIER = {
    "BK7": ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
    "F2": ((1.34533359, 0.00997743871), (0.209073176, 0.0470450767), (0.937357162, 111.886764)),
    "N-SF11": ((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)),
    "fused-silica": ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
}
_ALIASES = {"N-BK7": "BK7", "silica": "fused-silica"}


def index(glass: str, wavelength: float) -> float:
    """Refractive index of a glass by its name, or of a number written as its name ("1.52").

    Parameters
    ----------
    glass : str
        "air", "BK7" (or "N-BK7"), "F2", "N-SF11", "fused-silica", or a number.
    wavelength : float
        In vacuum [mm]; the formulas hold from 400 to 1500 nm.

    Raises
    ------
    BenchsimError
        If the name is not known.
    """
    if glass == "air":
        return 1.0
    terms = _SELLMEIER.get(_ALIASES.get(glass, glass))
    if terms is not None:
        square = (wavelength * 1e3) ** 2
        return math.sqrt(1 + sum(b * square / (square - c) for b, c in terms))
    try:
        value = float(glass)
    except ValueError:
        value = math.nan
    if not 1 <= value < 5:
        known = ", ".join(["air", *_SELLMEIER])
        raise BenchsimError(
            f"expander.surfaces: glass '{glass}' is not known; use {known} or the index as text, \"1.52\""
        )
    return value
