"""The order of a point's run: scene, orientation, the place on the ground, its match curves, and how they are shown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import CurvesRequest, check_output
from zlocus.core.scene import Scene, check_overlap
from zlocus.core.sensor_model import FloatArray
from zlocus.io.scene_file import open_scene
from zlocus.matching.ground_pixels import check_resolution, default_cell
from zlocus.matching.match_scene import MatchScene, settle
from zlocus.matching.point_match import NEAREST_TIES, Place, cell_of, curves_at, height_nearby
from zlocus.orientation.orientation import supported
from zlocus.pipeline.preparing import (
    asked_crs,
    heights_of_ties,
    made_folder,
    note_orientation,
    oriented,
    possible_heights,
    taking_part,
)
from zlocus.products.match_curve_figures import PointReport, loci, point_text, write_point

ROUNDS, SETTLED_M = 20, 0.01


def run_point(request: CurvesRequest, config: RunConfig, progress: Progress) -> str:
    """What is to be said of a point; figures and tables are written to `request.out`.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        For what cannot be used, and a point that fewer than two images show.
    """
    check_output(request.out, request.overwrite)
    with progress.stage("Opening images"):
        scene = open_scene(request.inputs, asked_crs(request.crs))
        scene = replace(scene, views=tuple(sorted(scene.views, key=lambda view: view.name)))
        check_views(request, scene)
        heights = request.heights or scene.heights
        check_overlap(scene, possible_heights(scene, heights))
    orientation = oriented(scene, config.orientation, heights, progress)
    note_orientation(orientation, progress)
    ready = taking_part(orientation.apply(scene), orientation)
    z_range = heights or heights_of_ties(ready, orientation, config.orientation)
    z = sum(z_range) / 2
    cell_m = request.resolution or default_cell(ready, z)
    check_resolution(cell_m, ready, z, "--resolution")
    settled = settle(
        ready, cell_m, (0.0, 0.0), z_range, orientation.xyz, request.reference, config.pyramid, orientation.measured
    )
    ties = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    place = located(request, ready, settled, ties)
    with progress.stage("Match curves"):
        looked = curves_at(asked(request), request.reference, settled, place, config)
    report = PointReport.of(asked(request), looked, settled, scene.crs)
    with made_folder(request.out), progress.stage("Drawing"):
        write_point(request.out, report, loci(looked.views, report), config.selection)
    return point_text(report, config.selection)


def asked(request: CurvesRequest) -> str:
    """The point as it was asked for."""
    if request.at is not None:
        return f"--at {request.at[0]:.12g} {request.at[1]:.12g}"
    assert request.pixel is not None
    return f"--pixel {request.pixel[0]} {request.pixel[1]:g} {request.pixel[2]:g}"


def check_views(request: CurvesRequest, scene: Scene) -> None:
    """Refuse views that are not there, and pixels that their view does not have."""
    names = [view.name for view in scene.views]
    if request.reference is not None and request.reference not in names:
        raise ConfigError(
            f"--reference {request.reference} is not a view of this scene. Choose one of {', '.join(names)}."
        )
    if request.pixel is None:
        return
    name, row, col = request.pixel
    if name not in names:
        raise ConfigError(f"--pixel {name}: no view of this scene has that name. Choose one of {', '.join(names)}.")
    rows, cols = scene.views[names.index(name)].image.shape
    if not (-0.5 <= row <= rows - 0.5 and -0.5 <= col <= cols - 0.5):
        raise GeometryError(
            f"--pixel {name} {row:g} {col:g} lies outside the image, which has {rows} rows and {cols} columns. Give "
            f"ROW from 0 to {rows - 1} and COL from 0 to {cols - 1}."
        )


def located(request: CurvesRequest, scene: Scene, settled: MatchScene, ties: FloatArray) -> Place:
    """The point on the ground, at the height asked for, else at that of the ties around it. scene : with
    corrected cameras of the images as they are; ties : (n, 3) m.

    Raises
    ------
    GeometryError
        A pixel whose ray does not meet the ground, or a height that no tie tells.
    """
    if request.height is None and not len(ties):
        raise GeometryError(f"No tie point tells the height of {asked(request)}. Give it with --height Z.")
    if request.at is not None:
        xy = np.array(request.at)
        z = height_nearby(xy, ties) if request.height is None else request.height
    else:
        xy, z = pixel_on_ground(request, scene, ties)
    source = "as asked for"
    if request.height is None:
        away = float(np.hypot(*(ties[:, :2] - xy).T).min())
        n_ties = min(NEAREST_TIES, len(ties))
        source = f"the median of the {n_ties} nearest tie points, of which the first is {away:.1f} m away"
    cell = cell_of(xy, settled)
    middle = np.array(settled.transform(CellWindow(*cell, 1, 1), 0) * (0.5, 0.5))
    return Place(np.array([*xy, z]), source, cell, middle)


def pixel_on_ground(request: CurvesRequest, scene: Scene, ties: FloatArray) -> tuple[FloatArray, float]:
    """Where a pixel meets the ground, (2,) m and its height: of the ties around the place, which the height moves."""
    assert request.pixel is not None
    name, row, col = request.pixel
    (sensor,) = (view.sensor for view in scene.views if view.name == name)
    z = float(np.median(ties[:, 2])) if request.height is None else request.height
    seen: list[float] = []
    while True:
        xy = sensor.ground_from_image(np.array([[col, row]]), np.array([z]))[0, :2]
        if not np.isfinite(xy).all():
            raise GeometryError(
                f"--pixel {name} {row:g} {col:g} does not meet the ground at {z:.1f} m. Give another --height."
            )
        if request.height is not None or len(seen) >= ROUNDS or any(abs(z - old) < SETTLED_M for old in seen):
            return xy, z
        seen.append(z)
        z = height_nearby(xy, ties)
