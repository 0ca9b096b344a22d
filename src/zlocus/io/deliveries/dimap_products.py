"""Products of Airbus in DIMAP: Pleiades, Pleiades Neo, SPOT 6 and 7.

A delivery holds a folder for each product, with `DIM_*.XML` (the index), `RPC_*.XML`, tiles `IMG_*_R1C1.TIF` or `.JP2`,
and `MASKS/*_MSK.GML`. Panchromatic and multispectral images have folders of their own.

Source: Airbus, Pleiades Imagery User Guide (2012), appendix on DIMAP V2.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from zlocus.core.errors import InputError
from zlocus.core.scene import Acquisition
from zlocus.io.cameras.dimap import rpc_file_of
from zlocus.io.deliveries.delivered_image import (
    DeliveredImage,
    Found,
    RefusedProduct,
    SetAside,
    Spectrum,
    found_in_products,
)
from zlocus.io.image_acquisition import first_number, sun_direction, time_in
from zlocus.io.stored_files import file_exists
from zlocus.io.tiled_products import ADVICE, DIMAP_INDEX, named_file, named_tiles, whole_number
from zlocus.io.vendor_xml import fields_of, plain_xml

# What lies beside the images and is none: previews and icons.
PREVIEWS = ("PREVIEW_", "ICON_")
TILE_NAME = re.compile(r"IMG_(?P<product>.*)_R\d+C\d+\.(?:TIF|TIFF|JP2)", re.IGNORECASE)
ORTHO = "is an ortho-image, whose pixels have no camera: order the product as PRIMARY (or SENSOR)"


def dimap_products(files: Sequence[Path]) -> Found:
    """The images of all `DIM_*.XML` of a delivery."""
    previews = tuple(SetAside(path, "") for path in files if path.name.upper().startswith(PREVIEWS))
    indices = [path for path in files if DIMAP_INDEX.fullmatch(path.name) is not None]
    # A product has a folder of its own, with all its files.
    found = found_in_products(
        indices, _product, lambda index: [path for path in files if path.is_relative_to(index.parent)]
    )
    return _without_index(files, found).with_more(Found(set_aside=previews)).with_more(found)


def _product(path: Path) -> Found:
    root = plain_xml(path)
    if root.find(".//Raster_Dimensions") is None:
        return Found()
    if (root.findtext(".//RASTER_GEOMETRY") or "").strip().upper() == "GROUND":
        return Found(set_aside=tuple(SetAside(each, ORTHO) for each in (path, *named_tiles(path))))
    return Found((dimap_image(path, root),))


def _without_index(files: Sequence[Path], found: Found) -> Found:
    """The tiles that no index names, where an RPC of their product lies beside them: one refusal for each product."""
    names = {path: match for path in files if (match := TILE_NAME.fullmatch(path.name)) is not None}
    tiles: dict[Path, list[Path]] = {}
    for path, match in names.items():
        index = path.with_name(f"DIM_{match['product']}.XML")
        if path not in found.claimed and path.with_name(f"RPC_{match['product']}.XML") in files:
            tiles.setdefault(index, []).append(path)
    return Found(
        refused=tuple(
            RefusedProduct(
                index,
                f"{index} is missing, so that it is not known how {named[0].name} and {len(named) - 1} more tiles lie. "
                f"{ADVICE}",
                frozenset(path for path in files if path.is_relative_to(index.parent)),
            )
            for index, named in tiles.items()
            if len(named) > 1
        )
    )


def dimap_image(path: Path, root: Element) -> DeliveredImage:
    """The image of a `DIM_*.XML`.

    Raises
    ------
    InputError
        The index is damaged.
    """
    camera, missing_camera = None, ""
    try:
        camera = rpc_file_of(path, root)
    except InputError as error:
        missing_camera = str(error)
    tiles = named_tiles(path)
    groups = root.findall(".//Data_Access/Data_Files")
    # Where the bands are in several groups of files, the first group has red, green and blue; the others are claimed.
    others = [named_file(path, at.get("href", "")) for each in groups[1:] for at in each.iter("DATA_FILE_PATH")]
    named = [each.get("href") for each in root.iterfind(".//Quality_Mask//COMPONENT_PATH")]
    masks = [named_file(path, name) for name in named if name]
    pixels = tiles[0] if len(tiles) == 1 else path
    dimensions = [root.findtext(f".//Raster_Dimensions/{name}") for name in ("NROWS", "NCOLS")]
    return DeliveredImage(
        product=path.stem[len("DIM_") :],
        pixels=pixels,
        camera=camera,
        acquisition=_acquisition(root),
        spectrum=_spectrum(root),
        colour_bands=_colour_bands(root),
        shape=(whole_number(dimensions[0], "NROWS", path), whole_number(dimensions[1], "NCOLS", path)),
        masks=tuple(mask for mask in masks if file_exists(mask)),
        missing_masks=tuple(mask for mask in masks if not file_exists(mask)),
        claimed=frozenset((path, *tiles, *others)),
        missing_camera=missing_camera,
    )


def _spectrum(root: Element) -> Spectrum:
    n_bands = (root.findtext(".//Raster_Dimensions/NBANDS") or "").strip()
    processing = (root.findtext(".//SPECTRAL_PROCESSING") or "").strip().upper()
    if processing in ("P", "PAN", "PA") or (not processing and n_bands == "1"):
        return Spectrum.PANCHROMATIC
    return Spectrum.MULTISPECTRAL if processing.startswith("MS") or processing == "XS" else Spectrum.OTHER


def _colour_bands(root: Element) -> tuple[int, int, int] | None:
    """Numbers of the bands that the index shows as red, green and blue."""
    order = root.find(".//Band_Display_Order")
    if order is None:
        return None
    number = {
        (each.findtext("BAND_ID") or "").strip(): (each.findtext("BAND_INDEX") or "").strip()
        for each in root.iterfind(".//Raster_Index")
    }
    shown = [(order.findtext(f"{colour}_CHANNEL") or "").strip() for colour in ("RED", "GREEN", "BLUE")]
    texts = [number.get(band, "") for band in shown]
    if not all(text.isdecimal() and int(text) > 0 for text in texts) or len(set(texts)) < len(texts):
        return None
    red, green, blue = (int(text) for text in texts)
    return red, green, blue


def _acquisition(root: Element) -> Acquisition:
    """When and how the image was taken, at the centre of the product where the index says it there."""
    strip = root.find(".//Strip_Source")
    said = {} if strip is None else fields_of(strip)
    date, time = time_in(f"{said.get('imaging_date', '')}T{said.get('imaging_time', '')}") or (None, None)
    places = root.findall(".//Located_Geometric_Values")
    centre = [each for each in places if (each.findtext("LOCATION_TYPE") or "").strip().lower() == "center"]
    angles = fields_of((centre or places)[0]) if places else {}
    names = [said.get("mission", ""), said.get("mission_index", "")]
    cloud = first_number(fields_of(root), ("cloud_coverage",))
    return Acquisition(
        date=date,
        time=time,
        satellite="".join(names) or None,
        sun_direction=sun_direction(first_number(angles, ("sun_azimuth",)), first_number(angles, ("sun_elevation",))),
        view_azimuth_deg=_view_azimuth_deg(angles),
        incidence_deg=first_number(angles, ("incidence_angle",)),
        off_nadir_deg=first_number(angles, ("viewing_angle",)),
        cloud_cover=None if cloud is None or not 0.0 <= cloud <= 100.0 else cloud / 100.0,
    )


def _view_azimuth_deg(angles: dict[str, str]) -> float | None:
    """Direction from the ground to the satellite, from the azimuth of the image's columns and both incidences."""
    azimuth = first_number(angles, ("azimuth_angle",))
    across = first_number(angles, ("incidence_angle_across_track",))
    along = first_number(angles, ("incidence_angle_along_track",))
    if azimuth is None or across is None or along is None:
        return None
    turned = math.atan2(math.tan(math.radians(across)), math.tan(math.radians(along)))
    return (azimuth - math.degrees(turned)) % 360.0


def dimap_input(path: Path) -> Found:
    """The image of one `DIM_*.XML` that is given as an input itself.

    Raises
    ------
    InputError
        It is the index of no image, or of an ortho-image.
    """
    found = _product(path)
    if not found.images:
        reason = found.set_aside[0].reason if found.set_aside else "is the index of no image"
        raise InputError(f"{path} {reason}.")
    return found
