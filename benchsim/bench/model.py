"""What an experiment is: frozen dataclasses in millimetres, radians and seconds.

Frame (design: the screen's frame): x is the screen's normal, toward the mirror; y west; z up; origin at the
screen's centre. Seen from the mirror's side +y is to the right. Files carry units in their keys; here every
length is in mm, every angle in rad, every time in s. Arrays are tuples, so that every object hashes and compares.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from benchsim.bench.fields import Field as FreeField

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Laser:
    """Beam at the mirror.

    ``beam_diameter`` is the 1/e² diameter in the plane through the nominal P perpendicular to the beam.
    ``divergence`` is the full angle between the 1/e² edges, as wavefront curvature: the beam is homocentric with
    curvature ``divergence / beam_diameter`` (1/mm). ``incoherent_divergence`` is the full 1/e² angle of a blur
    that is the same at every point of the beam.
    """

    wavelength: float = 632.8e-6
    beam_diameter: float = 10.0
    divergence: float = 4.0e-3
    incoherent_divergence: float = 0.0

    @property
    def waist(self) -> float:
        """1/e² radius at the mirror (mm); the density is exp(-2 ρ²/waist²)."""
        return self.beam_diameter / 2

    @property
    def curvature(self) -> float:
        """Wavefront curvature at the mirror (1/mm), > 0 diverging."""
        return self.divergence / self.beam_diameter


@dataclass(frozen=True)
class Mirror:
    """Rotating polygon (or cylinder): ``diameter`` is that of the circumscribed circle."""

    shape: str = "polygon"
    facets: int = 12
    diameter: float = 35.0
    height: float = 2.0
    stands_for: str = "elevation"

    @property
    def radius(self) -> float:
        """Reflecting distance r from the axis of rotation (mm): inscribed radius, or diameter/2 of a cylinder."""
        half = self.diameter / 2
        return half if self.shape == "cylinder" else half * math.cos(math.pi / self.facets)

    @property
    def facet_width(self) -> float:
        """Length of a facet across the axis (mm)."""
        return self.diameter * math.sin(math.pi / self.facets)


@dataclass(frozen=True)
class Marks:
    """AprilTags 36h11 printed on the board: ids, centres (y, z) and side of the black square, mm."""

    ids: tuple[int, ...]
    centres: tuple[tuple[float, float], ...]
    sides: tuple[float, ...]


@dataclass(frozen=True)
class Screen:
    """Lambertian board; ``size`` along y and z."""

    size: tuple[float, float] = (700.0, 700.0)
    reflectance: float = 0.8
    marks: Marks | None = None


@dataclass(frozen=True)
class Camera:
    """Pinhole with OpenCV's distortion k1 k2 p1 p2 k3; pixel (0, 0) is the centre of the top-left pixel.

    ``gamma`` is a number (light ∝ (counts − black_level)**gamma), "srgb" or "unknown".
    """

    name: str
    resolution: tuple[int, int]
    focal: float
    principal_point: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    position: Vector3 = (1200.0, 350.0, -150.0)
    look_at: Vector3 = (0.0, 0.0, 0.0)
    bit_depth: int = 16
    gamma: float | str = 1.0
    black_level: float = 0.0
    saturation_level: float = 65535.0

    def binned(self, k: int) -> Camera:
        """The same camera with k × k pixels taken as one."""
        (w, h), (cx, cy) = self.resolution, self.principal_point
        centre = ((cx + 0.5) / k - 0.5, (cy + 0.5) / k - 0.5)
        return replace(self, resolution=(w // k, h // k), focal=self.focal / k, principal_point=centre)


@dataclass(frozen=True)
class Physics:
    """What the simulation in doubt contains."""

    facets: bool = True
    beam: bool = True
    diffraction: bool = True


@dataclass(frozen=True)
class Uncertainty:
    """1 sigma of what was set by hand."""

    mirror_position: float = 1.0
    mirror_axis: float = 1.745e-3
    laser_direction: float = 1.745e-3
    screen_position: float = 0.2
    screen_angle: float = 1.0e-3
    beam_diameter_fraction: float = 0.02
    divergence_fraction: float = 0.005
    intrinsics_sigma: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Surface:
    """One refracting surface of the beam expander: radius (mm, inf flat), thickness behind it (mm), glass behind it."""

    radius: float
    thickness: float
    glass: str
    semi_diameter: float


@dataclass(frozen=True)
class Expander:
    """Lenses that make the beam."""

    surfaces: tuple[Surface, ...]
    defocus: float = 0.0
    decentre: float = 0.0
    tilt: float = 0.0


@dataclass(frozen=True)
class RenderOptions:
    """Read by ``render`` only."""

    seed: int = 1
    peak_fraction: float = 0.7
    room_fraction: float = 0.3
    full_well_e: float = 12000.0
    read_noise_e: float = 6.0
    blur_px: float = 0.7
    speckle_px: float = 0.0
    noise: bool = True
    dark: bool = True
    relative_error: float = 0.01


@dataclass(frozen=True)
class Exposure:
    """One picture: a setting and the camera that took it. ``image`` is None in a bench file."""

    camera: str
    setting: str
    laser_azimuth: float
    laser_elevation: float
    mirror_position: Vector3
    screen_shift: float = 0.0
    screen_roll: float = 0.0
    time: float = 0.0
    facet: int | None = None
    image: str | None = None
    dark: str | None = None

    @property
    def name(self) -> str:
        """What messages and tables call this exposure."""
        return self.image or self.setting


@dataclass(frozen=True, repr=False)
class Recording:
    """A recording, or a bench (the same without images). ``path`` is the TOML file it was read from.

    ``effects`` are as the file has them, in the catalogue's units; ``fields`` (see `fields.FORMS`) in mm, rad, s, px.
    """

    laser: Laser
    mirror: Mirror
    screen: Screen
    cameras: Mapping[str, Camera]
    exposures: tuple[Exposure, ...]
    physics: Physics = Physics()
    uncertainty: Uncertainty = Uncertainty()
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    fields: Mapping[str, FreeField] = field(default_factory=dict)
    expander: Expander | None = None
    render: RenderOptions = RenderOptions()
    title: str = ""
    path: Path = Path("recording.toml")
    defaults_used: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Folder that image paths are relative to."""
        return self.path.parent

    def save(self, folder: Path | str) -> Recording:
        """Write ``recording.toml``, marks and images into a folder, see `writing.save`; returns it as it lies there."""
        from benchsim.bench.writing import save

        return save(self, Path(folder))

    def __repr__(self) -> str:
        m, size, settings = self.mirror, self.screen.size, len({e.setting for e in self.exposures})
        images = sum(e.image is not None for e in self.exposures)
        polygon = f"{m.shape} of {m.facets} facets, {m.diameter:g} mm"
        parts = [
            f"exposures: {len(self.exposures)}, settings: {settings}, images: {images}",
            f"beam {self.laser.beam_diameter:g} mm, {1e3 * self.laser.divergence:g} mrad",
            polygon if m.shape == "polygon" else f"cylinder, {m.diameter:g} mm",
            f"board {size[0]:g} × {size[1]:g} mm",
            *([f"effects {', '.join(self.effects)}"] if self.effects else []),
        ]
        return f"<{'Recording' if images else 'Bench'} {self.title or self.path.name!r}: {'; '.join(parts)}>"
