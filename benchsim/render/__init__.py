"""The bench in Mitsuba: irradiance on the board first, the camera's picture of it second."""

from benchsim.render.irradiance import ScreenMap, irradiance

__all__ = ["ScreenMap", "irradiance"]
