"""A bench file rendered to a recording: setting errors drawn, every exposure photographed, the folder written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import write
from benchsim.bench.model import Camera, Exposure, Laser, Recording
from benchsim.bench.place import Placement, SettingErrors, camera_pose, place
from benchsim.bench.settings import OF_THE_SEAT, OF_THE_SETTING, from_vector, prior_sigma, screen_seats, uncertainty_of
from benchsim.renderer.expander import ExpandedBeam, check_against_laser, expand
from benchsim.renderer.irradiance import ScreenMap, irradiance
from benchsim.renderer.motion import TIMED
from benchsim.renderer.picture import Pose, photograph
from benchsim.renderer.sensor import expose, signals, write_image

POSE_POSITION = 2.0
"""1 sigma of the camera's position about its nominal one in every exposure, along each axis [mm]. The pose is solved
from the marks, so this says only that nobody may rely on the nominal one."""

POSE_ANGLE = 2.0e-3
"""1 sigma of the camera's turn about each of its axes in every exposure [rad]."""


EFFECTS = {"setting-errors": ("scale",)}


@dataclass(frozen=True)
class RenderedTruth:
    """What a rendered recording is made of; none of it is written into the recording.

    Attributes
    ----------
    recording : Recording
        As written: with image names, without ``[render]`` and ``[expander]``.
    laser : Laser
        With its true diameter and divergence.
    cameras : mapping
        With their true intrinsics.
    errors : tuple of SettingErrors
        One per exposure, in file order.
    placements : tuple of Placement
    poses : tuple of (R, t)
        Of the camera in every exposure.
    seed : int
        Everything was drawn from it.
    light_seeds, noise_seeds : tuple of int
        Of each exposure's rays, and of its pictures' noise.
    beam : ExpandedBeam or None
        What the lenses of ``[expander]`` make, before the draw of diameter and divergence.
    notes : tuple of str
        Sentences for the user: where the expander's beam differs from ``[laser]``.
    """

    recording: Recording
    laser: Laser
    cameras: Mapping[str, Camera]
    errors: tuple[SettingErrors, ...]
    placements: tuple[Placement, ...]
    poses: tuple[Pose, ...]
    seed: int
    light_seeds: tuple[int, ...]
    noise_seeds: tuple[int, ...]
    beam: ExpandedBeam | None = None
    notes: tuple[str, ...] = ()


def draw_errors(recording: Recording, rng: np.random.Generator) -> tuple[SettingErrors, ...]:
    """Setting errors of every exposure, as ``[uncertainty]`` states them.

    C, the axis and the laser's dials are drawn once per ``setting``, in the order in which settings first appear in the
    file; the screen's re-seating once per seat of `bench.settings.screen_seats`, the first seat being free of error.

    Returns
    -------
    tuple of SettingErrors
        In file order.
    """
    seats = screen_seats(recording.exposures)
    sigma = prior_sigma(uncertainty_of(recording), reseated=True)
    of_setting, of_seat = sigma[OF_THE_SETTING], sigma[OF_THE_SEAT]
    settings = {
        name: of_setting * rng.standard_normal(len(of_setting))
        for name in dict.fromkeys(e.setting for e in recording.exposures)
    }
    seatings = [np.zeros(len(of_seat))]
    seatings += [of_seat * rng.standard_normal(len(of_seat)) for _ in range(max(seats))]
    return tuple(
        from_vector(np.concatenate([settings[e.setting], seatings[s]]))
        for e, s in zip(recording.exposures, seats, strict=True)
    )


def draw_laser(recording: Recording, rng: np.random.Generator) -> Laser:
    """The laser with its true diameter and divergence, one draw each per recording, about those that it has."""
    u, laser = recording.uncertainty, recording.laser
    diameter, divergence = rng.standard_normal(2)
    return replace(
        laser,
        beam_diameter=laser.beam_diameter * (1 + u.beam_diameter_fraction * diameter),
        divergence=laser.divergence * (1 + u.divergence_fraction * divergence),
    )


def draw_cameras(recording: Recording, rng: np.random.Generator) -> dict[str, Camera]:
    """Cameras with their true intrinsics, one draw each per recording: focal length, principal point, k1."""
    focal, point, k1 = recording.uncertainty.intrinsics_sigma
    cameras = {}
    for name, c in recording.cameras.items():
        draws = rng.standard_normal(4)
        cameras[name] = replace(
            c,
            focal=c.focal * (1 + focal * draws[0]),
            principal_point=(c.principal_point[0] + point * draws[1], c.principal_point[1] + point * draws[2]),
            distortion=(c.distortion[0] + k1 * draws[3], *c.distortion[1:]),
        )
    return cameras


def draw_pose(camera: Camera, rng: np.random.Generator) -> Pose:
    """A camera's pose near its nominal one: ``POSE_POSITION`` along each axis, ``POSE_ANGLE`` about each of its own."""
    rotation, translation = camera_pose(camera)
    eye = -rotation.T @ translation + POSE_POSITION * rng.standard_normal(3)
    rotation = cv2.Rodrigues(POSE_ANGLE * rng.standard_normal(3))[0] @ rotation
    return rotation, -rotation @ eye


def _same_light(recording: Recording, exposure: Exposure, placement: Placement) -> tuple[object, ...]:
    """Key under which two exposures share their light: all stands alike, and the time is the same if that counts."""
    timed = any(name in recording.effects for name in TIMED) or "time" in recording.fields
    # The stage's field goes by the dials as stated, not by where the laser points.
    dials = (exposure.laser_azimuth, exposure.laser_elevation) if "stage" in recording.fields else ()
    stands = (np.asarray(v).tobytes() for v in vars(placement).values())
    return (exposure.facet, exposure.time if timed else None, dials, *stands)


def render_recording(
    recording: Recording,
    out_folder: str | Path,
    *,
    seed: int | None = None,
    noise: bool = True,
    setting_errors: bool = True,
    images: Sequence[str] | None = None,
    jpeg_quality: int = 90,
    conceal: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> RenderedTruth:
    """Photograph every exposure of a bench and write the folder of a recording.

    Parameters
    ----------
    recording : Recording
        Bench; images that it names are not looked at.
    out_folder : path
        Where ``recording.toml``, ``marks.csv`` and the images go; made if it is not there. Every file is written under
        a temporary name and then moved.
    seed : int, optional
        Default ``[render] seed``. One seed and one recording give one set of errors and of noise on one machine; the
        light's last bits depend on the order of threads.
    noise : bool
        False: no shot and read noise and no speckle; quantisation stays. ``[render] noise = false`` does the same.
    setting_errors : bool
        False: everything stands as stated, the camera too.
    images : sequence of str, optional
        Names of the images, one per exposure; default ``001.png`` … in file order. The suffix chooses the format.
    jpeg_quality : int
        Of images named .jpg.
    conceal : bool
        True: effects and fields are rendered and left out of the file that is written, as nature would.
    progress : callable, optional
        Called as progress(what, fraction done).

    Returns
    -------
    RenderedTruth

    Raises
    ------
    BenchsimError
        If the bench cannot be rendered or the folder not written.
    """
    options = recording.render
    seed = options.seed if seed is None else seed
    tell = progress or (lambda what, done: None)
    exposures = recording.exposures
    written = recording
    notes: tuple[str, ...] = ()
    beam, lenses = None, None
    if recording.expander is not None:
        tell("tracing the expander", 0.0)
        beam = expand(recording.expander, recording.laser.wavelength)
        note = check_against_laser(beam, recording.laser)
        notes, lenses = (() if note is None else (note,)), beam.table
        made = replace(recording.laser, beam_diameter=beam.diameter, divergence=beam.divergence)
        recording = replace(recording, laser=made)
    names = _image_names(len(exposures), images)
    darks = [f"{Path(n).stem}-dark{Path(n).suffix}" if options.dark else None for n in names]

    streams = np.random.SeedSequence(seed).spawn(4)
    drawn = np.random.default_rng(streams[0])
    laser, cameras, errors = recording.laser, dict(recording.cameras), (SettingErrors(),) * len(exposures)
    poses = [camera_pose(cameras[e.camera]) for e in exposures]
    if setting_errors:
        errors, laser, cameras = (
            draw_errors(recording, drawn),
            draw_laser(recording, drawn),
            draw_cameras(recording, drawn),
        )
        poses = [
            draw_pose(cameras[e.camera], rng) for e, rng in zip(exposures, _each(streams[1], exposures), strict=True)
        ]
    placements = [place(recording.mirror, e, x) for e, x in zip(exposures, errors, strict=True)]
    light_seeds, noise_seeds = (
        tuple(int(s) for s in stream.generate_state(len(exposures))) for stream in (streams[2], streams[3])
    )
    true = replace(recording, laser=laser, cameras=cameras)

    folder = _made(Path(out_folder))
    keys = [_same_light(recording, e, p) for e, p in zip(exposures, placements, strict=True)]
    maps: dict[tuple[object, ...], ScreenMap] = {}
    for i, e in enumerate(exposures):
        tell(f"rendering {names[i]}", i / len(exposures))
        if keys[i] not in maps:
            maps[keys[i]] = irradiance(true, e, placement=placements[i], seed=light_seeds[i], lenses=lenses)
        light = maps[keys[i]]
        if keys[i] not in keys[i + 1 :]:
            del maps[keys[i]]
        camera = cameras[e.camera]
        narrow = not recording.physics.beam
        try:
            picture = photograph(
                recording.screen,
                camera,
                light,
                placement=placements[i],
                pose=poses[i],
                narrow=narrow,
                effects=recording.effects,
                fields=recording.fields,
            )
            signal = signals(
                picture,
                options,
                recording.screen.reflectance,
                effects=recording.effects,
                fields=recording.fields,
            )
            rng = np.random.default_rng(noise_seeds[i]) if noise and options.noise else None
            write_image(folder / names[i], expose(signal, camera, options, rng), jpeg_quality=jpeg_quality)
            dark = darks[i]
            if dark is not None:
                counts = expose(signal, camera, options, rng, laser=False)
                write_image(folder / dark, counts, jpeg_quality=jpeg_quality)
        except BenchsimError as error:
            raise BenchsimError(f"{recording.path.name}: exposure[{i + 1}]: {error}") from None
    written = replace(
        written,
        exposures=tuple(replace(e, image=n, dark=d) for e, n, d in zip(exposures, names, darks, strict=True)),
        expander=None,
        path=folder / "recording.toml",
    )
    if conceal:
        written = replace(written, effects={}, fields={})
    write(written, written.path)
    tell("rendered", 1.0)
    return RenderedTruth(
        written,
        laser,
        cameras,
        errors,
        tuple(placements),
        tuple(poses),
        seed,
        light_seeds,
        noise_seeds,
        beam,
        notes,
    )


def _each(stream: np.random.SeedSequence, exposures: Sequence[Exposure]) -> list[np.random.Generator]:
    return [np.random.default_rng(s) for s in stream.spawn(len(exposures))]


def _image_names(n: int, images: Sequence[str] | None) -> list[str]:
    if images is None:
        return [f"{i:03d}.png" for i in range(1, n + 1)]
    if len(images) != n or len(set(images)) != n:
        raise BenchsimError(f"images: {len(images)} names for {n} exposures; give one name of its own to each")
    return list(images)


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BenchsimError(f"{folder}: cannot be written ({error.strerror}); choose another folder") from None
    return folder
