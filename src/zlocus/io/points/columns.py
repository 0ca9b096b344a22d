"""The columns of tables of points: which one holds what, by the names that programs and surveyors give them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.quoting import first_names

DEGREES_OF_X = ("longitude", "lon", "long", "lng")
DEGREES_OF_Y = ("latitude", "lat")
# Usual names of the columns by their role, in lower case. Those of ICESat-2's land product (ATL08) are among them.
ROLES: dict[str, tuple[str, ...]] = {
    "x": ("x", "easting", "east", "e", "x_m", "rechtswert", "ostwert", *DEGREES_OF_X),
    "y": ("y", "northing", "north", "n", "y_m", "hochwert", "nordwert", *DEGREES_OF_Y),
    "z": ("z", "h", "height", "elevation", "elev", "altitude", "alt", "z_m", "height_m", "elevation_m", "hoehe", "höhe",
          "ellipsoidal_height", "orthometric_height", "h_te_best_fit"),
    "sigma": ("sigma", "sigma_z", "sigma_h", "std", "std_z", "stddev", "vertical_accuracy", "h_te_uncertainty"),
    "sigma_xy": ("sigma_xy", "horizontal_accuracy"),
    "cover": ("class", "cover", "land_cover", "landcover", "vegetated", "classification", "klasse"),
    "time": ("time", "date", "datetime", "timestamp", "delta_time", "epoch"),
    "measured_x": ("measured_x", "x_measured"),
    "measured_y": ("measured_y", "y_measured"),
}  # fmt: skip
NEEDED = ("x", "y", "z")
MAX_NAMED = 12


def columns_of(
    path: Path, names: Sequence[str], given: Mapping[str, str], needed: Sequence[str] = NEEDED
) -> dict[str, str]:
    """The name of the column of each role that a table has. Upper and lower case count as the same.

    names : of its columns. given : names that were given by role, which go before the usual ones. needed : roles that
    it must have.

    Raises
    ------
    ConfigError
        A column that was given is not there.
    InputError
        A needed column is missing, or two columns may have one role.
    """
    by_name = {name.strip().lower(): name for name in reversed(names)}
    found: dict[str, str] = {}
    for role, usual in ROLES.items():
        if role in given:
            if given[role].strip().lower() not in by_name:
                raise ConfigError(
                    f"--columns {role}={given[role]}: {path} has no such column. It has "
                    f"{first_names(names, MAX_NAMED)}."
                )
            found[role] = by_name[given[role].strip().lower()]
            continue
        candidates = [by_name[name] for name in usual if name in by_name and name not in taken(given)]
        if len(candidates) > 1:
            raise InputError(
                f"{path} has the columns {' and '.join(candidates)}, each of which may be {role}. Name the one with "
                f"--columns {role}={candidates[0]}."
            )
        if candidates:
            found[role] = candidates[0]
        elif role in needed:
            raise InputError(
                f"{path} has no column that is known as {role}; it has {first_names(names, MAX_NAMED)}. Name it with "
                f"--columns {role}=NAME."
            )
    return found


def taken(given: Mapping[str, str]) -> set[str]:
    """Names of the columns that were given a role, in lower case."""
    return {name.strip().lower() for name in given.values()}


def are_degrees(columns: Mapping[str, str]) -> bool:
    """Whether x and y are longitude and latitude by the names of their columns.

    columns : see `columns_of`.
    """
    return columns.get("x", "").strip().lower() in DEGREES_OF_X and columns.get("y", "").strip().lower() in DEGREES_OF_Y


def columns_from_text(text: str) -> dict[str, str]:
    """Names of columns by role from the text of an option: x=EAST,y=NORTH.

    Raises
    ------
    ConfigError
        The text is not of this form.
    """
    found = {}
    for part in text.split(","):
        role, sign, name = part.partition("=")
        if not sign or not role.strip() or not name.strip():
            raise ConfigError(f"--columns {text} is not understood. Give roles and names such as x=EAST,y=NORTH,z=H.")
        found[role.strip().lower()] = name.strip()
    return found
