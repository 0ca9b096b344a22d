"""Ground control points from a table: a row per image point (see docs/how-to/orient.md)."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray
from zlocus.io.atomic_write import write_atomically
from zlocus.io.number_table import NumberTable, read_number_table
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum
from zlocus.orientation.control import GroundControl
from zlocus.orientation.triangulate import Observations

WHAT = "table of control points"
NEEDED = ("name", "x", "y", "z", "image", "column", "row")
NUMBERS = ("x", "y", "z", "sigma", "sigma_z", "column", "row")
WORDS = ("name", "role", "image")
CONTROL, CHECK = "control", "check"


def read_control(
    path: Path, views: Sequence[View], vertical_datum: VerticalDatum = ELLIPSOIDAL, crs: CRS | None = None
) -> GroundControl:
    """The control and check points of a table, with ellipsoidal heights.

    Columns: `name`, `x`, `y`, `z` in the scene's frame, `image` (name of a view or of its file), `column`, `row`;
    optional are `sigma` (m, of each coordinate), `sigma_z` (m, of z alone) and `role` (control or check).
    vertical_datum : datum of z; crs : of x and y, needed where the datum is a geoid.

    Raises
    ------
    InputError
        The table is malformed; an image is not in the scene; an image point lies outside its image or is given twice;
        rows of one point contradict each other; a check point is in one image only; the geoid does not cover a point.
    """
    table = read_number_table(path, WHAT, NUMBERS, WORDS)
    for name in NEEDED:
        if name not in table.columns and name not in table.labels:
            raise InputError(f"The {WHAT} {path} has no column {name}. Name it in the header.")
    names, first, point = np.unique(np.array(table.labels["name"]), return_index=True, return_inverse=True)
    point = point.ravel().astype(np.int64)
    view = _views(table, views)
    xy = table.stacked(("column", "row"))
    _check_inside(table, views, view, xy)
    _check_once(table, view, point)
    xyz, sigma, is_check = table.stacked(("x", "y", "z")), _sigmas(table), _checks(table)
    for row in range(len(table)):
        start = first[point[row]]
        same = (xyz[row] == xyz[start]).all() and np.array_equal(sigma[row], sigma[start], equal_nan=True)
        if not same or is_check[row] != is_check[start]:
            raise table.refuse(
                row, f"the point {names[point[row]]} has other coordinates, sigma or role than on line "
                f"{table.lines[start]}; give all its rows the same",
            )  # fmt: skip
    ground = xyz[first]
    if crs is not None:
        ground = np.column_stack([ground[:, :2], ground[:, 2] + vertical_datum.undulation(ground[:, :2], crs)])
    control = GroundControl(
        tuple(map(str, names)), ground, sigma[first], is_check[first], Observations(view, point, xy)
    )
    in_one_image = control.is_check & (np.bincount(point) < 2)
    if in_one_image.any():
        which = int(np.flatnonzero(in_one_image)[0])
        raise table.refuse(
            int(first[which]), f"the check point {names[which]} is seen in one image only, which does not fix it; "
            "add another, or leave it out",
        )  # fmt: skip
    return control


def write_control(path: Path, control: GroundControl, views: Sequence[View]) -> None:
    """Write control and check points as a table that `read_control` reads, with ellipsoidal heights.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    rows = [(*NEEDED[:4], "sigma", "sigma_z", "role", *NEEDED[4:])]
    observations = control.observations
    for view, point, (column, row) in zip(observations.view, observations.point, observations.xy, strict=True):
        x, y, z = control.xyz[point]
        sigma, _, sigma_z = control.sigma_m[point]
        numbers = (f"{x:.4f}", f"{y:.4f}", f"{z:.4f}", f"{sigma:.4f}", f"{sigma_z:.4f}")
        role = CHECK if control.is_check[point] else CONTROL
        place = (views[view].name, f"{column:.4f}", f"{row:.4f}")
        rows.append((control.names[point], *numbers, role, *place))

    def write(part: Path) -> None:
        with part.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)

    write_atomically(path, write)


def _views(table: NumberTable, views: Sequence[View]) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Index of the view of each row, (n,)."""
    number = {view.path.name: i for i, view in enumerate(views)} | {view.name: i for i, view in enumerate(views)}
    for row, name in enumerate(table.labels["image"]):
        if name not in number:
            known = ", ".join(view.name for view in views)
            raise table.refuse(row, f"the scene has no image {name!r}; it has {known}")
    return np.array([number[name] for name in table.labels["image"]], np.int64)


def _check_inside(table: NumberTable, views: Sequence[View], view: np.ndarray, xy: FloatArray) -> None:
    sizes = np.array([one.image.shape[::-1] for one in views])[view]
    outside = np.flatnonzero(~((xy >= -0.5) & (xy <= sizes - 0.5)).all(axis=1))
    if len(outside):
        row = int(outside[0])
        cols, rows = sizes[row]
        raise table.refuse(
            row, f"column {xy[row, 0]:g}, row {xy[row, 1]:g} lies outside {views[view[row]].name}, which has {cols} "
            f"columns and {rows} rows",
        )  # fmt: skip


def _check_once(table: NumberTable, view: np.ndarray, point: np.ndarray) -> None:
    first_row: dict[tuple[int, int], int] = {}
    for row, key in enumerate(zip(view.tolist(), point.tolist(), strict=True)):
        if key in first_row:
            raise table.refuse(
                row, f"the point {table.labels['name'][row]} is given in {table.labels['image'][row]} on line "
                f"{table.lines[first_row[key]]} already; remove one",
            )  # fmt: skip
        first_row[key] = row


def _sigmas(table: NumberTable) -> FloatArray:
    """Standard deviations of x, y and z, (n, 3) m; NaN where the table has none."""
    flat = table.columns.get("sigma", np.full(len(table), np.nan))
    sigma = np.column_stack([flat, flat, table.columns.get("sigma_z", flat)])
    wrong = np.flatnonzero((sigma <= 0).any(axis=1))
    if len(wrong):
        raise table.refuse(int(wrong[0]), "a sigma is a standard deviation in metres, above 0")
    return sigma


def _checks(table: NumberTable) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each row belongs to a check point, (n,)."""
    roles = table.labels.get("role", (CONTROL,) * len(table))
    for row, role in enumerate(roles):
        if role not in (CONTROL, CHECK):
            raise table.refuse(row, f"the role {role!r} is neither {CONTROL} nor {CHECK}")
    return np.array([role == CHECK for role in roles], bool)
