"""CARS: pairs of images resampled along epipolar lines, matched by Pandora, put on one grid (Youssefi et al. 2020)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import yaml
from pyproj import CRS
from rasterio.transform import from_origin

from peers.environments import CONFIGURATIONS, Environment, digest_of
from peers.measuring import Usage, measured
from peers.scenes import RESOLUTION_M, Scene

# Images with fewer pixels along a side are small.
SMALL_PX = 1000
# Realistic scenes are matched as hills are, JAX_068 as a town.
METHOD_OF = {"real": "hills", "registered": "city"}
PACKAGES = ("cars", "pandora", "libSGM", "shareloc", "cars-rasterize", "numba", "numpy")


@dataclass(frozen=True)
class Cars:
    """CARS in an environment of its own."""

    environment: Environment
    name: str = "CARS"

    def versions(self) -> dict[str, str]:
        """Versions of the packages that compute, and of the configuration."""
        configuration = digest_of([CONFIGURATIONS / "cars.yaml"])
        return self.environment.versions(*PACKAGES) | {"configuration": configuration}

    def run(self, scene: Scene, out: Path, cores: Sequence[int]) -> tuple[Path, Usage]:
        """Make the surface of a scene; return its path and the cost."""
        out.mkdir(parents=True, exist_ok=True)
        config = out / "cars.yaml"
        config.write_text(yaml.safe_dump(configuration(scene, out), sort_keys=False), encoding="utf-8")
        used = measured([self.environment.program("cars"), config], cores, out / "cars.log")
        return out / "cars" / "dsm" / "dsm.tif", used


def configuration(scene: Scene, out: Path) -> dict[str, Any]:
    """Configuration of CARS for a scene, from `configurations/cars.yaml`, with all usable pairs of the scene."""
    recommended = yaml.safe_load((CONFIGURATIONS / "cars.yaml").read_text(encoding="utf-8"))
    pairs = scene.pairs
    views = [view for view in scene.images if view in set(itertools.chain(*pairs))]
    matching = {"dense_matching": {"method": recommended["methods"][METHOD_OF.get(scene.kind, scene.kind)]}}
    low, high = scene.heights
    margins = dict.fromkeys(("lower_margin", "upper_margin"), round(high - low))
    return {
        "input": {
            "sensors": {view: {"image": str(scene.images[view])} for view in views},
            "pairing": [list(pair) for pair in pairs],
            "initial_elevation": {"dem": str(scene.terrain), "geoid": str(write_no_geoid(out / "geoid.tif"))},
        },
        "output": recommended["output"]
        | {"directory": str(out / "cars"), "resolution": RESOLUTION_M, "epsg": CRS(scene.crs).to_epsg()},
        "subsampling": {"advanced": {"resolutions": recommended["resolutions"][size_class(scene)]}},
        "tie_points": {"applications": {"all": {"sparse_matching": {"disparity_bounds_estimation": margins}}}},
        "surface_modeling": {"applications": {"all": matching}},
    }


def size_class(scene: Scene) -> str:
    """`small` or `large`, by the shortest side of all images."""
    sides = []
    for path in scene.images.values():
        with rasterio.open(path) as file:
            sides.append(min(file.shape))
    return "small" if min(sides) < SMALL_PX else "large"


def write_no_geoid(path: Path) -> Path:
    """Write a geoid of zero undulation: the terrain model is above the ellipsoid, and CARS would add its own geoid."""
    with rasterio.open(
        path, "w", driver="GTiff", height=181, width=361, count=1, dtype="float32", crs="EPSG:4326",
        transform=from_origin(-180.5, 90.5, 1.0, 1.0),
    ) as file:  # fmt: skip
        file.write(np.zeros((181, 361), np.float32), 1)
    return path
