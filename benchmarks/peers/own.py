"""zlocus itself, with default options; it gets the images, the grid and the area."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from peers.environments import STAMP, Environment
from peers.measuring import Usage, measured
from peers.scenes import RESOLUTION_M, Scene
from workplace import COVERAGE_SHORT

PACKAGES = ("zlocus", "numba", "numpy", "opencv-python-headless")


@dataclass(frozen=True)
class Own:
    """This checkout of zlocus, installed as by a user. It writes no report, because the other programs write none."""

    environment: Environment
    name: str = "zlocus"

    def versions(self) -> dict[str, str]:
        """Versions of the packages that compute; `code` identifies the state of the checkout."""
        code = (self.environment.folder / STAMP).read_text(encoding="utf-8")
        return self.environment.versions(*PACKAGES) | {"code": code}

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        """Make the surface of a scene; return its path and the cost."""
        command = [
            self.environment.program("zlocus"),
            "dsm",
            *scene.inputs,
            "-o",
            out / "zlocus",
            "--no-report",
        ]
        command += ["--crs", scene.crs, "--bounds", *scene.bounds, "--resolution", RESOLUTION_M]
        command += ["--workers", len(cores)]
        used = measured(command, cores, out / "zlocus.log", accept=(0, COVERAGE_SHORT))
        return out / "zlocus" / "dsm.tif", used


def shifts(out: Path, scene: Scene) -> dict[str, tuple[float, float]]:
    """Pointing corrections (column, row) px by view from the run in this folder; empty if there is no run."""
    record = out / "zlocus" / "run.json"
    if not record.exists():
        return {}
    views = json.loads(record.read_text())["orientation"]["views"]
    return {name: tuple(views[path.stem]["shift_px"]) for name, path in scene.images.items()}
