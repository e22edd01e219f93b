"""The recording file's keys, units, defaults and plausible ranges, as pydantic models.

Keys carry their unit; `files` turns a checked file into the dataclasses of `model`, in mm, rad and s.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from benchsim.bench.reading import RAISED

MOST_EXPOSURES = RAISED * 2000

Number = Annotated[float, Field(allow_inf_nan=False)]
Length = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Side = Annotated[float, Field(ge=1, le=1e5, allow_inf_nan=False)]
Counts = Annotated[float, Field(ge=0, le=65535, allow_inf_nan=False)]
Coefficient = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
Pixels = Annotated[int, Field(ge=1, le=50_000)]
Triple = Annotated[list[Length], Field(min_length=3, max_length=3)]
LengthSigma = Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)]
NonNegativeTriple = Annotated[list[LengthSigma], Field(min_length=3, max_length=3)]
AngleSigma = Annotated[float, Field(ge=0, le=500, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Table(BaseModel):
    """A TOML table: unknown keys, strings for numbers, NaN and infinities are errors."""

    model_config = ConfigDict(extra="forbid", strict=True)


class LaserTable(Table):
    wavelength_nm: Annotated[float, Field(ge=100, le=20000)] = 632.8
    beam_diameter_mm: Annotated[float, Field(ge=0.01, le=500)] = 10.0
    divergence_mrad: Annotated[float, Field(ge=-500, le=500)] = 4.0
    incoherent_divergence_mrad: Annotated[float, Field(ge=0, le=500)] = 0.0


class MirrorTable(Table):
    shape: Literal["polygon", "cylinder"] = "polygon"
    facets: Annotated[int, Field(ge=3, le=360)] = 12
    diameter_mm: Annotated[float, Field(ge=0.1, le=500)] = 35.0
    height_mm: Annotated[float, Field(ge=0.01, le=500)] = 2.0
    stands_for: Literal["elevation", "azimuth"] = "elevation"


class ScreenTable(Table):
    size_mm: Annotated[list[Side], Field(min_length=2, max_length=2)] = [700.0, 700.0]
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.8
    marks: str = "marks.csv"


class CameraTable(Table):
    resolution_px: Annotated[list[Pixels], Field(min_length=2, max_length=2)]
    focal_px: Annotated[float, Field(ge=1, le=1e6)]
    principal_point_px: Annotated[list[Length], Field(min_length=2, max_length=2)]
    distortion: Annotated[list[Coefficient], Field(min_length=5, max_length=5)] = [
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    ]
    position_mm: Triple = [1200.0, 350.0, -150.0]
    look_at_mm: Triple = [0.0, 0.0, 0.0]
    bit_depth: Literal[8, 16] = 16
    gamma: Annotated[float, Field(ge=0.1, le=10)] | Literal["srgb", "unknown"] = 1.0
    black_level: Counts = 0.0
    saturation_level: Annotated[float, Field(gt=0, le=65535)] | None = None


class PhysicsTable(Table):
    facets: bool = True
    beam: bool = True
    diffraction: bool = True


class UncertaintyTable(Table):
    mirror_position_mm: LengthSigma = 1.0
    mirror_axis_mrad: AngleSigma = 1.745
    laser_direction_mrad: AngleSigma = 1.745
    screen_position_mm: LengthSigma = 0.2
    screen_angle_mrad: AngleSigma = 1.0
    beam_diameter_fraction: Fraction = 0.02
    divergence_fraction: Fraction = 0.005
    intrinsics_sigma: NonNegativeTriple = [0.0, 0.0, 0.0]


class ExpanderTable(Table):
    surfaces: Annotated[list[list[float | str]], Field(min_length=1, max_length=100)]
    defocus_mm: Length = 0.0
    decentre_mm: Length = 0.0
    tilt_mrad: Annotated[float, Field(ge=-500, le=500)] = 0.0


class RenderTable(Table):
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1
    peak_fraction: Annotated[float, Field(gt=0, le=10)] = 0.7
    room_fraction: Annotated[float, Field(ge=0, le=1)] = 0.3
    full_well_e: Annotated[float, Field(ge=1, le=1e9)] = 12000.0
    read_noise_e: Annotated[float, Field(ge=0, le=1e9)] = 6.0
    blur_px: Annotated[float, Field(ge=0, le=100)] = 0.7
    speckle_px: Annotated[float, Field(ge=0, le=100)] = 0.0
    noise: bool = True
    dark: bool = True
    relative_error: Annotated[float, Field(ge=1e-4, lt=1)] = 0.01


class ExposureTable(Table):
    image: str | None = None
    dark: str | None = None
    camera: str
    setting: str
    laser_azimuth_deg: Annotated[float, Field(ge=-360, le=720)]
    laser_elevation_deg: Annotated[float, Field(ge=-90, le=90)]
    mirror_position_mm: Triple
    screen_shift_mm: Length = 0.0
    screen_roll_deg: Annotated[float, Field(ge=-720, le=720)] = 0.0
    time_s: Annotated[float, Field(ge=-1e11, le=1e11)] = 0.0
    facet: Annotated[int, Field(ge=0)] | None = None


class RecordingFile(Table):
    format: Literal["benchsim-recording/1"]
    title: str = ""
    laser: LaserTable = Field(default_factory=LaserTable)
    mirror: MirrorTable = Field(default_factory=MirrorTable)
    screen: ScreenTable = Field(default_factory=ScreenTable)
    cameras: Annotated[dict[str, CameraTable], Field(min_length=1)]
    physics: PhysicsTable = Field(default_factory=PhysicsTable)
    uncertainty: UncertaintyTable = Field(default_factory=UncertaintyTable)
    effects: dict[str, dict[str, Number]] = Field(default_factory=dict)
    fields: dict[str, dict[str, list[Number] | list[list[Number]]]] = Field(default_factory=dict)
    expander: ExpanderTable | None = None
    render: RenderTable = Field(default_factory=RenderTable)
    exposure: Annotated[list[ExposureTable], Field(min_length=1, max_length=MOST_EXPOSURES)]
