"""compare.html: two runs, two surfaces, or one of each, side by side on one page that needs no other file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import zlocus
from zlocus.core.errors import OutputError
from zlocus.core.requests import COMPARISON_FILES
from zlocus.evaluation.differences import THRESHOLDS_M, SurfaceDifferences, surface_differences
from zlocus.evaluation.histogram import differences_figure
from zlocus.io.atomic_write import write_atomically
from zlocus.io.rasters import write_cog
from zlocus.io.run_folder import check_surface
from zlocus.io.run_record import utc_now
from zlocus.io.vertical import ELLIPSOID
from zlocus.products.demo_figure import relief
from zlocus.products.match_curve_figures import svg_of
from zlocus.products.report import maps
from zlocus.products.report import record_differences as records
from zlocus.products.report import text as words
from zlocus.products.report.comparison import HISTOGRAM_INCHES, SATURATED_AT_NMAD, SVG_DPI, shrunk_means
from zlocus.products.report.page import rendered, run_record
from zlocus.products.report.record_differences import ValueRow

PAGE, DIFFERENCE = COMPARISON_FILES
# Of cells with a height in one surface only, and in both: OpenCV's order, and the colours of Okabe and Ito.
WHERE_COLOURS = {"only in A": (0, 159, 230), "only in B": (178, 114, 0), "in both": (225, 225, 225)}
EMPTY = (255, 255, 255)
# Larger tables are folded.
MAX_OPEN_ROWS = 12


@dataclass(frozen=True)
class ComparedSurface:
    """A surface of a comparison. dsm : its raster of heights; run : content of run.json, None of a raster alone."""

    path: Path
    dsm: Path
    run: Mapping[str, Any] | None


@dataclass(frozen=True)
class ComparedRuns:
    """Two surfaces, A and B, with their differences, B less A, on the grid of A."""

    first: ComparedSurface
    second: ComparedSurface
    differences: SurfaceDifferences

    @property
    def run_records(self) -> tuple[Mapping[str, Any], Mapping[str, Any]] | None:
        """run.json of both; None where one of them is a raster alone."""
        if self.first.run is None or self.second.run is None:
            return None
        return self.first.run, self.second.run


def compared_surface(path: Path) -> ComparedSurface:
    """The surface of a finished run, by its folder, or a raster of heights.

    Raises
    ------
    InputError
        The folder holds no finished surface.
    """
    if not path.is_dir():
        return ComparedSurface(path, path, None)
    check_surface(path)
    return ComparedSurface(path, path / "dsm.tif", run_record(path))


def compared_runs(first: Path, second: Path, geoid: Path | None = None) -> ComparedRuns:
    """Compare two runs, two rasters of heights, or one of each. geoid : see `surface_differences`.

    Raises
    ------
    InputError, ConfigError
        See `compared_surface` and `surface_differences`.
    """
    surfaces = compared_surface(first), compared_surface(second)
    return ComparedRuns(*surfaces, surface_differences(surfaces[0].dsm, surfaces[1].dsm, geoid))


def write_comparison(out: Path, runs: ComparedRuns) -> Path:
    """Write `PAGE` and the raster of the differences into a folder, each complete or not at all; the page's path.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out} cannot be made: {error.strerror}. Choose another folder with -o.") from error
    differences = runs.differences
    text = rendered(page_context(runs), "compare.html.jinja")
    write_cog(
        out / DIFFERENCE, differences.difference, differences.geobox, nodata=float("nan"),
        descriptions=("height in B less height in A",), units="m",
    )  # fmt: skip
    write_atomically(out / PAGE, lambda part: part.write_text(text, encoding="utf-8"))
    return out / PAGE


def page_context(runs: ComparedRuns) -> dict[str, Any]:
    """Values of the page's template."""
    differences, run_records = runs.differences, runs.run_records
    saturated_m = saturated_difference_m(differences)
    geobox = differences.geobox
    shows_metres = geobox.crs is None or not geobox.crs.geographic
    return {
        "version": zlocus.__version__, "created": words.when(utc_now()),
        "names": (str(runs.first.path), str(runs.second.path)), "runs": run_records,
        "only_rasters": [str(side.path) for side in (runs.first, runs.second) if side.run is None],
        "summary": summary(runs), "brief": brief_rows(runs), "grid": grid_sentence(differences),
        "assumed": [sentence[0].upper() + sentence[1:] + "." for sentence in differences.assumed],
        "map_of": maps.error_picture(
            shrunk_means(differences.difference, maps.MAP_PX), saturated_m, "B less A, m",
            "Differences of height: red where B is higher, blue where it is lower; white where one has no height.",
        ),
        "bar": maps.scale_bar(geobox.shape[1] * abs(float(geobox.resolution.x))) if shows_metres else None,
        "histogram": _histogram(differences), "statistics": statistics_rows(differences),
        "where": where_map(differences), "heights": _height_maps(differences), "max_open": MAX_OPEN_ROWS,
        "difference_file": DIFFERENCE, **(_record_part(*run_records) if run_records is not None else {}),
    }  # fmt: skip


def _record_part(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the template that come from run.json of both runs."""
    return {
        "options": records.option_differences(first, second), "versions": records.version_differences(first, second),
        "inputs": records.input_differences(first, second), "n_inputs": [len(run["inputs"]) for run in (first, second)],
        "cameras": records.camera_rows(first, second), "stages": records.stage_times(first, second),
    }  # fmt: skip


def summary(runs: ComparedRuns) -> str:
    """The comparison in one paragraph."""
    differences = runs.differences
    statistics, total = differences.statistics, differences.first.size
    counts = [int(np.count_nonzero(each)) for each in (differences.only_first, differences.only_second)]
    said = [
        f"Of the {total} cells of the grid, {words.percent(differences.n_both, total)} have a height in both, "
        f"{words.percent(counts[0], total)} in A only and {words.percent(counts[1], total)} in B only.",
        "Where both have one, the heights are the same."
        if differences.lowest_m == differences.highest_m == 0
        else f"Where both have one, the median of B less A is {words.number(statistics.median, 'm', 3)}, the spread "
        f"(NMAD) {words.number(statistics.nmad, 'm', 3)}, the RMSE {words.number(statistics.rmse, 'm', 3)}, and "
        f"{words.percent(statistics.within, 1)} of the differences are below {THRESHOLDS_M[0]:g} m.",
    ]
    if runs.run_records is not None:
        options = records.option_differences(*runs.run_records)
        n = len(options)
        said.append(
            "Both runs have the same options."
            if not n
            else f"{n} option{'s' if n > 1 else ''} of the two runs differ{'' if n > 1 else 's'}."
        )
        times = [words.seconds(records.total_s(run)) for run in runs.run_records]
        said.append(f"A took {times[0]}, B {times[1]}.")
    return " ".join(said)


def brief_rows(runs: ComparedRuns) -> list[ValueRow]:
    """What each surface is: grid, datum and share of heights; of runs also when, how and from what it was made."""
    differences = runs.differences
    rows = [ValueRow("vertical datum", _datum(differences.datums[0]), _datum(differences.datums[1]))]
    if runs.run_records is None:
        return rows
    of_both = [_of_run(run) for run in runs.run_records]
    return [*(ValueRow(name, of_both[0][name], of_both[1][name]) for name in of_both[0]), *rows]


def _of_run(run: Mapping[str, Any]) -> dict[str, str]:
    request, grid, orientation = run["config"]["request"], run["grid"], run["orientation"]
    rows, cols = grid["shape"]
    cell_m, left, top = grid["transform"][0], grid["transform"][2], grid["transform"][5]
    return {
        "made on": words.when(run.get("created")),
        "zlocus": run["versions"]["zlocus"],
        "images": str(len(orientation["views"])),
        "method": request["method"],
        "cell": f"{cell_m:g} m",
        "grid": f"{rows} rows, {cols} columns; upper left corner {left:.1f}, {top:.1f}",
        "CRS": words.crs_name(grid["crs"]),
        "heights searched": " to ".join(f"{z:.1f}" for z in run["heights"]["searched_m"]) + " m",
        "tie points": f"{orientation.get('n_ties', words.NONE)}, correction: {orientation.get('model', words.NONE)}",
        "coverage": f"{words.percent(run['coverage'], 1.0)} of the cells that two images see",
        "time": words.seconds(records.total_s(run)),
    }


def _datum(datum: str | None) -> str:
    return "not stated" if datum is None else f"the {ELLIPSOID}" if datum == ELLIPSOID else datum


def grid_sentence(differences: SurfaceDifferences) -> str:
    """How B came onto the grid of A, as a sentence."""
    beyond = ""
    if differences.n_elsewhere:
        beyond = f" {differences.n_elsewhere} cells of B with a height lie outside of the grid of A and are left out."
    if differences.same_cells:
        return f"The cells of A and B lie on each other where both reach, and are compared as they are.{beyond}"
    how = (
        f"each cell of A is compared with the mean of B at {differences.places_per_cell} places in it"
        if differences.places_per_cell > 1
        else "each cell of A is compared with the cell of B that holds its centre"
    )
    return f"The grids differ: {how}.{beyond}"


def statistics_rows(differences: SurfaceDifferences) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Statistics of the differences, and shares of them: name and value."""
    statistics = differences.statistics
    values = (
        ("median", statistics.median), ("NMAD", statistics.nmad), ("mean", statistics.mean),
        ("standard deviation", statistics.std), ("RMSE", statistics.rmse), ("LE90", statistics.le90),
        ("LE95", statistics.le95), ("lowest", differences.lowest_m), ("highest", differences.highest_m),
    )  # fmt: skip
    shares = [(f"share below {limit:g} m", words.percent(share, 1)) for limit, share in sorted(statistics.shares)]
    return [(name, words.number(value, "m", 3)) for name, value in values], [
        ("cells with a height in both", str(differences.n_both)), *shares,
    ]  # fmt: skip


def saturated_difference_m(differences: SurfaceDifferences) -> float:
    """Size of a difference, m, from which the map's colours are saturated."""
    statistics = differences.statistics
    return float(f"{max(SATURATED_AT_NMAD * statistics.nmad, abs(statistics.median), 0.05):.1g}")


def where_map(differences: SurfaceDifferences) -> tuple[maps.Picture, list[maps.Swatch]] | None:
    """Map of the cells with a height in one surface only; None where there are none."""
    if not (differences.only_first.any() or differences.only_second.any()):
        return None
    members = {
        "only in A": differences.only_first, "only in B": differences.only_second,
        "in both": np.isfinite(differences.difference),
    }  # fmt: skip
    colours = np.full((*differences.first.shape, 3), EMPTY, np.uint8)
    for name, cells in members.items():
        colours[cells] = WHERE_COLOURS[name]
    total = differences.first.size
    swatches = [
        maps.Swatch(maps.css(np.array(WHERE_COLOURS[name])), f"{name}: {np.count_nonzero(cells)} cells",
                    words.percent(int(np.count_nonzero(cells)), total))
        for name, cells in members.items()
    ]  # fmt: skip
    alt = "Cells with a height: orange in A only, blue in B only, grey in both; white where neither has one."
    return maps.picture(maps.shrunk(colours), alt, is_smooth=False), swatches


def _height_maps(differences: SurfaceDifferences) -> tuple[maps.Picture, maps.Picture, maps.Scale]:
    """Shaded heights of A and B with one scale of colours."""
    shown = [shrunk_means(z, maps.MAP_PX) for z in (differences.first, differences.second)]
    low, high = maps.span(np.concatenate([z.ravel() for z in shown]))
    step = -(-max(differences.first.shape) // maps.MAP_PX)
    cell_m = step * abs(float(differences.geobox.resolution.x))
    pictures = [_shaded(z, cell_m, (low, high), name) for z, name in zip(shown, "AB", strict=True)]
    return pictures[0], pictures[1], maps.Scale("height, m", maps.viridis(), maps.even_ticks(low, high))


def _shaded(z: NDArray[np.float32], cell_m: float, span: tuple[float, float], name: str) -> maps.Picture:
    alt = f"Shaded relief of {name}, coloured by height from {span[0]:.1f} to {span[1]:.1f} m; white without a height."
    return maps.picture(relief(z, cell_m, span), alt)


def _histogram(differences: SurfaceDifferences) -> maps.Picture:
    values = differences.difference[np.isfinite(differences.difference)].astype(np.float64)
    figure = differences_figure(values, differences.statistics, THRESHOLDS_M[0], HISTOGRAM_INCHES)
    statistics = differences.statistics
    alt = (
        f"Histogram of the differences about their median {words.number(statistics.median, 'm', 3)}, "
        f"NMAD {words.number(statistics.nmad, 'm', 3)}."
    )
    width, height = (round(SVG_DPI * side) for side in HISTOGRAM_INCHES)
    return maps.Picture(maps.data_uri(svg_of(figure).encode(), "image/svg+xml"), alt, width, height)


def comparison_text(runs: ComparedRuns) -> Sequence[str]:
    """The comparison in lines of text, for the command line."""
    differences = runs.differences
    counts = [int(np.count_nonzero(each)) for each in (differences.only_first, differences.only_second)]
    lines = [
        f"A: {runs.first.path}", f"B: {runs.second.path}", grid_sentence(differences),
        f"cells with a height: {differences.n_both} in both, {counts[0]} in A only, {counts[1]} in B only",
        *_difference_lines(differences), *differences.assumed,
    ]  # fmt: skip
    if runs.run_records is not None:
        first, second = runs.run_records
        lines += [
            f"coverage: {words.percent(first['coverage'], 1.0)}, {words.percent(second['coverage'], 1.0)}",
            f"time: {words.seconds(records.total_s(first))}, {words.seconds(records.total_s(second))}",
            f"options that differ: {records.listed_values(records.option_differences(first, second))}",
            f"versions that differ: {records.listed_values(records.version_differences(first, second))}",
            f"inputs that differ: {len(records.input_differences(first, second)) or 'none'}",
        ]
    return lines


def _difference_lines(differences: SurfaceDifferences) -> list[str]:
    """The statistics of the differences in lines of text."""
    statistics = differences.statistics
    if differences.lowest_m == differences.highest_m == 0.0:
        return ["B less A: no difference in any cell with a height in both"]
    return [
        f"B less A: median {statistics.median:+z.3f} m, NMAD {statistics.nmad:.3f} m, RMSE {statistics.rmse:.3f} m, "
        f"LE90 {statistics.le90:.3f} m",
        "differences below " + ", ".join(
            f"{limit:g} m: {words.percent(share, 1)}" for limit, share in sorted(statistics.shares)
        ),
    ]  # fmt: skip


def comparison_values(runs: ComparedRuns) -> dict[str, Any]:
    """The comparison for programs: numbers of cells, statistics of the differences in m, and options that differ."""
    differences, statistics = runs.differences, runs.differences.statistics
    values: dict[str, Any] = {
        "cells_in_both": differences.n_both,
        "cells_in_first_only": int(np.count_nonzero(differences.only_first)),
        "cells_in_second_only": int(np.count_nonzero(differences.only_second)),
        "median": statistics.median, "nmad": statistics.nmad, "mean": statistics.mean, "rmse": statistics.rmse,
        "le90": statistics.le90, "lowest": differences.lowest_m, "highest": differences.highest_m,
        "within_m": {f"{limit:g}": share for limit, share in sorted(statistics.shares)},
    }  # fmt: skip
    if runs.run_records is not None:
        rows = records.option_differences(*runs.run_records)
        values["options"] = {row.name: [row.first, row.second] for row in rows}
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in values.items()}
