"""Read RPCs from DIMAP files of Pleiades, Pleiades Neo and SPOT 6/7 (`RPC_*.XML`, `DIM_*.XML`).

DIMAP 2 counts the first pixel as (1, 1), so its offsets are lowered by one. DIMAP 3 gives the number of the first pixel
in its validity domain. Of the two models in the file the one from ground to image is used (`Inverse_Model`, in DIMAP 3
`GroundtoImage_Values`). Its terms are in the order of RPC00B, with longitude first.

Source: Airbus, Pleiades Imagery User Guide (2012), section on the rational function model.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.cameras.rpc_text import POLYNOMIALS, SCALARS, rpc_from_fields
from zlocus.io.safe_documents import read_xml
from zlocus.io.safe_text import EXPORT_AGAIN, MAX_MAGNITUDE, decimal
from zlocus.io.stored_files import file_exists, names_beside
from zlocus.io.tiled_products import DIMAP_INDEX, whole_number
from zlocus.sensors.rpc import RpcCoefficients

TILE = re.compile(r"_R(\d+)C(\d+)$", re.IGNORECASE)


def find_dimap(image: Path) -> Path | None:
    """The RPC_*.XML of an image by its name (IMG_id_R1C1.TIF: RPC_id.XML), else a DIM_*.XML that lists it, or None."""
    if DIMAP_INDEX.fullmatch(image.name):
        return image
    name = TILE.sub("", re.sub(r"^IMG_", "", image.stem))
    for suffix in (".XML", ".xml"):
        path = image.with_name(f"RPC_{name}{suffix}")
        if file_exists(path):
            return path
    for beside in names_beside(image):
        path = image.with_name(beside)
        if DIMAP_INDEX.fullmatch(beside) and _data_file(read_xml(path), image) is not None:
            return path
    return None


def read_dimap_rpc(path: Path, image: Path) -> RpcCoefficients:
    """The RPC of an image from an `RPC_*.XML`, or from that which a `DIM_*.XML` names.

    image : may be a tile of the product; then the offsets are those of the tile.
    """
    root = read_xml(path)
    if root.find(".//RFM_Validity") is None:
        path = rpc_file_of(path, root)
        root = read_xml(path)
    model = root.find(".//Inverse_Model")
    model = root.find(".//GroundtoImage_Values") if model is None else model
    validity = root.find(".//RFM_Validity")
    if model is None or validity is None:
        raise InputError(f"{path} holds no Inverse_Model with its RFM_Validity. Give the RPC_*.XML of the product.")
    fields = {name: _child_text(validity, name, path) for name in SCALARS}
    for name in POLYNOMIALS:
        fields[name] = " ".join(_child_text(model, f"{name}_{i}", path) for i in range(1, 21))
    domain = root.find(".//ImagetoGround_Validity_Domain")
    first_row, first_col = (
        1.0 if domain is None else _first_pixel(domain, name, path) for name in ("FIRST_ROW", "FIRST_COL")
    )
    rpc = rpc_from_fields(fields, path)
    tile_row, tile_col = _tile_origin(path, image)
    return rpc.moved(column=-first_col - tile_col, row=-first_row - tile_row)


def _tile_origin(path: Path, image: Path) -> tuple[int, int]:
    """Row and column of the product at which an image starts; (0, 0) if it is not a tile."""
    tile = TILE.search(image.stem)
    if tile is None or (int(tile[1]), int(tile[2])) == (1, 1):
        return 0, 0
    dim = path.with_name(re.sub(r"^RPC_", "DIM_", path.name))
    if not file_exists(dim):
        raise InputError(
            f"{image} is a tile of a larger product whose RPC counts its pixels, and {dim} is missing. Add it."
        )
    root = read_xml(dim)
    size = root.find(".//Regular_Tiling/NTILES_SIZE")
    overlap = [_child_text(root, f".//Regular_Tiling/OVERLAP_{axis}", dim) or "0" for axis in ("ROW", "COL")]
    entry = _data_file(root, image)
    if size is None or entry is None or any(decimal(each) != 0 for each in overlap):
        raise InputError(
            f"{dim} does not say where {image.name} lies in the product. Mosaic the tiles first (gdalbuildvrt)."
        )
    rows, cols = (whole_number(size.get(name), name, dim) for name in ("nrows", "ncols"))
    return (whole_number(entry.get("tile_R"), "tile_R", dim) - 1) * rows, (
        whole_number(entry.get("tile_C"), "tile_C", dim) - 1
    ) * cols


def _first_pixel(domain: Element, name: str, path: Path) -> float:
    """Number of the first pixel: 1 unless the file gives another one."""
    text = _child_text(domain, name, path) or "1"
    if not abs(decimal(text)) <= MAX_MAGNITUDE:
        raise InputError(f"{path}: {name} is {quoted(text)}, not a finite number. {EXPORT_AGAIN}")
    return decimal(text)


def _data_file(root: Element, image: Path) -> Element | None:
    """The Data_File element of a DIM_*.XML that names an image; None where there is none."""
    for entry in root.iterfind(".//Data_File"):
        reference = entry.find("DATA_FILE_PATH")
        if reference is not None and Path(reference.attrib.get("href", "")).name == image.name:
            return entry
    return None


def rpc_file_of(path: Path, root: Element) -> Path:
    """The RPC_*.XML to which a DIM_*.XML refers, else the one with the same name.

    root : of the DIM_*.XML.

    Raises
    ------
    InputError
        There is neither.
    """
    hrefs = [Path(element.attrib.get("href", "")).name for element in root.iter()]
    named = [name for name in hrefs if re.fullmatch(r"RPC_.*\.XML", name, re.IGNORECASE)]
    for name in named:
        if file_exists(path.with_name(name)):
            return path.with_name(name)
    sibling = path.with_name(re.sub(r"^DIM_", "RPC_", path.name))
    if sibling == path or not file_exists(sibling):
        if named:
            raise InputError(f"{path} names {named[0]}, which is missing. Add it.")
        wanted = "the RPC_*.XML of the product" if sibling == path else sibling.name
        raise InputError(f"{path} holds no RPC and names none. Add {wanted} beside it.")
    return sibling


def _child_text(element: Element, name: str, path: Path) -> str:
    """The text of a child element, without blanks around it; empty where there is none."""
    texts = {(child.text or "").strip() for child in element.findall(name)}
    if len(texts) > 1:
        raise InputError(f"{path} holds {name} twice, with different values. {EXPORT_AGAIN}")
    return texts.pop() if texts else ""
