"""All effects of the ray model: gathered from the elements' modules, checked, and handed to the elements.

Each element declares its ``EFFECTS`` and turns its tables into its own struct, so that a new effect touches that module
alone.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Exposure, Recording
from benchsim.bench.place import Placement
from benchsim.rays import air, camera, diffraction, laser, mirror, screen, timing

EFFECTS: Mapping[str, tuple[str, ...]] = {
    **laser.EFFECTS,
    **diffraction.EFFECTS,
    **mirror.EFFECTS,
    **air.EFFECTS,
    **screen.EFFECTS,
    **camera.EFFECTS,
    **timing.EFFECTS,
    "setting-errors": ("scale",),
}
"""Every effect that the ray model has, with its parameters as the recording's ``[effects]`` names them. Setting errors
move no light by themselves: they say how far off the settings may be (`bench.settings.uncertainty_of`)."""


@dataclass(frozen=True, eq=False)
class Elements:
    """What each element of the light's path does beyond the recording's tables, in one exposure; nothing by default."""

    source: laser.SourceEffects = field(default_factory=laser.SourceEffects)
    polygon: mirror.MirrorEffects = field(default_factory=mirror.MirrorEffects)
    air: air.AirEffects = field(default_factory=air.AirEffects)
    board: screen.BoardEffects = field(default_factory=screen.BoardEffects)
    timing: timing.TimeEffects = field(default_factory=timing.TimeEffects)
    diffraction: float = 0.0

    def turned(self, placement: Placement) -> Placement:
        """The placement with mirror, laser and board moved as the effects have them; nothing is aimed anew."""
        moved = mirror.turned(placement, self.polygon)
        return screen.turned(laser.turned(moved, self.source), self.board)


def check(recording: Recording) -> None:
    """Raise BenchsimError for an effect, or a parameter of one, that the ray model does not have."""
    for name, table in recording.effects.items():
        if name not in EFFECTS:
            raise BenchsimError(
                f"{recording.path.name}: effects.{name}: there is no such effect; mend the name or remove the table"
            )
        for key in table:
            if key not in EFFECTS[name]:
                known = ", ".join(EFFECTS[name][:4])
                raise BenchsimError(
                    f"{recording.path.name}: effects.{name}.{key}: {name} has no such parameter; give {known}"
                )


def elements(
    recording: Recording,
    exposure: Exposure,
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0),
    shared: dict[Hashable, Any] | None = None,
) -> Elements:
    """The elements of one exposure, from the recording's effects and fields.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure
    shape : (c4, e_plus, e_cross)
        Log-density of the beam's profile over the Gaussian, see `laser.SourceEffects`.
    shared : dict, optional
        Elements that are found here are not worked out again, and what is, is kept here: for calls with several
        exposures of recordings that outlive it.

    Raises
    ------
    BenchsimError
        As `check`, and for values that an element cannot take.
    """
    tables, fields = recording.effects, recording.fields
    known: dict[Hashable, Any] = {} if shared is None else shared
    gated = exposure.facet is not None
    try:
        if (id(recording), gated) not in known:
            check(recording)
            known[id(recording), gated] = (
                mirror.effects(tables, fields, recording.mirror, gated=gated),
                air.effects(tables, fields),
                screen.effects(tables, fields),
            )
        beam = laser.effects(tables, fields, exposure, shape)
        moved = timing.effects(tables, fields, recording, exposure)
        # The same object where it is equal: what is the same need not be stacked.
        beam, moved = known.setdefault(beam, beam), known.setdefault(moved, moved)
        polygon, way, board = known[id(recording), gated]
        key = tuple(id(part) for part in (beam, polygon, way, board, moved))
        if key not in known:
            known[key] = Elements(beam, polygon, way, board, moved, diffraction.effects(tables))
        found: Elements = known[key]
        return found
    except BenchsimError as error:
        raise BenchsimError(f"{recording.path.name}: {error}") from None
