"""A newcomer tries the tool on a recording that it makes: small, and silent about its answer until asked."""

import pytest

import benchsim as bs
from benchsim.bench.files import read

SEED = 4


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sample") / "s"
    return bs.sample(folder, seed=SEED)


@pytest.mark.slow
def test_the_recording_is_small_and_whole(made):
    assert sum(p.stat().st_size for p in made.folder.iterdir()) < 2e6
    recording = read(made.folder, images=True)
    assert len(recording.exposures) == 6
    assert all(len(f.trace.y_mm) > 50 for f in bs.fit(recording))


@pytest.mark.slow
def test_nothing_in_the_folder_or_in_what_is_said_tells_the_answer(made):
    name, *_ = made.concealed
    said = [made.summary(), str(made.as_dict()), *(p.read_text() for p in made.folder.iterdir() if p.suffix != ".jpg")]
    assert not [text for text in said if name in text]
    assert not made.recording.effects


@pytest.mark.slow
def test_the_folder_answers_when_asked(made):
    answer = bs.sample(made.folder, answer=True)
    assert (answer.concealed, answer.seed, answer.recording) == (made.concealed, SEED, None)
    assert answer.as_dict()["effect"] in answer.summary()


def test_no_answer_where_no_sample_lies(tmp_path):
    with pytest.raises(bs.BenchsimError, match="no sample lies there; make one"):
        bs.sample(tmp_path, answer=True)


def test_an_older_sample_is_not_replaced(tmp_path):
    (tmp_path / "recording.toml").write_text("# filled in\n")
    with pytest.raises(bs.BenchsimError, match="lies there already; name another folder, or remove it"):
        bs.sample(tmp_path)
    assert (tmp_path / "recording.toml").read_text() == "# filled in\n"
