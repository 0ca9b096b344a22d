"""`zlocus align`: places of both, the fit, the moved rasters and what is made of them, in this order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.align_request import AlignRequest
from zlocus.core.options import ProductOptions
from zlocus.core.progress import Progress
from zlocus.core.quoting import counted
from zlocus.core.requests import RUN_FILES, check_output
from zlocus.evaluation.fit_sample import (
    FitSample,
    RasterHeights,
    check_on_map,
    sample_of_points,
    sample_of_raster,
)
from zlocus.evaluation.fit_uncertainty import passes
from zlocus.evaluation.height_file import HeightFile
from zlocus.evaluation.point_reference import PointReference
from zlocus.evaluation.statistics import error_statistics
from zlocus.evaluation.surface_fit import SurfaceFit, fit_surface
from zlocus.io.points.ground_points import PointOptions
from zlocus.io.points.open_points import are_points
from zlocus.io.run_folder import RECORD, SURFACE_RASTERS, check_surface
from zlocus.io.run_record import Stopwatch, inputs_record, read_record, utc_now, versions_record, write_record
from zlocus.pipeline.output_folder import made_folder, remove_earlier_products
from zlocus.pipeline.recorded_run import config_of
from zlocus.products.derived import FILES, link_all, write_derived
from zlocus.products.moved_surface import FLAGS, HEIGHTS, Move, write_moved
from zlocus.products.styles import write_styles

# Fewer passes of a satellite say little about the error that all points of a pass share.
MIN_PASSES, MAX_LISTED_PASSES = 8, 100
# Of this many standard deviations an offset is more than chance.
SIGNIFICANT_SIGMAS = 2.0


@dataclass(frozen=True, eq=False)
class AlignedSurface:
    """The result of `zlocus align`. fit : what was removed; record : the entry `alignment` of run.json; files : names
    of those that were written; notes : what users should know, as sentences."""

    out: Path
    fit: SurfaceFit
    record: Mapping[str, Any]
    files: tuple[str, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """The offset with its uncertainty, what was left, and the files."""
        fit, sigma_m = self.fit, self.fit.sigma_m
        east, north, up = fit.shift_m
        lines = [f"the surface lies {up:+z.3f} m up of the reference (sigma {sigma_m[2]:.3f} m), which was removed"]
        if fit.undetermined is None:
            lines = [
                f"the surface lies {east:+z.3f} m east, {north:+z.3f} m north and {up:+z.3f} m up of the reference "
                f"(sigma {sigma_m[0]:.3f}, {sigma_m[1]:.3f} and {sigma_m[2]:.3f} m), which was removed"
            ]
        else:
            lines.append(f"the horizontal shift is not determined, and was left as it is: {fit.undetermined}")
        if fit.has_tilt:
            tilt = self.record["tilt"]
            sigma = tilt["sigma_east_m_per_km"], tilt["sigma_north_m_per_km"]
            lines.append(
                f"tilt removed: {tilt['east_m_per_km']:+z.3f} m/km to the east (sigma {sigma[0]:.3f}), "
                f"{tilt['north_m_per_km']:+z.3f} m/km to the north (sigma {sigma[1]:.3f})"
            )
        before, after = self.record["before"], self.record["after"]
        lines.append(
            f"differences at {fit.n} places: median {before['median']:+z.3f} m, NMAD {before['nmad']:.3f} m before; "
            f"{after['median']:+z.3f} m and {after['nmad']:.3f} m after"
        )
        return "\n".join([*lines, *self.notes, f"{self.out}: {', '.join(self.files)} written."])


def run_align(request: AlignRequest, point_options: PointOptions, progress: Progress) -> AlignedSurface:
    """Move a surface onto a reference, and write it with all rasters that belong to it.

    Raises
    ------
    InputError, ConfigError
        An input that cannot be used, before anything is written.
    OutputError
        The folder holds another result, or a file cannot be written.
    """
    check_output(request.out, request.overwrite, RUN_FILES)
    is_run = request.surface.is_dir()
    if is_run:
        check_surface(request.surface)
    height_file, stopwatch = HeightFile.open(request.dsm), Stopwatch()
    check_on_map(height_file)
    inputs = inputs_record(request.inputs)
    with stopwatch.stage("sample"), progress.stage("Reading both"):
        sample = _sample(request, point_options, height_file)
    with stopwatch.stage("fit"), progress.stage("Fitting"):
        fit = fit_surface(sample, request.max_shift_m, request.tilt, request.height_only)
    alignment, notes = alignment_record(request, point_options, sample, fit), _notes(request, sample, fit)
    alignment["inputs"] = inputs
    sources = {HEIGHTS: request.dsm}
    if is_run:
        sources |= {name: request.surface / name for name in SURFACE_RASTERS if (request.surface / name).is_file()}
    with stopwatch.stage("write"), made_folder(request.out):
        remove_earlier_products(request.out)
        files = write_moved(sources, request.out, Move(fit, request.keep_grid), progress)
        if is_run:
            files += _derived(request, progress)
        record = _run_record(request, alignment, stopwatch)
        write_record(request.out / RECORD, record)
        if is_run:
            link_all(request.out, progress)
    return AlignedSurface(request.out, fit, alignment, (*files, RECORD), notes)


def _sample(request: AlignRequest, point_options: PointOptions, height_file: HeightFile) -> FitSample:
    quality = request.surface / FLAGS if request.surface.is_dir() else None
    if are_points(request.references):
        reference = PointReference.open(height_file, request.references, point_options, request.geoid)
        return sample_of_points(reference, request.max_shift_m, quality)
    heights = RasterHeights.open(height_file, request.references[0], request.geoid)
    return sample_of_raster(heights, request.max_shift_m, quality)


def alignment_record(
    request: AlignRequest, point_options: PointOptions, sample: FitSample, fit: SurfaceFit
) -> dict[str, Any]:
    """The entry `alignment` of run.json: what was moved onto what, by how much, and how well that is known."""
    east, north, _ = fit.shift_m
    before, moved = sample.differences((0.0, 0.0)), sample.differences((east, north))
    after = moved - fit.offset(sample.xy)
    asked = {
        "tilt": request.tilt, "height_only": request.height_only, "max_shift_m": request.max_shift_m,
        "keep_grid": request.keep_grid, "geoid": None if request.geoid is None else str(request.geoid),
    }  # fmt: skip
    of_points = (
        {name: value for name, value in vars(point_options).items() if value} if are_points(request.references) else {}
    )
    return {
        "surface": str(request.surface), "references": list(map(str, request.references)),
        "created": utc_now(), "started_in": str(Path.cwd()),
        "versions": versions_record(), "options": asked | {"points": of_points}, **fit.as_dict(),
        "grid": "kept, heights interpolated" if request.keep_grid else "moved with the surface, nothing interpolated",
        "n_available": sample.n_available, "left_out": sample.left_out or {},
        "before": _figures(before), "after": _figures(after), "passes": _passes(sample, after),
        "surface_heights": sample.datums[0], "reference_heights": sample.datums[1], "assumed": list(sample.assumed),
        "geoid_added_to": None if sample.geoid_added_to is None else str(sample.geoid_added_to),
    }  # fmt: skip


def _figures(differences: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, float]:
    """Figures of differences (n,) m, NaN where unknown: outliers count too."""
    statistics = error_statistics(differences[np.isfinite(differences)], 1.0)
    return {name: getattr(statistics, name) for name in ("n", "median", "nmad", "mean", "rmse", "le90")}


def _passes(sample: FitSample, after: np.ndarray[Any, np.dtype[np.float64]]) -> list[dict[str, Any]] | None:
    """Number of points and median of what is left, of each pass; None where the points have no time."""
    time_s, known = sample.time_s, np.isfinite(after)
    if not np.isfinite(time_s).all():
        return None
    number = passes(time_s)
    found = []
    for one in range(min(int(number.max()) + 1, MAX_LISTED_PASSES)):
        left = after[(number == one) & known]
        found.append({"n": len(left), "median_m": float(np.median(left)) if len(left) else None})
    return found


def _notes(request: AlignRequest, sample: FitSample, fit: SurfaceFit) -> tuple[str, ...]:
    notes = list[str]()
    if len(sample) < sample.n_available:
        notes.append(f"{len(sample)} of {sample.n_available} places, chosen at random, were compared")
    for reason, n in (sample.left_out or {}).items():
        notes.append(f"{counted(n, 'point')} left out: {reason}")
    size, sigma_m = np.abs(fit.values), fit.sigma_m
    if (size <= SIGNIFICANT_SIGMAS * sigma_m).all():
        notes.append("the offset is not larger than its uncertainty: the surface fits the reference as it is")
    if np.isfinite(sample.time_s).all():
        n_passes = int(passes(sample.time_s).max()) + 1
        if n_passes < MIN_PASSES:
            notes.append(
                f"the points are of {n_passes} {'pass' if n_passes == 1 else 'passes'}: an error that all points of a "
                "pass share is hardly in the uncertainty"
            )
    if request.keep_grid and fit.undetermined is None:
        notes.append("the grid was kept: heights are interpolated between cells, which averages noise and widens edges")
    return (*notes, *sample.assumed)


def _derived(request: AlignRequest, progress: Progress) -> list[str]:
    """Make the maps that the surface has anew of the moved one, and return their names."""
    names = [name for name, file in FILES.items() if (request.surface / file).is_file()]
    options = _product_options(request.surface / RECORD)
    write_derived(request.out, names, options, progress)
    write_styles(request.out, options)
    return [FILES[name] for name in names]


def _product_options(record: Path) -> ProductOptions:
    return config_of(record, read_record(record)).products


def _run_record(request: AlignRequest, alignment: dict[str, Any], stopwatch: Stopwatch) -> dict[str, Any]:
    """The content of run.json: that of the run that made the surface, with the alignment."""
    if not request.surface.is_dir():
        return {
            "command": "zlocus align", "created": alignment["created"], "started_in": str(Path.cwd()),
            "alignment": alignment, "versions": alignment["versions"], "inputs": alignment["inputs"],
            "stages": stopwatch.stages,
        }  # fmt: skip
    run = read_record(request.surface / RECORD)
    run.pop("schema", None)
    if "alignment" in run:
        alignment["surface_alignment"] = run["alignment"]
    east, north = (alignment["offset_m"][axis] or 0.0 for axis in ("east", "north"))
    grid = dict(run.get("grid", {}))
    if not request.keep_grid and "transform" in grid:
        transform = list(grid["transform"])
        transform[2], transform[5] = transform[2] - east, transform[5] - north
        grid["transform"] = transform
    return run | {"grid": grid, "alignment": alignment}
