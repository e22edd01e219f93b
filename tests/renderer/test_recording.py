"""A rendered recording: what is drawn, what is written, and what is shared between exposures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import read
from benchsim.bench.model import (
    Camera,
    Exposure,
    Laser,
    Marks,
    Mirror,
    Recording,
    RenderOptions,
    Screen,
    Uncertainty,
)
from benchsim.bench.place import SettingErrors, camera_pose, place
from benchsim.bench.settings import prior_sigma, to_vector
from benchsim.rays import predict, project, screen
from benchsim.renderer import recording as module
from benchsim.renderer.irradiance import irradiance
from benchsim.renderer.recording import (
    POSE_ANGLE,
    POSE_POSITION,
    draw_cameras,
    draw_errors,
    draw_laser,
    render_recording,
)

MARKS = Marks((0, 1, 2, 3), ((-80.0, 80.0), (80.0, 80.0), (80.0, -80.0), (-80.0, -80.0)), (32.0,) * 4)
SCREEN = Screen((200.0, 200.0), 0.8, MARKS)
CAMERAS = {
    "A": Camera("A", (320, 240), 1000.0, (159.5, 119.5), (-0.08, 0.03, 0.0, 0.0, 0.0), black_level=800.0),
    "B": Camera(
        "B", (320, 240), 1000.0, (160.0, 120.0), position=(1100.0, -300.0, 100.0), bit_depth=8, saturation_level=255.0
    ),
}


def exposure(setting="s1", camera="A", shift=0.0, roll=0.0, time=0.0, facet=None):
    return Exposure(
        camera, setting, np.radians(101), np.radians(50), (1500.0, -160.0, -1430.0), shift, roll, time, facet
    )


def bench(*exposures, **options):
    return Recording(
        Laser(),
        Mirror(),
        SCREEN,
        CAMERAS,
        exposures,
        uncertainty=Uncertainty(intrinsics_sigma=(0.001, 2.0, 0.002)),
        render=RenderOptions(relative_error=0.1, **options),
    )


def test_errors_are_shared_by_setting_and_drawn_anew_by_seat():
    """File order is not the order of time: the earliest exposure's seat is free, the way back is a new seat."""
    exposures = (
        exposure("s1", shift=10.0, time=20.0),
        exposure("s1", time=0.0),
        exposure("s2", time=30.0),
        exposure("s2", shift=0.0, camera="B", time=40.0),
    )
    e = draw_errors(bench(*exposures), np.random.default_rng(1))
    assert not e[1].screen_position.any() and not e[1].screen_angle.any()
    assert e[0].screen_position.any() and e[2].screen_position.any()
    np.testing.assert_array_equal(e[2].screen_position, e[3].screen_position)
    assert not np.array_equal(e[0].screen_angle, e[2].screen_angle)
    np.testing.assert_array_equal(e[0].mirror_position, e[1].mirror_position)
    np.testing.assert_array_equal(e[2].laser_direction, e[3].laser_direction)
    assert not np.array_equal(e[0].mirror_axis, e[2].mirror_axis)


def test_errors_scatter_as_stated():
    """2000 draws, fixed seed: every component's rms within 5 of its sigmas (1/√2n); a false alarm in 1e6 each."""
    b = bench(exposure(), exposure(shift=5.0, time=1.0))
    rng = np.random.default_rng(2)
    drawn = np.array([to_vector(draw_errors(b, rng)[1]) for _ in range(2000)])
    sigma = prior_sigma(b.uncertainty, reseated=True)
    np.testing.assert_allclose(np.sqrt((drawn**2).mean(axis=0)), sigma, rtol=5 / np.sqrt(4000))
    lasers = [draw_laser(b, rng) for _ in range(2000)]
    assert np.std([x.beam_diameter for x in lasers]) == pytest.approx(0.2, rel=0.08)
    assert np.std([x.divergence for x in lasers]) == pytest.approx(2e-5, rel=0.08)
    a = [draw_cameras(b, rng)["A"] for _ in range(2000)]
    assert np.std([x.focal for x in a]) == pytest.approx(1.0, rel=0.08)
    assert np.std([x.principal_point[1] for x in a]) == pytest.approx(2.0, rel=0.08)
    assert np.std([x.distortion[0] for x in a]) == pytest.approx(0.002, rel=0.08)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("render") / "recording"
    b = bench(exposure(), exposure("s2", "B", shift=5.0, roll=0.1, time=60.0))
    calls = []
    truth = render_recording(b, folder, seed=4, progress=lambda what, done: calls.append((what, done)))
    return b, folder, truth, calls


def test_the_folder_is_a_recording(rendered):
    bench_file, folder, truth, calls = rendered
    assert sorted(p.name for p in folder.iterdir()) == [
        "001-dark.png",
        "001.png",
        "002-dark.png",
        "002.png",
        "marks.csv",
        "recording.toml",
    ]
    text = (folder / "recording.toml").read_text()
    assert "[render]" not in text and "[expander]" not in text
    back = read(folder, images=True)
    assert [(e.image, e.dark) for e in back.exposures] == [("001.png", "001-dark.png"), ("002.png", "002-dark.png")]
    assert back.laser.beam_diameter == bench_file.laser.beam_diameter and back.screen == bench_file.screen
    assert back.cameras == bench_file.cameras, "true intrinsics must not be told"
    assert calls[-1][1] == 1.0 and [c[1] for c in calls] == sorted(c[1] for c in calls)
    assert truth.laser != bench_file.laser and truth.cameras != bench_file.cameras


def test_the_pictures_show_line_and_marks_where_the_truth_puts_them(rendered):
    _, folder, truth, _ = rendered
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))
    for i, e in enumerate(truth.recording.exposures):
        camera = truth.cameras[e.camera]
        image = cv2.imread(str(folder / e.image), cv2.IMREAD_UNCHANGED)
        dark = cv2.imread(str(folder / e.dark), cv2.IMREAD_UNCHANGED)
        assert image.dtype == (np.uint8 if camera.bit_depth == 8 else np.uint16)
        span = camera.saturation_level - camera.black_level
        signal = (image.astype(float) - camera.black_level) / span
        assert 0.8 < signal.max() < 1.0
        assert (dark.astype(float) - camera.black_level).max() / span < 0.27
        seen = np.clip(signal / 0.3 * 255, 0, 255).astype(np.uint8)
        corners, ids, _ = detector.detectMarkers(seen)
        assert set(ids.ravel()) >= {0, 3} if i else sorted(ids.ravel()) == [0, 1, 2, 3]
        placement, (rotation, translation) = truth.placements[i], truth.poses[i]
        matrix = np.array(
            [[camera.focal, 0, camera.principal_point[0]], [0, camera.focal, camera.principal_point[1]], [0, 0, 1.0]]
        )
        for quad, tag in zip(corners, ids.ravel(), strict=True):
            y, z = MARKS.centres[tag]
            square = np.array([[0, y + a, z + b] for a, b in ((-16, 16), (16, 16), (16, -16), (-16, -16))])
            world = placement.screen_origin + square @ placement.screen_rotation.T
            want = cv2.projectPoints(
                world @ rotation.T + translation, np.zeros(3), np.zeros(3), matrix, np.array(camera.distortion)
            )[0].reshape(-1, 2)
            assert np.abs(quad[0] - want).max() < 1.5


def test_the_line_lies_where_the_ray_model_puts_it(rendered):
    """Rationale: errors, laser, camera and pose in the truth are those of the picture, end to end.

    Set-up: centroids of the rows within 6 px of the other realisation's curve, projected by OpenCV. Expectation: a mean
    difference below 0.03 px over 100 rows and more, whose noise is 0.1 px each; every error drawn moves the line by
    more.
    """
    _, folder, truth, _ = rendered
    for i, e in enumerate(truth.recording.exposures):
        camera = truth.cameras[e.camera]
        curve = predict(replace(truth.recording, laser=truth.laser), e, truth.errors[i])
        seen = project(camera, *truth.poses[i], screen.to_world(truth.placements[i], curve.points))
        order = np.argsort(seen[:, 1])
        image, dark = (cv2.imread(str(folder / n), cv2.IMREAD_UNCHANGED).astype(float) for n in (e.image, e.dark))
        light = image - dark
        inside = (seen[:, 0] > 10) & (seen[:, 0] < 310) & (np.abs(curve.points) < 95).all(axis=1)
        rows = np.arange(max(8, int(seen[inside, 1].min()) + 1), min(232, int(seen[inside, 1].max())))
        miss = []
        for v in rows:
            want = np.interp(v, seen[order, 1], seen[order, 0])
            u = np.arange(round(want) - 6, round(want) + 7)
            miss.append((light[v, u] @ (u - want)) / light[v, u].sum())
        assert len(rows) > 100
        assert abs(np.median(miss)) < 0.03, np.median(miss)


def test_the_pose_is_near_the_nominal_one(rendered):
    bench_file, _, truth, _ = rendered
    for e, (rotation, translation) in zip(bench_file.exposures, truth.poses, strict=True):
        nominal, shift = camera_pose(bench_file.cameras[e.camera])
        turn = np.linalg.norm(cv2.Rodrigues(rotation @ nominal.T)[0])
        move = np.linalg.norm(rotation.T @ translation - nominal.T @ shift)
        assert 0 < turn < 5 * POSE_ANGLE and 0 < move < 5 * POSE_POSITION


def test_one_seed_gives_one_recording(rendered, tmp_path):
    bench_file, folder, truth, _ = rendered
    again = render_recording(bench_file, tmp_path, seed=4)
    other = render_recording(replace(bench_file, exposures=bench_file.exposures[:1]), tmp_path / "b", seed=5)
    np.testing.assert_array_equal(to_vector(again.errors[1]), to_vector(truth.errors[1]))
    assert again.laser == truth.laser and again.noise_seeds == truth.noise_seeds
    a, b = (cv2.imread(str(p / "001.png"), cv2.IMREAD_UNCHANGED).astype(float) for p in (folder, tmp_path))
    # The light's last bits depend on the order of threads, and a Poisson draw may turn on them.
    assert (a != b).mean() < 1e-2
    assert not np.array_equal(to_vector(other.errors[0]), to_vector(truth.errors[0]))


def test_without_errors_and_noise_everything_stands_as_stated(tmp_path):
    b = bench(exposure(), dark=False)
    truth = render_recording(b, tmp_path, noise=False, setting_errors=False, images=["a.tif"])
    assert truth.laser == b.laser and truth.cameras == b.cameras and truth.seed == b.render.seed
    assert to_vector(truth.errors[0]).tolist() == to_vector(SettingErrors()).tolist()
    np.testing.assert_array_equal(truth.placements[0].axis, place(b.mirror, b.exposures[0]).axis)
    np.testing.assert_array_equal(truth.poses[0][0], camera_pose(b.cameras["A"])[0])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.tif", "marks.csv", "recording.toml"]
    image = cv2.imread(str(tmp_path / "a.tif"), cv2.IMREAD_UNCHANGED)
    wall = image[:5, :5]
    assert wall.min() == wall.max() > 800


def test_light_is_traced_once_where_mirror_laser_and_board_stand_alike(tmp_path, monkeypatch):
    """Two cameras on one setting share their light; another facet, or a moved board, does not."""
    calls = []

    def counted(recording, e, **keywords):
        calls.append(e)
        return irradiance(recording, e, **keywords)

    monkeypatch.setattr(module, "irradiance", counted)
    b = bench(exposure(), exposure(camera="B"), exposure(facet=2), exposure(shift=3.0, time=9.0), dark=False)
    render_recording(b, tmp_path)
    assert calls == [b.exposures[0], b.exposures[2], b.exposures[3]]


def test_what_cannot_be_rendered_is_told(tmp_path):
    b = bench(exposure())
    with pytest.raises(BenchsimError, match="images: 2 names for 1 exposures"):
        render_recording(b, tmp_path, images=["a.png", "b.png"])
    unknown = replace(b, cameras={"A": replace(CAMERAS["A"], gamma="unknown")})
    with pytest.raises(BenchsimError, match=r'exposure\[1\]: gamma: "unknown" cannot be rendered'):
        render_recording(unknown, tmp_path)
    away = replace(b, cameras={"A": replace(CAMERAS["A"], look_at=(0.0, 3000.0, 0.0))})
    with pytest.raises(BenchsimError, match=r"exposure\[1\]: the camera sees none"):
        render_recording(away, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BenchsimError, match="cannot be written"):
        render_recording(b, tmp_path / "file")
