"""Environments of other programs, each with a Python that they support, installed as wheels from the registry."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATIONS = Path(__file__).parent / "configurations"
# Of CPython, newest first; what is chosen has wheels of all that CARS 1.3.0 needs.
SUPPORTED = ((3, 12), (3, 13), (3, 11))
STAMP = ".installed"


class Missing(Exception):
    """What another program lacks here, in a sentence."""


@dataclass(frozen=True)
class Environment:
    """A folder with an interpreter and what a file of requirements names."""

    folder: Path

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    def program(self, name: str) -> Path:
        """A command that a package brings."""
        return self.folder / "bin" / name

    def versions(self, *packages: str) -> dict[str, str]:
        """Versions of installed packages."""
        ask = "import sys, importlib.metadata as m; print(*(m.version(p) for p in sys.argv[1:]), sep='\\n')"
        done = subprocess.run([self.python, "-c", ask, *packages], check=True, capture_output=True, text=True)
        return dict(zip(packages, done.stdout.split(), strict=True))


def installed(name: str, folder: Path) -> Environment:
    """The environment of `configurations/NAME.txt`, made where it is not there yet or another one is asked for.

    Raises `Missing` where no supported Python is found, or the registry has no wheels for it.
    """
    requirements = CONFIGURATIONS / f"{name}.txt"
    environment, wanted = Environment(folder / name), requirements.read_text(encoding="utf-8")
    stamp = environment.folder / STAMP
    if stamp.exists() and stamp.read_text(encoding="utf-8") == wanted:
        return environment
    shutil.rmtree(environment.folder, ignore_errors=True)
    subprocess.run([supported_python(), "-m", "venv", environment.folder], check=True)
    pip(environment, "-r", str(requirements))
    stamp.write_text(wanted, encoding="utf-8")
    return environment


def this_checkout(folder: Path) -> Environment:
    """zlocus as a user has it: this checkout with what it needs and no more, installed again where its code differs."""
    environment = Environment(folder / "zlocus")
    digest = hashlib.sha256()
    for path in sorted([ROOT / "pyproject.toml", *(ROOT / "src").rglob("*.py")]):
        digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    stamp = environment.folder / STAMP
    if stamp.exists() and stamp.read_text(encoding="utf-8") == digest.hexdigest():
        return environment
    if not environment.python.exists():
        subprocess.run([sys.executable, "-m", "venv", environment.folder], check=True)
    pip(environment, "--upgrade", "--force-reinstall", "--no-deps", str(ROOT))
    pip(environment, str(ROOT))
    stamp.write_text(digest.hexdigest(), encoding="utf-8")
    return environment


def pip(environment: Environment, *what: str) -> None:
    """Installs. Raises `Missing` where that fails, with what pip said last."""
    install = [environment.python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--prefer-binary"]
    done = subprocess.run([*install, *what], capture_output=True, text=True)
    if done.returncode:
        said = (done.stderr.strip() or "nothing said").splitlines()[-1]
        raise Missing(f"{what[-1]} could not be installed: {said}")


def supported_python() -> Path:
    """An interpreter that runs and whose version is supported: this one, or one by its name on the path or of pyenv."""
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
