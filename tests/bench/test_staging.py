"""Staging files and folders: whatever ends their maker, the next one takes them away, and nobody else's."""

import os
import signal
import subprocess
import sys

import pytest

from benchsim.bench.staging import OLD, staged, sweep
from benchsim.bench.writing import write_text
from benchsim.jobs.output import output_folder

MAKER = (
    "import sys, time\nfrom pathlib import Path\nfrom benchsim.bench.staging import staged\n"
    "with staged(Path(sys.argv[1]), folder=sys.argv[2] == 'folder') as staging:\n"
    "    if sys.argv[2] == 'folder':\n        (staging / 'half').write_text('x')\n"
    "    print('there', flush=True)\n    time.sleep(60)\n"
)


@pytest.fixture(params=["folder", "file"])
def maker(request, tmp_path):
    """A process in the midst of making ``tmp_path/out``."""
    process = subprocess.Popen(
        [sys.executable, "-c", MAKER, str(tmp_path / "out"), request.param], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "there\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_what_a_killed_process_left_is_removed_and_what_a_living_one_makes_stays(maker, tmp_path):
    before = os.listdir(tmp_path)
    assert len(before) == 1
    sweep(tmp_path / "out")
    write_text(tmp_path / "out", "another's")
    assert sorted(os.listdir(tmp_path)) == sorted([*before, "out"])
    maker.send_signal(signal.SIGKILL)
    maker.wait()
    sweep(tmp_path / "another")
    assert sorted(os.listdir(tmp_path)) == sorted([*before, "out"])
    write_text(tmp_path / "out", "x")
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("name", [".out-backup_1", ".out-old-12345678", ".outside-benchsim-12345678", "out-benchsim-1"])
def test_a_name_that_a_person_gave_is_not_ours(name, tmp_path):
    (tmp_path / name).mkdir()
    with output_folder(tmp_path / "out", "fit", []):
        pass
    assert sorted(os.listdir(tmp_path)) == sorted([name, "out"])


def test_a_link_or_pipe_of_such_a_name_is_not_followed_and_not_waited_for(tmp_path):
    (tmp_path / "precious").mkdir()
    (tmp_path / ".out-benchsim-12345678").symlink_to(tmp_path / "precious")
    os.mkfifo(tmp_path / ".out-benchsim-87654321")
    sweep(tmp_path / "out")
    assert (tmp_path / "precious").is_dir()


def test_an_old_result_put_aside_at_the_moment_of_a_kill_is_put_back(tmp_path):
    with output_folder(tmp_path / "out", "fit", []) as staging:
        (staging / "result.txt").write_text("old")
    aside = tmp_path / ".out-benchsim-12345678"
    aside.mkdir()
    (tmp_path / "out").rename(aside / OLD)
    with pytest.raises(RuntimeError), output_folder(tmp_path / "out", "fit", []):
        raise RuntimeError
    assert (tmp_path / "out" / "result.txt").read_text() == "old" and os.listdir(tmp_path) == ["out"]


def test_a_name_as_long_as_a_file_may_have_is_written(tmp_path):
    write_text(tmp_path / ("ä" * 127), "x")
    assert os.listdir(tmp_path) == ["ä" * 127]


def test_a_stop_on_the_way_leaves_nothing(tmp_path):
    for error in (KeyboardInterrupt, SystemExit, ValueError):
        with pytest.raises(error), staged(tmp_path / "out"):
            raise error
    assert not os.listdir(tmp_path)


def test_where_the_machine_has_no_locks_files_and_folders_are_made_all_the_same(tmp_path):
    """As on Windows; what another left stays, since it may be in use."""
    (tmp_path / ".out-benchsim-12345678").mkdir()
    code = (
        "import sys\nsys.modules['fcntl'] = None\nfrom pathlib import Path\n"
        "from benchsim.bench.writing import write_text\nfrom benchsim.jobs.output import output_folder\n"
        "write_text(Path('file'), 'x')\n"
        "for k in range(2):\n    with output_folder(Path('out'), 'fit', []) as f:\n        (f / f'{k}').touch()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted(os.listdir(tmp_path)) == [".out-benchsim-12345678", "file", "out"]
    assert sorted(os.listdir(tmp_path / "out")) == ["1", "benchsim.json"]
