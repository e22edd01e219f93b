"""A real ``dask scheduler`` with two workers that speak TLS alone, by certificates that are made for it."""

import json
import os
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from benchsim.jobs.cluster import Scheduler


def certificates(folder):
    """An authority, and a certificate and a key of its own making: three files."""
    folder.mkdir()
    now, made = datetime.now(UTC), {}
    for name in ("authority", "own"):
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        issuer, signing = made.get("authority", (subject, key))
        made[name] = (subject, key)
        signed = (
            x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number())
            .not_valid_before(now)
            .not_valid_after(now + timedelta(hours=1))
            .add_extension(x509.BasicConstraints(name == "authority", None), critical=True)
            .sign(signing, hashes.SHA256())
        )
        (folder / f"{name}.pem").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        made["own"][1].private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )
    return tuple(folder / name for name in ("authority.pem", "own.pem", "key.pem"))


@pytest.fixture(scope="session")
def dask_of_tls(tmp_path_factory):
    """A scheduler as benchsim is told of it, and its two workers; ended with the tests."""
    tmp_path = tmp_path_factory.mktemp("dask")
    tls = certificates(tmp_path / "tls")
    path = os.pathsep.join([str(Path(__file__).parent / "trial"), *sys.path])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    file = tmp_path / "scheduler.json"
    common = {"env": environment, "cwd": tmp_path, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    flags = [f"--tls-{what}={path}" for what, path in zip(("ca-file", "cert", "key"), tls, strict=True)]
    flags += ["--scheduler-file", str(file), "--no-dashboard"]
    scheduler = ["--protocol", "tls", "--host", "127.0.0.1", "--port", "0", *flags]
    started = [subprocess.Popen([sys.executable, "-m", "dask", "scheduler", *scheduler], **common)]
    try:
        wait(lambda: file.exists() and file.stat().st_size > 0)
        worker = [sys.executable, "-m", "dask", "worker", "--nthreads", "1", "--no-nanny", *flags]
        started += [subprocess.Popen(worker, **common) for _ in range(2)]
        yield Scheduler(json.loads(file.read_text())["address"], tls)
    finally:
        for process in started:
            process.kill()
            process.wait()


def wait(ready, seconds=120.0):
    end = time.monotonic() + seconds
    while not ready():
        assert time.monotonic() < end
        time.sleep(0.02)
