"""Whole runs on images of every data type, with nodata, masks and several bands."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy as copy_raster

from rendered_scenes import BLUNDER_M, PART, errors_of, read, run
from rpc_fixtures import write_image


def rewritten(images, folder, change, **profile):
    """The same images with pixels changed, in another data type, with another nodata value."""
    folder.mkdir()
    paths = []
    for name, path in images.paths.items():
        with rasterio.open(path) as source:
            pixels, rpc = source.read(1), source.rpcs
        paths.append(write_image(folder / f"{name}.tif", change(name, pixels.astype(float)), None, rpcs=rpc, **profile))
    return tuple(paths)


def with_hole(name, pixels, value):
    pixels = pixels.copy()
    if name == "nadir":
        pixels[70:84, 66:80] = value
    return pixels


VARIANTS = {
    "uint8": (lambda name, p: (p / 4).clip(1, 255).astype(np.uint8), {"nodata": 0}),
    "float32": (lambda name, p: (p / 300 - 1).astype(np.float32), {}),
    "float NaN": (lambda name, p: with_hole(name, p, np.nan).astype(np.float32), {}),
    "float nodata": (lambda name, p: with_hole(name, p, -9999).astype(np.float32), {"nodata": -9999}),
    "int16": (lambda name, p: with_hole(name, p - 300, -32768).astype(np.int16), {"nodata": -32768}),
    "colours": (lambda name, p: np.stack([(p * s / 4).clip(1, 255) for s in (0.9, 1.0, 0.7)]).astype(np.uint8),
                {"photometric": "RGB"}),
    "bands": (lambda name, p: np.stack([p, p * 0 + 7]).astype(np.uint16), {}),
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_kinds_of_images(images, tmp_path, variant):
    change, profile = VARIANTS[variant]
    paths = rewritten(images("sine"), tmp_path / "images", change, **profile)
    out = run(paths, tmp_path / "out", bounds=PART).out
    error, seen = errors_of(out, "sine")
    assert (np.abs(error[seen]) < BLUNDER_M).mean() > 0.97
    views = read(out / "views.tif")[0]
    has_hole = variant in ("float NaN", "float nodata", "int16")
    assert ((views == 2).sum() > 150) == has_hole
    _, ortho = read(out / "ortho.tif")
    n_bands = 3 if variant == "colours" else 1
    assert ortho.dtypes == (read(paths[0])[1].dtypes[0],) * n_bands


def test_masked_image(images, tmp_path):
    """An internal mask hides part of one image: there the two others decide."""
    paths = []
    for name, path in images("sine").paths.items():
        copy_raster(path, tmp_path / f"{name}.tif", driver="GTiff")
        paths.append(tmp_path / f"{name}.tif")
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(paths[0], "r+") as raster:
        raster.nodata = None
        mask = np.full(raster.shape, 255, np.uint8)
        mask[70:84, 66:80] = 0
        raster.write_mask(mask)
    out = run(tuple(paths), tmp_path / "out", bounds=PART).out
    error, seen = errors_of(out, "sine")
    assert (np.abs(error[seen]) < BLUNDER_M).mean() > 0.97
    assert (read(out / "views.tif")[0] == 2).sum() > 150
