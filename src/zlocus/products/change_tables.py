"""Tables and the picture of a change: volumes as CSV and GeoPackage, and a map of what was raised and lowered."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS
from rasterio.enums import Resampling

from zlocus.core.errors import OutputError
from zlocus.evaluation.change_noise import ChangeNoise
from zlocus.evaluation.volumes import ChangeClass, Volume
from zlocus.io.atomic_write import write_atomically
from zlocus.io.grid_inputs import PolygonFeatures
from zlocus.io.open_raster import open_raster

MAP_PX, DPI = 900, 110
# Colours of the map are saturated at this many times the spread of unchanged ground.
SATURATED_AT = 4.0
LAYER = "volumes"


def write_volumes(
    table: Path,
    layer: Path,
    features: PolygonFeatures,
    names: Sequence[str],
    volumes: Sequence[Volume],
    crs: CRS | None,
) -> None:
    """Write the volumes of polygons as CSV and, with the polygons, as GeoPackage.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    import pyogrio.raw

    rows = [
        {"number": int(number), "name": name, **volume.as_dict()}
        for number, name, volume in zip(features.numbers, names, volumes, strict=True)
    ]
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]) if rows else ["number"], lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: "" if _is_nan(value) else value for key, value in row.items()} for row in rows)
    write_atomically(table, lambda part: part.write_text(text.getvalue(), encoding="utf-8"))

    fields = list(rows[0]) if rows else []
    columns = [np.array([row[name] for row in rows], object if name == "name" else None) for name in fields]
    # GDAL requires this ending.
    part = layer.with_name(f".{layer.stem}.{os.getpid()}.part.gpkg")
    try:
        pyogrio.raw.write(
            part, shapely.to_wkb(features.polygons), columns, fields, layer=LAYER, driver="GPKG",
            geometry_type="Unknown", crs=None if crs is None else crs.to_wkt(),
        )  # fmt: skip
        os.replace(part, layer)
    except (OSError, RuntimeError, ValueError) as error:  # includes pyogrio's own
        raise OutputError(f"{layer} cannot be written: {error}. Check the folder and the space left.") from error
    finally:
        part.unlink(missing_ok=True)


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _colour(numbers: tuple[int, int, int]) -> tuple[float, float, float]:
    red, green, blue = (number / 255.0 for number in numbers)
    return red, green, blue


def write_change_picture(
    path: Path, difference: Path, classes: Path, features: PolygonFeatures | None, noise: ChangeNoise
) -> None:
    """Write a PNG of the differences beside the classes, with the outlines of polygons.

    Raises
    ------
    OutputError
        It cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    with open_raster(difference, "raster") as file:
        step = max(1.0, max(file.shape) / MAP_PX)
        shape = max(1, round(file.height / step)), max(1, round(file.width / step))
        left, bottom, right, top = file.bounds
        values = file.read(1, out_shape=shape, resampling=Resampling.average)
    with open_raster(classes, "raster") as file:
        kind = file.read(1, out_shape=shape, resampling=Resampling.nearest)
    figure = Figure(figsize=(11.0, 1.4 + 5.0 * min(shape[0] / shape[1], 2.0)), layout="constrained")
    axes, beside = figure.subplots(1, 2, sharex=True, sharey=True)
    most = max(SATURATED_AT * noise.spread_m, 1e-3)
    extent = (left, right, bottom, top)
    drawn = axes.imshow(values, cmap="RdBu_r", vmin=-most, vmax=most, extent=extent, interpolation="nearest")
    figure.colorbar(
        drawn,
        ax=[axes, beside],
        orientation="horizontal",
        shrink=0.5,
        aspect=40,
        label="height in B less height in A, m",
    )
    colours = {
        ChangeClass.UNKNOWN: (255, 255, 255), ChangeClass.UNCHANGED: (225, 225, 225), ChangeClass.RAISED: (178, 24, 43),
        ChangeClass.LOWERED: (33, 102, 172),
    }  # fmt: skip
    table = np.array([colours[each] for each in ChangeClass], np.uint8)
    beside.imshow(table[kind], extent=extent, interpolation="nearest")
    patches = [Patch(color=_colour(colours[each]), label=each.name.lower()) for each in list(ChangeClass)[1:]]
    beside.legend(handles=patches, fontsize=7, loc="lower left")
    for each in (axes, beside):
        each.tick_params(labelsize=6)
        each.ticklabel_format(useOffset=False, style="plain")
        for polygon in [] if features is None else features.polygons:
            for part in shapely.get_parts(polygon):
                each.plot(*shapely.get_coordinates(part.exterior).T, color="black", linewidth=0.8)
    axes.set_title("difference", loc="left", fontsize=9)
    beside.set_title("class", loc="left", fontsize=9)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    write_atomically(path, lambda part: figure.savefig(part, format="png", dpi=DPI))
