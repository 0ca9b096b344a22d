"""The folder of a finished cloud, opened again: its images with the cameras of the run, and the maps of their
pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pyproj import CRS

from zlocus.core.errors import InputError, ZlocusError
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.requests import CloudRequest, SetupRequest
from zlocus.io.open_raster import open_raster
from zlocus.io.run_record import inputs_record, read_record
from zlocus.matching.image_space import is_by_depth
from zlocus.pipeline.image_scenes import set_up_images
from zlocus.pipeline.recorded_run import config_of, folder_of, request_with
from zlocus.pipeline.setup import open_inputs
from zlocus.products.cloud_maps import ImageMap
from zlocus.products.point_cloud import file_names
from zlocus.products.report.file_names import RECORD
from zlocus.products.tie_observations import OBSERVATIONS, read_observations


@dataclass(frozen=True)
class OpenedCloud:
    """A finished cloud.

    folder : of it; crs : of the scene; image_maps : of its reference images; step_m : of each of them, by how much its
    heights, or distances, change where another image moves by a step of the matching.
    """

    folder: Path
    crs: CRS
    image_maps: list[ImageMap]
    step_m: list[float]


def is_cloud(folder: Path) -> bool:
    """Whether a folder has the record of a cloud."""
    if not (folder / RECORD).is_file():
        return False
    try:
        asked = read_record(folder / RECORD)["config"]["request"]
        return "references" in asked and "products" not in asked
    except (ZlocusError, KeyError, TypeError):
        return False


def open_cloud(folder: Path, progress: Progress) -> OpenedCloud:
    """Open the folder of a cloud.

    Raises
    ------
    InputError
        A map is missing or of another image, an input has changed, or the cameras of the run cannot be restored.
    """
    run = read_record(folder / RECORD)
    base = folder_of(folder, run)
    try:
        _check_inputs(base, run["inputs"])
        others = {"out": folder, "overwrite": False}
        request = request_with(folder / RECORD, run, CloudRequest, lambda path: base / path, others)
        opened = open_inputs(SetupRequest.of(request), SilentProgress(), "later")
        ties = read_observations(folder, len(opened.scene.views))
        if ties is None:
            progress.note(f"{folder} has no {OBSERVATIONS}: its tie points are searched again.")
        setup = set_up_images(opened.scene, config_of(folder / RECORD, run), progress, ties)
        views, of_images = {view.name: view for view in setup.scene.views}, dict(run["images"])
        scene_views = [views[name] for name in of_images]
        steps = [_step_m(of_images[view.name]) for view in scene_views]
    except (KeyError, AttributeError, TypeError) as error:
        raise InputError(f"{folder / RECORD} is not what a cloud writes. Make the cloud again.") from error
    except ZlocusError as error:
        raise InputError(
            f"The cameras of the cloud in {folder} cannot be restored ({str(error).rstrip('.')}). Put its images back, "
            "or make it again."
        ) from error
    is_depth, image_maps = is_by_depth(setup.scene), []
    for view, stem in zip(scene_views, file_names(list(of_images)), strict=True):
        path, quality_path = (folder / f"{stem}_{of}.tif" for of in ("depth" if is_depth else "height", "quality"))
        for each in (path, quality_path):
            _check_map(each, view.image.shape, view.name)
        image_maps.append(ImageMap(view, path, quality_path, is_depth, opened.vertical_datum, setup.scene.crs))
    return OpenedCloud(folder, setup.scene.crs, image_maps, steps)


def _check_inputs(base: Path, recorded: Sequence[Mapping[str, Any]]) -> None:
    """Refuse inputs that are not those of the cloud. base : where relative paths begin; recorded : see
    `inputs_record`. Missing files are named where they are read."""
    for record in recorded:
        path = base / record["path"]
        if record["sha256"] and path.is_file() and inputs_record([path])[0]["sha256"] != record["sha256"]:
            raise InputError(f"{path} has changed since the cloud was made")


def _check_map(path: Path, shape: tuple[int, int], name: str) -> None:
    if not path.is_file():
        raise InputError(
            f"{path.parent} lacks {path.name}, from which a mesh is made. The command that made the cloud makes it "
            "again."
        )
    with open_raster(path, "map") as source:
        if source.shape != shape:
            raise InputError(f"{path} has not the rows and columns of {name}. Make the cloud again.")


def _step_m(of_image: Mapping[str, Any]) -> float:
    """Step (m) of the heights that were searched for an image, or of the depths in the middle of their range."""
    if "step_m" in of_image:
        return float(of_image["step_m"])
    low, high = of_image["disparities_px"]
    step, middle = (high - low) / of_image["steps"], (low + high) / 2
    return float(of_image["disparity_times_depth_px_m"] * step / middle**2)
