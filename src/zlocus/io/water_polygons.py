"""Read the polygons of water surfaces, with the levels that an attribute gives them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.grid_inputs import read_features
from zlocus.io.height_values import is_fill
from zlocus.io.safe_text import decimal

# No water on the Earth, above any datum in use, has a level beyond these, m.
LEVELS_M = (-1000.0, 10000.0)
# A Shapefile holds attributes, CRS and encoding in files of their own.
SHAPEFILE_SUFFIXES = (".dbf", ".prj", ".cpg")


@dataclass(frozen=True)
class WaterPolygons:
    """Polygons of water surfaces, each in one piece.

    path : of their file; polygons : (n,) shapely polygons in the grid's CRS; names : (n,) what messages call them;
    levels_m : (n,) float64, in the run's vertical datum, NaN where the images are to tell.
    """

    path: Path
    polygons: NDArray[Any]
    names: tuple[str, ...]
    levels_m: NDArray[np.float64]

    def only(self, which: NDArray[np.bool_]) -> WaterPolygons:
        """Some of the polygons. which : (n,) bool."""
        names = tuple(name for name, is_kept in zip(self.names, which, strict=True) if is_kept)
        return WaterPolygons(self.path, self.polygons[which], names, self.levels_m[which])


def read_water(path: Path, crs: CRS, field: str | None) -> WaterPolygons:
    """The water surfaces in a vector file; every part of a multipolygon is one of its own.

    field : attribute that holds the level of each, m; None: the images tell all levels.

    Raises
    ------
    InputError
        See `read_features`; or a value of the attribute is no height.
    """
    features = read_features(path, crs, field)
    n = len(features.polygons)
    levels = np.full(n, np.nan) if features.values is None else _levels(path, features.numbers, features.values, field)
    parts, of_feature = shapely.get_parts(features.polygons, return_index=True)
    n_parts = np.bincount(of_feature, minlength=n)
    names, seen = list[str](), np.zeros(n, np.int64)
    for feature in of_feature:
        seen[feature] += 1
        part = f", part {seen[feature]}" if n_parts[feature] > 1 else ""
        names.append(f"polygon {features.numbers[feature]}{part}")
    return WaterPolygons(path, parts, tuple(names), levels[of_feature])


def files_of_water(path: Path) -> list[Path]:
    """The files of a vector file on which levels depend: of a Shapefile also those beside it."""
    beside = [path.with_suffix(suffix) for suffix in SHAPEFILE_SUFFIXES] if path.suffix.lower() == ".shp" else []
    return [path, *(each for each in beside if each.is_file())]


def _levels(path: Path, numbers: NDArray[np.int64], values: NDArray[Any], field: str | None) -> NDArray[np.float64]:
    """Levels (n,) m in the values of an attribute; NaN where it is empty."""
    levels = np.full(len(values), np.nan)
    for k, value in enumerate(values):
        if _is_unset(value):
            continue
        levels[k] = decimal(str(value))
        if not LEVELS_M[0] < levels[k] < LEVELS_M[1]:
            raise InputError(
                f"Polygon {numbers[k]} of {path} has {quoted(str(value))} in {field}, which is no water level in "
                "metres. Correct it, or leave it empty to have the level found from the images."
            )
    return levels


def _is_unset(value: Any) -> bool:
    """Whether a value of an attribute says nothing: it is missing, an empty text, or a number for no data."""
    if value is None or isinstance(value, str):
        return not (value or "").strip()
    return isinstance(value, int | float | np.number) and bool(np.isnan(value) or is_fill(np.array(value)))
