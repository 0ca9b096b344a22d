"""Rendered images as a vendor ships them: a basic product of WorldView-3 for each, with its pixels in tiles.

What a product holds is told in `zlocus.io.deliveries.maxar_products`.
"""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

from zlocus.core.scene import Acquisition
from zlocus.sensors.rpc import RpcCoefficients
from zlocus.synthetic.acquisitions import SATELLITE, acquisition_of, described
from zlocus.synthetic.files import RenderedScene, fit_exposure, new_folder, write_image
from zlocus.synthetic.scenes import SceneSpec, exposures_of

FOLDER, ORDER = "delivery", "500648062040_01"
TILE_PX = 256


def deliver(spec: SceneSpec, rendered_scene: RenderedScene) -> Path:
    """Replace the images of a rendered scene by a folder with a product of each, and return that folder.

    Raises
    ------
    OutputError
        The folder exists already, or cannot be written.
    """
    folder = rendered_scene.folder / FOLDER
    with new_folder(folder) as part:
        for index, exposure in enumerate(exposures_of(spec)):
            with rasterio.open(rendered_scene.images[exposure.view.name]) as image:
                pixels = image.read(1)
            acquisition = acquisition_of(spec, exposure, index)
            _write_product(part, index + 1, pixels, fit_exposure(spec, exposure).rpc, acquisition)
    for path in rendered_scene.images.values():
        path.unlink()
    return folder


def _write_product(
    folder: Path, number: int, pixels: NDArray[np.integer], rpc: RpcCoefficients, acquisition: Acquisition
) -> None:
    assert isinstance(acquisition.time, datetime.datetime)
    place = f"{ORDER}_P{number:03}"
    product = folder / f"{place}_PAN"
    product.mkdir()
    stamp = f"{acquisition.time:%y%b%d%H%M%S}".upper()
    name = f"{stamp}-P1BS-{place}"
    tiles = {}
    rows, cols = pixels.shape
    for top in range(0, rows, TILE_PX):
        for left in range(0, cols, TILE_PX):
            tile = pixels[top : top + TILE_PX, left : left + TILE_PX]
            file = f"{stamp}-P1BS_R{top // TILE_PX + 1}C{left // TILE_PX + 1}-{place}.TIF"
            write_image(product / file, tile, None)
            tiles[file] = (top, left, *tile.shape)
    (product / f"{name}.TIL").write_text(_til(tiles))
    (product / f"{name}.IMD").write_text(_imd(pixels.shape, acquisition))
    (product / f"{name}.RPB").write_text(_rpb(rpc))


def _til(tiles: dict[str, tuple[int, int, int, int]]) -> str:
    """The index of tiles. tiles : first row and column, rows and columns of each file."""
    groups = "".join(
        f'BEGIN_GROUP = TILE_{number}\n\tfilename = "{file}";\n\tULColOffset = {left};\n\tULRowOffset = {top};\n'
        f"\tLRColOffset = {left + cols - 1};\n\tLRRowOffset = {top + rows - 1};\nEND_GROUP = TILE_{number}\n"
        for number, (file, (top, left, rows, cols)) in enumerate(tiles.items(), 1)
    )
    return f'bandId = "P";\nnumTiles = {len(tiles)};\ntileUnits = "Pixels";\ntileOverlap = 0;\n{groups}END;\n'


def _imd(shape: tuple[int, ...], acquisition: Acquisition) -> str:
    said = described(acquisition)
    quoted = said | {"satId": f'"{said["satId"]}"'}
    lines = "".join(f"\t{name} = {text};\n" for name, text in quoted.items())
    return (
        f'version = "R";\nbandId = "P";\npanSharpenAlgorithm = "None";\nnumRows = {shape[0]};\n'
        f"numColumns = {shape[1]};\nBEGIN_GROUP = BAND_P\n\tabsCalFactor = 1.0e-02;\nEND_GROUP = BAND_P\n"
        f"BEGIN_GROUP = IMAGE_1\n{lines}END_GROUP = IMAGE_1\nEND;\n"
    )


def _rpb(rpc: RpcCoefficients) -> str:
    scalars = {
        "lineOffset": rpc.line_off, "sampOffset": rpc.samp_off, "latOffset": rpc.lat_off, "longOffset": rpc.lon_off,
        "heightOffset": rpc.height_off, "lineScale": rpc.line_scale, "sampScale": rpc.samp_scale,
        "latScale": rpc.lat_scale, "longScale": rpc.lon_scale, "heightScale": rpc.height_scale,
    }  # fmt: skip
    lists = {
        "lineNumCoef": rpc.line_num, "lineDenCoef": rpc.line_den, "sampNumCoef": rpc.samp_num,
        "sampDenCoef": rpc.samp_den,
    }  # fmt: skip
    lines = [f"\t{name} = {float(value)!r};\n" for name, value in scalars.items()]
    for name, values in lists.items():
        lines.append(f"\t{name} = (\n" + ",\n".join(f"\t\t\t{float(value):+.17E}" for value in values) + ");\n")
    heading = f'satId = "{SATELLITE}";\nbandId = "P";\nSpecId = "RPC00B";\n'
    return f"{heading}BEGIN_GROUP = IMAGE\n{''.join(lines)}END_GROUP = IMAGE\nEND;\n"
