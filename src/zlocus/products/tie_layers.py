"""ties.gpkg and ranking.gpkg: tie points, and how well images match there, as layers of points."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import OutputError
from zlocus.core.scene import Scene, is_local
from zlocus.core.sensor_model import FloatArray
from zlocus.io.vertical import ELLIPSOIDAL, VerticalDatum
from zlocus.matching.match_curve import FAIR, GOOD
from zlocus.matching.pair_labels import NOT_RANKED, LabelledTies
from zlocus.orientation.orientation import Orientation
from zlocus.orientation.triangulate import project_points

# Shapely geometries (n,) and their columns, (n,) each.
Batch = tuple[NDArray[np.object_], dict[str, NDArray[np.generic]]]
TIES = "ties.gpkg"
LABELS = ("good", "fair", "poor")
# Prefix of the columns with labels, and name of the column that holds all labels as text.
LABEL, TEXT = "label_", "labels"
# More images than this do not get a column each but one text, because SQLite has at most 2000 columns.
MAX_COLUMNS = 100


def write_ties(path: Path, orientation: Orientation, scene: Scene, vertical_datum: VerticalDatum = ELLIPSOIDAL) -> None:
    """Write the layer `ties`: one 3-D point per tie, in the scene's frame, with its height above `vertical_datum`.

    Columns: height_m; sigma_z_m, its standard deviation; n_images; images, their names with commas between;
    residual_px, the largest distance of an observation from the projected point. Ties whose rays do not meet are left
    out, and so are those where the geoid raster has no value. scene : with the orientation applied.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    seen, xyz = orientation.observations, orientation.xyz
    away = np.hypot(*(seen.xy - project_points([view.sensor for view in scene.views], seen, xyz)).T)
    residual = np.zeros(len(xyz))
    np.maximum.at(residual, seen.point, np.nan_to_num(away))
    n_images = np.bincount(seen.point, minlength=len(xyz)).astype(np.int32)
    names: list[list[str]] = [[] for _ in xyz]
    order = np.lexsort((seen.view, seen.point))
    for point, view in zip(seen.point[order].tolist(), seen.view[order].tolist(), strict=True):
        names[point].append(scene.views[view].name)
    xyz = vertical_datum.points_from_ellipsoidal(xyz, scene.crs)
    kept = np.isfinite(xyz).all(axis=1)
    images = np.array([",".join(parts) for parts in names], dtype=object)
    columns: dict[str, NDArray[np.generic]] = {
        "height_m": xyz[:, 2], "sigma_z_m": orientation.sigma_z_m, "n_images": n_images, "images": images,
        "residual_px": residual,
    }  # fmt: skip
    crs = vertical_datum.compound_crs(scene.crs)
    write_points(path, "ties", xyz[kept], {name: column[kept] for name, column in columns.items()}, crs)


def label_counts(labelled_ties: Sequence[LabelledTies], n_views: int) -> NDArray[np.int64]:
    """Counts (3, i, i) int64 of the labels good, fair and poor of the search image (last axis) against the reference.

    0 where the two were not compared.
    """
    counts = np.zeros((3, n_views, n_views), np.int64)
    for part in labelled_ties:
        at = np.ix_(part.views, part.views)
        for k, is_label in enumerate((part.labels == GOOD, part.labels == FAIR, part.labels < FAIR)):
            counts[k][at] += is_label.sum(axis=0)
    counts[:, np.arange(n_views), np.arange(n_views)] = 0
    return counts


def counted_pairs(counts: NDArray[np.int64], names: Sequence[str]) -> list[dict[str, Any]]:
    """Number of points and counts of labels of each pair of images that was compared, in either order.

    counts : of `label_counts`; names : of the scene's images.
    """
    return [
        {"images": [names[i], names[j]], "points": int(n.sum()), **dict(zip(LABELS, n.tolist(), strict=True))}
        for i, j in combinations(range(len(names)), 2)
        if (n := counts[:, i, j]).any()
    ]


def write_ranking(
    path: Path,
    labelled_ties: Sequence[LabelledTies],
    names: Sequence[str],
    crs: CRS,
    vertical_datum: VerticalDatum = ELLIPSOIDAL,
) -> None:
    """Write the layer `ranking`: one 3-D point per ranked tie point and reference, from south-west to north-east.

    Columns: reference; height_m; n_good, search images labelled 1 there; label_NAME of every image, NULL where it is
    the reference or was not compared; of more than `MAX_COLUMNS` images instead labels, NAME=LABEL of those that were
    compared, with commas between. names : of the scene's images. vertical_datum : of the heights that are written;
    points where its raster has no value are left out.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    is_wide = len(names) <= MAX_COLUMNS
    parts = [part.rows(len(names)) if is_wide else part.texts(names) for part in labelled_ties]
    labels_of_none = np.zeros((0, len(names)), np.int16) if is_wide else np.zeros(0, object)
    nothing = (np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int32), labels_of_none)
    xyz, reference, n_good, labels = (np.concatenate(arrays) for arrays in zip(nothing, *parts, strict=True))
    xyz = vertical_datum.points_from_ellipsoidal(xyz, crs)
    order = np.lexsort((reference, xyz[:, 1], xyz[:, 0]))
    order = order[np.isfinite(xyz[order, 2])]
    xyz, reference, n_good, labels = xyz[order], reference[order], n_good[order], labels[order]
    columns: dict[str, NDArray[np.generic]] = {
        "reference": np.array(names, dtype=object)[reference], "height_m": xyz[:, 2], "n_good": n_good,
    }  # fmt: skip
    nulls = {}
    if is_wide:
        for i, name in enumerate(column_names(names)):
            columns[name], nulls[name] = labels[:, i].copy(), labels[:, i] == NOT_RANKED
    else:
        columns[TEXT] = labels
    write_points(path, "ranking", xyz, columns, vertical_datum.compound_crs(crs), nulls)


def labels_in(text: str) -> dict[str, int]:
    """Labels by names of images, from a text of the column `TEXT`."""
    return {name: int(label) for name, _, label in (part.rpartition("=") for part in text.split(",") if part)}


def column_names(names: Sequence[str]) -> list[str]:
    """Columns of images, all different even where A and a count as equal, as they do in SQLite."""
    columns: list[str] = []
    for name in names:
        column, k = LABEL + name, 1
        while column.casefold() in {old.casefold() for old in columns}:
            k += 1
            column = f"{LABEL}{name}_{k}"
        columns.append(column)
    return columns


def write_points(
    path: Path,
    layer: str,
    xyz: FloatArray,
    columns: dict[str, NDArray[np.generic]],
    crs: CRS,
    nulls: dict[str, NDArray[np.bool_]] | None = None,
) -> None:
    """Write a GeoPackage with one layer of 3-D points, complete or not at all.

    xyz : (n, 3) m; columns, nulls : (n,) each, NULL where NaN or where `nulls` is set; a local frame has no CRS.
    """
    from shapely import points

    write_features(path, layer, "Point Z", [(points(xyz), columns)], crs, nulls)


def write_features(
    path: Path,
    layer: str,
    geometry_type: str,
    batches: Iterable[Batch],
    crs: CRS,
    nulls: dict[str, NDArray[np.bool_]] | None = None,
) -> None:
    """Write a GeoPackage with one layer, complete or not at all.

    batches : one or more; nulls : only where there is one batch; the rest as in `write_points`.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    # The import takes a third of a second where it also imports pandas.
    import pyogrio.raw
    from pyogrio.errors import DataLayerError, DataSourceError
    from shapely import to_wkb

    # GDAL requires this ending.
    part = path.with_name(f".{path.stem}.{os.getpid()}.part.gpkg")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="'crs' was not provided")
            for number, (geometries, columns) in enumerate(batches):
                masks = [(nulls or {}).get(name, np.zeros(len(geometries), bool)) for name in columns]
                pyogrio.raw.write(
                    part, np.asarray(to_wkb(geometries, output_dimension=3, flavor="iso"), dtype=object),
                    list(columns.values()), np.array(list(columns), dtype=object), field_mask=masks, layer=layer,
                    driver="GPKG", geometry_type=geometry_type, crs=None if is_local(crs) else crs.to_wkt(),
                    append=number > 0,
                )  # fmt: skip
        os.replace(part, path)
    except (OSError, DataSourceError, DataLayerError) as error:
        reason = (getattr(error, "strerror", None) or str(error)).rstrip(".")
        raise OutputError(f"{path} cannot be written: {reason}. Check the folder and the space left.") from error
    finally:
        part.unlink(missing_ok=True)
