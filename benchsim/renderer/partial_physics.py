"""Physics that is there in part: light that is a mixture of what two simulations say.

``facets``, ``finite-beam`` and ``diffraction`` with an amplitude a, where ``[physics]`` has them false: (1 − a) of the
light without and a of the light with. The mixture is nothing that an optics library could draw as such, nor anything
of nature's between 0 and 1; both its parts are.
"""

from __future__ import annotations

from dataclasses import replace

from benchsim.bench.model import Physics, Recording
from benchsim.renderer.effects import Effects, value

EFFECTS = {"facets": ("facets", "size_mm"), "finite-beam": ("beam", "size_mm"), "diffraction": ("fresnel", "size_mm")}
"""``size_mm`` is what a diagnosis says of the amplitude's size on the trace; it draws nothing."""

_SWITCH = {"facets": "facets", "finite-beam": "beam", "diffraction": "diffraction"}


def mixture(recording: Recording) -> list[tuple[float, Physics]]:
    """Shares of the light and the physics that makes each; shares of 0 are left out."""
    parts = [(1.0, recording.physics)]
    for name, (parameter, _) in EFFECTS.items():
        switch = _SWITCH[name]
        a = value(recording.effects, name, parameter)
        if a == 0 or getattr(recording.physics, switch):
            continue
        parts = [
            part
            for share, physics in parts
            for part in ((share * (1 - a), physics), (share * a, replace(physics, **{switch: True})))
            if part[0] != 0
        ]
    return parts


def without(effects: Effects) -> Effects:
    """Effects but for those of this module."""
    return {name: own for name, own in effects.items() if name not in EFFECTS}
