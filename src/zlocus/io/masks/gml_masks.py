"""Masks of Pléiades, Pléiades Neo and SPOT 6/7: GML files of polygons, in pixels of the image or on the ground.

The structure is that of "HMA" masks: `Mask / maskMembers / MaskFeature`, each with a `maskType` and an extent of
polygons. Those of primary products are in pixels (`srsName="urn:ogc:def:derivedCRSType:OGC:1.0:image"`): column and
row, where (1, 1) is the centre of the first pixel, so that an image of 400 columns reaches from 0.5 to 400.5.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.crs import file_crs
from zlocus.io.masks.class_names import words_of
from zlocus.io.masks.polygon_mask import MaskPolygons
from zlocus.io.safe_documents import read_xml

# Kinds of masks by the first letters of their files.
KIND_OF_LETTERS = {
    "CLD": "cloud", "CUT": "cutline", "DET": "detector", "DTC": "detector", "QTE": "quality", "ROI": "region",
    "SHD": "shadow", "SLT": "straylight", "SNW": "snow", "VIS": "hidden",
}  # fmt: skip
FIRST_PIXEL = 1.0  # column and row of its centre
REGION = words_of("region of interest")
IMAGE_CRS = "derivedcrstype:ogc:1.0:image"
# Ways to write a CRS in which coordinates are in the order of its authority, such as latitude before longitude.
AUTHORITY_ORDER = ("urn:ogc:def:crs:", "opengis.net/def/crs/")
MIN_RING_POINTS = 4


@dataclass(frozen=True)
class GmlMask:
    """A mask file.

    kind : see `KIND_OF_LETTERS`, None where its name does not say it; mask_polygons : of all its features; is_region :
    whether everything outside of them is masked.
    """

    kind: str | None
    mask_polygons: MaskPolygons
    is_region: bool


def kind_of_file(path: Path) -> str | None:
    """The kind of a mask by the name of its file (`CLD_PHR1A_..._MSK.GML`); None where the name does not say it."""
    letters = re.match(r"([A-Z]{3})_", path.name.upper())
    return KIND_OF_LETTERS.get(letters[1]) if letters and path.suffix.lower() == ".gml" else None


def is_vendor_gml(root: Element) -> bool:
    """Whether a GML document is a mask, and not any collection of features."""
    return _local(root) == "Mask"


def read_gml_mask(path: Path, root: Element | None = None, classes: Sequence[str] | None = None) -> GmlMask:
    """Read a mask; one without features masks nothing.

    root : of the document, where it was read before; classes : only features of these types (`maskType`), None: all.

    Raises
    ------
    InputError
        The file is no such mask, or its coordinates cannot be used.
    """
    root = read_xml(path) if root is None else root
    if not is_vendor_gml(root):
        raise InputError(f"{path} is no GML mask: its root is {quoted(_local(root))}, not Mask. Give another file.")
    kind, title = kind_of_file(path), next((each.text or "" for each in root if _local(each) == "name"), "")
    default = next((each.get("srsName") for each in root.iter() if _local(each) == "Envelope"), None)
    features = [each for each in root.iter() if _local(each) == "MaskFeature"]
    if classes is not None:
        features = _of_types(features, classes, path)
    polygons, systems = [], set()
    for feature in features:
        for element in feature.iter():
            if _local(element) == "Polygon":
                polygons.append(_polygon(element, path))
                systems.add(element.get("srsName") or default)
    if len(systems) > 1:
        raise InputError(f"{path} has polygons in several coordinate systems ({len(systems)}), which are not read.")
    found = _in_system(np.array(polygons, object), systems.pop() if systems else None, path)
    is_region = kind == "region" or words_of(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", title)) >= REGION
    return GmlMask(kind, found, is_region)


def _local(element: Element) -> str:
    """The name of an element without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _of_types(features: Sequence[Element], classes: Sequence[str], path: Path) -> list[Element]:
    """The features of some types."""
    types = {words_of(text): text for each in features for text in _types(each)}
    wanted = {words_of(name) for name in classes}
    if types and not wanted <= types.keys():
        (missing, *_) = (name for name in classes if words_of(name) not in types)
        raise InputError(f"{path} has no class called {quoted(missing)}. It has {', '.join(types.values())}.")
    return [each for each in features if any(words_of(text) in wanted for text in _types(each))]


def _types(feature: Element) -> Iterator[str]:
    return ((each.text or "").strip() for each in feature.iter() if _local(each) == "maskType")


def _polygon(element: Element, path: Path) -> shapely.Polygon:
    """A polygon with its holes. GML 3: exterior and interior; GML 2: outerBoundaryIs and innerBoundaryIs."""
    shells, holes = [], []
    for side in element:
        rings = [_ring(each, path) for each in side.iter() if _local(each) == "LinearRing"]
        if _local(side) in ("exterior", "outerBoundaryIs"):
            shells += rings
        elif _local(side) in ("interior", "innerBoundaryIs"):
            holes += rings
    if len(shells) != 1:
        raise InputError(f"{path} has a polygon with {len(shells)} outlines, not one. It is damaged.")
    return shapely.Polygon(shells[0], holes)


def _ring(element: Element, path: Path) -> NDArray[np.float64]:
    """The points (n, 2) of a ring, closed."""
    text, dimension = "", 2
    for each in element.iter():
        if _local(each) in ("posList", "pos", "coordinates"):
            dimension = int(each.get("srsDimension") or element.get("srsDimension") or dimension)
            text += " " + (each.text or "").replace(",", " ")
    try:
        numbers = np.array(text.split(), np.float64)
        points = numbers.reshape(-1, dimension)[:, :2]
    except ValueError as error:
        raise InputError(f"{path} has a ring that is no list of points: {error}. It is damaged.") from error
    if not np.isfinite(points).all():
        raise InputError(f"{path} has a ring with a coordinate that is not finite. It is damaged.")
    if len(points) and (points[0] != points[-1]).any():
        points = np.concatenate([points, points[:1]])
    if len(points) < MIN_RING_POINTS:
        raise InputError(f"{path} has a ring of {len(points)} points, which is no outline. It is damaged.")
    return points


def _in_system(polygons: NDArray[np.object_], name: str | None, path: Path) -> MaskPolygons:
    """Polygons in a coordinate system as zlocus counts: pixels from the centre of the first one, or x before y."""
    if name is None or IMAGE_CRS in name.lower():
        return MaskPolygons(shapely.transform(polygons, lambda xy: xy - FIRST_PIXEL), None)
    crs = _crs(name, path)
    axes = [axis.direction.lower() for axis in crs.axis_info[:2]]
    if axes[0] in ("north", "south") and any(way in name.lower() for way in AUTHORITY_ORDER):
        polygons = shapely.transform(polygons, lambda xy: xy[:, ::-1])
    return MaskPolygons(polygons, crs)


def _crs(name: str, path: Path) -> CRS:
    """The CRS that a `srsName` means: `EPSG:n`, URNs of OGC and of CNES, or the addresses of both."""
    code = re.search(r"(?:epsg|projectiontype)\b.*?[:/#](\d+)$", name.strip().lower())
    return file_crs(f"EPSG:{code[1]}" if code else name, path)
