"""Open the masks of a view: find out what each file is, check that it fits the image, and read its polygons."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from zlocus.core.errors import InputError, ZlocusWarning
from zlocus.io.crs import file_crs
from zlocus.io.masks.gml_masks import is_vendor_gml, read_gml_mask
from zlocus.io.masks.ground_polygons import GroundView
from zlocus.io.masks.image_mask import ImageMask, MaskPart
from zlocus.io.masks.mask_entry import MaskEntry
from zlocus.io.masks.polygon_mask import MaskPolygons, PolygonMask
from zlocus.io.masks.raster_mask import open_raster_mask
from zlocus.io.open_raster import existing_file
from zlocus.io.safe_documents import read_xml
from zlocus.io.stored_files import file_exists
from zlocus.io.vector_files import check_degrees, read_vector

VECTOR_SUFFIXES = (
    ".fgb", ".geojson", ".geojsonl", ".gml", ".gpkg", ".json", ".kml", ".shp", ".sqlite", ".topojson",
)  # fmt: skip
# Distance (px) of a pixel's outer corner from its centre.
HALF_PX = 0.5


def open_masks(entries: Sequence[MaskEntry], image: Path, ground_view: GroundView, name: str) -> ImageMask:
    """The mask of an image from the entries of its view.

    entries : with paths that can be opened, at least one; image : path of the image; name : of the view, for messages.

    Raises
    ------
    InputError
        A mask cannot be read, or does not fit the image; the message names the view.
    """
    parts, files = list[MaskPart](), list[Path]()
    for entry in entries:
        path = Path(entry.file)
        try:
            parts.append(_open_part(entry, existing_file(path, "mask"), image, ground_view))
        except InputError as error:
            raise InputError(f"The mask of the view {name}: {error}") from error
        files += [path, *_files_beside(path)]
    return ImageMask(tuple(parts), tuple(files))


def _files_beside(path: Path) -> list[Path]:
    """Files beside a mask from which it is read too."""
    beside = [path.with_suffix(suffix) for suffix in (".shx", ".prj")] if path.suffix.lower() == ".shp" else []
    return [file for file in (path.with_name(path.name + ".aux.xml"), *beside) if file_exists(file)]


def _open_part(entry: MaskEntry, path: Path, image: Path, ground_view: GroundView) -> MaskPart:
    is_vector = path.suffix.lower() in VECTOR_SUFFIXES
    if entry.kind in ("polygons", "gml") or (entry.kind is None and is_vector):
        return _open_polygons(entry, path, image, ground_view)
    return open_raster_mask(entry, path, image, ground_view.shape)


def _open_polygons(entry: MaskEntry, path: Path, image: Path, ground_view: GroundView) -> PolygonMask:
    if entry.band is not None or entry.names is not None:
        raise InputError(f"band and names are for rasters, and {path} holds polygons. Leave them out.")
    found, is_region = _polygons_of(entry, path)
    polygons = found.polygons
    if found.crs is not None:
        polygons = ground_view.pixels_of(polygons, found.crs, entry.height, path)
    polygon_mask = PolygonMask.of(path, ground_view.shape, polygons, is_region != bool(entry.outside))
    if len(found.polygons) and polygon_mask.is_beside_image:
        covered = "every pixel" if polygon_mask.is_outside else "no pixel"
        warnings.warn(
            f"The mask {path} covers {covered} of {image}, because its polygons lie beside the image. Check their "
            "coordinates and the height.",
            ZlocusWarning,
            stacklevel=2,
        )
    return polygon_mask


def _polygons_of(entry: MaskEntry, path: Path) -> tuple[MaskPolygons, bool]:
    """The polygons of a file, and whether they are the region outside of which everything is masked."""
    if entry.kind == "gml" or (entry.kind is None and path.suffix.lower() == ".gml"):
        root = read_xml(path)
        if entry.kind == "gml" or is_vendor_gml(root):
            if entry.coordinates is not None:
                raise InputError(f"{path} says itself what its coordinates are. Leave `coordinates` out.")
            classes = None if entry.values is None else [str(value) for value in entry.values]
            gml_mask = read_gml_mask(path, root, classes)
            return gml_mask.mask_polygons, gml_mask.is_region
    if entry.values is not None:
        raise InputError(f"values are for rasters and masks of vendors, and {path} holds polygons. Leave them out.")
    read = read_vector(path, may_be_empty=True)
    on_ground = entry.coordinates == "ground" or (entry.coordinates is None and read.crs is not None)
    if not on_ground:
        return MaskPolygons(_counted_from_centre(read.polygons, entry.coordinates == "pixel_corners"), None), False
    if read.crs is None:
        raise InputError(f"{path} has no CRS, so its polygons are in pixels. Leave `coordinates: ground` out.")
    crs = file_crs(read.crs, path)
    check_degrees(read.polygons, crs, path)
    return MaskPolygons(read.polygons, crs), False


def _counted_from_centre(polygons: NDArray[np.object_], from_corner: bool) -> NDArray[np.object_]:
    """Polygons in pixels with (0, 0) at the centre of the first one, and rows downwards.

    Programs for maps count rows upwards, so that those of an image are negative.
    """
    if not len(polygons):
        return polygons
    is_upwards = shapely.total_bounds(polygons)[3] <= 0.0
    sign, offset = np.array([1.0, -1.0 if is_upwards else 1.0]), HALF_PX if from_corner else 0.0
    return np.asarray(shapely.transform(polygons, lambda xy: xy * sign - offset))
