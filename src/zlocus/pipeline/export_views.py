"""Open what an export names: images, a scene file, or the folder of a run with the cameras that it found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from zlocus.core.errors import GeometryError, InputError, ZlocusError
from zlocus.core.export_request import ExportRequest
from zlocus.core.footprints import shared_ground
from zlocus.core.options import OrientationOptions
from zlocus.core.progress import Progress
from zlocus.core.request_checks import check_inputs
from zlocus.core.scene import Scene, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import checked_crs
from zlocus.io.run_record import read_record
from zlocus.io.scene_file import open_scene
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.tie_heights import supported
from zlocus.pipeline.orient import ORIENTATION
from zlocus.pipeline.ortho import SURFACE, oriented_run
from zlocus.pipeline.setup import orient_views, requested_crs, sorted_views
from zlocus.products.corrected_cameras import SCENE
from zlocus.products.exported_images import ExportArea
from zlocus.products.report.file_names import RECORD
from zlocus.products.tie_observations import read_observations

# Heights of an export reach beyond nearly all tie points by this share of their spread, and by so much at least, m.
HEIGHT_PERCENT, HEIGHT_MARGIN, MIN_HEIGHT_MARGIN_M = 1.0, 0.2, 2.0


@dataclass(frozen=True)
class OpenedExport:
    """The views of an export.

    scene : with the cameras that are exported; orientation : their tie points, None where none are asked for.
    """

    scene: Scene
    orientation: Orientation | None

    @property
    def ties(self) -> FloatArray:
        """Ground points (n, 3) m of the tie points that are to be trusted."""
        if self.orientation is None:
            return np.empty((0, 3))
        xyz = self.orientation.xyz
        return np.asarray(xyz[supported(xyz, self.orientation.sigma_z_m)])


def open_export(request: ExportRequest, with_ties: bool, progress: Progress) -> OpenedExport:
    """Open the views of a request. with_ties : tie points are wanted; of a run they are read, else they are searched.

    Raises
    ------
    InputError, ConfigError, GeometryError
        An input that cannot be used.
    """
    (first, *others) = request.inputs
    wanted = requested_crs(request.crs)
    if not others and first.is_dir():
        if (first / SURFACE).is_file() and (first / RECORD).is_file():
            return _of_surface(first, wanted)
        if (first / SCENE).is_file():
            scene = sorted_views(open_scene([first / SCENE], wanted))
            return OpenedExport(scene, _with_ties(scene, first, progress) if with_ties else None)
        if (first / RECORD).is_file():
            raise InputError(
                f"{first} holds a result without cameras that can be exported. Give the folder of `zlocus orient` or "
                "`zlocus dsm`, or the scene.yaml."
            )
    check_inputs(request.inputs, may_be_single=not with_ties)
    scene = sorted_views(open_scene(request.inputs, wanted, least=2 if with_ties else 1))
    return OpenedExport(scene, _with_ties(scene, None, progress) if with_ties else None)


def _of_surface(folder: Path, wanted: CRS | None) -> OpenedExport:
    """The views of the run of a surface."""
    try:
        scene, orientation = oriented_run(folder)
    except (KeyError, AttributeError) as error:
        raise InputError(f"{folder / RECORD} is not what a run writes. Make the surface again.") from error
    except ZlocusError as error:
        raise InputError(
            f"The cameras of the run in {folder} cannot be restored ({str(error).rstrip('.')}). Put its images back, "
            "or use `zlocus orient`."
        ) from error
    if wanted is not None and wanted != checked_crs(scene.crs):
        raise InputError(f"The surface in {folder} is in {scene.crs.to_string()}. Leave --crs out.")
    return OpenedExport(scene, orientation)


def _with_ties(scene: Scene, folder: Path | None, progress: Progress) -> Orientation:
    """The tie points of a scene whose cameras stay as they are: read from a folder that keeps them, or searched."""
    known = None
    if folder is not None and _views_of_orientation(folder) == [view.name for view in scene.views]:
        known = read_observations(folder, len(scene.views))
    return orient_views(scene, replace(OrientationOptions(), model="none"), progress, known_ties=known)


def _views_of_orientation(folder: Path) -> list[str]:
    """Names of the views that `zlocus orient` oriented into a folder, in the order of its ties; none where it does not
    say."""
    try:
        return sorted(read_record(folder / ORIENTATION)["views"])
    except (ZlocusError, KeyError, TypeError):
        return []


def area_of_export(request: ExportRequest, opened_export: OpenedExport) -> ExportArea | None:
    """The ground to be exported; None where nothing tells it, as for frame cameras in a local frame without ties."""
    heights = request.heights or opened_export.scene.heights or _heights_of_ties(opened_export)
    if heights is None:
        return None
    scene = opened_export.scene
    bounds = request.bounds or scene.bounds
    if bounds is None:
        try:
            bounds = shared_ground(scene, heights)
        except GeometryError:
            return None
        ties = opened_export.ties
        if is_local(scene.crs) and len(ties):
            low, high = ties[:, :2].min(axis=0), ties[:, :2].max(axis=0)
            bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return ExportArea(bounds, heights)


def _heights_of_ties(opened_export: OpenedExport) -> tuple[float, float] | None:
    z = opened_export.ties[:, 2]
    if not len(z):
        return None
    low, high = np.percentile(z, (HEIGHT_PERCENT, 100.0 - HEIGHT_PERCENT))
    margin = max(HEIGHT_MARGIN * (high - low), MIN_HEIGHT_MARGIN_M)
    return float(low - margin), float(high + margin)
