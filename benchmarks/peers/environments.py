"""Environments of the other programs, each with a supported Python, installed from the package registry."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATIONS = Path(__file__).parent / "configurations"
# Versions of CPython for which CARS 1.3.0 and all that it needs have wheels, in the order of preference.
SUPPORTED = ((3, 12), (3, 13), (3, 11))
STAMP = ".installed"


class Missing(Exception):
    """A program cannot run here; the message says what is missing."""


@dataclass(frozen=True)
class Environment:
    """A folder with an interpreter and installed packages."""

    folder: Path

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    def program(self, name: str) -> Path:
        """Path of a command that a package installs."""
        return self.folder / "bin" / name

    def versions(self, *packages: str) -> dict[str, str]:
        """Versions of installed packages."""
        ask = "import sys, importlib.metadata as m; print(*(m.version(p) for p in sys.argv[1:]), sep='\\n')"
        done = subprocess.run([self.python, "-c", ask, *packages], check=True, capture_output=True, text=True)
        return dict(zip(packages, done.stdout.split(), strict=True))


def installed(name: str, folder: Path) -> Environment:
    """The environment of `configurations/NAME.txt`, made where it is not there yet or another one is asked for.

    Raises `Missing` where no supported Python is found, or something cannot be installed.
    """
    requirements = CONFIGURATIONS / f"{name}.txt"
    wanted = requirements.read_text(encoding="utf-8")
    return made(Environment(folder / name), wanted, supported_python, ["-r", str(requirements)])


def this_checkout(folder: Path) -> Environment:
    """Install this checkout with its required packages only, as a user does; again if its code has changed."""
    files = sorted([ROOT / "pyproject.toml", ROOT / "README.md", ROOT / "LICENSE", *(ROOT / "src").rglob("*")])
    files = [
        path
        for path in files
        if path.is_file() and not {"__pycache__"} & set(path.parts) and ".egg-info" not in str(path)
    ]
    digest = digest_of(files)
    with tempfile.TemporaryDirectory() as scratch:
        # The build leaves folders beside the source, so a copy is built.
        for path in files:
            copy = Path(scratch) / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
        return made(Environment(folder / "zlocus"), digest, lambda: Path(sys.executable), [scratch])


def digest_of(files: Iterable[Path]) -> str:
    """Fingerprint of the names and contents of files."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def made(environment: Environment, wanted: str, python: Callable[[], Path], what: list[str]) -> Environment:
    """The environment if its stamp equals `wanted`; otherwise it is made again."""
    stamp = environment.folder / STAMP
    if stamp.exists() and stamp.read_text(encoding="utf-8") == wanted:
        return environment
    shutil.rmtree(environment.folder, ignore_errors=True)
    run([python(), "-m", "venv", environment.folder])
    options = ["--quiet", "--disable-pip-version-check", "--prefer-binary"]
    run([environment.python, "-m", "pip", "install", *options, *what])
    stamp.write_text(wanted, encoding="utf-8")
    return environment


def run(command: list[Any]) -> None:
    """Run a command.

    Raises
    ------
    Missing
        The command failed; the message holds its last line of output.
    """
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "nothing said").splitlines()[-1]
        raise Missing(f"`{' '.join(map(str, command[1:]))}` failed: {said}")


def supported_python() -> Path:
    """A Python interpreter of a supported version: this one, one on the PATH, or one of pyenv."""
    named = [shutil.which(f"python{major}.{minor}") for major, minor in SUPPORTED]
    pyenv = sorted(Path.home().glob(".pyenv/versions/*/bin/python"))
    for candidate in [*filter(None, named), *map(str, pyenv), sys.executable]:
        ask = [candidate, "-c", "import sys; print(*sys.version_info[:2])"]
        done = subprocess.run(ask, capture_output=True, text=True)
        if done.returncode == 0 and tuple(map(int, done.stdout.split())) in SUPPORTED:
            return Path(candidate)
    wanted = ", ".join(f"{major}.{minor}" for major, minor in sorted(SUPPORTED))
    raise Missing(
        f"no Python of {wanted} was found on the path: install one of them (the programs have no wheels for others)"
    )
