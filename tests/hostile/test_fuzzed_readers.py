"""Files from strangers: whatever stands in them, every reader ends within two seconds, in a value or one sentence.

``BENCHSIM_FUZZ=1000`` gives every file of the corpus a thousand mutants, drawn anew each time, instead of the few that
fit into a test run and are the same each time. How many were accepted is printed at the end.
"""

import os
import shutil
import signal
import sys
import warnings
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from PIL import Image
from scipy.io import wavfile

sys.path.insert(0, str(Path(__file__).parent))
from mutants import mutants

from benchsim.bench.errors import BenchsimError
from benchsim.bench.files import complaints, read
from benchsim.bench.marks import read_marks
from benchsim.bench.names import printable
from benchsim.calibration import is_camera, read_camera
from benchsim.instruments.mount import paint, pointing, stated
from benchsim.intake.photo import read_photo
from benchsim.jobs import reporting
from benchsim.jobs.detector_files import read_record
from benchsim.jobs.drone_places import gps, read_positions
from benchsim.jobs.field_list import heliostats
from benchsim.plant import files as plants
from benchsim.trial import ledger

CORPUS = Path(__file__).parent / "corpus"
MORE = int(os.environ.get("BENCHSIM_FUZZ", 0))
EACH = MORE or 25
SECONDS = 2.0
"""Of the processor: what else the machine does is no fault of the reader."""


def of_folder(reader):
    return lambda path: reader(path.parent)


def recording(path):
    complaints(path)
    read(path)


def camera(path):
    is_camera(path)
    read_camera(path)


def session(path):
    stated.recognises(path)
    stated.read(path)


def plant(path):
    plants.complaints(path.parent)
    plants.read(path.parent)


def photo(path):
    gps(path)
    read_photo(path)


READERS = {
    "recording/recording.toml": recording,
    "recording/marks.csv": read_marks,
    "camera/camera.toml": camera,
    "paint/tower-measurements.json": lambda path: paint.read(path.parent / "AA01"),
    "paint/AA01/heliostat-properties.json": of_folder(paint.read),
    "paint/AA01/1000-calibration-properties.json": of_folder(paint.read),
    "tpoint/run.dat": lambda path: (pointing.recognises(path), pointing.read(path)),
    "mmt/run.log": lambda path: (pointing.recognises(path), pointing.read(path)),
    "mount/mount.toml": session,
    **{f"plant/{name}": plant for name in ("plant.toml", "heliostats.csv", "sun.csv", "field.csv")},
    **{f"plant-{kind}/layout.csv": plant for kind in ("solarpilot", "soltrace")},
    "record/r.csv": lambda path: read_record(path, 3),
    "record/r.wav": lambda path: read_record(path, 3),
    "record/r.h5": lambda path: read_record(path, 3),
    "record/positions.csv": lambda path: read_positions(path, plants.read(CORPUS / "plant")),
    "field/field.csv": lambda path: heliostats(path, None),
    **{f"validation/{name}.json": of_folder(reporting.build) for name in ("page", "validation", "conics", "benchsim")},
    **{f"diagnosis/{name}.json": of_folder(reporting.build) for name in ("page", "diagnosis", "pixels", "benchsim")},
    "score/score.json": of_folder(reporting.build),
    "ledger/ledger.jsonl": lambda path: ledger.standing(ledger.read(path)),
    **{f"picture/p.{kind}": photo for kind in ("png", "jpg", "tif")},
}


class Hangs(BaseException):
    """No reader may catch it."""


def stop(*_):
    raise Hangs


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    """A copy of the corpus with pictures in it, in which one file at a time is spoilt."""
    folder = tmp_path_factory.mktemp("hostile") / "corpus"
    shutil.copytree(CORPUS, folder)
    (folder / "recording" / "001.png").write_bytes(b"not looked at here")
    (folder / "field").mkdir()
    (folder / "field" / "field.csv").write_text("id,path\nAA01,AA01\nAA02,AA02\n")
    for name in ("AA01", "AA02"):
        shutil.copytree(folder / "paint" / "AA01", folder / "field" / name)
    shutil.copy(folder / "paint" / "tower-measurements.json", folder / "field")
    (folder / "record").mkdir()
    table = np.column_stack([np.arange(250) / 500, np.arange(750).reshape(250, 3) % 9])
    head = "time_s,detector_1,detector_2,detector_3"
    np.savetxt(folder / "record" / "r.csv", table, delimiter=",", header=head, comments="", fmt="%.6g")
    (folder / "record" / "positions.csv").write_text("name,latitude_deg,longitude_deg,height_m\na.jpg,37.1,-2.4,590\n")
    wavfile.write(folder / "record" / "r.wav", 500, table[:, 1:].astype(np.float32))
    with h5py.File(folder / "record" / "r.h5", "w") as file:
        file.create_dataset("samples", data=table[:, 1:], chunks=(50, 3), compression="gzip", shuffle=True)
        file.attrs["rate_hz"] = 500.0
    (folder / "picture").mkdir()
    counts = np.arange(12 * 16, dtype=np.uint8).reshape(12, 16)
    exif = Image.Exif()
    exif[0x0112], exif[0x0110] = 6, "a phone"
    exif.get_ifd(0x8825).update({1: "N", 2: (37.0, 5.0, 2.5), 3: "W", 4: (2.0, 21.0, 1.5), 6: 590.25})
    Image.fromarray(counts).save(folder / "picture" / "p.jpg", exif=exif)
    cv2.imwrite(str(folder / "picture" / "p.png"), counts.astype(np.uint16) * 257)
    cv2.imwrite(str(folder / "picture" / "p.tif"), counts)
    return folder


@pytest.mark.parametrize("name", READERS)
def test_a_mutant_is_read_or_refused_in_one_sentence(name, corpus, record_property):
    path, reader = corpus / name, READERS[name]
    whole = path.read_bytes()
    reader(path)  # as it is, it can be read
    counts = {"accepted": 0, "refused": 0}

    @settings(
        max_examples=EACH, database=None, derandomize=not MORE, deadline=None, suppress_health_check=list(HealthCheck)
    )
    @given(body=mutants(whole, path.suffix))
    def reads(body):
        path.write_bytes(body)
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            reader(path)
            counts["accepted"] += 1
        except BenchsimError as error:
            said = str(error)
            assert printable(said) == said and len(said) < 1000 and (path.name in said or path.parent.name in said)
            counts["refused"] += 1
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

    before = signal.signal(signal.SIGPROF, stop)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reads()
    finally:
        signal.signal(signal.SIGPROF, before)
        path.write_bytes(whole)
        record_property("hostile", [name, *counts.values()])
    assert counts["refused"]
