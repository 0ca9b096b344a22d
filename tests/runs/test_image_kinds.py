"""Whole runs on images of every data type, with no-data values, masks and several bands."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy as copy_raster

from rendered_scenes import BLUNDER_M, PART, errors_of, read, run
from rpc_fixtures import write_image


def rewritten(images, folder, change, **profile):
    """Write the images again with changed pixels and another profile (data type, no-data value, compression)."""
    folder.mkdir()
    paths = []
    for name, path in images.paths.items():
        with rasterio.open(path) as source:
            pixels, rpc = source.read(1), source.rpcs
        paths.append(write_image(folder / f"{name}.tif", change(name, pixels.astype(float)), None, rpcs=rpc, **profile))
    return tuple(paths)


def byte(pixels, share=1.0):
    return (pixels * share / 4).clip(1, 255).astype(np.uint8)


def colours(pixels):
    return np.stack([byte(pixels, share) for share in (0.9, 1.0, 0.7)])


def clear(name, pixels):
    """An alpha band; the nadir image is transparent in its middle."""
    return with_hole(name, np.full(pixels.shape, 255.0), 0).astype(np.uint8)


def by_gamma(name, pixels):
    """Grey values of the nadir image after a gamma curve, as in the JPEG of a camera; those of the others unchanged."""
    return (byte(255 * (pixels / pixels.max()) ** 0.45, 4.0) if name == "nadir" else byte(pixels)).astype(np.uint8)


def with_hole(name, pixels, value):
    pixels = pixels.copy()
    if name == "nadir":
        pixels[70:84, 66:80] = value
    return pixels


BLOCKS = {"blockxsize": 64, "blockysize": 64}
VARIANTS = {
    "uint8": (lambda name, p: (p / 4).clip(1, 255).astype(np.uint8), {"nodata": 0}),
    "float32": (lambda name, p: (p / 300 - 1).astype(np.float32), {}),
    "float NaN": (lambda name, p: with_hole(name, p, np.nan).astype(np.float32), {}),
    "float nodata": (lambda name, p: with_hole(name, p, -9999).astype(np.float32), {"nodata": -9999}),
    "int16": (lambda name, p: with_hole(name, p - 300, -32768).astype(np.int16), {"nodata": -32768}),
    "colours": (lambda name, p: np.stack([(p * s / 4).clip(1, 255) for s in (0.9, 1.0, 0.7)]).astype(np.uint8),
                {"photometric": "RGB"}),
    "JPEG": (lambda name, p: byte(p), {"compress": "jpeg", "jpeg_quality": 90, "tiled": True, **BLOCKS}),
    "JPEG in colours": (lambda name, p: colours(p), {
        "photometric": "YCbCr", "compress": "jpeg", "jpeg_quality": 90, "tiled": True, "interleave": "pixel", **BLOCKS,
    }),
    "LZW": (lambda name, p: p.astype(np.uint16), {"compress": "lzw", "predictor": 2}),
    "ZSTD": (lambda name, p: (p / 300 - 1).astype(np.float32), {"compress": "zstd", "predictor": 3}),
    "alpha": (lambda name, p: np.stack([byte(p), clear(name, p)]), {"alpha": "YES"}),
    "colours with alpha": (lambda name, p: np.concatenate([colours(p), clear(name, p)[None]]),
                           {"photometric": "RGB", "alpha": "YES"}),
    "four bands": (lambda name, p: np.stack([p, p * 0 + 7, p[::-1], p * 0]).astype(np.uint16), {}),
    "gamma": (by_gamma, {}),
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
    has_hole = variant in ("float NaN", "float nodata", "int16", "alpha", "colours with alpha")
    assert ((views == 2).sum() > 150) == has_hole
    _, ortho = read(out / "ortho.tif")
    n_bands = 3 if "colours" in variant else 1
    assert ortho.dtypes == (read(paths[0])[1].dtypes[0],) * n_bands


def test_masked_image(images, tmp_path):
    """An internal mask covers part of one image; there the heights come from the two others."""
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
