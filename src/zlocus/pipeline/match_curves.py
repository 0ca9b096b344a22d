"""`zlocus curves`: setup, the point on the ground, its match curves, and their figures, in this order."""

from __future__ import annotations

import numpy as np

from zlocus.core.errors import ConfigError, GeometryError
from zlocus.core.grid import CellWindow
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import CurvesRequest, SetupRequest, check_output
from zlocus.core.scene import Scene
from zlocus.core.sensor_model import FloatArray
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.point_match import NEAREST_TIES, Place, cell_of, curves_at, height_nearby
from zlocus.orientation.tie_heights import supported
from zlocus.pipeline.messages import note_orientation
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run, supported_views
from zlocus.products.match_curve_figures import write_point
from zlocus.products.point_report import PointReport, loci, point_text

# A pixel is followed to the ground in at most this many rounds, until its height changes by less than this.
MAX_ROUNDS, HEIGHT_TOLERANCE_M = 20, 0.01


def run_curves(request: CurvesRequest, config: RunConfig, progress: Progress) -> str:
    """Match one point, write figures and tables of its match curves to `request.out`, and return them as text.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        An input that cannot be used, or a point that fewer than two images show.
    """
    check_output(request.out, request.overwrite)
    setup_request = SetupRequest.of(request)
    with progress.stage("Opening images"):
        opened_inputs = open_inputs(setup_request, progress)
        check_views(request, opened_inputs.scene)
    orientation = orient_views(opened_inputs.scene, config.orientation, progress)
    note_orientation(orientation, progress, request.heights is not None)
    setup = set_up_run(setup_request, opened_inputs, orientation, config, progress)
    ties = orientation.xyz[supported(orientation.xyz, orientation.sigma_z_m)]
    place = requested_place(request, supported_views(setup.scene, orientation), setup.match_scene, ties)
    with progress.stage("Match curves"):
        curves = curves_at(requested_point(request), request.reference, setup.match_scene, place, config)
    report = PointReport.of(requested_point(request), curves, setup.match_scene, setup.scene.crs)
    with made_folder(request.out), progress.stage("Drawing"):
        write_point(request.out, report, loci(curves.views, report), config.selection)
    return point_text(report, config.selection)


def requested_point(request: CurvesRequest) -> str:
    """The point as the command line gives it."""
    if request.at is not None:
        return f"--at {request.at[0]:.12g} {request.at[1]:.12g}"
    assert request.pixel is not None
    return f"--pixel {request.pixel[0]} {request.pixel[1]:g} {request.pixel[2]:g}"


def check_views(request: CurvesRequest, scene: Scene) -> None:
    """Refuse names that no view has, and pixels outside their image.

    Raises
    ------
    ConfigError, GeometryError
        Such a name or pixel is given.
    """
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


def requested_place(request: CurvesRequest, scene: Scene, match_scene: MatchScene, ties: FloatArray) -> Place:
    """The point on the ground, at the requested height or else at the height of the tie points around it.

    scene : the views that take part, with corrected cameras; ties : (n, 3) m.

    Raises
    ------
    GeometryError
        A pixel whose ray does not meet the ground, or a height that no tie tells.
    """
    if request.height is None and not len(ties):
        raise GeometryError(f"No tie point tells the height of {requested_point(request)}. Give it with --height Z.")
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
    cell = cell_of(xy, match_scene)
    middle = np.array(match_scene.transform(CellWindow(*cell, 1, 1), 0) * (0.5, 0.5))
    return Place(np.array([*xy, z]), source, cell, middle)


def pixel_on_ground(request: CurvesRequest, scene: Scene, ties: FloatArray) -> tuple[FloatArray, float]:
    """Where the ray of a pixel meets the ground: position (2,) m, and height, m.

    Without a requested height, the height is that of the tie points around the position, which itself depends on the
    height: both are found in a few rounds.
    """
    assert request.pixel is not None
    name, row, col = request.pixel
    (sensor,) = (view.sensor for view in scene.views if view.name == name)
    z = float(np.median(ties[:, 2])) if request.height is None else request.height
    earlier: list[float] = []
    while True:
        xy = sensor.ground_from_image(np.array([[col, row]]), np.array([z]))[0, :2]
        if not np.isfinite(xy).all():
            raise GeometryError(
                f"--pixel {name} {row:g} {col:g} does not meet the ground at {z:.1f} m. Give another --height."
            )
        if (
            request.height is not None
            or len(earlier) >= MAX_ROUNDS
            or any(abs(z - old) < HEIGHT_TOLERANCE_M for old in earlier)
        ):
            return xy, z
        earlier.append(z)
        z = height_nearby(xy, ties)
