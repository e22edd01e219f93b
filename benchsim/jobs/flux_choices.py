"""What commands of plants let one choose, for the command line and the job; nothing heavy is loaded for it."""

from __future__ import annotations

from enum import StrEnum


class MountErrors(StrEnum):
    """Whose errors of the mounts a plant is computed with."""

    stated = "stated"
    none = "none"
    drawn = "drawn"
    diagnosed = "diagnosed"


class FluxEngine(StrEnum):
    """How a flux is computed."""

    product = "product"
    carlo = "carlo"
    both = "both"


class DroneSurface(StrEnum):
    """With which surface of the mirrors a drone's glints are compared."""

    design = "design"
    measured = "measured"
