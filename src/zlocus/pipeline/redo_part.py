"""A part of a finished surface that is to be redone, opened and checked, without the images."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS

from zlocus.core.errors import GeometryError, InputError, OutputError
from zlocus.core.height_range import HeightRange
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.redo_request import RedoRequest
from zlocus.core.requests import DsmRequest
from zlocus.io.break_lines import GivenLines, read_break_lines
from zlocus.io.grid_inputs import read_polygons
from zlocus.io.row_strips import strips_of
from zlocus.io.run_record import inputs_record, read_record, versions_record
from zlocus.io.vertical import VerticalDatum, grid_crs, named_vertical_datum
from zlocus.io.water_polygons import files_of_water, read_water
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.fingerprint import kernels_of_package
from zlocus.pipeline.finished_record import ITEM, Finished, read_finished
from zlocus.pipeline.finished_run import files_gone
from zlocus.pipeline.redo_options import differing, redo_config, redo_request
from zlocus.pipeline.water import far_levels
from zlocus.products.metadata import METADATA
from zlocus.products.raster_cells import SurfaceReader
from zlocus.products.redone_area import RAMP_CELLS, RedoneArea
from zlocus.products.report.file_names import RECORD, REPORT


@dataclass(frozen=True)
class RedonePart:
    """A part of a finished surface that is to be redone.

    request : of the part; dsm_request, config : with which it is matched; run, finished : records of the surface;
    geobox : of the surface; redone_area : on it; vertical_datum : of its heights; level_polygons, levels_m : polygons
    (n,) with --level, and their levels; given_lines : break lines; files : area and break lines, with their checksums.
    """

    request: RedoRequest
    dsm_request: DsmRequest
    config: RunConfig
    run: dict[str, Any]
    finished: Finished
    geobox: GeoBox
    redone_area: RedoneArea
    vertical_datum: VerticalDatum
    level_polygons: NDArray[Any] | None = None
    levels_m: NDArray[np.float64] | None = None
    given_lines: GivenLines | None = None
    files: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    @property
    def crs(self) -> CRS:
        """The CRS of the grid."""
        return grid_crs(self.geobox)

    @property
    def margin_m(self) -> float | None:
        """Width of the ramp; None where there is none."""
        if self.levels_m is not None:
            return None
        return RAMP_CELLS * float(self.geobox.transform.a) if self.request.margin_m is None else self.request.margin_m

    @property
    def key(self) -> dict[str, Any]:
        """Everything that the part depends on, beside the surface."""
        return {
            **self.files, "level": self.request.level, "margin_m": self.request.margin_m,
            "options": differing(self.dsm_request, self.config, self.run), "versions": versions_record(),
            "kernels": kernels_of_package(),
        }  # fmt: skip

    @property
    def digest(self) -> str:
        """SHA-256 of the key."""
        return hashlib.sha256(json.dumps(self.key, sort_keys=True, default=str).encode()).hexdigest()


def opened_part(request: RedoRequest, progress: Progress) -> RedonePart:
    """Open the finished run and everything that is given, except images."""
    out = request.dsm_request.out
    finished = read_finished(out)
    if finished is None or not finished.key or not (out / RECORD).is_file():
        raise OutputError(
            f"{out} holds no finished surface, and --redo changes a part of one. Give the same command without --redo "
            "first."
        )
    TileCheckpoint.check_free(out)
    if gone := files_gone(out, finished, progress) - {REPORT, ITEM, METADATA}:
        raise OutputError(
            f"{out} lacks {', '.join(sorted(gone))} of its run. Give the command of the run again, without --redo, and "
            "then this one."
        )
    run = read_record(out / RECORD)
    dsm_request, config = redo_request(request, run), redo_config(request, run)
    with SurfaceReader(out) as reader:
        geobox = reader.geobox
    vertical_datum, crs = named_vertical_datum(dsm_request.vertical), grid_crs(geobox)
    level_polygons, levels = _levels(request, run, crs, vertical_datum, progress)
    polygons = read_polygons(request.area, crs) if level_polygons is None else level_polygons
    redone_area = RedoneArea.of(polygons, geobox, request.margin_m)
    rows, cols = geobox.shape
    if not any(redone_area.has_cells(strip.row, 0, (strip.rows, cols)) for strip in strips_of(rows)):
        xmin, ymin, xmax, ymax = geobox.boundingbox.bbox
        raise GeometryError(
            f"No polygon of {request.area} holds a cell of the surface in {out} (E {xmin:.0f} to {xmax:.0f} m, N "
            f"{ymin:.0f} to {ymax:.0f} m). Check the polygons and their CRS."
        )
    given_lines = None
    if request.break_lines is not None:
        given_lines = read_break_lines(request.break_lines, crs, float(geobox.transform.a))
        _check_lines(given_lines, redone_area)
    files = {"area": inputs_record(files_of_water(request.area))}
    if request.break_lines is not None:
        files["break_lines"] = inputs_record(files_of_water(request.break_lines))
    return RedonePart(
        request, dsm_request, config, run, finished, geobox, redone_area, vertical_datum, level_polygons, levels,
        given_lines, files,
    )  # fmt: skip


def _levels(
    request: RedoRequest, run: Mapping[str, Any], crs: CRS, vertical_datum: VerticalDatum, progress: Progress
) -> tuple[NDArray[Any] | None, NDArray[np.float64] | None]:
    """Polygons (n,) of --redo and their levels (n,) m; None where no level is given."""
    if request.level is None:
        return None, None
    found = read_water(request.area, crs, request.level_field)
    if request.level_m is not None:
        found = replace(found, levels_m=np.full(len(found.polygons), request.level_m))
    if without := [name for name, level in zip(found.names, found.levels_m, strict=True) if np.isnan(level)]:
        raise InputError(
            f"{without[0].capitalize()} of {request.area} has no level in {request.level_field}. Fill it in, or take "
            "the polygon out."
        )
    searched = run["heights"]["searched_m"]
    height_range = HeightRange.limited_to((float(searched[0]), float(searched[1])))
    for sentence in far_levels(found, height_range, crs, vertical_datum):
        progress.note(sentence)
    return found.polygons, found.levels_m


def _check_lines(given_lines: GivenLines, redone_area: RedoneArea) -> None:
    """Refuse break lines that do not meet the area."""
    points = shapely.points(given_lines.held[:, :2])
    segments = shapely.linestrings(given_lines.jumps)
    union = shapely.union_all(redone_area.polygons)
    shapely.prepare(union)
    if not (shapely.intersects(union, points).any() or shapely.intersects(union, segments).any()):
        raise GeometryError(
            f"No line of {given_lines.path} meets the area that is redone. Check the lines and their CRS."
        )
