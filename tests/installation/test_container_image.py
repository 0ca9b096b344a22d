"""The Dockerfile: linted, run by a user without rights, and built where buildah and a base image can be had."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from places import ROOT
from zlocus import __version__

DOCKERFILE = ROOT / "Dockerfile"
BASE = os.environ.get("ZLOCUS_TEST_BASE_IMAGE", "python:3.12-slim")
# How pip reaches the package index of this machine, also while an image is built.
SHARED = ("/etc/pip.conf", str(Path.home() / ".config" / "pip"), "/etc/ssl/certs")
PULL_S, BUILD_S = 60, 280


def instructions() -> list[str]:
    text = re.sub(r"\\\n\s*", "", DOCKERFILE.read_text(encoding="utf-8"))
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def test_the_linter_is_content():
    beside_python = Path(sys.executable).parent / "hadolint"
    hadolint = beside_python if beside_python.exists() else shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed: the Dockerfile is not linted")
    done = subprocess.run([str(hadolint), str(DOCKERFILE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_base_is_an_argument_and_the_user_has_no_rights():
    lines = instructions()
    assert lines[0].startswith("ARG BASE=")
    assert [line for line in lines if line.startswith("FROM")] == ["FROM ${BASE}"]
    users = [line.split()[1] for line in lines if line.startswith("USER")]
    assert len(users) == 1
    assert int(users[0]) > 0
    after = lines[lines.index(f"USER {users[0]}") :]
    assert 'ENTRYPOINT ["zlocus"]' in after


def test_what_the_image_copies_is_not_ignored():
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    sources = [word for line in instructions() if line.startswith("COPY") for word in line.split()[1:-1]]
    assert ignored[0] == "*"
    assert {f"!{source}" for source in sources} == {line for line in ignored if line.startswith("!")}
    assert all((ROOT / source).exists() for source in sources)


@pytest.fixture
def buildah(tmp_path):
    """Runs buildah with a store of its own, or with the one that ZLOCUS_TEST_BUILDAH_ROOT names."""
    command = shutil.which("buildah")
    if command is None:
        pytest.skip("buildah is not installed: no image is built")
    root = os.environ.get("ZLOCUS_TEST_BUILDAH_ROOT", str(tmp_path / "store"))
    store = [command, "--root", root, "--runroot", str(tmp_path / "run"), "--storage-driver", "vfs"]
    environment = {**os.environ, "BUILDAH_ISOLATION": "chroot"}

    def run(*words: str, timeout: float = PULL_S) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*store, *words], capture_output=True, text=True, check=False, timeout=timeout, env=environment
        )

    return run


def test_the_image_is_built_and_starts(buildah):
    pulled = buildah("pull", "--policy", "missing", BASE)
    if pulled.returncode:
        pytest.skip(
            f"no base image, so no image is built: {BASE} cannot be had ({pulled.stderr.splitlines()[-1][:200]})"
        )
    volumes = [
        f"--volume={place}:{place.replace(str(Path.home()), '/root')}:ro" for place in SHARED if Path(place).exists()
    ]
    arguments = ["--build-arg", f"BASE={BASE}", "--build-arg", "KERNELS=no"]
    built = buildah("build", *volumes, *arguments, "--tag", "zlocus-test", str(ROOT), timeout=BUILD_S)
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    container = buildah("from", "zlocus-test").stdout.strip()
    try:
        assert __version__ in buildah("run", container, "--", "zlocus", "--version").stdout
        assert buildah("run", container, "--", "id", "-u").stdout.strip() not in ("", "0")
        assert buildah("run", container, "--", "sh", "-c", "pwd && touch there && ls").stdout == "/work\nthere\n"
    finally:
        buildah("rm", container)
        buildah("rmi", "zlocus-test")
