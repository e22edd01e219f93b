"""What a file says of itself."""

import cv2
import numpy as np
import pytest
from phone_pictures import picture, save

from benchsim.bench.errors import BenchsimError
from benchsim.intake.photo import read_photo


def test_exif_is_read(tmp_path):
    p, counts = read_photo(save(tmp_path / "a.jpg", picture(100), 61.0, orientation=6, aperture=1.8))
    assert p.resolution == (320, 240) and counts.shape == (240, 320, 3)
    assert (p.bit_depth, p.lossy, p.orientation, p.model) == (8, True, 6, "Acme P1")
    assert p.time.isoformat() == "2026-05-04T09:01:01"
    assert (p.exposure, p.iso, p.aperture, p.focal, p.zoom, p.hdr) == (0.5, 50.0, 1.8, 5.6, 1.0, False)
    # 26 mm on a frame whose diagonal is 43.27 mm, on a diagonal of 400 px.
    assert p.focal_px == pytest.approx(26 / 43.27 * 400, rel=1e-6)


def test_a_picture_that_says_nothing(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((30, 40), 2**15, np.uint16))
    p, _ = read_photo(tmp_path / "a.png")
    assert (p.resolution, p.bit_depth, p.orientation) == ((40, 30), 16, 1)
    assert p.time is None and p.focal_px is None and p.model == ""


def test_hdr_is_told(tmp_path):
    assert [read_photo(save(tmp_path / "a.jpg", picture(), rendered=n))[0].hdr for n in (0, 1, 3, 4)] == [0, 0, 1, 0]


@pytest.mark.parametrize("time", ["0000:00:00 00:00:00", "yesterday", ""])
def test_a_clock_that_was_never_set_is_no_time(tmp_path, time):
    assert read_photo(save(tmp_path / "a.jpg", picture(), time=time))[0].time is None


def test_heic_is_refused_with_the_mend(tmp_path):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic")
    with pytest.raises(BenchsimError, match=r"IMG_1\.HEIC: a HEIC.*export it as JPEG"):
        read_photo(tmp_path / "IMG_1.HEIC")
