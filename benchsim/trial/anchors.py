"""What ties a ledger to the world: signatures in it, and hashes of it that somebody else keeps.

A chain of hashes shows that nothing was changed since; whoever holds the folder can make another chain. He cannot sign
it with a key that he has not, nor bring it into what was published, time-stamped or committed before.
"""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey as Private
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from benchsim.bench.errors import BenchsimError
from benchsim.bench.reading import TOML_BYTES, read_file
from benchsim.jobs.progress import Progress, silent
from benchsim.trial.ledger import Line, Standing

SECONDS = 60
"""For openssl or git, which take well below one; a file system that hangs must not hold up for ever."""


@dataclass(frozen=True)
class KeyResult:
    """A key pair: where the private half lies, and the public half."""

    path: Path
    public: str

    def as_dict(self) -> dict[str, str]:
        """Plain values for ``--json``."""
        return {"key": str(self.path), "public": self.public}

    def summary(self) -> str:
        """What a person wants to know, on a terminal."""
        return f"{self.path}: private, keep it; public, to be made known: {self.public}"


def key(path: Path | str, *, progress: Progress = silent) -> KeyResult:
    """Make an Ed25519 key (PEM, PKCS 8), or tell the public half of the one that is there.

    Parameters
    ----------
    path : path

    Raises
    ------
    BenchsimError
        If it cannot be written, or holds something else.
    """
    at = Path(path)
    if not at.exists():
        made = Private.generate().private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        try:
            with open(os.open(at, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(made)
        except OSError as error:
            raise BenchsimError(f"{at}: cannot be written ({error.strerror}); choose another place") from None
    return KeyResult(at, public_of(read_key(at)))


def read_key(path: Path, apart: Sequence[Path] = ()) -> Private:
    """Private key, which must not lie in folders that are handed on.

    Parameters
    ----------
    path : Path
    apart : sequence of Path

    Raises
    ------
    BenchsimError
        If it is no Ed25519 key without a password, or lies there.
    """
    for folder in apart:
        if path.resolve().is_relative_to(folder.resolve()):
            raise BenchsimError(f"--key {path}: lies in {folder}, which is handed on; keep keys elsewhere")
    try:
        found = serialization.load_pem_private_key(read_file(path, TOML_BYTES), None)
    except BenchsimError:
        raise
    except Exception:
        # Whatever the parser makes of what is no key, its own errors and those of OpenSSL included.
        found = None
    if not isinstance(found, Private):
        raise BenchsimError(f"{path}: is no Ed25519 key without a password; make one with 'benchsim trial key'")
    return found


def public_of(private: Private) -> str:
    """Public half, in hexadecimal."""
    return private.public_key().public_bytes_raw().hex()


def _signed_text(by: str, head: str) -> bytes:
    # The role, lest one part's signature serve as the other's.
    return f"benchsim-trial {by} {head}".encode()


def signature(private: Private, by: str, head: str) -> dict[str, str]:
    """Line by which "concealer" or "judge" signs all up to a hash."""
    signed = private.sign(_signed_text(by, head)).hex()
    return {"kind": "signed", "by": by, "key": public_of(private), "signature": signed}


def holds(line: Line) -> bool:
    """Whether a ``signed`` line is signed by the key that it names."""
    try:
        public = Ed25519PublicKey.from_public_bytes(bytes.fromhex(line["key"]))
        public.verify(bytes.fromhex(line["signature"]), _signed_text(line["by"], line["before"]))
    except (InvalidSignature, ValueError):
        return False
    return True


def unsigned(stands: Standing, expected: Mapping[str, str | None]) -> list[str]:
    """What is wrong with the signatures, a sentence each.

    Parameters
    ----------
    stands : Standing
    expected : mapping of "concealer" or "judge" → public key or None
        None: whoever signed.
    """
    out = [
        f"the signature of the {by} is not that of the key it names" for by, s in stands.signed.items() if not holds(s)
    ]
    for by, public in expected.items():
        line = stands.signed.get(by)
        if public is not None and line is None:
            out.append(f"--{by}: the {by} did not sign it, or the signature was taken away")
        elif public is not None and line is not None and line["key"] != public.strip().lower():
            out.append(f"--{by}: the {by}'s part is signed by another key, {line['key']}")
    return out


def complain(stands: Standing, by: str, public: str | None = None) -> None:
    """Raise BenchsimError if "concealer" or "judge" signed badly, or not with an expected key."""
    found = unsigned(stands, {by: public})
    if found:
        raise BenchsimError("; ".join(found))


def stamped(token: Path, authority: Path, ends: Mapping[str, str]) -> tuple[str, str]:
    """Part of a trial that an RFC 3161 time stamp vouches for, and when it was given, as ``openssl ts`` verifies it.

    Parameters
    ----------
    token : Path
        The authority's response.
    authority : Path
        Certificates that are trusted, PEM.
    ends : mapping of part → hash of its last line
        The SHA-256 that was stamped.

    Raises
    ------
    BenchsimError
        If it is of another hash, of another authority, or cannot be checked.
    """
    files = [str(p.absolute()) for p in (token, authority)]
    for path in (token, authority):
        read_file(path, TOML_BYTES)
    for part, head in reversed(list(ends.items())):
        done = _run(["openssl", "ts", "-verify", "-digest", head, "-in", files[0], "-CAfile", files[1]])
        if done.returncode == 0:
            shown = _run(["openssl", "ts", "-reply", "-in", files[0], "-text"]).stdout.decode(errors="replace")
            when = re.search(r"^Time stamp: (.*)$", shown, re.MULTILINE)
            return part, when[1] if when else "an unknown time"
    raise BenchsimError(
        f"--timestamp {token}: is no time stamp of any part of this trial by an authority in {authority}; see "
        f"'openssl ts -verify -digest {list(ends.values())[-1]} -in {token} -CAfile {authority}'"
    )


def committed(repository: Path, commit: str, ends: Mapping[str, str]) -> str:
    """Part of a trial whose last hash stands in the message of a Git commit.

    Parameters
    ----------
    repository : Path
    commit : str
        Its full hash: names move.
    ends : mapping of part → hash of its last line

    Raises
    ------
    BenchsimError
        If there is no such commit, or it holds no hash of this trial.
    """
    name = commit.lower()
    if not re.fullmatch(r"[0-9a-f]{40}|[0-9a-f]{64}", name):
        raise BenchsimError(f"--commit {commit}: give the commit's full hash, since branches and tags move")
    done = _run(["git", "-C", str(repository.absolute()), "cat-file", "commit", name])
    if done.returncode != 0:
        raise BenchsimError(f"--commit {name}: is no commit in {repository}; fetch it first")
    whole = b"commit %d\0" % len(done.stdout) + done.stdout
    # git shows what lies under a name without hashing it again; SHA-1 is what most repositories have.
    if (hashlib.sha1(whole) if len(name) == 40 else hashlib.sha256(whole)).hexdigest() != name:
        raise BenchsimError(f"--commit {name}: what {repository} holds under this name has another hash")
    for part, head in reversed(list(ends.items())):
        if head.encode() in done.stdout:
            return part
    raise BenchsimError(f"--commit {name}: its message holds no root hash of this trial")


def _run(command: list[str]) -> subprocess.CompletedProcess[bytes]:
    # A repository that lacks the commit must not be told by its own configuration where, and how, to get it.
    environment = {**os.environ, "GIT_NO_LAZY_FETCH": "1", "LC_ALL": "C"}
    try:
        return subprocess.run(command, capture_output=True, check=False, timeout=SECONDS, env=environment)
    except (OSError, subprocess.TimeoutExpired):
        raise BenchsimError(f"{command[0]}: cannot be run; install it, or verify without what it checks") from None
