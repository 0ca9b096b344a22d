"""Find and read the RPC of an image.

Pixels: all readers return offsets with (0, 0) at the centre of the first pixel. The GeoTIFF tag, `_RPC.TXT` and `.RPB`
use this convention; DIMAP does not (see `dimap`).
"""

from __future__ import annotations

from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.io.cameras.dimap import find_dimap, read_dimap_rpc
from zlocus.io.cameras.isd import is_isd, read_isd_rpc
from zlocus.io.cameras.rpc_text import read_rpb, read_rpc_txt, rpc_from_fields
from zlocus.io.open_raster import existing_file, open_raster
from zlocus.io.stored_files import file_exists
from zlocus.io.vendor_xml import plain_xml
from zlocus.sensors.rpc import RpcCoefficients

RPB_SUFFIXES = (".RPB", ".rpb")
TXT_ENDINGS = ("_RPC.TXT", "_rpc.txt", "_RPC.txt")


def read_rpc(image: Path, file: Path | None = None) -> RpcCoefficients:
    """The RPC of an image.

    It is searched in GDAL's order, in which a side-car file has precedence because it often corrects the tag: `file` if
    given; NAME.RPB; NAME_RPC.TXT; NAME.XML of Maxar; DIMAP (RPC_*.XML); the tag in the image.

    Raises
    ------
    InputError
        There is none, or it is damaged; the message names the file and the field.
    """
    image = Path(image)
    file = find_sidecar(image) if file is None else existing_file(file, "camera file")
    if file is None:
        return _from_tag(image)
    suffix = file.suffix.lower()
    if suffix == ".xml":
        return read_isd_rpc(file) if is_isd(plain_xml(file)) else read_dimap_rpc(file, image)
    if suffix == ".rpb":
        return read_rpb(file)
    if suffix == ".txt":
        return read_rpc_txt(file)
    return _from_tag(file)


def find_sidecar(image: Path) -> Path | None:
    """The file beside an image that holds its RPC; None where there is none."""
    names = [image.stem + suffix for suffix in RPB_SUFFIXES] + [image.stem + ending for ending in TXT_ENDINGS]
    for name in names:
        if file_exists(image.with_name(name)):
            return image.with_name(name)
    return _isd_with_rpc(image) or find_dimap(image)


def _isd_with_rpc(image: Path) -> Path | None:
    """The XML of image support data of Maxar beside an image, if it holds an RPC."""
    for suffix in (".XML", ".xml"):
        file = image.with_suffix(suffix)
        if file_exists(file) and file != image:
            root = plain_xml(file)
            if is_isd(root) and root.find("RPB") is not None:
                return file
    return None


def has_rpc_tag(image: Path) -> bool:
    """Whether an image file holds an RPC itself.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    with open_raster(image) as source:
        return bool(source.tags(ns="RPC"))


def _from_tag(image: Path) -> RpcCoefficients:
    """The RPC stored in an image file (RPC tag of GeoTIFF, RPC00B of NITF), read by GDAL."""
    with open_raster(image) as source:
        fields = source.tags(ns="RPC")
    if not fields:
        raise InputError(
            f"{image} has no camera: no RPC tag, and no {image.stem}.RPB, {image.stem}_RPC.TXT or RPC_*.XML beside it. "
            "Add one of them, or name the camera in a scene.yaml."
        )
    return rpc_from_fields(fields, image)
