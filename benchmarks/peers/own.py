"""zlocus itself, with the options that it has by default: images, grid and area are all it is given."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from peers.environments import STAMP, Environment
from peers.measuring import Usage, measured
from peers.scenes import RESOLUTION_M, Scene

# Exit status where much of the area has no height: a surface all the same.
COVERAGE_SHORT = 3
PACKAGES = ("zlocus", "numba", "numpy", "opencv-python-headless")


@dataclass(frozen=True)
class Own:
    """This checkout of zlocus, as a user has it. Its page about the run is not asked for: the others make none."""

    environment: Environment
    name: str = "zlocus"

    def versions(self) -> dict[str, str]:
        """Of what computes; `code` tells states of the checkout apart."""
        code = (self.environment.folder / STAMP).read_text(encoding="utf-8")
        return self.environment.versions(*PACKAGES) | {"code": code}

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        """A surface of the scene, and what it took."""
        command = [
            self.environment.program("zlocus"),
            "dsm",
            *scene.images.values(),
            "-o",
            out / "zlocus",
            "--no-report",
        ]
        command += ["--crs", scene.crs, "--bounds", *scene.bounds, "--resolution", RESOLUTION_M]
        command += ["--workers", len(cores)]
        used = measured(command, cores, out / "zlocus.log", accept=(0, COVERAGE_SHORT))
        return out / "zlocus" / "dsm.tif", used


def shifts(out: Path, scene: Scene) -> dict[str, tuple[float, float]]:
    """Pointing corrections (column, row) px by view that a run in this folder found; none where there is no run."""
    record = out / "zlocus" / "run.json"
    if not record.exists():
        return {}
    views = json.loads(record.read_text())["orientation"]["views"]
    return {name: tuple(views[path.stem]["shift_px"]) for name, path in scene.images.items()}
