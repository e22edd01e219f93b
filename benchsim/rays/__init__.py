"""The bench's own ray model, float64 and deterministic, one module each in the order of the light.

`laser` (beam), `mirror` (turning facets), `screen` (board), `camera` (pixels); `sweep` joins them at one phase and
gives the profiles of the time-averaged trace, `diffraction` and `profile` what they look like, `curve` the predicted
trace, `sensitivity` its derivatives by the setting errors.
"""

from benchsim.rays.camera import board_points, pixel_rays, project, project_board
from benchsim.rays.curve import irradiance, irradiance_profiles, predict, trace_curve
from benchsim.rays.sensitivity import COMPONENTS, jacobian, setting_errors

__all__ = [
    "COMPONENTS",
    "board_points",
    "irradiance",
    "irradiance_profiles",
    "jacobian",
    "pixel_rays",
    "predict",
    "project",
    "project_board",
    "setting_errors",
    "trace_curve",
]
