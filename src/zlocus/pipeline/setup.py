"""What is settled before the first tile of a surface: scene, cameras, heights, grid and lattice.

A run does it once; who looks at its surface afterwards does the same again with the ties that the run kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import GeometryError
from zlocus.core.grid import Grid, grid_from_bounds, grid_from_geobox
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import DsmRequest
from zlocus.core.scene import Scene, check_overlap, is_local
from zlocus.io.grid_inputs import dem_datum, read_dem, read_geobox
from zlocus.io.input_files import files_of
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import VerticalDatum, vertical_datum
from zlocus.matching.ground_pixels import check_resolution, default_cell, median_ground_pixel
from zlocus.matching.match_scene import MatchScene, settle, shared_ground
from zlocus.orientation.orientation import Orientation, supported
from zlocus.orientation.plausibility import Doubt
from zlocus.pipeline.preparing import (
    area_to_match,
    asked_crs,
    heights_asked_for,
    heights_of_ties,
    note_dem,
    note_doubts,
    possible_heights,
    taking_part,
    with_heights,
)

# Tie points that it takes to doubt a DEM, or the cameras.
FEWEST_TO_COMPARE = 20


@dataclass(frozen=True)
class Opened:
    """What a request names. like : grid of --like; files : whose content the result depends on."""

    scene: Scene
    vertical: VerticalDatum
    like: GeoBox | None
    files: list[Path]


@dataclass(frozen=True)
class Settled:
    """What all tiles share. scene : with corrected cameras; z_range : heights searched, m; matching : what a tile is
    matched with; doubts : about the cameras."""

    scene: Scene
    orientation: Orientation
    z_range: tuple[float, float]
    grid: Grid
    matching: MatchScene
    doubts: tuple[Doubt, ...] = ()


def opened(request: DsmRequest, progress: Progress) -> Opened:
    """Everything that a request names, open, but for its polygons."""
    like, vertical = read_geobox(request.like) if request.like else None, vertical_datum(request.vertical)
    scene = _scene(request, like, vertical)
    note_dem(request.dem, request.dem_vertical, progress)
    return Opened(scene, vertical, like, _files(request, scene, vertical))


def settled_run(
    request: DsmRequest, found: Opened, orientation: Orientation, config: RunConfig, progress: Progress
) -> Settled:
    """Heights, grid and lattice of a scene whose orientation is known."""
    corrected = orientation.apply(found.scene)
    scene = taking_part(corrected, orientation)
    z_range = _searched_heights(request, scene, orientation, config, progress)
    grid = _grid(request, found.like, scene, orientation, z_range)
    matching = settle(
        scene, grid.cell_m, grid.anchor, z_range, orientation.xyz, request.reference, config.pyramid,
        orientation.measured,
    )  # fmt: skip
    far = () if request.dem is None else ties_far_from_dem(request, scene, orientation, config)
    note_doubts(far, progress)
    matching = _with_dem(request, matching, scene.crs, config)
    return Settled(corrected, orientation, z_range, grid, matching, (*orientation.doubts, *far))


def _scene(request: DsmRequest, like: GeoBox | None, vertical: VerticalDatum) -> Scene:
    """The scene, its views by name, so that the order of the inputs changes nothing, with the heights asked for."""
    crs = asked_crs(request.crs) if like is None else CRS.from_wkt(like.crs.to_wkt())  # type: ignore[union-attr]
    scene = open_scene(request.inputs, crs)
    if is_local(scene.crs):
        _check_local(request)
    bounds = request.bounds if like is None else like.boundingbox.bbox
    scene = with_heights(scene, request.heights, vertical, bounds)
    check_overlap(scene, possible_heights(scene, scene.heights))
    return replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))


def _check_local(request: DsmRequest) -> None:
    """Refuse what has a place on the Earth, in a local frame."""
    for name in ("dem", "area", "mask"):
        if path := getattr(request, name):
            raise GeometryError(
                f"The scene's frame is local, where {path} has no place. Leave --{name} out; --bounds and --heights "
                "are in that frame."
            )


def _searched_heights(
    request: DsmRequest, scene: Scene, orientation: Orientation, config: RunConfig, progress: Progress
) -> tuple[float, float]:
    """Height range of the search: as asked for, else from the DEM, else from the ties."""
    if scene.heights:
        return heights_asked_for(scene, scene.heights, progress)
    if request.dem is None:
        return heights_of_ties(scene, orientation, config.orientation)
    z = possible_heights(scene, None)
    bounds = shared_ground(scene, (z[0], z[-1]))
    cell = median_ground_pixel(scene, sum(z) / len(z)) * 16
    geobox = grid_from_bounds(bounds, cell, scene.crs).geobox
    heights = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical))
    if not np.isfinite(heights).any():
        raise GeometryError(f"{request.dem} has no heights where the images overlap. Give one that covers them.")
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    low, high = low - config.pyramid.dem_down_m, high + config.pyramid.dem_up_m
    return heights_asked_for(scene, (low, high), progress, f"The heights around {request.dem}")


def _with_dem(request: DsmRequest, settled: MatchScene, crs: CRS, config: RunConfig) -> MatchScene:
    """Limits from the DEM for the coarsest level."""
    if request.dem is None:
        return settled
    level = settled.levels - 1
    window = settled.seen.at_level(level, 0)
    geobox = GeoBox((window.rows, window.cols), settled.transform(window, level), crs)
    dem = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical))
    limits = np.stack([dem - config.pyramid.dem_down_m, dem + config.pyramid.dem_up_m]).astype(np.float32)
    return replace(settled, prior=limits)


def ties_far_from_dem(
    request: DsmRequest, scene: Scene, orientation: Orientation, config: RunConfig
) -> tuple[Doubt, ...]:
    """A doubt where the tie points lie farther from the DEM than is searched around it."""
    assert request.dem is not None, "callers make sure"
    xyz = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    if len(xyz) < FEWEST_TO_COMPARE:
        return ()
    (west, south), (east, north) = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    cell = median_ground_pixel(scene, float(np.median(xyz[:, 2]))) * 16
    geobox = grid_from_bounds((west - cell, south - cell, east + cell, north + cell), cell, scene.crs).geobox
    heights = read_dem(request.dem, geobox, dem_datum(request.dem, request.dem_vertical), may_miss=True)
    col, row = ~geobox.transform * (xyz[:, 0], xyz[:, 1])
    above = xyz[:, 2] - heights[np.floor(row).astype(int), np.floor(col).astype(int)]
    above = above[np.isfinite(above)]
    if not len(above) or -config.pyramid.dem_down_m <= np.median(above) <= config.pyramid.dem_up_m:
        return ()
    return (
        Doubt(
            f"The tie points lie {np.median(above):+.0f} m from {request.dem} (median), beyond what is searched around "
            "it. Check the cameras, and with --dem-vertical what the heights of the DEM are above.",
            is_grave=True,
        ),
    )


def _grid(
    request: DsmRequest, like: GeoBox | None, scene: Scene, orientation: Orientation, z_range: tuple[float, float]
) -> Grid:
    """The grid asked for: another raster's, or the area at a resolution, both with defaults."""
    z = (z_range[0] + z_range[1]) / 2
    if like is not None:
        grid = grid_from_geobox(like, str(request.like))
        check_resolution(grid.cell_m, scene, z, f"--like {request.like}: its cell of")
        return grid
    cell = request.resolution or default_cell(scene, z)
    check_resolution(cell, scene, z, "--resolution")
    bounds = request.bounds or area_to_match(scene, orientation, z_range)
    return grid_from_bounds(bounds, cell, scene.crs)


def _files(request: DsmRequest, scene: Scene, vertical: VerticalDatum) -> list[Path]:
    """Every file whose content the result depends on."""
    extra = [path for path in (request.like, request.dem, request.area, request.mask) if path is not None]
    extra += vertical.files
    if request.dem is not None:
        extra += dem_datum(request.dem, request.dem_vertical).files
    listed = list(request.inputs) + files_of(scene) + extra
    return list(dict.fromkeys(listed))
