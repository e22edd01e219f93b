"""The bench's own ray model, float64 and deterministic, one module each in the order of the light.

`laser` (beam), `mirror` (turning facets), `air`, `screen` (board), `camera` (pixels), `timing` (drift, shaking): each
declares its own effects, which `effects` gathers. `sweep` joins them at one phase and gives the profiles of the
time-averaged trace, `diffraction`, `profile` and `width` what they look like, `curve` the trace of a bench, `ghost`
what the front of a mirror's glass adds, and `prediction` the trace of a recording's exposure.

Predictions are asked for by the thousand. `interpolated_trace` therefore traces few rays where nothing has kinks, and
`batch` makes one bench of many whose numbers are arrays, so that the elements' own formulas work out all of them in one
pass.
"""

from benchsim.rays.camera import board_points, pixel_rays, project, see
from benchsim.rays.curve import irradiance, irradiance_profiles, trace_curve
from benchsim.rays.effects import EFFECTS
from benchsim.rays.prediction import Case, ghost, predict, predict_many

__all__ = [
    "EFFECTS",
    "Case",
    "board_points",
    "ghost",
    "irradiance",
    "irradiance_profiles",
    "pixel_rays",
    "predict",
    "predict_many",
    "project",
    "see",
    "trace_curve",
]
