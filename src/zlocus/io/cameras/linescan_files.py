"""Tables of line scanners: focal planes, trajectories and line times (see docs/reference/linescan.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.crs import is_in_metres
from zlocus.io.number_table import NumberTable, read_number_table, write_number_table
from zlocus.sensors.earth_frame import WGS84, WGS84_EARTH, EarthSpace, between, east_north_up
from zlocus.sensors.linescan import FocalLine, LineTimes
from zlocus.sensors.trajectory import MIN_SAMPLES, Trajectory

CALIBRATION, TRAJECTORY, TIMES = "focal plane calibration", "trajectory", "table of line times"
POSITION_COLUMNS = {"projected": ("x", "y", "z"), "geographic": ("lon", "lat", "height")}
OMEGA_PHI_KAPPA, ROLL_PITCH_HEADING = ("omega", "phi", "kappa"), ("roll", "pitch", "heading")
QUATERNION = ("qx", "qy", "qz", "qw")
ROTATION_COLUMNS = (OMEGA_PHI_KAPPA, ROLL_PITCH_HEADING, QUATERNION)
WGS84_GEOCENTRIC = CRS.from_epsg(4978)
Rays = Literal["earth", "frame"]
# Largest difference of the norm of a quaternion from 1.
UNIT_LENGTH_TOLERANCE = 1e-3
MAX_DETECTORS = 1_000_000
# Heights above the ellipsoid outside of this range are a mistake in units or CRS.
MIN_CAMERA_HEIGHT_M, MAX_CAMERA_HEIGHT_M = -2e4, 2e6


def read_calibration(path: Path, name: str | None, focal_mm: float) -> FocalLine:
    """The detectors of a line of the focal plane.

    Columns of the table: `column`, `x_mm`, `y_mm`, and `line` where it holds several. name : of the line. Detectors
    that the table leaves out are interpolated by a cubic spline.

    Raises
    ------
    InputError
        The table is malformed, there is no such line, or its detectors do not follow one another along a line.
    """
    table = read_number_table(path, CALIBRATION, ("column", "x_mm", "y_mm"), ("line",))
    _need(table, ("column", "x_mm", "y_mm"))
    table = _of_line(table, name)
    if len(table) < 2:
        raise InputError(f"The {CALIBRATION} {path} holds one column only. At least two are needed.")
    table.check_monotonic("column")
    column, xy_mm = table.columns["column"], table.stacked(("x_mm", "y_mm"))
    if column[0] != 0.0 or (column != np.rint(column)).any():
        raise table.refuse(0, "columns are whole numbers from 0 on; number them so")
    n = int(column[-1]) + 1
    if n > len(column):
        if n > MAX_DETECTORS:
            raise table.refuse(len(column) - 1, f"column {n - 1} is more than the {MAX_DETECTORS} a line may have")
        from scipy.interpolate import CubicSpline

        xy_mm = CubicSpline(column, xy_mm)(np.arange(n))
    line = FocalLine(xy_mm, focal_mm)
    if not line.goes_on():
        raise InputError(
            f"The {CALIBRATION} {path} does not run along a line: some column lies behind the one before it. Mend "
            "x_mm and y_mm."
        )
    return line


def read_times(path: Path, n_rows: int) -> LineTimes:
    """The exposure times of rows, from a table with the columns `row` and `time`; linear in between.

    Raises
    ------
    InputError
        The table is malformed, or does not reach from the first row of the image to the last.
    """
    table = read_number_table(path, TIMES, ("row", "time"))
    _need(table, ("row", "time"))
    table.check_monotonic("row")
    table.check_monotonic("time", may_decrease=True)
    rows = table.columns["row"]
    if len(rows) < 2 or rows[0] > 0 or rows[-1] < n_rows - 1:
        raise InputError(
            f"The {TIMES} {path} goes from row {rows[0]:g} to {rows[-1]:g}, but the image has rows 0 to {n_rows - 1}. "
            "Give the times of the first and the last row, or more."
        )
    known = (rows > 0) & (rows < n_rows - 1)
    at = np.concatenate([[0.0], rows[known], [max(n_rows - 1, 1)]])
    return LineTimes(at, LineTimes(rows, table.columns["time"]).time(at))


def read_trajectory(
    path: Path, crs: CRS | None, rays: Rays, boresight_deg: FloatArray, lever_arm: FloatArray
) -> Trajectory:
    """The trajectory of a camera, in geocentric axes, or in those of the frame where rays are straight in it.

    The table has a column `time`, and columns of a position and a rotation (`POSITION_COLUMNS`, `ROTATION_COLUMNS`).
    crs : of the positions; None: WGS84 for `lon`, `lat`, or the scene's frame where rays are straight in it.
    boresight_deg : (3,) omega, phi, kappa that turn the platform's axes into the camera's; lever_arm : (3,) m from the
    point of the table to the projection centre, in the platform's axes.

    Raises
    ------
    InputError
        The table is malformed, times do not increase, or positions do not fit the CRS.
    """
    names = (
        "time",
        *POSITION_COLUMNS["projected"],
        *POSITION_COLUMNS["geographic"],
        *OMEGA_PHI_KAPPA,
        *ROLL_PITCH_HEADING,
        *QUATERNION,
    )
    table = read_number_table(path, TRAJECTORY, names)
    place = _one_of(table, tuple(POSITION_COLUMNS.values()))
    turn = _one_of(table, ROTATION_COLUMNS)
    _need(table, ("time", *place, *turn))
    if len(table) < MIN_SAMPLES:
        raise InputError(f"The {TRAJECTORY} {path} has {len(table)} rows. At least {MIN_SAMPLES} are needed.")
    table.check_monotonic("time")
    platform = _platform(table, turn)
    if rays == "frame":
        if place != POSITION_COLUMNS["projected"]:
            raise InputError(f"The {TRAJECTORY} {path} has {', '.join(place)}, but rays: frame needs x, y, z.")
        places = table.stacked(place)
    else:
        places, local = _on_earth(table, place, turn, crs)
        platform = local @ platform
    from scipy.spatial.transform import Rotation

    camera = Rotation.from_euler("XYZ", boresight_deg, degrees=True).as_matrix()
    camera_from_earth = np.ascontiguousarray((platform @ camera).swapaxes(-1, -2))
    return Trajectory(table.columns["time"] + 0.0, places + platform @ lever_arm, camera_from_earth)


def write_calibration(path: Path, lines: dict[str, FocalLine], comment: str, every: int = 1) -> None:
    """Write the lines of a focal plane as `read_calibration` reads them.

    every : write each such column and the last one, which is enough for straight lines.
    """
    last = {name: len(line.xy_mm) - 1 for name, line in lines.items()}
    columns = {name: np.unique([*range(0, last[name], every), last[name]]) for name in lines}
    xy_mm = np.concatenate([line.xy_mm[columns[name]] for name, line in lines.items()])
    column = np.concatenate([*columns.values()]).astype(float)
    names = [name for name, held in columns.items() for _ in held]
    write_number_table(path, {"column": column, "x_mm": xy_mm[:, 0], "y_mm": xy_mm[:, 1]}, comment, {"line": names})


def write_trajectory(path: Path, trajectory: Trajectory, comment: str, quaternions: bool = False) -> None:
    """Write a trajectory as `read_trajectory` reads it, without boresight and lever arm: x, y, z of its own axes, and
    the camera's omega, phi, kappa or quaternions in them."""
    from scipy.spatial.transform import Rotation

    turn: tuple[str, ...] = OMEGA_PHI_KAPPA
    rotations = Rotation.from_matrix(trajectory.rotations.swapaxes(-1, -2).copy())
    if quaternions:
        turn, turns = QUATERNION, rotations.as_quat()
    else:
        turns = rotations.as_euler("XYZ", degrees=True)
    values = np.column_stack([trajectory.times, trajectory.centres, turns])
    write_number_table(path, dict(zip(("time", *POSITION_COLUMNS["projected"], *turn), values.T, strict=True)), comment)


def write_times(path: Path, lines: LineTimes, comment: str) -> None:
    """Write line times as `read_times` reads them."""
    write_number_table(path, {"row": lines.rows, "time": lines.times}, comment)


def _need(table: NumberTable, names: tuple[str, ...]) -> None:
    for name in names:
        if name not in table.columns:
            raise InputError(f"The {table.what} {table.path} has no column {name}. Name it in the header.")


def _one_of(table: NumberTable, choices: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """The group of column names of which the table has some; it must be exactly one."""
    given = [names for names in choices if any(name in table.columns for name in names)]
    if len(given) != 1:
        allowed = " or ".join(", ".join(names) for names in choices)
        raise InputError(f"The {table.what} {table.path} must have the columns {allowed}, one of these only.")
    return given[0]


def _of_line(table: NumberTable, name: str | None) -> NumberTable:
    """The rows of the table that belong to one line."""
    lines = table.labels.get("line", ())
    held = sorted(set(lines))
    if not held and name is None:
        return table
    if name not in held:
        advice = f"Write line: with one of {', '.join(held)}" if held else "Leave line: out, or add that column"
        problem = "names no line" if name is None else f"asks for the line {name!r}"
        raise InputError(
            f"The {table.what} {table.path} has {len(held)} named lines, and the scene {problem}. {advice}."
        )
    rows = np.flatnonzero([line == name for line in lines])
    columns = {key: values[rows] for key, values in table.columns.items()}
    return NumberTable(table.path, table.what, columns, {}, tuple(table.lines[row] for row in rows))


def _platform(table: NumberTable, turn: tuple[str, ...]) -> FloatArray:
    """Rotations from the platform's axes to local ones, (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    if turn == QUATERNION:
        quaternions = table.stacked(turn)
        wrong = np.flatnonzero(np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > UNIT_LENGTH_TOLERANCE)
        if len(wrong):
            raise table.refuse(int(wrong[0]), "the quaternion qx, qy, qz, qw is not of length 1; mend it")
        return Rotation.from_quat(quaternions).as_matrix()
    if turn == OMEGA_PHI_KAPPA:
        return Rotation.from_euler("XYZ", table.stacked(turn), degrees=True).as_matrix()
    return navigation_rotations(*np.deg2rad(table.stacked(turn)).T)


def navigation_rotations(roll: FloatArray, pitch: FloatArray, heading: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) from an aircraft's axes (right, forward, up) to east, north and up.

    roll, pitch, heading : (n,) rad. heading is clockwise from north, pitch is positive nose up, and roll is positive
    right wing down; they turn, in the order heading, pitch, roll, about the moved axes down, right and forward
    (ARINC 705).
    """
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZXY", np.column_stack([-heading, pitch, roll])).as_matrix()


def _on_earth(
    table: NumberTable, place: tuple[str, ...], turn: tuple[str, ...], crs: CRS | None
) -> tuple[FloatArray, FloatArray]:
    """Geocentric positions (n, 3) m, and rotations (n, 3, 3) from the axes of the angles to geocentric axes.

    The axes of the angles are east, north and up, with grid north for a projected CRS. Quaternions are geocentric.
    """
    given, height = table.stacked(place), table.stacked(place)[:, 2]
    crs = _checked(table, place, crs)
    if crs.is_geocentric:
        places = np.column_stack(between(crs, WGS84_GEOCENTRIC).transform(*given.T))
        height = WGS84_EARTH.geographic_from_cartesian(places)[:, 2]
    else:
        places = EarthSpace(crs, WGS84).cartesian_from_ground(given)
    wrong = np.flatnonzero(~((height > MIN_CAMERA_HEIGHT_M) & (height < MAX_CAMERA_HEIGHT_M)))
    if len(wrong):
        raise table.refuse(int(wrong[0]), f"{', '.join(place)} are not a place in {crs.name}; check crs and the units")
    if turn == QUATERNION:
        if not crs.is_geocentric:
            raise InputError(f"The {table.what} {table.path} has quaternions, which need a geocentric crs: EPSG:4978.")
        return places, np.broadcast_to(np.eye(3), (len(table), 3, 3))
    if crs.is_projected:
        return places, WGS84_EARTH.poses(crs, given)[1].swapaxes(-1, -2)
    lon, lat, _ = WGS84_EARTH.geographic_from_cartesian(places).T
    return places, east_north_up(np.deg2rad(lon), np.deg2rad(lat))


def _checked(table: NumberTable, place: tuple[str, ...], crs: CRS | None) -> CRS:
    """The CRS of positions, checked: projected in metres or geocentric for x, y, z; geographic for lon, lat."""
    if place == POSITION_COLUMNS["geographic"]:
        crs = WGS84 if crs is None else crs
        fits = crs.is_geographic
    else:
        if crs is None:
            raise InputError(f"The {table.what} {table.path} has x, y, z. Name their crs in the scene file.")
        fits = crs.is_geocentric or crs.is_projected
    if not fits or crs.is_compound or not (crs.is_geographic or is_in_metres(crs)):
        raise InputError(
            f"The {table.what} {table.path} has {', '.join(place)}, which {crs.name} is not for. Allowed: a projected "
            "CRS in metres or EPSG:4978 for x, y, z; a geographic one for lon, lat, height; heights are ellipsoidal."
        )
    return crs
