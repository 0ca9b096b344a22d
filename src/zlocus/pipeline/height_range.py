"""The height range that a run searches: as requested, around a terrain model, or found from the tie points.

`height_range_of_run` decides, in this order: `--heights` or the heights of the scene file; `--dem`, extended by
`pyramid.dem_down_m` and `pyramid.dem_up_m`; else the tie points: nearly all of their heights, with the margins
`orientation.range_margin`, `range_up_m` and `range_down_m`, are where the surface is expected, and `search_up_m` and
`search_down_m` beyond them are searched too, but not for single cells and not in image space
(`zlocus.orientation.tie_heights.height_range_of_ties`). A range never reaches up to the lowest camera.

Two more modules limit heights. Before tie points are known, `possible_heights` says at which heights views are compared
at all; where the cameras do not tell, a run needs `--heights`, also with `--dem`. And with `--dem` every cell of the
coarsest level is limited to the surroundings of the DEM (`zlocus.pipeline.setup.limited_by_dem`). Below that, each
block has a search range of its own (`zlocus.matching.search_range`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from zlocus.core.errors import GeometryError
from zlocus.core.footprints import footprint, is_shared, shared_ground
from zlocus.core.grid import grid_from_bounds
from zlocus.core.height_range import HeightRange
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import SetupRequest
from zlocus.core.scene import Scene, View, is_local
from zlocus.core.sensor_model import capped, lowest_station
from zlocus.io.grid_inputs import dem_datum, read_dem
from zlocus.io.vertical import VerticalDatum
from zlocus.matching.ground_pixels import median_ground_pixel
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.tie_heights import height_range_of_ties

N_POSSIBLE_HEIGHTS = 5
# Land on Earth lies between these heights above the ellipsoid.
LOWEST_LAND_M, HIGHEST_LAND_M = -500.0, 9000.0
# Depths below the lowest camera at which footprints are compared: the smallest, and how many in equal ratios.
SMALLEST_DEPTH_M, N_DEPTHS = 2.0, 49
# Nothing is searched nearer to the lowest camera than this share of the depth of the lowest ground below it. Where
# heights are requested the share is smaller: a little more than projection tables need.
CLEARANCE_FOUND, CLEARANCE_REQUESTED = 0.25, 0.125


def height_range_of_run(
    request: SetupRequest, scene: Scene, orientation: Orientation, config: RunConfig, progress: Progress
) -> HeightRange:
    """Heights at which the surface is expected and those that are searched, ellipsoidal, m.

    scene : views that take part, with corrected cameras, and the heights requested.

    Raises
    ------
    GeometryError
        The DEM has no heights where the images overlap, or tie points tell no range.
    """
    if scene.heights:
        return HeightRange.limited_to(range_below_cameras(scene, scene.heights, progress))
    if request.dem is None:
        found = range_from_ties(scene, orientation, config.orientation)
        # Without evidence nothing tells a clear agreement from one by chance.
        return found if request.method == "mvll-sgm" else HeightRange.limited_to(found.expected)
    z = possible_heights(scene, None)
    bounds = shared_ground(scene, (z[0], z[-1]))
    cell = median_ground_pixel(scene, sum(z) / len(z)) * 16
    geobox = grid_from_bounds(bounds, cell, scene.crs).geobox
    heights = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical))
    if not np.isfinite(heights).any():
        raise GeometryError(f"{request.dem} has no heights where the images overlap. Give one that covers them.")
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    low, high = low - config.pyramid.dem_down_m, high + config.pyramid.dem_up_m
    around = range_below_cameras(scene, (low, high), progress, f"The heights around {request.dem}")
    return HeightRange.limited_to(around)


def range_from_ties(scene: Scene, orientation: Orientation, options: OrientationOptions) -> HeightRange:
    """Height range (m) of the tie points with its margins, cut below the lowest camera."""
    station = lowest_station(view.sensor for view in scene.views)
    names = [view.name for view in orientation.views]
    found = height_range_of_ties(orientation.xyz, orientation.sigma_z_m, names, options, station)
    expected, searched = (capped(heights, station, CLEARANCE_FOUND) for heights in (found.expected, found.searched))
    return HeightRange(expected, searched)


def range_below_cameras(
    scene: Scene, heights: tuple[float, float], progress: Progress, name: str = "The heights asked for"
) -> tuple[float, float]:
    """A requested height range (m), cut below the lowest camera; a note says so. name : of the range, for the note."""
    station = lowest_station(view.sensor for view in scene.views)
    searched = capped(heights, station, CLEARANCE_REQUESTED)
    if searched != heights:
        progress.note(
            f"{name}, {heights[0]:g} to {heights[1]:g} m, reach the lowest camera, which is {station:.1f} m high: "
            f"{searched[0]:g} to {searched[1]:.1f} m are searched."
        )
    return searched


def possible_heights(scene: Scene, heights: tuple[float, float] | None) -> list[float]:
    """Heights (m) at which the scene may have ground, lowest first, for a first comparison of footprints.

    heights : range that was requested, None where none was.

    Raises
    ------
    GeometryError
        Neither the request nor the cameras tell.
    """
    if heights is not None:
        return [float(z) for z in np.linspace(*heights, N_POSSIBLE_HEIGHTS)]
    bounds = [b for view in scene.views if (b := view.sensor.height_bounds()) is not None]
    if not bounds:
        return [float(z) for z in np.linspace(*heights_below_cameras(scene), N_POSSIBLE_HEIGHTS)]
    low, high = max(b[0] for b in bounds), min(b[1] for b in bounds)
    return [float(z) for z in np.linspace(low, max(high, low), N_POSSIBLE_HEIGHTS)]


def with_heights(
    scene: Scene,
    heights: tuple[float, float] | None,
    vertical_datum: VerticalDatum,
    bounds: Sequence[float] | None = None,
) -> Scene:
    """The scene with the requested height range, converted to ellipsoidal heights; unchanged where none is requested.

    heights : (zmin, zmax) m above `vertical_datum`. The ellipsoidal range holds them wherever two views see the same
    ground in `bounds` (None: in the area that the scene file gives, if any).

    Raises
    ------
    GeometryError
        The frame is local, where a geoid has no meaning.
    """
    if vertical_datum.geoid is not None and is_local(scene.crs):
        raise GeometryError(
            f"The scene's frame is local, where no place is above {vertical_datum.surface_name}. Leave --vertical out."
        )
    if heights is None or vertical_datum.geoid is None:
        return scene if heights is None else replace(scene, heights=heights)
    area = shared_ground(scene, heights)
    if inside := bounds or scene.bounds:
        west, south = max(area[0], inside[0]), max(area[1], inside[1])
        east, north = min(area[2], inside[2]), min(area[3], inside[3])
        area = (west, south, east, north) if west < east and south < north else area
    low, high = vertical_datum.undulation_range(area, scene.crs)
    return replace(scene, heights=(heights[0] + low, heights[1] + high))


def heights_below_cameras(scene: Scene) -> tuple[float, float]:
    """Lowest and highest height (m) at which two views see the same ground, for cameras with known positions.

    A camera that looks down sees nothing above itself, and close below itself it sees too little to share with another
    view. So the ground ends well below the lowest camera. How deep the ground lies is unknown; the lowest land is
    known.

    Raises
    ------
    GeometryError
        A camera has no known position or sees as high as itself, or no two views see the same ground.
    """
    lowest = lowest_station(view.sensor for view in scene.views)
    advice = "give the range of heights that holds the ground: --heights ZMIN ZMAX, or heights: in the scene file"
    if lowest is None or any(_sees_as_high_as_itself(view) for view in scene.views):
        raise GeometryError(f"The cameras do not say at which heights the ground may be; {advice}.")
    deepest = max(lowest - LOWEST_LAND_M, 2 * SMALLEST_DEPTH_M)
    depths = np.geomspace(deepest, SMALLEST_DEPTH_M, N_DEPTHS)
    shared = [z for depth in depths if is_shared(scene, z := float(lowest - depth))]
    if not shared:
        raise GeometryError(
            f"No two images see the same ground anywhere below the lowest camera, which is {lowest:.0f} m high. "
            f"Check the positions and angles of the cameras; if they are right, {advice}."
        )
    return shared[0], min(shared[-1], HIGHEST_LAND_M)


def _sees_as_high_as_itself(view: View) -> bool:
    """Whether some ray at the image's border does not go down."""
    height = lowest_station([view.sensor])
    assert height is not None, "callers make sure"
    return len(footprint(view, height + 1.0)) > 0
