"""`zlocus export`: views are opened, cameras are converted or fitted, and all files appear at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.export_request import EXPORT_RECORD, ExportRequest
from zlocus.core.progress import Progress
from zlocus.core.requests import check_output
from zlocus.core.scene import Scene, View, is_local
from zlocus.core.sensor_model import SensorModel, bare
from zlocus.io.cameras.rpc import read_rpc
from zlocus.io.run_record import request_as_dict, versions_record
from zlocus.io.staged_export import staged_export, write_export_record
from zlocus.pipeline.export_cloud_mesh import export_cloud_mesh
from zlocus.pipeline.export_mesh import export_mesh
from zlocus.pipeline.export_views import OpenedExport, area_of_export, open_export
from zlocus.pipeline.messages import some_names
from zlocus.pipeline.opened_cloud import is_cloud
from zlocus.pipeline.ortho import SURFACE
from zlocus.products import colmap_model, nerf_transforms
from zlocus.products.adjust_files import PREFIX, adjust_file_name, write_adjust
from zlocus.products.exported_images import FOLDER, ExportArea, ExportedView, exported_view, write_image
from zlocus.products.exported_points import ExportedPoints, exported_points
from zlocus.products.point_cloud import file_names
from zlocus.products.rpc_copies import write_rpc_copy
from zlocus.sensors.correction import ShiftedModel
from zlocus.sensors.earth_frame import FRAME_SPACE
from zlocus.sensors.frame import FrameModel
from zlocus.sensors.line_shifts import StraightenedImage
from zlocus.sensors.local_frame import LocalFrame
from zlocus.sensors.perspective_fit import FitError, PixelPart
from zlocus.sensors.rigid_adjustment import fit_adjustment
from zlocus.sensors.rpc import RpcCoefficients, RpcModel
from zlocus.sensors.rpc_fit import GRID_HEIGHTS, GRID_POINTS, fit_rpc

# The origin of a local frame is rounded to whole metres.
ORIGIN_STEP_M = 1.0
# Entries of the record that the answer of the command leaves out.
OF_RECORD = ("request", "versions")


@dataclass(frozen=True)
class ExportResult:
    """What was written. text : for people; values : for programs."""

    text: str
    values: dict[str, Any]


def run_export(request: ExportRequest, progress: Progress) -> ExportResult:
    """Write what a request asks for into its folder.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used or written; nothing is left of new files then.
    """
    check_output(request.out, request.overwrite, (EXPORT_RECORD,), "export")
    if request.kind == "mesh":
        first = request.inputs[0]
        of_cloud = not (first / SURFACE).is_file() and is_cloud(first)
        text, record = (export_cloud_mesh if of_cloud else export_mesh)(request, progress)
    elif request.kind in ("asp", "rpc"):
        text, record = _export_rpcs(request, progress)
    else:
        text, record = _export_perspective(request, progress)
    return ExportResult(text, {name: value for name, value in record.items() if name not in OF_RECORD})


def _export_perspective(request: ExportRequest, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Perspective cameras, images and tie points for COLMAP or NeRF tools."""
    with progress.stage("Opening images"):
        opened_export = open_export(request, request.points is not False, progress)
    area = area_of_export(request, opened_export)
    frame = local_frame(opened_export, area)
    writer = colmap_model if request.kind == "colmap" else nerf_transforms
    scene = opened_export.scene
    exported_views, beside = [], []
    for view, file in zip(scene.views, file_names([view.name for view in scene.views]), strict=True):
        exported = exported_view(view, frame, area, file, writer.can_be_said)
        if exported is None:
            beside.append(view.name)
        else:
            exported_views.append(exported)
    if not exported_views:
        raise GeometryError(f"None of the images ({some_names(beside)}) shows the area. Check --bounds and --heights.")
    if beside:
        progress.note(f"{some_names(beside)}: left out, because the area is not seen there.")
    check_errors({each.view.name: each.fit_error for each in exported_views}, request, "perspective camera")
    points = None
    if opened_export.orientation is not None:
        names = [view.name for view in scene.views]
        points = exported_points(opened_export.orientation, exported_views, names, frame)
    record = {
        **_record(request),
        "frame": frame.as_dict(),
        "area": None if area is None else {"bounds": list(area.bounds), "heights": list(area.heights)},
        "images": {each.view.name: each.as_dict() for each in exported_views},
        "points": 0 if points is None else len(points),
    }
    with staged_export(request.out) as stage, progress.stage("Writing", len(exported_views)) as counted:
        (stage / FOLDER).mkdir()
        for exported in exported_views:
            write_image(stage / FOLDER, exported)
            counted.advance()
        if request.kind == "colmap":
            colmap_model.write_model(stage, exported_views, points)
        else:
            nerf_transforms.write_transforms(stage, exported_views, points)
        write_export_record(stage, record)
    return _perspective_text(request, exported_views, points, frame), record


def _perspective_text(
    request: ExportRequest, exported_views: Sequence[ExportedView], points: ExportedPoints | None, frame: LocalFrame
) -> str:
    where = colmap_model.MODEL if request.kind == "colmap" else Path(nerf_transforms.TRANSFORMS)
    n_points = "no tie points" if points is None else f"{len(points)} tie points"
    origin = ", ".join(f"{value:.12g}" for value in frame.ground)
    lines = [f"{request.out / where}: {len(exported_views)} images, {n_points}."]
    fitted = [each.fit_error for each in exported_views if each.fit_error is not None]
    if fitted:
        lines.append(_errors_text(fitted, f"{len(fitted)} fitted cameras differ from their sensor models"))
    n_exact = len(exported_views) - len(fitted)
    if n_exact:
        lines.append(f"{n_exact} cameras are exact.")
    unit = "" if is_local(frame.crs) else f" ({frame.crs.to_string()})"
    lines.append(f"Coordinates are metres from {origin}{unit}: see {request.out / EXPORT_RECORD}.")
    return "\n".join(lines)


def local_frame(opened_export: OpenedExport, area: ExportArea | None) -> LocalFrame:
    """The axes of an export: east, north and up over the curved Earth, or those of the scene where it is Cartesian.

    A local frame keeps its coordinates. The origin on a map is the middle of the area, in whole metres.
    """
    scene = opened_export.scene
    if is_local(scene.crs):
        return LocalFrame.shifted(scene.crs, np.zeros(3))
    if area is not None:
        west, south, east, north = area.bounds
        middle = np.array([(west + east) / 2, (south + north) / 2, sum(area.heights) / 2])
    else:
        ties = opened_export.ties
        points = ties if len(ties) else np.array([_station(view.sensor, scene) for view in scene.views])
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            raise GeometryError("No area is known over which the cameras could be fitted. Give --heights ZMIN ZMAX.")
        middle = np.median(points, axis=0)
    origin = np.rint(middle / ORIGIN_STEP_M) * ORIGIN_STEP_M
    if any(_is_cartesian(view.sensor) for view in scene.views):
        return LocalFrame.shifted(scene.crs, origin)
    return LocalFrame.tangent(scene.crs, origin)


def _is_cartesian(sensor: SensorModel) -> bool:
    """Whether a camera takes the map as Cartesian."""
    sensor = bare(sensor)
    return isinstance(sensor, FrameModel) and sensor.space == FRAME_SPACE


def _station(sensor: SensorModel, scene: Scene) -> Any:
    """Ground coordinates (3,) of the projection centre of a frame camera; NaN of other cameras."""
    sensor = bare(sensor)
    if not isinstance(sensor, FrameModel):
        return np.full(3, np.nan)
    return sensor.space.ground_from_cartesian(np.array([sensor.centre]))[0]


def check_errors(fit_errors: dict[str, FitError | None], request: ExportRequest, what: str) -> None:
    """Refuse cameras that are farther from their sensor model than is asked for.

    Raises
    ------
    GeometryError
        The error of a view exceeds the limit.
    """
    known = {name: fit for name, fit in fit_errors.items() if fit is not None}
    bad = {name: fit for name, fit in known.items() if not fit.max_px <= request.max_error_px}
    if not bad:
        return
    worst = max(bad, key=lambda name: bad[name].max_px)
    fit, n_others = bad[worst], len(bad) - 1
    others = f", as do {n_others} more of {len(fit_errors)} images" if n_others else ""
    is_of_area = request.kind in ("colmap", "nerf")
    advice = "Give a smaller --bounds or narrower --heights, or accept it" if is_of_area else "Accept it"
    raise GeometryError(
        f"The {what} of {worst} differs from its sensor model by up to {fit.max_px:.2f} px (RMS {fit.rms_px:.2f} px), "
        f"more than {request.max_error_px:g} px{others}. {advice} with --max-error PX."
    )


def _errors_text(fit_errors: Sequence[FitError], what: str) -> str:
    worst, rms = max(fit.max_px for fit in fit_errors), np.sqrt(np.mean([fit.rms_px**2 for fit in fit_errors]))
    return f"{what} by {worst:.3f} px at most, {rms:.3f} px RMS."


def _record(request: ExportRequest) -> dict[str, Any]:
    return {"format": request.kind, "request": request_as_dict(request), "versions": versions_record()}


def _export_rpcs(request: ExportRequest, progress: Progress) -> tuple[str, dict[str, Any]]:
    """Copies of images with corrected RPC, or adjustments of their RPC for Ames Stereo Pipeline."""
    with progress.stage("Opening images"):
        opened_export = open_export(request, False, progress)
    scene, names = opened_export.scene, file_names([view.name for view in opened_export.scene.views])
    record: dict[str, Any] = {**_record(request), "images": {}}
    displaced = [view.name for view in scene.views if isinstance(view.image, StraightenedImage)]
    if displaced:
        progress.note(
            f"{some_names(displaced)}: lines lie off their camera model in slow waves, which an RPC cannot express. "
            "They stay in the pixels."
        )
    if request.kind == "rpc":
        fit_errors, text = _write_copies(request, scene, names, record, progress), "corrected RPC in their tags"
    else:
        fit_errors, text = (
            _write_adjustments(request, scene, record),
            f"adjustments for --bundle-adjust-prefix {PREFIX}",
        )
    lines = [f"{request.out}: {len(scene.views)} images, {text}."]
    if fit_errors:
        lines.append(_errors_text(fit_errors, "They differ from the corrected sensor models"))
    return "\n".join(lines), record


def _write_copies(
    request: ExportRequest, scene: Scene, names: Sequence[str], record: dict[str, Any], progress: Progress
) -> list[FitError]:
    """Write the copies, and return the errors of their RPC."""
    fitted = {view.name: corrected_rpc(view, scene, request.heights) for view in scene.views}
    check_errors({name: fit for name, (_, fit) in fitted.items()}, request, "corrected RPC")
    with staged_export(request.out) as stage, progress.stage("Copying", len(scene.views)) as counted:
        for view, name in zip(scene.views, names, strict=True):
            rpc, fit = fitted[view.name]
            write_rpc_copy(stage / f"{name}.tif", view.path, rpc)
            record["images"][view.name] = {"file": f"{name}.tif", "source": str(view.path), **fit.as_dict()}
            counted.advance()
        write_export_record(stage, record)
    return [fit for _, fit in fitted.values()]


def corrected_rpc(view: View, scene: Scene, heights: tuple[float, float] | None) -> tuple[RpcCoefficients, FitError]:
    """An RPC that contains the corrections of a view, and its error over the whole image and a range of heights.

    heights : None: those of the view's RPC, or of the scene. A shifted RPC stays exact.

    Raises
    ------
    ConfigError
        No heights are known.
    GeometryError
        The sensor does not map all of the image.
    """
    column = row = 0.0
    sensor = view.sensor
    while isinstance(sensor, ShiftedModel):
        column, row, sensor = column + sensor.column, row + sensor.row, sensor.base_sensor
    if isinstance(sensor, RpcModel):
        return sensor.rpc.moved(column=column, row=row), FitError(0.0, 0.0)
    z_range = heights or view.sensor.height_bounds() or scene.heights
    if is_local(scene.crs):
        raise ConfigError("The scene's frame is local, where an RPC has no place. Give a scene with a CRS.")
    if z_range is None:
        raise ConfigError(f"No heights are known over which {view.name} could be fitted. Give --heights ZMIN ZMAX.")
    rpc = fit_rpc(view.sensor, view.image.shape, scene.crs, z_range).rpc
    at = PixelPart(0, 0, view.image.shape[1], view.image.shape[0]).grid(2 * GRID_POINTS)
    xy = np.tile(at, (GRID_HEIGHTS + 1, 1))
    xyz = view.sensor.ground_from_image(xy, np.repeat(np.linspace(*z_range, GRID_HEIGHTS + 1), len(at)))
    return rpc, FitError.of(RpcModel(rpc, scene.crs).image_from_ground(xyz) - xy)


def _write_adjustments(request: ExportRequest, scene: Scene, record: dict[str, Any]) -> list[FitError]:
    """Write the adjustment of each image against the RPC that it was delivered with, and return their errors."""
    if is_local(scene.crs):
        raise ConfigError("The scene's frame is local, and adjustments are geocentric. Give a scene with a CRS.")
    adjustments = {}
    for view in scene.views:
        if isinstance(bare(view.sensor), FrameModel):
            raise InputError(f"{view.name} has a frame camera. Adjustments are written for images with RPC.")
        delivered = RpcModel(read_rpc(view.path), scene.crs)
        heights = request.heights or scene.heights or delivered.height_bounds()
        adjustments[view.name] = fit_adjustment(delivered, view.sensor, view.image.shape, scene.crs, heights)
    fit_errors = {name: each.fit_error for name, each in adjustments.items()}
    files = [adjust_file_name(view.path) for view in scene.views]
    if len(set(files)) < len(files):
        raise InputError("Two images have the same name in different folders, and Ames Stereo Pipeline goes by names.")
    check_errors(dict(fit_errors), request, "adjusted RPC")
    with staged_export(request.out) as stage:
        for view, file in zip(scene.views, files, strict=True):
            each = adjustments[view.name]
            write_adjust(stage / file, each)
            record["images"][view.name] = {
                "file": file, "source": str(view.path), "translation_m": each.translation.tolist(),
                "turn_rad": each.turn.tolist(), **each.fit_error.as_dict(),
            }  # fmt: skip
        write_export_record(stage, record)
    return list(fit_errors.values())
