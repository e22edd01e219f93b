"""The bench's own ray model, float64 and deterministic, one module each in the order of the light.

`laser` (beam), `mirror` (turning facets), `screen` (board), `camera` (pixels); `sweep` joins them at one phase and
gives the profiles of the time-averaged trace, `diffraction` and `profile` what they look like, `curve` the predicted
trace.
"""

from benchsim.rays.camera import board_points, pixel_rays, project, project_board, see
from benchsim.rays.curve import irradiance, irradiance_profiles, predict, trace_curve

__all__ = [
    "board_points",
    "irradiance",
    "irradiance_profiles",
    "pixel_rays",
    "predict",
    "project",
    "project_board",
    "see",
    "trace_curve",
]
