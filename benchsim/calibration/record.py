"""``camera.toml``: a camera as ``recording.toml`` wants it, with what a calibration leaves open of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomlkit
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera
from benchsim.bench.schema import CameraTable, NonNegativeTriple, Number, Table
from benchsim.bench.toml_file import load_toml
from benchsim.bench.writing import write_text
from benchsim.calibration.model import LENS

Array = NDArray[np.float64]

FORMAT = "benchsim-camera/1"


class _Uncertainty(Table):
    intrinsics_sigma: NonNegativeTriple


class _Calibration(Table):
    parameters: list[str]
    covariance: list[list[Number]]
    photographs: Annotated[int, Field(gt=0)]
    marks: Annotated[int, Field(gt=0)]
    rms_px: Annotated[float, Field(ge=0)]
    board: str = ""


class _File(Table):
    format: Literal["benchsim-camera/1"]
    cameras: Annotated[dict[str, CameraTable], Field(min_length=1, max_length=1)]
    uncertainty: _Uncertainty
    calibration: _Calibration


@dataclass(frozen=True)
class CameraRecord:
    """What ``camera.toml`` holds.

    Attributes
    ----------
    name : str
    table : mapping
        ``[cameras.NAME]`` as it stands.
    intrinsics_sigma : (focal as a fraction, principal point in px, k1)
        For ``[uncertainty]``.
    covariance : (8, 8)
        Of `solve.LENS`, px where they are.
    """

    name: str
    table: Mapping[str, Any]
    intrinsics_sigma: tuple[float, float, float]
    covariance: Array


def write_camera(
    path: Path,
    camera: Camera,
    intrinsics_sigma: tuple[float, float, float],
    covariance: Array,
    *,
    photographs: int,
    marks: int,
    rms: float,
    board: str,
) -> None:
    """Write ``camera.toml``; the tables ``[cameras.NAME]`` and ``[uncertainty]`` can be copied as they stand."""
    doc = tomlkit.document()
    doc["format"] = FORMAT
    table = tomlkit.table()
    table["resolution_px"] = list(camera.resolution)
    table["focal_px"] = _number(camera.focal)
    table["principal_point_px"] = [_number(x) for x in camera.principal_point]
    table["distortion"] = [_number(x) for x in camera.distortion]
    table["distortion"].comment("k1 k2 p1 p2 k3")
    table["bit_depth"] = camera.bit_depth
    table["gamma"] = camera.gamma
    cameras = tomlkit.table(is_super_table=True)
    cameras[camera.name] = table
    doc["cameras"] = cameras
    uncertainty = tomlkit.table()
    uncertainty["intrinsics_sigma"] = [float(f"{x:.4g}") for x in intrinsics_sigma]
    uncertainty["intrinsics_sigma"].comment("1 sigma: focal length (fraction), principal point (px), k1")
    doc["uncertainty"] = uncertainty
    calibration = tomlkit.table()
    calibration["parameters"] = list(LENS)
    rows = tomlkit.array()
    for row in covariance:
        rows.add_line([float(f"{x:.8e}") for x in row])
    rows.multiline(True)
    calibration["covariance"] = rows
    calibration["photographs"] = photographs
    calibration["marks"] = marks
    calibration["rms_px"] = float(f"{rms:.4g}")
    calibration["board"] = board
    doc["calibration"] = calibration
    write_text(path, tomlkit.dumps(doc))


def _number(x: float) -> float:
    return float(f"{x:.9g}")


def is_camera(path: Path) -> bool:
    """Whether a file is a ``camera.toml``: only such a one is overwritten."""
    try:
        return load_toml(path).get("format") == FORMAT
    except BenchsimError:
        return False


def read_camera(path: Path) -> CameraRecord:
    """Read ``camera.toml``.

    Raises
    ------
    BenchsimError
        If it is not there, is no such file, or a key is wrong; names file and key.
    """
    if not path.exists():
        raise BenchsimError(f"{path.name}: not there (looked in {path.parent}); make it with 'benchsim calibrate'")
    data = load_toml(path)
    try:
        file = _File.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise BenchsimError(
            f"{path.name}: {key}: {first['msg'].lower()}; make the file anew with 'benchsim calibrate'"
        ) from None
    name = next(iter(file.cameras))
    covariance = file.calibration.covariance
    if file.calibration.parameters != list(LENS) or [len(row) for row in covariance] != [len(LENS)] * len(LENS):
        raise BenchsimError(
            f"{path.name}: calibration.covariance: not of the parameters {', '.join(LENS)}; make the file anew with "
            "'benchsim calibrate'"
        )
    focal, point, k1 = file.uncertainty.intrinsics_sigma
    return CameraRecord(name, data["cameras"][name], (focal, point, k1), np.array(covariance, float))
