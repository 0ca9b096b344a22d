"""`zlocus change`: the difference of two surfaces, its significance, and volumes inside polygons."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from affine import Affine
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from rasterio.windows import Window
from scipy.stats import norm

from zlocus.core.command_outcome import CommandOutcome
from zlocus.core.errors import InputError, OutputError
from zlocus.core.grid import CellWindow
from zlocus.core.progress import Progress
from zlocus.core.requests import check_output
from zlocus.core.sensor_model import FloatArray
from zlocus.core.surface_requests import CHANGE_FILES, ChangeRequest
from zlocus.evaluation.change_noise import ChangeNoise, StableWindow, change_noise
from zlocus.evaluation.volumes import ChangeCells, ChangeClass, Volume, volume_of
from zlocus.io.grid_inputs import PolygonFeatures, cells_inside, read_features
from zlocus.io.open_raster import open_raster
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.io.run_record import Stopwatch, inputs_record, request_as_dict, utc_now, versions_record, write_record
from zlocus.io.surface_cells import PlacedSurface, SurfaceCells, read_cells
from zlocus.io.surface_inputs import (
    ORTHO,
    QUALITY,
    VIEWS,
    WATER,
    SurfaceInput,
    check_joinable,
    check_not_inputs,
    converted_datums,
    stating_datum,
    surface_input,
)
from zlocus.matching.quality import Quality
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.surface_workers import blocks_of
from zlocus.products.change_tables import write_change_picture, write_volumes
from zlocus.products.other_styles import write_other_styles

COMMAND = "zlocus change"
RECORD, DIFFERENCE, SIGMAS, SIGNIFICANCE, CLASSES, TABLE, LAYER, PICTURE = CHANGE_FILES
# Windows in which unchanged ground is looked at: side in cells, and most of them.
SAMPLE_CELLS, MAX_WINDOWS = 128, 100
# Cells of unchanged ground below which its errors cannot be told.
MIN_STABLE_CELLS = 1000
# Cells beside a polygon that do not count as unchanged.
RIM_CELLS = 3
NMAD = 1.4826


@dataclass(frozen=True)
class _Pair:
    """Both surfaces on the common grid, and where ground is unchanged.

    placed : earlier and later surface; changed, stable : polygons, None where none are given; extra_sigma_m : error
    that is added to what the surfaces state, for one that states none.
    """

    placed: tuple[PlacedSurface, PlacedSurface]
    changed: NDArray[np.object_] | None
    stable: NDArray[np.object_] | None
    extra_sigma_m: float = 0.0

    @property
    def geobox(self) -> GeoBox:
        return self.placed[0].geobox

    @property
    def is_known(self) -> bool:
        """Whether it is known which ground has not changed."""
        return self.changed is not None or self.stable is not None

    def differences(self, window: CellWindow) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Differences and their stated standard deviations (r, c) m, NaN where a height is missing or interpolated,
        and heights of the first surface."""
        first, second = (read_cells(each, window) for each in self.placed)
        heights = [_measured(each) for each in (first, second)]
        difference = heights[1] - heights[0]
        squares = np.full(difference.shape, self.extra_sigma_m**2)
        for cells, placed in zip((first, second), self.placed, strict=True):
            if placed.source.has_sigma:
                sigma = cells.sigma.astype(np.float64)
                known = np.isfinite(sigma)
                usual = float(np.median(sigma[known])) if known.any() else 0.0
                squares += np.where(known, sigma, usual) ** 2
        sigma = np.sqrt(squares)
        return difference, np.where(sigma > 0, sigma, 1.0), heights[0]

    def stable_window(self, window: CellWindow) -> StableWindow:
        """Differences of a window on unchanged ground."""
        difference, sigma, height = self.differences(window)
        box = _part(self.geobox, window)
        if self.stable is not None:
            difference = np.where(cells_inside(self.stable, box), difference, np.nan)
        if self.changed is not None:
            difference = np.where(cells_inside(self.changed, box), np.nan, difference)
        down, across = np.gradient(height, abs(float(box.transform.a)))
        return StableWindow(window.row, window.col, difference, sigma, np.stack([across, -down], axis=-1))


def run_change(request: ChangeRequest, progress: Progress) -> CommandOutcome:
    """Subtract two surfaces, and write the results into the folder of the request.

    Raises
    ------
    InputError, ConfigError
        A surface or polygons cannot be read, the surfaces do not overlap, or too little ground is unchanged.
    OutputError
        The folder holds another result, or a file cannot be written.
    """
    stopwatch = Stopwatch()
    with stopwatch.stage("inputs"), progress.stage("Opening surfaces"):
        surfaces = surface_input(request.first), surface_input(request.second)
        check_not_inputs(request.out, surfaces)
        check_output(request.out, request.overwrite, CHANGE_FILES, "result")
        pair, features = _pair(request, surfaces, progress)
    with stopwatch.stage("unchanged ground"):
        pair, noise = _noise(pair, progress)
    _note_noise(request, pair, noise, progress)
    with made_folder(request.out):
        with stopwatch.stage("difference"):
            counts = _write_rasters(request, pair, noise, progress)
        volumes: list[Volume] = []
        if features is not None:
            with stopwatch.stage("volumes"):
                volumes = _volumes(request, pair, noise, features, progress)
            names = _names(features)
            write_volumes(request.out / TABLE, request.out / LAYER, features, names, volumes, pair.placed[0].grid_crs)
        write_other_styles(request.out, (DIFFERENCE, SIGMAS, SIGNIFICANCE, CLASSES, LAYER))
        write_change_picture(request.out / PICTURE, request.out / DIFFERENCE, request.out / CLASSES, features, noise)
        inputs = inputs_record(
            [path for surface in surfaces for path in surface.files]
            + [path for path in (request.area, request.stable, request.geoid) if path is not None and path.is_file()]
        )
        record = _record(request, pair, noise, counts, inputs, stopwatch)
        if features is not None:
            record["volumes"] = [
                {"number": int(number), "name": name, **volume.as_dict()}
                for number, name, volume in zip(features.numbers, _names(features), volumes, strict=True)
            ]
        write_record(request.out / RECORD, record)
    written = [name for name in CHANGE_FILES if (request.out / name).is_file()]
    text = _text(request, noise, counts, features, volumes)
    values: dict[str, Any] = {key: record[key] for key in ("noise", "cells", "volumes") if key in record}
    return CommandOutcome(
        "\n".join([*text, f"{request.out}: {', '.join(written)} written."]),
        {"files": [str(request.out / name) for name in written], **values},
    )


def _pair(
    request: ChangeRequest, surfaces: tuple[SurfaceInput, SurfaceInput], progress: Progress
) -> tuple[_Pair, PolygonFeatures | None]:
    """The surfaces on the common grid: that of the one with the larger cells, where both lie."""
    first, second = surfaces
    by_cell = (second, first) if _is_coarser(second, first) else (first, second)
    for sentence in check_joinable(by_cell, request.geoid):
        progress.note(sentence)
    base, stated = by_cell[0], stating_datum(surfaces)
    placed = [
        PlacedSurface(each, base.geobox, base.crs, converted_datums(stated, each, request.geoid)) for each in surfaces
    ]
    common = placed[0].window.within(placed[1].window)
    if not (common.rows and common.cols):
        raise InputError(
            f"{first.path} and {second.path} do not overlap. Give two surfaces of the same ground, or check the CRS of "
            "both."
        )
    geobox = _part(base.geobox, common)
    placed = [replace(each, geobox=geobox, source=_without_images(each.source)) for each in placed]
    for each in placed:
        if not each.is_on_grid:
            progress.note(f"The cells of {each.source.path} do not lie on the grid of {base.path}: they are resampled.")
    features, changed, stable = None, None, None
    if request.area is not None or request.stable is not None:
        if base.crs is None:
            raise InputError(
                f"{base.dsm} has no CRS, so no polygon can be laid over it. Assign one (gdal_edit -a_srs)."
            )
        cell_m = abs(float(geobox.transform.a))
        if request.area is not None:
            features = read_features(request.area, base.crs, request.name)
            changed = np.asarray(shapely.buffer(features.polygons, RIM_CELLS * cell_m))
        if request.stable is not None:
            stable = read_features(request.stable, base.crs).polygons
    return _Pair((placed[0], placed[1]), changed, stable), features


def _is_coarser(one: SurfaceInput, other: SurfaceInput) -> bool:
    """Whether a surface with a CRS in metres has clearly larger cells than another one."""
    in_metres = one.crs is None or not one.crs.is_geographic
    return in_metres and ((other.crs is not None and other.crs.is_geographic) or one.cell > 1.01 * other.cell)


def _without_images(surface: SurfaceInput) -> SurfaceInput:
    """The surface without the rasters that do not matter here."""
    layers = {name: path for name, path in surface.layers.items() if name not in (VIEWS, WATER, ORTHO)}
    return replace(surface, layers=layers)


def _noise(pair: _Pair, progress: Progress) -> tuple[_Pair, ChangeNoise]:
    """Errors of the differences, and the pair with the error of a surface that states none.

    Raises
    ------
    InputError
        Too little ground is unchanged.
    """
    rows, cols = pair.geobox.shape
    cell_windows = list(blocks_of(rows, cols, SAMPLE_CELLS))
    # Random windows see all distances; the same ones every time.
    order = np.random.default_rng(0).permutation(len(cell_windows))
    windows: list[StableWindow] = []
    with progress.stage("Unchanged ground", min(len(cell_windows), MAX_WINDOWS)) as stage:
        for number in order:
            window = pair.stable_window(cell_windows[int(number)])
            if np.isfinite(window.difference).any():
                windows.append(window)
                stage.advance()
            if len(windows) == MAX_WINDOWS:
                break
    n = sum(int(np.isfinite(window.difference).sum()) for window in windows)
    if n < MIN_STABLE_CELLS:
        raise InputError(_too_little(pair, n))
    states = [each.source.has_sigma for each in pair.placed]
    if states.count(False) == 1:
        d = np.concatenate([each.difference[np.isfinite(each.difference)] for each in windows])
        sigma = np.concatenate([each.sigma[np.isfinite(each.difference)] for each in windows])
        spread = NMAD * float(np.median(np.abs(d - np.median(d))))
        extra = math.sqrt(max(spread**2 - float(np.median(sigma)) ** 2, 0.0))
        pair = replace(pair, extra_sigma_m=extra)
        windows = [replace(each, sigma=np.hypot(each.sigma, extra)) for each in windows]
        silent = pair.placed[states.index(False)].source.path
        found = f"{extra:.3g} m" if extra else "less than that of the other surface"
        progress.note(f"{silent} states no standard deviation: {found}, by the differences of unchanged ground.")
    elif not any(states):
        progress.note(
            "Neither surface states standard deviations: all differences count as equally precise, by their spread on "
            "unchanged ground."
        )
    return pair, change_noise(windows, abs(float(pair.geobox.transform.a)), pair.is_known)


def _too_little(pair: _Pair, n: int) -> str:
    paths = " and ".join(str(each.source.path) for each in pair.placed)
    if not pair.is_known:
        return (
            f"Only {n} cells have a height in both of {paths}, and {MIN_STABLE_CELLS} are needed to tell how exact "
            "their differences are. Give two surfaces with more in common."
        )
    return (
        f"Only {n} cells of unchanged ground have a height in both of {paths}, and {MIN_STABLE_CELLS} are needed to "
        "tell how exact the differences are. Give smaller polygons with --area, or more ground with --stable."
    )


def _note_noise(request: ChangeRequest, pair: _Pair, noise: ChangeNoise, progress: Progress) -> None:
    if not pair.is_known:
        progress.note(
            "Neither --area nor --stable says which ground has changed: offset and errors are those of the smaller "
            "differences of all ground."
        )
    if noise.is_shift_clear:
        east, north = noise.shift_m
        progress.note(
            f"{request.second} seems to lie {east:+.2f} m east and {north:+.2f} m north of {request.first}, which "
            "makes false change on slopes and edges. Align them first."
        )


def _write_rasters(
    request: ChangeRequest, pair: _Pair, noise: ChangeNoise, progress: Progress
) -> dict[ChangeClass, int]:
    """Write the four rasters, block by block. The result: number of cells of each class."""
    limit = float(norm.ppf(1.0 - request.level / 2.0))
    is_removed = not request.keep_offset
    nan, counts = float("nan"), dict.fromkeys(ChangeClass, 0)
    meanings = " ".join(kind.name for kind in ChangeClass)
    tags = {"flag_values": ", ".join(str(int(kind)) for kind in ChangeClass), "flag_meanings": meanings}
    windows = list(blocks_of(*pair.geobox.shape))
    with ExitStack() as stack, progress.stage("Subtracting", len(windows)) as stage:
        sinks = {
            name: stack.enter_context(RasterSink(request.out / name, pair.geobox, bands))
            for name, bands in (
                (DIFFERENCE, RasterBands("float32", nan, ("height in B less height in A",), "m")),
                (SIGMAS, RasterBands("float32", nan, ("standard deviation of the difference",), "m")),
                (SIGNIFICANCE, RasterBands("float32", nan, ("difference in standard deviations",))),
                (CLASSES, RasterBands("uint8", 0, ("class of change",), tags=tags)),
            )
        }
        for window in windows:
            difference, sigma, _ = pair.differences(window)
            known = np.isfinite(difference)
            significance = noise.significance(difference, sigma, is_removed)
            kind = np.select(
                [~known, significance > limit, significance < -limit],
                [ChangeClass.UNKNOWN, ChangeClass.RAISED, ChangeClass.LOWERED], ChangeClass.UNCHANGED,
            ).astype(np.uint8)  # fmt: skip
            removed = difference - noise.offset_m if is_removed else difference
            for name, values in (
                (DIFFERENCE, removed), (SIGMAS, np.where(known, noise.sigma(sigma, is_removed), np.nan)),
                (SIGNIFICANCE, significance),
            ):  # fmt: skip
                sinks[name].write(window.row, window.col, values.astype(np.float32))
            sinks[CLASSES].write(window.row, window.col, kind)
            for each in ChangeClass:
                counts[each] += int((kind == each).sum())
            stage.advance()
        if not sum(counts.values()) - counts[ChangeClass.UNKNOWN]:
            raise InputError(f"No cell has a height in both of {request.first} and {request.second}.")
        _remove_earlier(request.out)
    return counts


def _remove_earlier(out: Path) -> None:
    """Remove the files of an earlier result, so that old and new ones never stand together."""
    for name in CHANGE_FILES:
        try:
            (out / name).unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{out / name} cannot be replaced: {error.strerror}. Choose another folder.") from error


def _volumes(
    request: ChangeRequest, pair: _Pair, noise: ChangeNoise, features: PolygonFeatures, progress: Progress
) -> list[Volume]:
    volumes = []
    with _results(request, noise) as read, progress.stage("Volumes", len(features.polygons)) as stage:
        for polygon in features.polygons:
            volumes.append(volume_of(polygon, pair.geobox, read, noise, not request.keep_offset))
            stage.advance()
    missing = [number for number, each in zip(features.numbers, volumes, strict=True) if not each.n_known]
    if missing:
        progress.note(
            f"{len(missing)} of {len(volumes)} polygons have no cell with a height in both surfaces, and no volume "
            f"(number {', '.join(str(number) for number in missing[:8])}{'...' if len(missing) > 8 else ''})."
        )
    return volumes


@contextmanager
def _results(request: ChangeRequest, noise: ChangeNoise) -> Iterator[Any]:
    """A function that reads windows of the results, also beyond the grid."""
    beside = noise.offset_sigma_m if not request.keep_offset else abs(noise.offset_m)
    with ExitStack() as stack:
        files = [
            stack.enter_context(open_raster(request.out / name, "raster")) for name in (DIFFERENCE, SIGMAS, CLASSES)
        ]

        def read(window: CellWindow) -> ChangeCells:
            inner = window.within(CellWindow(0, 0, *files[0].shape))
            out = [np.full((window.rows, window.cols), np.nan) for _ in range(2)]
            kind = np.zeros((window.rows, window.cols), np.uint8)
            if inner.rows and inner.cols:
                here = inner.slices_in(window)
                part = Window(inner.col, inner.row, inner.cols, inner.rows)
                for values, file in zip((*out, kind), files, strict=True):
                    values[here] = file.read(1, window=part)
            own = np.sqrt(np.maximum(out[1] ** 2 - beside**2, 0.0))
            return ChangeCells(out[0], own, kind)

        yield read


def _record(
    request: ChangeRequest, pair: _Pair, noise: ChangeNoise, counts: dict[ChangeClass, int],
    inputs: Sequence[dict[str, Any]], stopwatch: Stopwatch,
) -> dict[str, Any]:  # fmt: skip
    """The content of change.json, without the volumes."""
    crs = pair.placed[0].grid_crs
    known = sum(counts.values()) - counts[ChangeClass.UNKNOWN]
    changed = counts[ChangeClass.RAISED] + counts[ChangeClass.LOWERED]
    return {
        "command": COMMAND, "created": utc_now(), "started_in": str(Path.cwd()),
        "config": {"request": request_as_dict(request)}, "versions": versions_record(), "inputs": list(inputs),
        "grid": {
            "crs": None if crs is None else crs.to_string(), "transform": list(pair.geobox.transform)[:6],
            "shape": list(pair.geobox.shape),
        },
        "vertical": {"heights_above": stating_datum([each.source for each in pair.placed]).datum},
        "resampled": [str(each.source.path) for each in pair.placed if not each.is_on_grid],
        "offset_removed": not request.keep_offset, "unchanged_ground_is_known": pair.is_known,
        "noise": noise.as_dict(), "sigma_added_m": round(pair.extra_sigma_m, 5),
        "cells": {kind.name.lower(): counts[kind] for kind in ChangeClass}
        | {"significant_share": round(changed / known, 6), "expected_by_chance": request.level},
        "stages": stopwatch.stages,
    }  # fmt: skip


def _names(features: PolygonFeatures) -> list[str]:
    if features.values is None:
        return [str(number) for number in features.numbers]
    return ["" if value is None else str(value) for value in features.values]


def _text(
    request: ChangeRequest, noise: ChangeNoise, counts: dict[ChangeClass, int], features: PolygonFeatures | None,
    volumes: Sequence[Volume],
) -> list[str]:  # fmt: skip
    """The answer for people."""
    known = sum(counts.values()) - counts[ChangeClass.UNKNOWN]
    shares = [counts[kind] / known for kind in (ChangeClass.RAISED, ChangeClass.LOWERED)]
    lines = [
        f"A: {request.first}", f"B: {request.second}",
        f"unchanged ground: B less A {noise.offset_m:+.3f} +-{noise.offset_sigma_m:.3f} m "
        f"({'kept' if request.keep_offset else 'removed'}), spread {noise.spread_m:.3f} m, {noise.scale:.2f} times "
        f"what the standard deviations say; errors reach over {math.sqrt(noise.correlation.area_m2):.1f} m",
        f"significant at {100 * request.level:g} %: {100 * shares[0]:.1f} % of {known} cells raised, "
        f"{100 * shares[1]:.1f} % lowered",
    ]  # fmt: skip
    if features is not None:
        lines.append(f"{'polygon':<16} {'volume, m3':>14} {'+- (68 %)':>12} {'mean, m':>9} {'known, %':>9}")
        for name, each in zip(_names(features), volumes, strict=True):
            lines.append(
                f"{name[:16]:<16} {each.volume_m3:>14.1f} {each.sigma_m3:>12.1f} {each.mean_m:>9.3f} "
                f"{100 * each.known_share:>9.1f}{'' if each.is_significant else '  not significant'}"
            )
    return lines


def _measured(surface_cells: SurfaceCells) -> FloatArray:
    """Heights (r, c), NaN where they are interpolated. The level of water counts as measured."""
    height = surface_cells.height.astype(np.float64)
    if QUALITY in surface_cells.flags:
        quality = surface_cells.flags[QUALITY].astype(np.uint16)
        height[(quality & np.uint16(Quality.WATER)) == np.uint16(Quality.FILLED)] = np.nan
    return height


def _part(geobox: GeoBox, window: CellWindow) -> GeoBox:
    moved = geobox.transform * Affine.translation(window.col, window.row)
    return GeoBox((window.rows, window.cols), moved, geobox.crs)
