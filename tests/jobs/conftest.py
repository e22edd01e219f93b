"""One small recording, rendered once per session; tests copy it and spoil the copy."""

import shutil
from pathlib import Path

import pytest

SCENES = Path(__file__).resolve().parents[2] / "scenes"

SMALLER = {
    "resolution_px = [2000, 1500]": "resolution_px = [1000, 750]",
    "focal_px = 2200.0": "focal_px = 1100.0",
    "principal_point_px = [999.5, 749.5]": "principal_point_px = [499.5, 374.5]",
}


@pytest.fixture(scope="session")
def small_bench(tmp_path_factory):
    """Fig. 7(a) with a camera of half the pixels each way: a bench file, its marks beside it."""
    folder = tmp_path_factory.mktemp("bench")
    text = (SCENES / "fig7a.toml").read_text()
    for old, new in SMALLER.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "small.toml").write_text(text)
    shutil.copy(SCENES / "marks.csv", folder)
    return folder / "small.toml"


@pytest.fixture(scope="session")
def rendered(small_bench, tmp_path_factory):
    """The recording that ``render`` makes of the small bench; read it, never write into it."""
    from benchsim import jobs

    folder = tmp_path_factory.mktemp("rendered") / "recording"
    return jobs.render(small_bench, folder).folder


@pytest.fixture
def recording(rendered, tmp_path):
    """A copy that a test may spoil."""
    folder = tmp_path / "recording"
    shutil.copytree(rendered, folder)
    return folder
