"""Files from strangers: a finished folder in which a file is something else altogether is told by that file."""

import shutil
from pathlib import Path

import pytest

from benchsim import jobs
from benchsim.bench.errors import BenchsimError

CORPUS = Path(__file__).parent / "corpus" / "validation"


@pytest.mark.parametrize("name", sorted(path.name for path in CORPUS.iterdir()))
@pytest.mark.parametrize("value", ["1", "[]", "[" * 10_000, '{"format": 1}', "", "\x00"])
def test_a_file_that_is_something_else_altogether(name, value, tmp_path):
    shutil.copytree(CORPUS, tmp_path, dirs_exist_ok=True)
    (tmp_path / name).write_text(value)
    with pytest.raises(BenchsimError, match=name):
        jobs.report(tmp_path)
