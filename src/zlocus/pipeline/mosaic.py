"""`zlocus mosaic`: surfaces are opened, their offsets found, and their cells joined block by block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from odc.geo.geobox import GeoBox
from pyproj import CRS
from pyproj.crs import CompoundCRS

from zlocus.core.command_outcome import CommandOutcome
from zlocus.core.errors import ConfigError, InputError
from zlocus.core.grid import CellWindow
from zlocus.core.progress import Progress
from zlocus.core.quoting import counted
from zlocus.core.requests import check_output
from zlocus.core.surface_requests import MOSAIC_FILES, MosaicRequest
from zlocus.io.crs import crs_label
from zlocus.io.grid_inputs import read_geobox
from zlocus.io.run_folder import RECORD
from zlocus.io.run_record import Stopwatch, inputs_record, request_as_dict, utc_now, versions_record, write_record
from zlocus.io.surface_cells import PlacedSurface
from zlocus.io.surface_inputs import (
    VIEWS,
    WATER,
    SurfaceInput,
    check_joinable,
    check_not_inputs,
    converted_datums,
    stating_datum,
    surface_input,
)
from zlocus.io.vertical import ELLIPSOID, ELLIPSOIDAL_DESCRIPTION, vertical_part
from zlocus.pipeline.output_folder import made_folder, remove_earlier_products
from zlocus.pipeline.surface_workers import blocks_of, results_of, slots_for
from zlocus.products.blending import RunRelations, SeamKind
from zlocus.products.mosaic_picture import PICTURE, write_picture
from zlocus.products.mosaic_rasters import RASTERS, SOURCE, MosaicJob, MosaicRasters, OffsetJob, reaching
from zlocus.products.other_styles import write_other_styles
from zlocus.products.run_offsets import (
    BLOCK_CELLS,
    PairOffset,
    PairSample,
    RunOffsets,
    as_record,
    estimated_sigmas,
    joined_samples,
    pair_offset,
    run_offsets,
)

COMMAND = "zlocus mosaic"
DEFAULT_FEATHER_CELLS, MIN_FEATHER_CELLS, MAX_FEATHER_CELLS = 32, 2, 256
# Side of the windows in which differences are sampled, and how many of them are looked at for each pair of runs.
SAMPLE_CELLS, WINDOWS_PER_PAIR = 8 * BLOCK_CELLS, 64
# A mosaic has at most so many runs: their numbers have 16 bits.
MAX_RUNS = 65_535


@dataclass(frozen=True)
class _Placement:
    """The surfaces on the common grid. windows : cells that each may reach; n_covered : cells of all their windows."""

    surfaces: tuple[SurfaceInput, ...]
    placed: tuple[PlacedSurface, ...]
    geobox: GeoBox
    grid_crs: CRS | None
    windows: tuple[CellWindow, ...]

    @property
    def whole_window(self) -> CellWindow:
        rows, cols = self.geobox.shape
        return CellWindow(0, 0, rows, cols)

    @property
    def spatial_geobox(self) -> GeoBox:
        """The grid with the vertical datum of the heights."""
        stated = stating_datum(self.surfaces)
        vertical = vertical_part(CRS.from_wkt(stated.spatial_wkt)) if stated.spatial_wkt else None
        if vertical is None or self.grid_crs is None:
            return self.geobox
        name = f"{self.grid_crs.name} + {vertical.name}"
        parts = CompoundCRS(name=name, components=[self.grid_crs, vertical])
        return GeoBox(self.geobox.shape, self.geobox.transform, parts.to_wkt())


def run_mosaic(request: MosaicRequest, progress: Progress) -> CommandOutcome:
    """Join surfaces, and write the result into the folder of the request.

    Raises
    ------
    InputError, ConfigError
        A surface cannot be read or joined with the others; see `check_joinable`.
    OutputError
        The folder holds another result, or a file cannot be written.
    StoppedError
        A block failed; nothing was written.
    """
    stopwatch = Stopwatch()
    with stopwatch.stage("inputs"), progress.stage("Opening surfaces"):
        surfaces = tuple(surface_input(each) for each in request.inputs)
        check_not_inputs(request.out, surfaces)
        check_output(request.out, request.overwrite, MOSAIC_FILES, "result")
        if len(surfaces) > MAX_RUNS:
            raise ConfigError(f"{len(surfaces)} surfaces are too many for one mosaic. Join up to {MAX_RUNS} at a time.")
        for sentence in check_joinable(surfaces, request.geoid):
            progress.note(sentence)
        placement = _placement(request, surfaces)
    _note_resampling(placement, progress)
    feather_cells = _feather_cells(request, placement)
    with stopwatch.stage("offsets") as usage:
        samples = _samples(request, placement, usage, progress)
    pairs = [pair_offset(*numbers, joined_samples(found)) for numbers, found in sorted(samples.items())]
    offsets = run_offsets(len(surfaces), pairs)
    is_removed = offsets.is_significant and not request.keep_offsets
    placement = _with_offsets(_with_sigmas(placement, pairs, progress), offsets, is_removed)
    _note_offsets(placement, offsets, is_removed, progress)
    with made_folder(request.out):
        with stopwatch.stage("blocks") as usage:
            job = _job(placement, pairs, feather_cells, progress)
            names, counts, n_of_run = _write(request, placement, job, usage, progress)
        write_picture(request.out, [str(surface.path) for surface in surfaces])
        write_other_styles(request.out, RASTERS)
        with stopwatch.stage("checksums"), progress.stage("Checksums of the inputs"):
            more = [path for path in (request.like, request.geoid) if path is not None and path.is_file()]
            inputs = inputs_record([path for surface in surfaces for path in surface.files] + more)
        record = {
            "command": COMMAND, "created": utc_now(), "started_in": str(Path.cwd()),
            "config": {"request": request_as_dict(request)}, "versions": versions_record(), "inputs": inputs,
            "grid": _grid_record(placement), "vertical": {"heights_above": _datum_words(placement)},
            "feather_cells": feather_cells, "offsets": as_record(offsets, request.inputs, is_removed),
            "runs": _runs_record(placement, n_of_run),
            "cells": {kind.name.lower(): counts[kind] for kind in SeamKind},
            "stages": stopwatch.stages,
        }  # fmt: skip
        write_record(request.out / RECORD, record)
    files = [str(request.out / name) for name in (*names, PICTURE, RECORD)]
    return CommandOutcome(
        _text(request, counts, offsets, is_removed, (*names, PICTURE, RECORD)),
        {"files": files, **{key: record[key] for key in ("grid", "offsets", "runs", "cells", "feather_cells")}},
    )


def _placement(request: MosaicRequest, surfaces: tuple[SurfaceInput, ...]) -> _Placement:
    """The surfaces on the grid of the result.

    Raises
    ------
    InputError
        A surface has no cell on the grid.
    """
    first, stated = surfaces[0], stating_datum(surfaces)
    geobox, grid_crs = first.geobox, first.crs
    if request.like is not None:
        geobox = read_geobox(request.like)
        assert geobox.crs is not None, "a grid that is read has a CRS"
        like_crs = CRS.from_user_input(str(geobox.crs))
        if grid_crs is None:
            raise InputError(
                f"{first.dsm} has no CRS, and --like {request.like} has one. Assign it (gdal_edit -a_srs)."
            )
        grid_crs = grid_crs if like_crs == grid_crs else like_crs
    placed = [PlacedSurface(each, geobox, grid_crs, converted_datums(stated, each, request.geoid)) for each in surfaces]
    windows = [each.window for each in placed]
    if request.like is None:
        whole = windows[0]
        for window in windows[1:]:
            whole = whole.around(window) if window.rows and window.cols else whole
        moved = geobox.transform * geobox.transform.translation(whole.col, whole.row)
        geobox = GeoBox((whole.rows, whole.cols), moved, geobox.crs)
        windows = [replace(each, row=each.row - whole.row, col=each.col - whole.col) for each in windows]
    rows, cols = geobox.shape
    windows = [each.within(CellWindow(0, 0, rows, cols)) for each in windows]
    for surface, window in zip(surfaces, windows, strict=True):
        if not (window.rows and window.cols):
            grid = "" if grid_crs is None else f" ({crs_label(grid_crs)})"
            raise InputError(
                f"{surface.path} has no cell on the grid of the mosaic{grid}. Leave it out, or check its CRS."
            )
    return _Placement(
        surfaces, tuple(replace(each, geobox=geobox) for each in placed), geobox, grid_crs, tuple(windows)
    )  # fmt: skip


def _note_resampling(placement: _Placement, progress: Progress) -> None:
    moved = [str(each.source.path) for each in placement.placed if not each.is_on_grid]
    if moved:
        more = " and others" if len(moved) > 3 else ""
        progress.note(
            f"The cells of {', '.join(moved[:3])}{more} do not lie on the grid of the mosaic: their heights are "
            "interpolated, except at jumps."
        )


def _feather_cells(request: MosaicRequest, placement: _Placement) -> int:
    if request.feather_m is None:
        return DEFAULT_FEATHER_CELLS
    cell_m = abs(placement.geobox.transform.a)
    cells = round(request.feather_m / cell_m)
    if not MIN_FEATHER_CELLS <= cells <= MAX_FEATHER_CELLS:
        raise ConfigError(
            f"--feather {request.feather_m:g} m is {cells} cells. Give a distance between "
            f"{MIN_FEATHER_CELLS * cell_m:g} and {MAX_FEATHER_CELLS * cell_m:g} m."
        )
    return cells


def _samples(
    request: MosaicRequest, placement: _Placement, usage: Any, progress: Progress
) -> dict[tuple[int, int], list[PairSample]]:
    """Differences of all pairs of runs that overlap, in windows spread over each overlap."""
    windows = _sampled_windows(placement)
    samples: dict[tuple[int, int], list[PairSample]] = {}
    n_cells = sum(window.rows * window.cols for window in windows)
    job = OffsetJob(placement.placed, placement.windows)
    with progress.stage("Comparing runs", len(windows)) as stage:
        results = {}
        slots = slots_for(n_cells, request.workers)
        for window, sampled in results_of(job, windows, slots, request.scheduler, usage, progress):
            results[window] = sampled
            stage.advance()
        # The order in which workers are ready must not matter.
        for window in windows:
            for numbers, sample in results[window].items():
                samples.setdefault(numbers, []).append(sample)
    return samples


def _sampled_windows(placement: _Placement) -> list[CellWindow]:
    """Windows of the grid, whole blocks, up to `WINDOWS_PER_PAIR` for each pair of runs that may overlap."""
    chosen = set[CellWindow]()
    windows = placement.windows
    for i, first in enumerate(windows):
        for second in windows[i + 1 :]:
            common = first.within(second)
            if not (common.rows and common.cols):
                continue
            rows = range(common.row // SAMPLE_CELLS, -(-(common.row + common.rows) // SAMPLE_CELLS))
            cols = range(common.col // SAMPLE_CELLS, -(-(common.col + common.cols) // SAMPLE_CELLS))
            n = len(rows) * len(cols)
            for k in np.unique(np.linspace(0, n - 1, min(n, WINDOWS_PER_PAIR)).astype(int)).tolist():
                row, col = rows[k // len(cols)] * SAMPLE_CELLS, cols[k % len(cols)] * SAMPLE_CELLS
                chosen.add(CellWindow(row, col, SAMPLE_CELLS, SAMPLE_CELLS).within(placement.whole_window))
    return sorted(chosen, key=lambda window: (window.row, window.col))


def _with_sigmas(placement: _Placement, pairs: Sequence[PairOffset], progress: Progress) -> _Placement:
    """The surfaces that state no standard deviation with one that their differences from others tell."""
    estimated = estimated_sigmas(len(placement.surfaces), pairs)
    surfaces = list(placement.surfaces)
    for number, surface in enumerate(surfaces):
        if surface.has_sigma:
            continue
        sigma_m = float(estimated[number])
        if math.isfinite(sigma_m):
            surfaces[number] = replace(surface, sigma_m=sigma_m)
            progress.note(
                f"{surface.path} states no standard deviation: {sigma_m:.3g} m, by its differences from the others. "
                f"Give another one with {surface.dsm}=METRES or {surface.dsm}=RASTER."
            )
        else:
            progress.note(
                f"{surface.path} states no standard deviation and overlaps no other surface: it stays unknown."
            )
    placed = tuple(replace(each, source=one) for each, one in zip(placement.placed, surfaces, strict=True))
    return replace(placement, surfaces=tuple(surfaces), placed=placed)


def _with_offsets(placement: _Placement, offsets: RunOffsets, is_removed: bool) -> _Placement:
    if not is_removed:
        return placement
    return replace(
        placement,
        placed=tuple(
            replace(each, offset_m=float(offset))
            for each, offset in zip(placement.placed, offsets.offset_m, strict=True)
        ),
    )


def _note_offsets(placement: _Placement, offsets: RunOffsets, is_removed: bool, progress: Progress) -> None:
    n_groups = len(np.unique(offsets.group))
    if n_groups > 1:
        progress.note(
            f"The surfaces fall into {n_groups} groups that do not overlap: no offset between groups can be known."
        )
    if not offsets.is_significant:
        return
    largest = int(np.argmax(np.abs(offsets.offset_m)))
    offset, sigma = offsets.offset_m[largest], offsets.sigma_m[largest]
    said = (
        f"{placement.surfaces[largest].path} lies {offset:+.3f} m (+-{sigma:.3f} m) "
        f"from {placement.surfaces[int(offsets.group[largest])].path}, the largest offset of all."
    )
    progress.note(f"{said} Offsets are removed." if is_removed else f"{said} Offsets stay, as --keep-offsets asks.")


def _job(placement: _Placement, pairs: Sequence[PairOffset], feather_cells: int, progress: Progress) -> MosaicJob:
    surfaces, n = placement.surfaces, len(placement.surfaces)
    scale, shared = np.ones((n, n)), np.zeros((n, n), bool)
    for pair in pairs:
        first, second = pair.first, pair.second
        if surfaces[first].has_sigma and surfaces[second].has_sigma and pair.scale > 1.0:
            scale[first, second] = scale[second, first] = pair.scale
        shared[first, second] = shared[second, first] = bool(surfaces[first].images & surfaces[second].images)
    bands = {each.ortho_bands for each in surfaces if each.ortho_bands is not None}
    if len(bands) > 1:
        progress.note("The ortho-images have different bands or types of numbers: the mosaic has none.")
    has = tuple(name for name in (VIEWS, WATER) if any(name in each.layers for each in surfaces))
    return MosaicJob(
        placement.placed, placement.windows, RunRelations(scale, shared), feather_cells,
        bands.pop() if len(bands) == 1 else None, has, placement.whole_window,
    )  # fmt: skip


def _write(
    request: MosaicRequest, placement: _Placement, job: MosaicJob, usage: Any, progress: Progress
) -> tuple[tuple[str, ...], dict[SeamKind, int], NDArray[np.int64]]:
    """Write all rasters. The result: their names, the number of cells of each kind, and of each run."""
    rows, cols = placement.geobox.shape
    counts, n_of_run = dict.fromkeys(SeamKind, 0), np.zeros(len(placement.surfaces) + 1, np.int64)
    windows = list(blocks_of(rows, cols))
    reached = [window for window in windows if reaching(placement.windows, window)]
    stated = stating_datum(placement.surfaces)
    description = ELLIPSOIDAL_DESCRIPTION if stated.datum == ELLIPSOID else "height"
    with MosaicRasters(
        request.out, placement.geobox, placement.spatial_geobox, description, job.has, job.ortho_bands, request.inputs
    ) as rasters:
        with progress.stage("Joining", len(windows)) as stage:
            for window in set(windows) - set(reached):
                rasters.write_empty(window)
                counts[SeamKind.EMPTY] += window.rows * window.cols
                stage.advance()
            slots = slots_for(rows * cols, request.workers)
            for window, block in results_of(job, reached, slots, request.scheduler, usage, progress):
                rasters.write(window, block)
                for kind in SeamKind:
                    counts[kind] += block.count(kind)
                n_of_run += np.bincount(block.layers[SOURCE].ravel(), minlength=len(n_of_run))
                stage.advance()
        remove_earlier_products(request.out, has_incomplete=False)
        for name in MOSAIC_FILES:
            (request.out / name).unlink(missing_ok=True)
    return rasters.names, counts, n_of_run[1:]


def _grid_record(placement: _Placement) -> dict[str, Any]:
    crs = None if placement.grid_crs is None else placement.grid_crs.to_string()
    return {"crs": crs, "transform": list(placement.geobox.transform)[:6], "shape": list(placement.geobox.shape)}


def _datum_words(placement: _Placement) -> str | None:
    datum = stating_datum(placement.surfaces).datum
    return f"the {ELLIPSOID}" if datum == ELLIPSOID else datum


def _runs_record(placement: _Placement, n_of_run: NDArray[np.int64]) -> list[dict[str, Any]]:
    """What was done with each run; its number is that in source.tif."""
    return [
        {
            "number": number + 1, "run": str(each.source.path), "cells": int(n), "resampled": not each.is_on_grid,
            "offset_removed_m": round(each.offset_m, 4), "sigma_m": each.source.sigma_m,
            "converted": each.vertical_datums is not None,
        }
        for number, (each, n) in enumerate(zip(placement.placed, n_of_run, strict=True))
    ]  # fmt: skip


def _text(
    request: MosaicRequest, counts: dict[SeamKind, int], offsets: RunOffsets, is_removed: bool, names: Sequence[str]
) -> str:
    """The answer for people."""
    known = sum(counts.values()) - counts[SeamKind.EMPTY]
    lines = [
        f"{counted(known, 'cell')} of {len(request.inputs)} surfaces: {counts[SeamKind.ONE]} of one alone, "
        f"{counts[SeamKind.BLENDED]} blended, {counts[SeamKind.CHOSEN]} where they contradict each other and one was "
        "chosen"
    ]
    if offsets.pairs:
        done = "removed" if is_removed else "kept"
        listed = ", ".join(
            f"{Path(name).name} {offset:+.3f} +-{sigma:.3f} m"
            for name, offset, sigma in list(zip(request.inputs, offsets.offset_m, offsets.sigma_m, strict=True))[1:9]
        )
        lines.append(f"offsets from {Path(request.inputs[0]).name}, {done}: {listed}")
        wide = [pair for pair in offsets.pairs if math.isfinite(pair.scale)]
        if wide:
            worst = max(pair.scale for pair in wide)
            lines.append(f"spread of the differences: {worst:.2f} times what the standard deviations say, or less")
    else:
        lines.append("no two surfaces overlap: they stand side by side")
    return "\n".join([*lines, f"{request.out}: {', '.join(names)} written."])
