"""Where a grid lies, in its CRS and in degrees, and how much of it two images see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import CRS, Transformer

from zlocus.core.footprints import Bounds, shared_area
from zlocus.core.grid import Grid
from zlocus.core.height_range import HeightRange
from zlocus.core.scene import Scene, is_local
from zlocus.orientation.orientation import Orientation
from zlocus.pipeline.setup import RunSetup
from zlocus.pipeline.tile_run import Polygons

# Shares of an area above this are not worth a sentence.
NEARLY_ALL = 0.995


@dataclass(frozen=True)
class Extent:
    """Where a grid lies.

    crs : of the grid; bounds : (xmin, ymin, xmax, ymax) m, as --bounds takes them; degrees : the same as longitudes and
    latitudes of WGS 84, None in a local frame.
    """

    crs: CRS
    bounds: Bounds
    degrees: Bounds | None

    @classmethod
    def of(cls, grid: Grid, crs: CRS) -> Extent:
        """The extent of a grid."""
        bounds: Bounds = grid.geobox.boundingbox.bbox
        if is_local(crs):
            return cls(crs, bounds, None)
        degrees = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform_bounds(*bounds)
        return cls(crs, bounds, degrees)

    @property
    def crs_text(self) -> str:
        """Name of the CRS, with its code where it has one."""
        return crs_text(self.crs)

    def as_dict(self) -> dict[str, Any]:
        """For programs."""
        return {
            "bounds": [round(value, 3) for value in self.bounds],
            "bounds_degrees": None if self.degrees is None else [round(value, 7) for value in self.degrees],
        }

    def __str__(self) -> str:
        listed = " ".join(f"{value:.2f}" for value in self.bounds)
        if self.degrees is None:
            return f"bounds {listed} (xmin ymin xmax ymax, m of the local frame)"
        west, south, east, north = self.degrees
        return (
            f"bounds {listed} (xmin ymin xmax ymax, m), in degrees of WGS 84 longitude {west:.6f} to {east:.6f}, "
            f"latitude {south:.6f} to {north:.6f}"
        )


def crs_text(crs: CRS) -> str:
    """Name of a CRS, with its code where it has one: EPSG:32631 (WGS 84 / UTM zone 31N)."""
    authority = None if is_local(crs) else crs.to_authority()
    return str(crs.name) if authority is None else f"{':'.join(authority)} ({crs.name})"


def above(crs: CRS) -> str:
    """What heights of a search are above, as words that follow a height."""
    return "of the local frame" if is_local(crs) else "above the ellipsoid"


def seen_share(scene: Scene, z: float, area: Any) -> float:
    """Share of an area, a shapely geometry, that two images or more see where the ground has a height z (m)."""
    return round(float(area.intersection(shared_area(scene, z)).area / area.area), 6) if area.area > 0 else 1.0


def seen_share_of_run(setup: RunSetup, polygons: Polygons, has_bounds: bool) -> float | None:
    """Share of the area that a run asks for that two images see; None where none is asked for, and in a local frame.

    polygons : of --area and --mask; has_bounds : whether the request names bounds or a grid.
    """
    from shapely import union_all

    is_asked = has_bounds or polygons.inside is not None or setup.scene.bounds is not None
    if not is_asked or is_local(setup.scene.crs):
        return None
    area = area_of(setup.grid)
    if polygons.inside is not None:
        area = area.intersection(union_all(polygons.inside))
    if polygons.outside is not None:
        area = area.difference(union_all(polygons.outside))
    return seen_share(setup.scene, ground_height(setup.orientation, setup.height_range), area)


def ground_height(orientation: Orientation, height_range: HeightRange) -> float:
    """A height of the ground, m: the median of the tie points, or else the middle of the heights expected."""
    z = orientation.refined_xyz[:, 2]
    return float(np.median(z)) if len(z) else height_range.middle


def area_of(grid: Grid) -> Any:
    """The rectangle of a grid, as a shapely geometry."""
    from shapely import box

    return box(*grid.geobox.boundingbox.bbox)


def seen_sentence(share: float | None, about: str = "") -> str:
    """How much of the area asked for two images see, as a sentence; "" where it is nearly all, or not known.

    about : "about " where the share is estimated.
    """
    if share is None or share >= NEARLY_ALL:
        return ""
    percent = f"{about}{100 * share:.0f} %"
    return f"Two images or more see {percent} of the area asked for; no height can be found in the rest of it."
