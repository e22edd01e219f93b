"""A camera from photographs of the board: intrinsics and distortion with their covariance, and whether to believe them.

``calibrate`` takes what ``pictures`` lists and the board's marks.
"""

from benchsim.calibration.advice import TARGETS, sight
from benchsim.calibration.calibrate import Calibration, calibrate, pictures
from benchsim.calibration.model import BOARD, LENS
from benchsim.calibration.record import CameraRecord, is_camera, read_camera, write_camera

__all__ = [
    "BOARD",
    "LENS",
    "TARGETS",
    "Calibration",
    "CameraRecord",
    "calibrate",
    "is_camera",
    "pictures",
    "read_camera",
    "sight",
    "write_camera",
]
