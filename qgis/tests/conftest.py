"""QGIS without a window, with the plugin from its archive, and a small rendered scene. Run by `make test-qgis`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import rasterio

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "qgis"), str(Path(__file__).parent)]
# Debian's script `qgis_process` gives the program an option that it does not know.
PROGRAMS = ("qgis_process.bin", "qgis_process")
PYTHONS = ("/usr/bin/python3",)
SIZE, SEED, CELL_M = 120, 24, 0.6


class Qgis:
    """QGIS with a profile of its own. program : qgis_process; python : the one that can import qgis."""

    def __init__(self, program: str, python: str, home: Path, commands: Path) -> None:
        self.program, self.python, self.plugins = program, python, home / "plugins"
        kept = {name: os.environ[name] for name in ("LANG", "NUMBA_CACHE_DIR") if name in os.environ}
        self.environment = {
            **kept, "HOME": str(home), "PATH": f"{commands}:/usr/bin:/bin", "QT_QPA_PLATFORM": "offscreen",
            "QGIS_PLUGINPATH": str(self.plugins), "XDG_RUNTIME_DIR": str(home), "PYTHONWARNINGS": "ignore",
        }  # fmt: skip

    def process(self, *words: object, **more: str) -> subprocess.CompletedProcess[str]:
        """Run qgis_process. more : of the environment."""
        return subprocess.run(
            [self.program, *map(str, words)], env=self.environment | more, capture_output=True, text=True, timeout=300
        )

    def run(self, algorithm: str, **parameters: object) -> dict[str, object]:
        """Run an algorithm, and return its outputs. A list is a parameter that is given several times."""
        done = self.process("--json", "run", f"zlocus:{algorithm}", *_words(parameters))
        assert done.returncode == 0, done.stdout + done.stderr
        return dict(json.loads(done.stdout[done.stdout.index("{") :])["results"])

    def refused(self, algorithm: str, **parameters: object) -> str:
        """Run an algorithm that fails, and return what it says."""
        done = self.process("run", f"zlocus:{algorithm}", *_words(parameters))
        assert done.returncode != 0
        return done.stdout + done.stderr

    def script(self, name: str, *words: object) -> dict[str, object]:
        """Run a script of this folder in QGIS's Python, and return what it prints in its last line."""
        done = subprocess.run(
            [self.python, str(Path(__file__).parent / name), *map(str, words)], env=self.environment,
            capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def _words(parameters: dict[str, object]) -> list[str]:
    return [
        f"--{name}={each}"
        for name, value in parameters.items()
        for each in (value if isinstance(value, list) else [value])
    ]


@pytest.fixture(scope="session")
def qgis(tmp_path_factory: pytest.TempPathFactory) -> Qgis:
    """QGIS, with the plugin unpacked from its archive and enabled."""
    program = next((found for name in PROGRAMS if (found := shutil.which(name))), None)
    python = next((name for name in PYTHONS if _has_qgis(name)), None)
    if program is None or python is None:
        pytest.skip("QGIS is missing: apt-get install --no-install-recommends qgis python3-qgis")
    from package import write_archive

    home, commands = tmp_path_factory.mktemp("home"), tmp_path_factory.mktemp("bin")
    (commands / "zlocus").symlink_to(Path(sys.executable).parent / "zlocus")
    made = Qgis(program, python, home, commands)
    archive = home / "plugin.zip"
    write_archive(archive)
    with zipfile.ZipFile(archive) as file:
        file.extractall(made.plugins)
    assert made.process("plugins", "enable", "zlocus_processing").returncode == 0
    return made


def _has_qgis(python: str) -> bool:
    if not Path(python).exists():
        return False
    return subprocess.run([python, "-c", "import qgis.core"], capture_output=True).returncode == 0


@pytest.fixture(scope="session")
def scene(qgis: Qgis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small rendered town with exact truth."""
    folder = tmp_path_factory.mktemp("scene") / "scene"
    words = ["-m", "zlocus.synthetic", "-o", folder, "--size", SIZE, "--views", 3, "--seed", SEED]
    subprocess.run([sys.executable, *map(str, words)], check=True, capture_output=True)
    return folder


@pytest.fixture(scope="session")
def middle(scene: Path) -> list[float]:
    """A box of 24 m in the middle of the scene: xmin, ymin, xmax, ymax in UTM."""
    with rasterio.open(scene / "truth_dsm.tif") as file:
        west, south, east, north = file.bounds
    x, y = (west + east) / 2, (south + north) / 2
    return [x - 12, y - 12, x + 12, y + 12]


@pytest.fixture(scope="session")
def images(scene: Path) -> list[str]:
    """Its images."""
    return sorted(str(path) for path in scene.glob("img_*.tif"))


@pytest.fixture(scope="session")
def surface(qgis: Qgis, images: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its surface, made by the plugin."""
    out = tmp_path_factory.mktemp("surface") / "out"
    found = qgis.run("dsm", INPUT=images, RESOLUTION=CELL_M, MAPS="0,1", OUTPUT=out, WORKERS=1)
    assert found["OUTPUT"] == str(out)
    return out
