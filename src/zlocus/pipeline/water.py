"""What a run says of water surfaces: polygons beside the grid, those that keep their heights, doubtful levels."""

from __future__ import annotations

import numpy as np
import shapely
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.height_range import HeightRange
from zlocus.core.progress import Progress
from zlocus.core.quoting import first_names
from zlocus.core.requests import DsmRequest
from zlocus.io.vertical import VerticalDatum
from zlocus.io.water_polygons import WaterPolygons
from zlocus.products.water import WaterFound, without_cells

# A message names at most this many water surfaces.
MAX_NAMED = 3
# A given level is refused where it is further outside the searched heights than these are wide, at least this, m.
MIN_MARGIN_M = 50.0
# A level is said to be uncertain where its standard deviation is larger, m.
UNCERTAIN_M = 0.25


def water_on_grid(water_polygons: WaterPolygons, geobox: GeoBox, progress: Progress) -> WaterPolygons:
    """The water polygons that hold a cell of the grid; the others are said.

    Raises
    ------
    InputError
        None of them does.
    """
    beside = without_cells(water_polygons, geobox)
    if len(beside) == len(water_polygons.names):
        xmin, ymin, xmax, ymax = geobox.boundingbox.bbox
        raise InputError(
            f"No water polygon of {water_polygons.path} holds a cell of the grid (E {xmin:.0f} to {xmax:.0f} m, N "
            f"{ymin:.0f} to {ymax:.0f} m). Check the polygons and their CRS."
        )
    if beside:
        lies = "lies outside the grid and has" if len(beside) == 1 else "lie outside the grid and have"
        progress.note(f"{first_names(beside, MAX_NAMED).capitalize()} of {water_polygons.path} {lies} no effect.")
    return water_polygons.only(np.isin(water_polygons.names, beside, invert=True))


def far_levels(
    water_polygons: WaterPolygons, height_range: HeightRange, crs: CRS, vertical_datum: VerticalDatum
) -> list[str]:  # fmt: skip
    """Sentences about the given levels that are outside the searched heights of a run.

    water_polygons : those on the grid; height_range : ellipsoidal; crs : of the grid; vertical_datum : of the levels.

    Raises
    ------
    InputError
        A level is further outside than the searched heights are wide, which no ground beside the water can explain.
    """
    levels = water_polygons.levels_m
    if not np.isfinite(levels).any():
        return []
    xy = shapely.get_coordinates(shapely.point_on_surface(water_polygons.polygons))
    low, high = (z - vertical_datum.undulation(xy, crs) for z in height_range.searched)
    margin, sentences = np.maximum(high - low, MIN_MARGIN_M), list[str]()
    for k in np.flatnonzero((levels < low) | (levels > high)):
        said = (
            f"The level {levels[k]:.2f} m of {water_polygons.names[k]} in {water_polygons.path} is outside the heights "
            f"where the ground is looked for, {low[k]:.1f} to {high[k]:.1f} m"
        )
        if not low[k] - margin[k] <= levels[k] <= high[k] + margin[k]:
            raise InputError(f"{said}. Correct the level, or name its vertical datum by --vertical.")
        sentences.append(f"{said}. Check the level and its vertical datum (--vertical).")
    return sentences


def note_water(water_found: WaterFound, request: DsmRequest, progress: Progress) -> None:
    """Say which water surfaces were levelled, which keep their heights, and which levels are doubtful."""
    levelled = water_found.levelled_surfaces
    if levelled:
        said = [f"{each.name} at {each.level.height_m:.2f} m" for each in levelled]
        progress.note(f"Water levelled: {first_names(said, MAX_NAMED)}.")
    water_found.doubts += _doubts(water_found, request)
    for sentence in water_found.doubts:
        progress.note(sentence)
    if water_found.n_possible and not request.level_water:
        progress.note(
            f"Possible water in {water_found.n_possible} area{'s' if water_found.n_possible > 1 else ''} (3 in "
            "water.tif): the images agree at no height there. --water or --level-water levels it."
        )


def _doubts(water_found: WaterFound, request: DsmRequest) -> list[str]:
    """Sentences about water surfaces without a level, and about levels that the images tell badly."""
    doubts = []
    if request.level_water and not water_found.n_possible:
        doubts.append(
            "--level-water levels nothing: no area looks like water, dark, flat at its rim and without matches."
        )
    if water_found.left:
        doubts.append(
            f"Too few heights at the shore tell the level of {first_names(water_found.left, MAX_NAMED)}, and the "
            "matched heights stay there. Give levels by --water-level."
        )
    found = [each for each in water_found.levelled_surfaces if each.level.sigma_m > UNCERTAIN_M]  # NaN where given
    steep = [f"{each.name} (by {each.level.sigma_m:.1f} m)" for each in found if each.level.source != "inside"]
    if steep:
        doubts.append(
            f"The ground rises steeply from the water, whose level may be too high: {first_names(steep, MAX_NAMED)}. "
            "Give the level by --water-level where it is known."
        )
    land = [
        f"{each.name} (over {100 * each.level.inside_share:.0f} %, with a relief of {each.level.sigma_m:.1f} m)"
        for each in found
        if each.level.source == "inside"
    ]
    if land:
        doubts.append(
            f"Matched like land, which water is not: {first_names(land, MAX_NAMED)}. Its median became the "
            "level; check the polygons and their CRS."
        )
    return doubts
