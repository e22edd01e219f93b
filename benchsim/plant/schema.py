"""The plant file's keys, units, defaults and plausible ranges, as pydantic models."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from benchsim.bench.reading import RAISED
from benchsim.bench.schema import Fraction, Table

FORMAT = "benchsim-plant/1"

MOST_HELIOSTATS = RAISED * 100_000
MOST_RECEIVERS = 20
MOST_ARRAYS = 8
MOST_DETECTORS = RAISED * 1000

Metres = Annotated[float, Field(ge=-1e5, le=1e5)]
Place = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Size = Annotated[float, Field(ge=0.1, le=200)]
Edge = Annotated[float, Field(ge=0.1, le=50)]
Reach = Annotated[float, Field(ge=1, le=1e5)]
Mrad = Annotated[float, Field(ge=0, le=50)]
Angle = Annotated[float, Field(ge=-100, le=100)]
Count = Annotated[int, Field(ge=1, le=1000)]
Across = Annotated[float, Field(ge=-500, le=500)]
Rate = Annotated[float, Field(ge=1, le=8_000)]
Name = Annotated[str, Field(min_length=1, max_length=60)]


class SiteTable(Table):
    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(ge=-180, le=360)]
    elevation_m: Annotated[float, Field(ge=-500, le=6000)] = 0.0
    time_zone: Name = "UTC"
    attenuation: Literal["clear", "none"] = "clear"


class ReceiverTable(Table):
    name: Name
    kind: Literal["plane", "aperture", "cylinder"] = "plane"
    centre_m: Place
    width_m: Size | None = None
    diameter_m: Size | None = None
    height_m: Size
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    elevation_deg: Annotated[float, Field(ge=-85, le=85)] = 0.0
    peak_limit_kw_m2: Annotated[float, Field(gt=0, le=1e5)] | None = None


class SunTable(Table):
    shape: Literal["gaussian", "pillbox", "buie", "table"] = "pillbox"
    sigma_mrad: Annotated[float, Field(ge=0.1, le=50)] | None = None
    half_angle_mrad: Annotated[float, Field(ge=0.1, le=50)] | None = None
    csr: Annotated[float, Field(ge=0.001, le=0.8)] | None = None
    table: Name | None = None


class OpticsTable(Table):
    slope_mrad: Mrad
    specularity_mrad: Mrad = 0.0
    reflectance: Annotated[float, Field(gt=0, le=1)]
    soiling: Fraction = 0.0


class HeliostatsTable(Table):
    table: Name = "heliostats.csv"
    format: Literal["benchsim", "solarpilot", "soltrace", "paint", "field"] = "benchsim"
    tower: Name | None = None
    kinematics: Literal["az-el", "east-west"] | None = None
    width_m: Edge | None = None
    height_m: Edge | None = None
    facets: Annotated[list[Count], Field(min_length=2, max_length=2)] = Field(default_factory=lambda: [1, 1])
    focal_m: Reach | None = None
    canting_m: Reach | None = None
    receiver: Name | None = None
    diagnosed: Name | None = None


class DetectorTable(Table):
    name: Name
    receiver: Name | None = None
    along: Literal["horizontal", "vertical"]
    offset_m: Across
    from_m: Across
    to_m: Across
    pitch_m: Annotated[float, Field(ge=0.005, le=20)]
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = None


class PrismsTable(Table):
    radius_m: Annotated[float, Field(ge=0.01, le=2)] = 0.15
    height_m: Annotated[float, Field(ge=0.01, le=2)] = 0.15
    facets: Annotated[int, Field(ge=6, le=200)] = 36
    reflectance: Annotated[float, Field(gt=0, le=1)] = 0.9
    slope_mrad: Annotated[float, Field(ge=0.05, le=2)] = 0.25
    background_w_m2: Annotated[float, Field(gt=0, le=1500)] = 100.0
    detector_spread: Annotated[float, Field(ge=0.001, le=0.2)] = 0.005
    rate_low_hz: Rate = 127.0
    rate_high_hz: Rate = 197.0
    mains_hz: Annotated[float, Field(ge=10, le=1000)] | None = 50.0
    sample_rate_hz: Annotated[int, Field(ge=20, le=20_000)] = 500
    record_s: Annotated[float, Field(ge=1, le=600)] = 20.0
    longest_s: Annotated[float, Field(ge=1, le=600)] = 60.0


Millimetres = Annotated[float, Field(ge=0, le=1000)]
Length = Annotated[float, Field(ge=0.02, le=10)]


class DroneTable(Table):
    distance_m: Annotated[float, Field(ge=20, le=1000)] = 150.0
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    elevation_deg: Annotated[float, Field(ge=5, le=75)] = 35.0
    pitch_m: Annotated[float, Field(ge=0.05, le=5)] = 0.35
    seconds_each: Annotated[float, Field(gt=0, le=600)] = 2.0
    at_once: Annotated[int, Field(ge=1, le=200)] = 12
    lamp_right_mm: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    lamp_up_mm: Annotated[float, Field(ge=-1000, le=1000)] = -120.0
    rtk_relative_mm: Millimetres = 10.0
    rtk_absolute_mm: Millimetres = 0.0
    detection_mm: Millimetres = 20.0
    position_mm: Millimetres = 10.0
    kinematics_mm: Millimetres = 30.0
    canting_mrad: Mrad = 0.4
    slope_length_m: Length = 0.25
    tilt_mrad: Mrad | None = None
    map_mrad: Mrad = 0.1
    map_length_m: Length = 0.1
    false_glints: Fraction = 0.01


class PlantFile(Table):
    format: Literal["benchsim-plant/1"]
    title: str = ""
    site: SiteTable
    receiver: Annotated[list[ReceiverTable], Field(min_length=1, max_length=MOST_RECEIVERS)]
    sun: SunTable = Field(default_factory=SunTable)
    optics: OpticsTable
    heliostats: HeliostatsTable
    errors: dict[str, Angle] = Field(default_factory=dict)
    detector: Annotated[list[DetectorTable], Field(max_length=MOST_ARRAYS)] = Field(default_factory=list)
    prisms: PrismsTable = Field(default_factory=PrismsTable)
    drone: DroneTable = Field(default_factory=DroneTable)
