"""From photograph to trace: light, marks, camera pose, ridge with error bars, table.

``extract`` measures an exposure's trace, ``only_ridge`` leaves its ridge, and ``covariance`` is how that is known.
"""

from benchsim.trace.extract import PixelTrace, extract, extract_pixels
from benchsim.trace.image import Photograph, read_image
from benchsim.trace.marks import board_corners, find_marks
from benchsim.trace.pose import Pose, solve_pose, to_board, to_pixels
from benchsim.trace.table import RidgeNoise, Trace, covariance, only_ridge, unsaturated, write_table

__all__ = [
    "Photograph",
    "PixelTrace",
    "Pose",
    "RidgeNoise",
    "Trace",
    "board_corners",
    "covariance",
    "extract",
    "extract_pixels",
    "find_marks",
    "only_ridge",
    "read_image",
    "solve_pose",
    "to_board",
    "to_pixels",
    "unsaturated",
    "write_table",
]
