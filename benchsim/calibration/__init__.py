"""Camera calibration from photographs of the board: intrinsics and distortion with their covariance."""
