"""Matchers of rectified pairs: OpenCV's StereoSGBM, and Pandora with libSGM."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from peers.environments import CONFIGURATIONS, Environment, digest_of
from peers.measuring import Usage, measured
from peers.scenes import Scene

HERE = Path(__file__).parent
PAIRS = HERE / "pairs.py"


@dataclass(frozen=True)
class Matcher:
    """A script that matches pairs in an environment of its own.

    script : NAME of its `match_NAME.py` and its configuration; packages : those that compute.
    """

    environment: Environment
    name: str
    script: str
    packages: tuple[str, ...]

    def versions(self) -> dict[str, str]:
        """Versions of the packages that compute, and of the configuration."""
        configuration = digest_of([CONFIGURATIONS / f"{self.script}.json"])
        return self.environment.versions(*self.packages) | {"configuration": configuration}

    def options(self) -> dict[str, object]:
        """The options that its documentation recommends."""
        found: dict[str, object] = json.loads((CONFIGURATIONS / f"{self.script}.json").read_text(encoding="utf-8"))
        return found

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        """Make the surface of a scene; return its path and the cost of rectifying, matching and merging."""
        out.mkdir(parents=True, exist_ok=True)
        pairs = [
            {
                "views": pair,
                "left": f"{out}/{k}_left.tif",
                "right": f"{out}/{k}_right.tif",
                "disparity": f"{out}/{k}.npy",
            }
            for k, pair in enumerate(scene.pairs)
        ]
        job = out / "job.json"
        said = {
            "images": list(scene.images), "inputs": [str(path) for path in scene.inputs],
            "shifts": {name: scene.shift(name) for name in scene.images},
            "crs": scene.crs, "bounds": scene.bounds, "heights": scene.heights, "pairs": pairs,
            "options": self.options(), "threads": len(cores), "surface": str(out / "dsm.tif"),
        }  # fmt: skip
        job.write_text(json.dumps(said, indent=1))
        prepare, merge = ([sys.executable, PAIRS, step, job] for step in ("prepare", "merge"))
        match = [self.environment.python, HERE / f"match_{self.script}.py", job]
        steps = {"prepare": prepare, "match": match, "merge": merge}
        used = (measured(command, cores, out / f"{step}.log") for step, command in steps.items())
        return out / "dsm.tif", sum(used, Usage())


def opencv(environment: Environment) -> Matcher:
    return Matcher(environment, "OpenCV SGBM", "opencv", ("opencv-python-headless", "numpy"))


def pandora(environment: Environment) -> Matcher:
    return Matcher(environment, "Pandora", "pandora", ("pandora", "pandora_plugin_libsgm", "libSGM", "numpy"))
