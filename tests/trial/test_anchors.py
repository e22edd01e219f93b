"""What ties a trial to the world: keys and who signed, published roots, time stamps, Git commits."""

import json
import shutil
import stat
import subprocess

import fakes
import pytest
from typer.testing import CliRunner

from benchsim import trial
from benchsim.bench.errors import BenchsimError
from benchsim.cli import app
from benchsim.trial import ledger


def ends(folder):
    """Root hashes of concealing, judging and opening."""
    paths = (folder / "recordings", folder / "verdicts", folder)
    return [ledger.read(p / ledger.NAME)[-1]["hash"] for p in paths]


def test_a_key_is_made_once_and_for_its_owner_alone(tmp_path):
    made = trial.key(tmp_path / "key")
    assert stat.S_IMODE(made.path.stat().st_mode) == 0o600
    assert trial.key(tmp_path / "key") == made and trial.key(tmp_path / "other").public != made.public
    assert made.public in made.summary() and "PRIVATE" not in made.summary()
    (tmp_path / "poem").write_text("no key")
    for wrong in ("poem", ".", "not/there"):
        with pytest.raises(BenchsimError, match=r"no Ed25519 key|cannot be"):
            trial.key(tmp_path / wrong)


def test_keys_of_openssl_and_no_others_are_taken(tmp_path):
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    for name, *kind in (("ed", "ed25519"), ("rsa", "RSA"), ("locked", "ed25519", "-aes256", "-pass", "pass:x")):
        subprocess.run(
            ["openssl", "genpkey", "-algorithm", *kind, "-out", tmp_path / name], check=True, capture_output=True
        )
    assert len(trial.key(tmp_path / "ed").public) == 64
    for name in ("rsa", "locked"):
        with pytest.raises(BenchsimError, match="no Ed25519 key without a password"):
            trial.key(tmp_path / name)


def test_a_key_in_the_trial_s_folder_is_refused(spoilt, tmp_path):
    options = {"workers": 0, "make": fakes.make, "certificate": fakes.certificate}
    inside = trial.key(spoilt / "recordings" / "key").path
    with pytest.raises(BenchsimError, match="keep keys elsewhere"):
        trial.conceal(spoilt, 20, seed=7, key=inside, **options)
    with pytest.raises(BenchsimError, match="keep keys elsewhere"):
        trial.judge(spoilt / "recordings", tmp_path / "v", key=inside, workers=0, diagnose=fakes.diagnose)
    link = tmp_path / "link"
    link.symlink_to(inside)
    with pytest.raises(BenchsimError, match="keep keys elsewhere"):
        trial.judge(spoilt / "recordings", tmp_path / "v", key=link, workers=0, diagnose=fakes.diagnose)
    beside = trial.key(spoilt / "key").path
    with pytest.raises(BenchsimError, match="keep keys elsewhere"):
        trial.judge(spoilt / "recordings", spoilt / "verdicts", key=beside, workers=0, diagnose=fakes.diagnose)


def test_signers_and_roots_vouch(opened, keys):
    found = trial.verify(opened, concealer=keys["concealer"].public, judge=keys["judge"].public, roots=ends(opened))
    assert found.signed == {by: keys[by].public for by in ("concealer", "judge")}
    assert len(found.vouched) == 5 and "Nobody vouches" not in found.summary()
    for by, wrong in (("concealer", "judge"), ("judge", "concealer"), ("judge", "stranger")):
        with pytest.raises(BenchsimError, match=f"--{by}: the {by}'s part is signed by another key"):
            trial.verify(opened, **{by: keys[wrong].public})
    middle = ledger.read(opened / ledger.NAME)[5]["hash"]
    for root in (middle, 64 * "0", "", "x"):
        with pytest.raises(BenchsimError, match="no part of this trial ends with it"):
            trial.verify(opened, roots=[root])


def test_every_part_prints_its_root(concealed, opened, keys, tmp_path):
    options = {"make": fakes.make, "certificate": fakes.certificate, "key": keys["concealer"].path}
    heads = ends(opened)
    assert heads[0] in trial.conceal(concealed, 20, seed=7, workers=0, **options).summary()
    shutil.copytree(opened, tmp_path / "t")
    judged = trial.judge(tmp_path / "t/recordings", tmp_path / "t/verdicts", workers=0, diagnose=fakes.diagnose)
    assert heads[1] in judged.summary() and heads[2] in trial.open(tmp_path / "t").summary()


def test_what_was_sealed_without_a_key_is_not_signed_later(tmp_path, keys):
    options = {"workers": 0, "make": fakes.make, "certificate": fakes.certificate}
    trial.conceal(tmp_path / "t", 1, **options)
    with pytest.raises(BenchsimError, match="the concealer did not sign it"):
        trial.conceal(tmp_path / "t", 1, key=keys["concealer"].path, **options)


def test_a_judge_signs_his_further_runs(concealed, keys, tmp_path):
    shutil.copytree(concealed, tmp_path / "t")
    places, key = (tmp_path / "t/recordings", tmp_path / "t/verdicts"), keys["judge"].path
    trial.judge(*places, workers=0, diagnose=fakes.diagnose, key=key)
    trial.judge(*places, workers=0, diagnose=fakes.diagnose, again=["002"], key=key)
    with pytest.raises(BenchsimError) as refused:
        trial.verify(tmp_path / "t", unopened=True, judge=keys["judge"].public)
    assert str(refused.value) == "the trial does not verify: case 002: was judged 2 times"
    trial.judge(*places, workers=0, diagnose=fakes.diagnose, again=["002"])
    with pytest.raises(BenchsimError, match="the judge did not sign it"):
        trial.verify(tmp_path / "t", unopened=True, judge=keys["judge"].public)


def test_a_judge_refuses_recordings_that_are_badly_signed(concealed, tmp_path):
    shutil.copytree(concealed / "recordings", tmp_path / "r")
    *lines, last = ledger.read(tmp_path / "r" / ledger.NAME)
    (tmp_path / "r" / ledger.NAME).unlink()
    forged = {**last, "signature": 128 * "0"}
    new = [{k: v for k, v in line.items() if k not in ("before", "hash")} for line in (*lines, forged)]
    ledger.append(tmp_path / "r" / ledger.NAME, new)
    with pytest.raises(BenchsimError, match="the signature of the concealer is not that of the key"):
        trial.judge(tmp_path / "r", tmp_path / "v", workers=0, diagnose=fakes.diagnose)


def test_the_commands_sign_and_verify(opened, keys, tmp_path):
    def said(*arguments):
        return CliRunner().invoke(app, ["trial", *map(str, arguments)])

    assert "private, keep it" in said("key", tmp_path / "key").output
    who = ["--concealer", keys["concealer"].public, "--judge", keys["judge"].public]
    done = said("verify", opened, *who, *(x for root in ends(opened) for x in ("--root", root)), "--json")
    assert done.exit_code == 0 and len(json.loads(done.output)["vouched"]) == 5
    done = said("verify", opened, "--judge", keys["stranger"].public)
    assert done.exit_code == 1 and done.output.count("\n") == 1
    assert "Nobody vouches for it" in said("verify", opened).output


AUTHORITY = """
[ts]
serial = {0}/serial
crypto_device = builtin
signer_cert = {0}/tsa.pem
signer_key = {0}/tsa-key.pem
signer_digest = sha256
default_policy = 1.2.3.4
digests = sha256
ess_cert_id_alg = sha256
"""


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    """stamp(hash, name) → response of a time-stamping authority whose certificate is beside it."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    at = tmp_path_factory.mktemp("authority")
    (at / "ts.conf").write_text(AUTHORITY.format(at))

    def openssl(*arguments):
        subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)

    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", 3, "-subj", "/CN=authority", "-addext",
            "extendedKeyUsage=critical,timeStamping", "-keyout", at / "tsa-key.pem",
            "-out", at / "tsa.pem")  # fmt: skip

    def stamp(head, name):
        openssl("ts", "-query", "-digest", head, "-sha256", "-cert", "-out", at / f"{name}.tsq")
        openssl("ts", "-reply", "-config", at / "ts.conf", "-section", "ts", "-queryfile", at / f"{name}.tsq",
                "-out", at / f"{name}.tsr")  # fmt: skip
        return at / f"{name}.tsr"

    return stamp, at / "tsa.pem"


def test_a_time_stamp_of_a_root_vouches(opened, authority):
    stamp, trusted = authority
    for k, (part, head) in enumerate(zip(("recordings", "verdicts", "opening"), ends(opened), strict=True)):
        found = trial.verify(opened, timestamp=(stamp(head, f"root-{k}"), trusted))
        assert found.vouched[0].startswith(f"time stamp of the {part}, ") and "GMT" in found.vouched[0]


def test_time_stamps_of_others_are_refused(opened, authority, tmp_path, keys):
    stamp, trusted = authority
    other = stamp(ledger.read(opened / ledger.NAME)[5]["hash"], "middle")
    good = stamp(ends(opened)[2], "good")
    spoilt = tmp_path / "spoilt.tsr"
    spoilt.write_bytes(good.read_bytes()[:-1] + b"\0")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-subj", "/CN=authority", "-keyout",
         tmp_path / "k.pem", "-out", tmp_path / "other.pem"], check=True, capture_output=True,
    )  # fmt: skip
    for token, ca in ((other, trusted), (spoilt, trusted), (good, tmp_path / "other.pem"), (trusted, trusted)):
        with pytest.raises(BenchsimError, match="is no time stamp of any part of this trial by an authority in"):
            trial.verify(opened, timestamp=(token, ca))
    with pytest.raises(BenchsimError, match="cannot be read"):
        trial.verify(opened, timestamp=(tmp_path / "none", trusted))


@pytest.fixture
def repository(tmp_path):
    """commit(message) → hash, in a repository."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    at = tmp_path / "repository"

    def git(*arguments):
        who = ["-c", "user.name=x", "-c", "user.email=x@localhost", "-c", "commit.gpgsign=false"]
        return subprocess.run(["git", "-C", at, *who, *arguments], check=True, capture_output=True, text=True).stdout

    at.mkdir()
    git("init", "-q")

    def commit(message):
        git("commit", "-q", "--allow-empty", "-m", message)
        return git("rev-parse", "HEAD").strip()

    return at, commit


def test_a_commit_that_holds_a_root_vouches(opened, repository):
    at, commit = repository
    for part, head in zip(("recordings", "verdicts", "opening"), ends(opened), strict=True):
        name = commit(f"A trial\n\nroot {head}\n")
        assert trial.verify(opened, commit=(at, name)).vouched == (f"commit {name} with the root of the {part}",)
    for wrong, says in (
        (commit("nothing"), "holds no root hash"),
        ("HEAD", "full hash"),
        (40 * "0", "is no commit in"),
    ):
        with pytest.raises(BenchsimError, match=says):
            trial.verify(opened, commit=(at, wrong))


def test_a_commit_under_a_false_name_is_refused(opened, repository):
    """Whoever holds the repository puts another body where git looks for the name."""
    at, commit = repository
    name, false = commit("nothing"), commit(f"root {ends(opened)[2]}")
    objects = at / ".git/objects"
    target = objects / name[:2] / name[2:]
    target.chmod(0o644)
    shutil.copyfile(objects / false[:2] / false[2:], target)
    with pytest.raises(BenchsimError, match=r"has another hash|is no commit in"):
        trial.verify(opened, commit=(at, name))
