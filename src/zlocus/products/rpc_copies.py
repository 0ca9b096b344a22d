"""Copies of images with another RPC in their tags: pixels, bands, masks and all other metadata stay as they are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rasterio
from rasterio.enums import ColorInterp, Interleaving, MaskFlags
from rasterio.rpc import RPC
from rasterio.windows import Window

from zlocus.core.errors import InputError
from zlocus.io.open_raster import open_raster
from zlocus.io.rasters import BLOCK_SIZE, COG_OPTIONS
from zlocus.sensors.rpc import RpcCoefficients

# Namespaces of metadata that describe the file itself, or the camera that is replaced, or of files beside the image.
OWN_NAMESPACES = (
    "IMAGE_STRUCTURE", "DERIVED_SUBDATASETS", "SUBDATASETS", "RPC", "GEOLOCATION", "COLOR_PROFILE", "TRE", "DES",
    "NITF_METADATA", "IMD", "IMAGERY",
)  # fmt: skip
# Pixels that are copied at a time, all bands together.
STRIP_PIXELS = 1 << 24


def write_rpc_copy(path: Path, image: Path, rpc: RpcCoefficients) -> None:
    """Write a copy of an image as GeoTIFF with an RPC, strip by strip.

    Raises
    ------
    InputError
        The image cannot be read.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part.tif")
    try:
        with (
            open_raster(image) as source,
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True, GDAL_PAM_ENABLED=False),
            rasterio.open(part, "w", **_profile(source, image), rpcs=gdal_rpc(rpc)) as copy,
        ):
            _describe(source, copy)
            has_mask = MaskFlags.per_dataset in source.mask_flag_enums[0] and not _has_alpha(source)
            for window in _strips(source):
                copy.write(source.read(window=window), window=window)
                if has_mask:
                    copy.write_mask(source.dataset_mask(window=window), window=window)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def gdal_rpc(rpc: RpcCoefficients) -> RPC:
    """An RPC as rasterio writes it. Both count pixels from the centre of the first one."""
    return RPC(
        height_off=rpc.height_off, height_scale=rpc.height_scale, lat_off=rpc.lat_off, lat_scale=rpc.lat_scale,
        long_off=rpc.lon_off, long_scale=rpc.lon_scale, line_off=rpc.line_off, line_scale=rpc.line_scale,
        samp_off=rpc.samp_off, samp_scale=rpc.samp_scale, line_num_coeff=list(rpc.line_num),
        line_den_coeff=list(rpc.line_den), samp_num_coeff=list(rpc.samp_num), samp_den_coeff=list(rpc.samp_den),
    )  # fmt: skip


def _has_alpha(source: rasterio.DatasetReader) -> bool:
    return ColorInterp.alpha in source.colorinterp


def _profile(source: rasterio.DatasetReader, image: Path) -> dict[str, Any]:
    """How the copy is stored: lossless, in tiles, with the bands and the type of the source."""
    if len(set(source.dtypes)) > 1:
        raise InputError(
            f"{image} has bands of different types ({', '.join(sorted(set(source.dtypes)))}). Write them as one type: "
            "gdal_translate -ot."
        )
    profile = {
        "driver": "GTiff", "width": source.width, "height": source.height, "count": source.count,
        "dtype": source.dtypes[0], "nodata": source.nodata, "tiled": True, "blockxsize": BLOCK_SIZE,
        "blockysize": BLOCK_SIZE, "compress": COG_OPTIONS["COMPRESS"], "BIGTIFF": "IF_SAFER",
        "interleave": "pixel" if source.interleaving == Interleaving.pixel else "band",
    }  # fmt: skip
    if source.colorinterp[:3] == (ColorInterp.red, ColorInterp.green, ColorInterp.blue):
        profile["photometric"] = "RGB"
    if "int" in source.dtypes[0] and "complex" not in source.dtypes[0]:
        profile["predictor"] = 2
    if source.crs is not None and not source.transform.is_identity:
        profile |= {"crs": source.crs, "transform": source.transform}
    return profile


def _describe(source: rasterio.DatasetReader, copy: Any) -> None:
    """Copy everything that describes the bands and the exposure."""
    copy.colorinterp = source.colorinterp
    copy.descriptions = source.descriptions
    copy.units = tuple(unit or "" for unit in source.units)
    copy.scales, copy.offsets = source.scales, source.offsets
    copy.update_tags(**source.tags())
    for band in source.indexes:
        copy.update_tags(band, **source.tags(band))
        if source.colorinterp[band - 1] == ColorInterp.palette:
            copy.write_colormap(band, source.colormap(band))
    for namespace in source.tag_namespaces():
        if namespace not in OWN_NAMESPACES and ":" not in namespace:
            copy.update_tags(ns=namespace, **source.tags(ns=namespace))
    points, crs = source.gcps
    if points and crs is not None and source.transform.is_identity:
        copy.gcps = (points, crs)


def _strips(source: rasterio.DatasetReader) -> Iterator[Window]:
    """Windows of the image, in rows of the copy's tiles."""
    width = source.width
    while width > BLOCK_SIZE and width * BLOCK_SIZE * source.count > STRIP_PIXELS:
        width = -(-width // (2 * BLOCK_SIZE)) * BLOCK_SIZE
    for row in range(0, source.height, BLOCK_SIZE):
        for col in range(0, source.width, width):
            yield Window(col, row, min(width, source.width - col), min(BLOCK_SIZE, source.height - row))
