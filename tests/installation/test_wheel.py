"""The wheel: pure Python, with all files that the package reads, and usable where it is installed alone."""

from __future__ import annotations

import os
import shutil
import site
import subprocess
import sys
import venv
from pathlib import Path
from zipfile import ZipFile

import pytest

from places import ROOT
from zlocus import __version__

SOURCE = ROOT / "src" / "zlocus"
BUILT_FROM = ("pyproject.toml", "setup.py", "README.md", "LICENSE")
PAGES = [path.relative_to(ROOT) for path in (ROOT / "docs").rglob("*.md")]
PIP = ("-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input")


def run(*command: str | Path, **options) -> str:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=120, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built without a network from a copy, so that nothing is left in the clone."""
    pytest.importorskip("setuptools", "77", reason="setuptools 77 is not installed: no wheel is built")
    folder = tmp_path_factory.mktemp("wheel")
    for name in BUILT_FROM:
        shutil.copy(ROOT / name, folder)
    for page in PAGES:
        (folder / page).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / page, folder / page)
    shutil.copytree(SOURCE, folder / "src" / "zlocus", ignore=shutil.ignore_patterns("__pycache__"))
    run(sys.executable, *PIP, "wheel", ".", "--no-deps", "--no-build-isolation", "--no-index", "-w", "dist", cwd=folder)
    (built,) = (folder / "dist").iterdir()
    return built


def test_the_wheel_is_pure_python(wheel):
    assert wheel.name == f"zlocus-{__version__}-py3-none-any.whl"
    with ZipFile(wheel) as archive:
        assert b"Root-Is-Purelib: true" in archive.read(f"zlocus-{__version__}.dist-info/WHEEL")
        assert [name for name in archive.namelist() if name.endswith((".so", ".pyd", ".dll"))] == []


def test_the_wheel_holds_what_the_package_reads(wheel):
    """All files beside the sources of the clone (templates, the inspector's page, the mark of typed packages), and the
    pages of the documentation.

    Notes for programmers are left out.
    """
    with ZipFile(wheel) as archive:
        names = set(archive.namelist())
    files = (p for p in SOURCE.rglob("*") if p.is_file() and p.suffix != ".md" and "__pycache__" not in p.parts)
    expected = {(Path("zlocus") / p.relative_to(SOURCE)).as_posix() for p in files}
    assert {"zlocus/py.typed", "zlocus/__main__.py"} <= expected
    assert {Path(name).suffix for name in expected} >= {".py", ".jinja", ".js", ".html"}
    meta = f"zlocus-{__version__}.dist-info/"
    pages = {f"zlocus/pages/{path.relative_to('docs').as_posix()}" for path in PAGES}
    assert len(pages) > 40
    assert {name for name in names if not name.startswith(meta)} == expected | pages
    assert f"{meta}licenses/LICENSE" in names


def test_the_installed_wheel_starts_in_an_empty_folder(wheel, tmp_path):
    """In an environment of its own, which finds the packages that zlocus needs, and not the clone."""
    venv.create(tmp_path / "env", symlinks=True)
    python, empty = tmp_path / "env" / "bin" / "python", tmp_path / "empty"
    if not python.exists():
        pytest.skip("environments of this system have no bin/python")
    empty.mkdir()
    installed = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    run(sys.executable, *PIP, "--python", python, "install", "--no-deps", "--no-index", wheel)
    (installed / "needed.pth").write_text("\n".join(site.getsitepackages()) + "\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    where = run(python, "-c", "import zlocus; print(zlocus.__file__)", cwd=empty, env=environment).strip()
    assert Path(where).is_relative_to(installed)
    for command in ([python, "-m", "zlocus"], [tmp_path / "env" / "bin" / "zlocus"]):
        assert __version__ in run(*command, "--version", cwd=empty, env=environment)
    assert "dsm" in run(python, "-m", "zlocus", "--help", cwd=empty, env=environment)
    assert list(empty.iterdir()) == []
