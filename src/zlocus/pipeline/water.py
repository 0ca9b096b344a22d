"""What a run says of water surfaces: polygons beside the grid, those that keep their heights, doubtful levels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from odc.geo.geobox import GeoBox

from zlocus.core.errors import InputError
from zlocus.core.progress import Progress
from zlocus.core.requests import DsmRequest
from zlocus.io.water_polygons import WaterPolygons
from zlocus.products.water import WaterFound, without_cells

# A message names at most this many water surfaces.
MAX_NAMED = 3
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
        progress.note(f"{_named(beside).capitalize()} of {water_polygons.path} {lies} no effect.")
    return water_polygons.only(np.isin(water_polygons.names, beside, invert=True))


def note_water(water_found: WaterFound, request: DsmRequest, progress: Progress) -> None:
    """Say which water surfaces were levelled, which keep their heights, and which levels are uncertain."""
    if water_found.levelled_surfaces:
        said = [f"{each.name} at {each.level.height_m:.2f} m" for each in water_found.levelled_surfaces]
        progress.note(f"Water levelled: {_named(said)}.")
    if water_found.left:
        progress.note(
            f"Too few heights at the shore tell the level of {_named(water_found.left)}, and the matched heights stay "
            "there. Give levels by --water-level."
        )
    uncertain = [
        f"{each.name} (by {each.level.sigma_m:.1f} m)"
        for each in water_found.levelled_surfaces
        if each.level.sigma_m > UNCERTAIN_M  # NaN where it was given
    ]
    if uncertain:
        progress.note(
            f"The ground rises steeply from the water, whose level may be too high: {_named(uncertain)}. Give the "
            "level by --water-level where it is known."
        )
    if water_found.n_possible and not request.level_water:
        progress.note(
            f"Possible water in {water_found.n_possible} area{'s' if water_found.n_possible > 1 else ''} (3 in "
            "water.tif): the images agree at no height there. --water or --level-water levels it."
        )


def _named(names: Sequence[str]) -> str:
    """Names in a sentence, the first few of many."""
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return f"{', '.join(names[:MAX_NAMED])}{more}"
