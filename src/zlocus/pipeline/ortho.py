"""`zlocus ortho`: the surface, the images with their cameras, an ortho-image of each, and a mosaic, in this order.

An image that took part in the run of the surface has the camera that the run gave it. The pointing of any other image
is corrected by comparing it with an ortho-image of the same surface.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zlocus.core.errors import InputError, ZlocusError
from zlocus.core.footprints import Bounds
from zlocus.core.options import OrientationOptions, RunConfig
from zlocus.core.ortho_request import MOSAIC, MOSAIC_IMAGES, ORTHO_FILES, ORTHO_RECORD, OrthoRequest
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.requests import SetupRequest, check_output
from zlocus.core.resources import cores
from zlocus.core.scene import Scene, View
from zlocus.io.atomic_write import remove_earlier
from zlocus.io.ground_reference import OrthoReference, open_reference
from zlocus.io.input_files import InputFiles
from zlocus.io.run_record import Stopwatch, read_record, result_record, write_record
from zlocus.io.scene_file import open_scene
from zlocus.io.styles.file_names import remove_styles
from zlocus.io.surface_heights import SurfaceHeights, open_surface
from zlocus.orientation.ground_match import NoGroundMatch, match_to_ground
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.resection import resected
from zlocus.pipeline.messages import some_names
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.recorded_run import config_of, request_of
from zlocus.pipeline.setup import open_inputs, opencv_in_one_thread, orient_views, sorted_views
from zlocus.products.ortho_images import OrthoSource, ortho_area, write_ortho
from zlocus.products.ortho_mosaic import planned_mosaic, write_mosaic
from zlocus.products.other_styles import write_other_styles
from zlocus.products.point_cloud import file_names
from zlocus.products.report.file_names import RECORD
from zlocus.products.tie_observations import read_observations

SURFACE, ORTHO = "dsm.tif", "ortho.tif"
ENDING = "_ortho.tif"
# Images of a mosaic whose pixels differ by more than this factor do not show the same detail.
ALIKE_PIXELS = 1.5


@dataclass(frozen=True)
class PointedView:
    """A view with the camera that its ortho-image is made with.

    pointing : where that camera comes from: `run`, `matched` or `delivered`; facts : of the match, for the record.
    """

    view: View
    pointing: str
    facts: dict[str, Any]


@dataclass(frozen=True)
class OrthoPart:
    """An ortho-image to be made: its file, its view, its source, and the ground that it shows."""

    path: Path
    pointed: PointedView
    source: OrthoSource
    area: Bounds
    cell_m: float


def run_ortho(request: OrthoRequest, config: RunConfig, progress: Progress) -> dict[str, Any]:
    """Make the ortho-images of a request, and the mosaic; return the content of the record that is written.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used, before anything is written.
    StoppedError
        An input has changed meanwhile.
    """
    check_output(request.out, request.overwrite, ORTHO_FILES, "set of ortho-images")
    watch, workers = Stopwatch(), request.workers or cores()
    folder = request.surface if request.surface.is_dir() else None
    raster = request.surface / SURFACE if folder else request.surface
    if folder and not raster.is_file():
        raise InputError(f"{folder} holds no {SURFACE}. Give the folder of a surface, or a raster of heights.")
    with watch.stage("open"), progress.stage("Opening images"):
        surface = open_surface(raster, request.surface_vertical)
        scene = sorted_views(open_scene(request.inputs, surface.crs, least=1))
        run_views = {} if folder is None else views_of_run(folder, progress)
    reference = reference_of(request, folder, surface)
    files = [raster, *([] if reference is None else [reference.image.path])]
    inputs = InputFiles.of([*files, *(path for view in scene.views for path in view.files)], scene)
    with watch.stage("pointing"), progress.stage("Pointing", len(scene.views)) as stage, opencv_in_one_thread():
        pointed = []
        for view in scene.views:
            pointed.append(pointed_view(view, run_views, reference, config.orientation, workers))
            stage.advance()
    note_pointing(pointed, reference, request, progress)
    parts = parts_of(request, pointed, surface, progress)
    mosaicked = mosaic_parts(request, parts, progress)
    with made_folder(request.out), complete_or_removed(request.out, [part.path for part in parts]):
        with watch.stage("ortho"), opencv_in_one_thread():
            written = [write_ortho(part.path, part.source, surface, part.area, part.cell_m, progress, workers)
                       for part in parts]  # fmt: skip
        records = {part.source.name: record_of(part, vars(counts)) for part, counts in zip(parts, written, strict=True)}
        record: dict[str, Any] = {"surface": str(raster), "images": records}
        if mosaicked:
            with watch.stage("mosaic"), opencv_in_one_thread():
                record["mosaic"] = make_mosaic(request, mosaicked, surface, progress, workers)
        with watch.stage("styles"):
            made = [part.path.name for part in parts] + [MOSAIC, MOSAIC_IMAGES] * bool(mosaicked)
            write_other_styles(request.out, made, config.products)
        shared = result_record(request, config, inputs.record(), watch)
        write_record(request.out / ORTHO_RECORD, record | shared)
    return record


@contextmanager
def complete_or_removed(out: Path, paths: Sequence[Path]) -> Iterator[None]:
    """Remove what an earlier command left in the folder, and after a failure what this one has written.

    paths : of the ortho-images that are written.
    """
    _remove(out, [*earlier_files(out), *ORTHO_FILES])
    try:
        yield
    except BaseException:
        _remove(out, [*(path.name for path in paths), *ORTHO_FILES])
        raise


def _remove(out: Path, names: Sequence[str]) -> None:
    """Remove files with their styles. The record has none: `ortho.qml` is the style of a surface's `ortho.tif`."""
    remove_earlier(out, names)
    remove_styles(out, [name for name in names if Path(name).suffix == ".tif"])


def earlier_files(out: Path) -> list[str]:
    """Names of the ortho-images that the record in a folder lists; none where it is missing or damaged."""
    try:
        names = [str(each["file"]) for each in read_record(out / ORTHO_RECORD)["images"].values()]
    except (ZlocusError, KeyError, AttributeError, TypeError):
        return []
    return [name for name in names if Path(name).name == name and name.endswith(ENDING)]


def views_of_run(folder: Path, progress: Progress) -> dict[Path, View]:
    """The views of the run in a folder with the cameras that it gave them, by the path of their image.

    Empty where the run cannot be restored, which is noted.
    """
    try:
        corrected, _ = oriented_run(folder)
    except (ZlocusError, KeyError, AttributeError) as error:
        progress.note(
            f"The cameras of the run in {folder} cannot be restored ({str(error).rstrip('.')}). Its images are treated "
            "like images that took no part in it."
        )
        return {}
    return {view.path.resolve(): view for view in corrected.views}


def oriented_run(folder: Path) -> tuple[Scene, Orientation]:
    """The scene of the run of a surface in a folder with the cameras that the run gave it, and its orientation.

    Raises
    ------
    InputError, ConfigError, GeometryError
        The run cannot be restored.
    KeyError, AttributeError
        Its record is not what a run writes.
    """
    run = read_record(folder / RECORD)
    request, config = request_of(folder / RECORD, run), config_of(folder / RECORD, run)
    opened = open_inputs(SetupRequest.of(request), SilentProgress())
    ties = read_observations(folder, len(opened.scene.views))
    if ties is None and run["orientation"].get("n_ties"):
        raise InputError(f"its observations are missing from {folder}.")
    orientation = orient_views(opened.scene, config.orientation, SilentProgress(), known_ties=ties)
    return orientation.apply(opened.scene), orientation


def reference_of(request: OrthoRequest, folder: Path | None, surface: SurfaceHeights) -> OrthoReference | None:
    """The ortho-image that pointings are corrected against; None where there is none, or none is to be corrected."""
    if request.pointing == "delivered":
        return None
    path = request.reference
    if path is None and folder is not None and (folder / ORTHO).is_file():
        path = folder / ORTHO
    return None if path is None else open_reference(path, surface.crs, surface)


def pointed_view(
    view: View, run_views: dict[Path, View], reference: OrthoReference | None, options: OrientationOptions, threads: int
) -> PointedView:
    """A view with the camera of the run, or else with its pointing corrected against the reference, where there is
    one."""
    of_run = run_views.get(view.path.resolve())
    if of_run is not None:
        return PointedView(replace(view, sensor=of_run.sensor, image=of_run.image), "run", {})
    if reference is None:
        return PointedView(view, "delivered", {})
    threads = threads if reference.is_in_frame else 1
    matches = match_to_ground(view, reference, reference.frame, options, threads=threads)
    if isinstance(matches, NoGroundMatch):
        return PointedView(view, "delivered", {"reason": matches.reason})
    found = resected(view, matches.xyz, matches.xy, options)
    facts = {
        "n_points": len(matches),
        "n_windows": matches.n_windows,
        "offset_px": [round(float(each), 3) for each in matches.offset_px],
        "sigma_px": round(found.sigma_px, 4),
    }
    return PointedView(replace(view, sensor=found.sensor), "matched", facts)


def note_pointing(
    pointed: Sequence[PointedView], reference: OrthoReference | None, request: OrthoRequest, progress: Progress
) -> None:
    """Say how the cameras were corrected that the run did not correct."""
    for each in pointed:
        if each.pointing == "matched":
            column, row = each.facts["offset_px"]
            progress.note(
                f"{each.view.name} took no part in the surface: its pointing was corrected by {column:+.1f} columns "
                f"and {row:+.1f} rows, from {each.facts['n_points']} places that agree to "
                f"{each.facts['sigma_px']:.2f} px."
            )
        elif "reason" in each.facts and reference is not None:
            progress.note(
                f"{each.view.name} {each.facts['reason']} (compared with {reference.image.path}). It is laid on the "
                "surface as its camera was delivered, and may be off by its pointing error. Where cameras may be far "
                "off, set a larger orientation.max_pointing_px with --set."
            )
    plain = [each.view.name for each in pointed if each.pointing == "delivered" and not each.facts]
    if plain and request.pointing != "delivered":
        progress.note(
            f"{some_names(plain)}: laid on the surface as the cameras were delivered, for there is no ortho-image to "
            "compare with. Give one of the same surface with --reference."
        )


def parts_of(
    request: OrthoRequest, pointed: Sequence[PointedView], surface: SurfaceHeights, progress: Progress
) -> list[OrthoPart]:
    """The ortho-images to be made.

    Raises
    ------
    InputError
        No image shows the surface.
    """
    parts, beside = [], []
    names = file_names([each.view.name for each in pointed])
    for each, name in zip(pointed, names, strict=True):
        area = ortho_area(each.view, surface, request.bounds)
        if area is None:
            beside.append(each.view.name)
            continue
        source = OrthoSource.of(each.view, surface.median)
        cell_m = request.resolution or source.cell_m
        parts.append(OrthoPart(request.out / f"{name}{ENDING}", each, source, area, cell_m))
    if not parts:
        where = "" if request.bounds is None else " within --bounds"
        raise InputError(
            f"None of the images ({some_names(beside)}) shows the surface {surface.path}{where}. Check that they show "
            "the same place, and their cameras."
        )
    if beside:
        progress.note(f"{some_names(beside)}: no ortho-image is made, for the surface is not seen there.")
    return parts


def record_of(part: OrthoPart, counts: dict[str, int]) -> dict[str, Any]:
    """The record of an ortho-image. counts : of its pixels."""
    return {
        "file": part.path.name,
        "pixel_m": part.cell_m,
        "bands": len(part.source.bands.bands),
        "dtype": part.source.bands.dtype.name,
        "pointing": part.pointed.pointing,
        **part.pointed.facts,
        "pixels": counts,
    }


def mosaic_parts(request: OrthoRequest, parts: Sequence[OrthoPart], progress: Progress) -> list[OrthoPart]:
    """The ortho-images that a mosaic is made of; none where none is wanted, or they do not go together.

    Raises
    ------
    InputError
        A mosaic is asked for, and the images have different bands.
    """
    if request.mosaic is False or (len(parts) < 2 and not request.mosaic):
        return []
    first = parts[0].source.bands
    for part in parts[1:]:
        bands = part.source.bands
        if (len(bands.bands), bands.dtype) == (len(first.bands), first.dtype):
            continue
        sentence = (
            f"No mosaic is made, because {parts[0].source.name} has {len(first.bands)} bands of {first.dtype.name} and "
            f"{part.source.name} {len(bands.bands)} of {bands.dtype.name}. Give images of one kind."
        )
        if request.mosaic:
            raise InputError(sentence)
        progress.note(sentence)
        return []
    return list(parts)


def make_mosaic(
    request: OrthoRequest, parts: Sequence[OrthoPart], surface: SurfaceHeights, progress: Progress, workers: int
) -> dict[str, Any]:
    """Make the mosaic, and return its record."""
    cell_m = min(part.cell_m for part in parts)
    if max(part.cell_m for part in parts) > ALIKE_PIXELS * cell_m:
        progress.note(f"The images have pixels of different size: the mosaic has those of the finest, {cell_m:g} m.")
    plan = planned_mosaic(
        [part.source for part in parts], [part.area for part in parts], surface, cell_m, request.level_colours,
        progress, workers,
    )  # fmt: skip
    pixels = write_mosaic(request.out / MOSAIC, request.out / MOSAIC_IMAGES, plan, progress, workers)
    return {
        "file": MOSAIC,
        "images_file": MOSAIC_IMAGES,
        "pixel_m": cell_m,
        "images": {
            part.source.name: {
                "number": number,
                "pixels": pixels[part.source.name],
                "gain": plan.levels.gain[number - 1].round(5).tolist(),
                "offset": plan.levels.offset[number - 1].round(4).tolist(),
            }
            for number, part in enumerate(parts, 1)
        },
    }
