"""A bench photographed with a phone: colour, tone curve, JPEG with EXIF, uneven light, a hand that touches it.

What the file states of the camera is what its data sheet says; the true one is drawn from ``intrinsics_sigma``. Views
of the board alone, for a calibration, come with the pictures of the bench.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image as Pillow
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Laser, Recording
from benchsim.bench.place import Placement, SettingErrors, camera_pose, place
from benchsim.bench.writing import write_bytes
from benchsim.renderer.irradiance import ScreenMap, irradiance
from benchsim.renderer.picture import Picture, Pose, photograph
from benchsim.renderer.recording import draw_cameras, draw_errors, draw_laser, draw_pose
from benchsim.renderer.sensor import RED_LASER, Counts, Image, Signals, develop, signals, speckle

EPOCH = datetime(2026, 5, 4, 9, 0, 0)
"""When the first picture of the bench is taken, if its ``time_s`` is 0."""

DIAGONAL_35MM = 43.27
"""Of a frame of 24 mm × 36 mm [mm]: what EXIF's focal length "in 35 mm film" refers to."""

VIEW_TILT = 0.6
"""Largest angle of a calibration's view to the board's normal [rad]."""


BOARD_LEVEL = 0.4
"""White of the board in a calibration's view, at the middle of the picture, as a share of the range: the lamp makes one
side half as bright again, and a phone's curve leaves no room near white."""


@dataclass(frozen=True)
class Phone:
    """What a phone adds to a sensor.

    Attributes
    ----------
    room_fall : float
        Room light at the right edge of the picture relative to the left one: one lamp stands beside the board.
    contrast : float
        Amplitude of the contrast curve that follows sRGB's, y - contrast sin(2πy): darker shadows, brighter lights. No
        maker states its curve; 0.06 is what published curves of phones come near.
    sharpening : float
        Share of the picture less its own blur (1 px) that is added.
    motion : px
        1 σ of the camera's turn about its x and y axes between a photograph and its dark picture.
    quality : int
        Of JPEG, colour subsampled 4:2:0.
    portrait : int
        Every so many-th setting is taken with the phone upright; 0: none.
    views : int
        Pictures of the board for a calibration.
    """

    room_fall: float = 0.25
    contrast: float = 0.06
    sharpening: float = 0.3
    motion: float = 1.5
    quality: int = 92
    portrait: int = 3
    views: int = 12


@dataclass(frozen=True)
class PhoneTruth:
    """What a phone's pictures are made of; none of it lies in the folder.

    ``bench``, ``board``: paths of the pictures relative to the folder, of the bench a photograph and its dark picture
    in turn. ``laser``, ``camera``: the true ones. ``errors``, ``poses``, ``dark_poses``: of every exposure.
    """

    bench: tuple[str, ...]
    board: tuple[str, ...]
    laser: Laser
    camera: Camera
    errors: tuple[SettingErrors, ...]
    poses: tuple[Pose, ...]
    dark_poses: tuple[Pose, ...]


def photograph_with_phone(
    recording: Recording,
    folder: str | Path,
    *,
    phone: Phone | None = None,
    seed: int | None = None,
    noise: bool = True,
    setting_errors: bool = True,
    progress: Callable[[str, float], None] | None = None,
) -> PhoneTruth:
    """Photograph every exposure, with a dark picture, into ``bench/``, and the board from all sides into ``board/``.

    Pictures are named as a phone does, ``IMG_0001.jpg`` …, dark ones not marked as such; no recording is written.

    Parameters
    ----------
    recording : Recording
        Bench with one camera of 8 bits.
    folder : path
        Must exist.
    phone : Phone, optional
    seed, noise, setting_errors, progress
        As `recording.render_recording`; the true intrinsics are drawn with the setting errors.

    Returns
    -------
    PhoneTruth

    Raises
    ------
    BenchsimError
        If the bench cannot be rendered so.
    """
    phone = phone or Phone()
    options = recording.render
    seed = options.seed if seed is None else seed
    tell = progress or (lambda what, done: None)
    exposures, folder = recording.exposures, Path(folder)
    if len(recording.cameras) != 1 or next(iter(recording.cameras.values())).bit_depth != 8:
        raise BenchsimError(f"{recording.path.name}: cameras: a phone is one camera with bit_depth = 8; mend the table")
    if recording.expander is not None:
        raise BenchsimError(f"{recording.path.name}: expander: not rendered for a phone; state the beam in [laser]")
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)]
    stated = next(iter(recording.cameras.values()))
    errors, laser, camera = (SettingErrors(),) * len(exposures), recording.laser, stated
    if setting_errors:
        errors, laser, camera = draw_truth(recording, seed)
    true = replace(recording, laser=laser, cameras={stated.name: camera})
    grain = streams[3] if noise and options.noise else None
    total, bench, board, poses, dark_poses = len(exposures) + phone.views, [], [], [], []
    (folder / "bench").mkdir(exist_ok=True)
    (folder / "board").mkdir(exist_ok=True)
    order = list(dict.fromkeys(e.setting for e in exposures))
    for i, e in enumerate(exposures):
        tell(f"photographing setting {e.setting}", i / total)
        where = place(recording.mirror, e, errors[i])
        light = irradiance(true, e, placement=where, seed=int(streams[2].integers(2**31)))
        upright = phone.portrait > 0 and order.index(e.setting) % phone.portrait == phone.portrait - 1
        pose = draw_pose(camera, streams[1]) if setting_errors else camera_pose(camera)
        pose = turned(pose, [0.0, 0.0, -np.pi / 2]) if upright else pose
        after = turned(pose, [*(streams[1].normal(0, phone.motion / camera.focal, 2)), 0.0])
        poses.append(pose)
        dark_poses.append(after)

        try:
            with_laser = signals(
                _seen(recording, camera, light, where, pose), options, recording.screen.reflectance,
                effects=recording.effects, fields=recording.fields,
            )  # fmt: skip
        except BenchsimError as error:
            raise BenchsimError(f"{recording.path.name}: exposure[{i + 1}]: {error}") from None
        level = options.peak_fraction * options.room_fraction / recording.screen.reflectance
        room = _seen(recording, camera, None, where, after).room if phone.motion else None
        without = with_laser.room if room is None else gaussian_filter(room, options.blur_px) * np.float32(level)
        for k, signal in enumerate((with_laser, Signals(np.zeros_like(without), without))):
            name = f"bench/IMG_{2 * i + k + 1:04d}.jpg"
            counts = _developed(signal, camera, recording, phone, grain)
            _write(folder / name, counts, stated, e.time + 20.0 * k, 6 if upright else 1, phone.quality)
            bench.append(name)
    flat = place(recording.mirror, exposures[0])
    for i in range(phone.views):
        tell("photographing the board", (len(exposures) + i) / total)
        view = _seen(recording, camera, None, flat, _view(camera, i, streams[1]))
        lit = gaussian_filter(view.room, options.blur_px) * np.float32(BOARD_LEVEL / recording.screen.reflectance)
        name = f"board/IMG_{2 * len(exposures) + i + 1:04d}.jpg"
        counts = _developed(Signals(np.zeros_like(lit), lit), camera, recording, phone, grain)
        last = max(e.time for e in exposures)
        _write(folder / name, counts, stated, last + 600.0 + 15.0 * i, 1, phone.quality)
        board.append(name)
    tell("photographed", 1.0)
    return PhoneTruth(tuple(bench), tuple(board), laser, camera, tuple(errors), tuple(poses), tuple(dark_poses))


def draw_truth(recording: Recording, seed: int) -> tuple[tuple[SettingErrors, ...], Laser, Camera]:
    """Setting errors of every exposure, laser and camera as `photograph_with_phone` draws them from a seed."""
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(4)[0])
    errors, laser = draw_errors(recording, rng), draw_laser(recording, rng)
    return errors, laser, next(iter(draw_cameras(recording, rng).values()))


def _seen(recording: Recording, camera: Camera, light: ScreenMap | None, where: Placement, pose: Pose) -> Picture:
    return photograph(
        recording.screen, camera, light, placement=where, pose=pose,
        effects=recording.effects, fields=recording.fields,
    )  # fmt: skip


def turned(pose: Pose, angles: list[float]) -> Pose:
    """A camera turned about its own axes by a rotation vector (3,) [rad]; it stays where it is."""
    turn = Rotation.from_rotvec(angles).as_matrix()
    return turn @ pose[0], turn @ pose[1]


def tone(counts: Counts, phone: Phone) -> Image:
    """What the phone makes of a linear sensor's counts of 16 bits, 0 … 1: sRGB's curve, contrast, sharpening."""
    s = np.linspace(0, 1, 2**16)
    # IEC 61966-2-1.
    curve = np.where(s <= 0.0031308, 12.92 * s, 1.055 * s ** (1 / 2.4) - 0.055)
    curve = (curve - phone.contrast * np.sin(2 * np.pi * curve)).astype(np.float32)
    y = curve[counts]
    if phone.sharpening:
        y += np.float32(phone.sharpening) * (y - cv2.GaussianBlur(y, (9, 9), 1.0))
    return np.clip(y, 0, 1)


def _developed(
    light: Signals, camera: Camera, recording: Recording, phone: Phone, rng: np.random.Generator | None
) -> Counts:
    """Red, green and blue counts of 8 bits."""
    h, w = light.room.shape
    fall = np.linspace(1.0, phone.room_fall, w, dtype=np.float32)[None, :] * np.linspace(0.9, 1.0, h)[:, None]
    sensor = replace(camera, bit_depth=16, gamma=1.0, black_level=0.0, saturation_level=65535.0)
    lit = speckle(light.laser, recording.render.speckle_px, rng)
    room = light.room * (fall / fall[h // 2, w // 2]).astype(np.float32)
    planes = [develop(room + np.float32(share) * lit, sensor, recording.render, rng) for share in RED_LASER]
    return np.rint(255 * tone(np.stack(planes, axis=-1), phone)).astype(np.uint8)


def _view(camera: Camera, index: int, rng: np.random.Generator) -> Pose:
    """A view of the board: from all sides up to ``VIEW_TILT``, near and far, every third upright."""
    angle = 2.4 * index
    tilt = VIEW_TILT * np.sqrt(rng.uniform(0.1, 1.0))
    distance = np.linalg.norm(camera.position) * rng.uniform(0.7, 1.1)
    toward = np.array([np.cos(tilt), np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle)])
    aim = np.array([0.0, *rng.normal(0, 60.0, 2)])
    seen = replace(camera, position=tuple(aim + distance * toward), look_at=tuple(aim))
    pose = camera_pose(seen)
    return turned(pose, [0.0, 0.0, -np.pi / 2]) if index % 3 == 2 else pose


def _write(path: Path, counts: Counts, stated: Camera, time: float, orientation: int, quality: int) -> None:
    """A JPEG with the EXIF that a phone writes, under a temporary name first."""
    exif = Pillow.Exif()
    exif[0x010F], exif[0x0110], exif[0x0112] = "benchsim", "simulated phone", orientation
    own: dict[int, Any] = {}
    stamp = (EPOCH + timedelta(seconds=time)).strftime("%Y:%m:%d %H:%M:%S")
    own[0x9003], own[0x9004], own[0x9291] = stamp, stamp, f"{round(1000 * (time % 1)):03d}"
    own[0x829A], own[0x8827], own[0x829D] = 0.5, 50, 1.8
    across = float(np.hypot(*stated.resolution))
    own[0x920A] = round(5.6 / 26.0 * stated.focal / across * DIAGONAL_35MM, 2)
    own[0xA405] = round(stated.focal / across * DIAGONAL_35MM)
    own[0xA001], own[0xA404] = 1, 1.0
    # Assigned: the oldest Pillow does not write what is only put into the table it hands out.
    exif[0x8769] = own
    picture = io.BytesIO()
    Pillow.fromarray(counts).save(picture, "JPEG", quality=quality, subsampling="4:2:0", exif=exif)
    write_bytes(path, picture.getvalue())
