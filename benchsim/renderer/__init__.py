"""The bench in Mitsuba: irradiance on the board first, the camera's picture of it second.

Importing the room registers the plugins of `plugins` for whatever variant is set, now or later, so that plain
``mi.load_file`` and ``mi.render`` can use ``scenes/*.xml``. It sets no variant; `backend.use` does, and tests it.
Where Mitsuba cannot be loaded the import is a BenchsimError: everything but rendering goes without it.
"""

from benchsim.bench.errors import BenchsimError

try:
    import drjit  # noqa: F401
    import mitsuba  # noqa: F401
except ImportError as error:
    raise BenchsimError(
        f"nothing can be rendered here: Mitsuba cannot be loaded ({error}); pip install 'mitsuba>=3.9,<4'"
    ) from None

from benchsim.renderer import effects, plugins
from benchsim.renderer.irradiance import ScreenMap, irradiance
from benchsim.renderer.picture import Picture, photograph
from benchsim.renderer.recording import RenderedTruth, draw_errors, render_recording
from benchsim.renderer.reference import scene_xml

EFFECTS = effects.gather()[0]
"""Every effect that the room draws, name → parameters; a parameter that ends in ``*`` is a row, one per facet."""

__all__ = [
    "EFFECTS",
    "Picture",
    "RenderedTruth",
    "ScreenMap",
    "draw_errors",
    "irradiance",
    "photograph",
    "plugins",
    "render_recording",
    "scene_xml",
]
