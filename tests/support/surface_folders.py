"""A folder as `zlocus dsm` leaves it, made of given heights, without matching."""

from __future__ import annotations

import json

import numpy as np
from affine import Affine
from odc.geo.geobox import GeoBox

from evaluation_rasters import CELL_M, CRS, NORTH, WEST
from zlocus.io.rasters import RasterBands, RasterSink
from zlocus.matching.quality import Quality
from zlocus.products.rasters import flag_tags

TRANSFORM = Affine(CELL_M, 0, WEST, 0, -CELL_M, NORTH)


def written(path, values, bands, transform=TRANSFORM, mask=None):
    shape = values.shape[-2:]
    with RasterSink(path, GeoBox(shape, transform, CRS), bands) as sink:
        sink.write(0, 0, values, mask)


def surface_folder(folder, z, transform=TRANSFORM, is_filled=None):
    """The rasters and run.json of a surface. z : (r, c) m; is_filled : (r, c) cells whose heights were filled."""
    folder.mkdir()
    known = np.isfinite(z)
    flags = np.where(known, 0, Quality.NO_MATCH).astype(np.uint16)
    if is_filled is not None:
        flags[is_filled] |= np.uint16(Quality.FILLED)
    row, col = np.indices(z.shape)
    number = (row * 7 + col) % 251
    nan = float("nan")
    rasters = {
        "dsm.tif": (z.astype(np.float32), RasterBands("float32", nan, ("height above the ellipsoid",), "m")),
        "sigma.tif": (
            np.where(known, number / 1000, nan).astype(np.float32), RasterBands("float32", nan, ("sigma",), "m"),
        ),
        "quality.tif": (flags, RasterBands("uint16", descriptions=("quality bit flags",), tags=flag_tags())),
        "views.tif": (number.astype(np.uint8), RasterBands("uint8", 0, ("images used",))),
        "water.tif": (np.zeros(z.shape, np.uint8), RasterBands("uint8", descriptions=("water surface",))),
    }  # fmt: skip
    for name, (values, bands) in rasters.items():
        written(folder / name, values, bands, transform)
    colours = np.stack([number, number + 1, number + 2]).astype(np.uint16)
    bands = RasterBands("uint16", descriptions=("red", "green", "blue"), has_colours=True, has_mask=True)
    written(folder / "ortho.tif", colours, bands, transform, known)
    run = {
        "schema": 2, "command": "zlocus dsm", "created": "2026-01-01T00:00:00+00:00", "versions": {}, "inputs": [],
        "config": {"request": {"inputs": [], "out": str(folder)}, "options": {}}, "stages": [],
        "grid": {"crs": CRS, "transform": list(transform)[:6], "shape": list(z.shape)},
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps(run))
    return folder
