"""Images that vendors deliver as tiles with an index: DIMAP (`DIM_*.XML`) and Maxar (`.TIL`).

The index is opened as one image. GDAL has drivers for both, but follows whatever the index names; here the tiles lie in
or below the folder of the index, are all there, have the sizes that the index says, and neither overlap nor leave gaps.

Sources: Airbus, Pleiades Imagery User Guide (2012), appendix on DIMAP V2; DigitalGlobe, Imagery Support Data
Documentation (2014), tile map file.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.archives import is_archived
from zlocus.io.grouped_text import StatementGroup, read_groups
from zlocus.io.safe_documents import read_xml
from zlocus.io.stored_files import file_beside, file_exists, file_state

DIMAP_INDEX = re.compile(r"DIM_.*\.XML", re.IGNORECASE)
TIL_SUFFIX = ".til"
# Products of one strip have a few hundred tiles.
MAX_TILES = 4096
ADVICE = "Copy the whole product again from its source."
# Names that GDAL gives the types of pixels.
VRT_TYPES = {
    "uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
    "float32": "Float32", "float64": "Float64",
}  # fmt: skip


@dataclass(frozen=True)
class TileHeader:
    """What the header of a tile says. shape : rows and columns; colours : name of each band's meaning, as GDAL has it;
    nodata : None where the file has none."""

    shape: tuple[int, int]
    dtype: str
    colours: tuple[str, ...]
    nodata: float | None


@dataclass(frozen=True)
class PlacedTile:
    """A tile. row, col : of its first pixel in the product."""

    path: Path
    row: int
    col: int
    header: TileHeader

    @property
    def end(self) -> tuple[int, int]:
        """Row and column beyond the last pixel, in the product."""
        return self.row + self.header.shape[0], self.col + self.header.shape[1]


@dataclass(frozen=True)
class NamedTile:
    """A tile as its index names it. row, col : of its first pixel in the product; last : row and column of its last
    pixel as the index says, None where it does not."""

    path: Path
    row: int
    col: int
    last: tuple[int, int] | None = None


@dataclass(frozen=True)
class TileLayout:
    """All tiles of a product. shape : rows and columns of the product."""

    shape: tuple[int, int]
    tiles: tuple[PlacedTile, ...]

    def as_vrt(self, name: Callable[[Path], str]) -> str:
        """The virtual raster of the product, for GDAL. name : GDAL's name of a file."""
        header = self.tiles[0].header
        root = ElementTree.Element("VRTDataset", rasterXSize=str(self.shape[1]), rasterYSize=str(self.shape[0]))
        for number, colour in enumerate(header.colours, 1):
            band = ElementTree.SubElement(root, "VRTRasterBand", dataType=VRT_TYPES[header.dtype], band=str(number))
            if header.nodata is not None:
                ElementTree.SubElement(band, "NoDataValue").text = repr(header.nodata)
            ElementTree.SubElement(band, "ColorInterp").text = colour
            for tile in self.tiles:
                _add_source(band, tile, number, name(tile.path))
        return ElementTree.tostring(root, encoding="unicode")


def is_tile_index(path: Path) -> bool:
    """Whether a file is the index of a tiled product, by its name."""
    return path.suffix.lower() == TIL_SUFFIX or DIMAP_INDEX.fullmatch(path.name) is not None


def named_tiles(path: Path) -> list[Path]:
    """The files of pixels that an index names, whether or not they are there.

    Raises
    ------
    InputError
        The index is damaged, or names a file outside its folder.
    """
    named, _ = _named(path)
    return [tile.path for tile in named]


def tile_layout(path: Path, header: Callable[[Path], TileHeader]) -> TileLayout:
    """The checked layout of a tiled product. path : of its index; header : reads that of a tile.

    Raises
    ------
    InputError
        The index is damaged; a tile is missing, has another size or other pixels than the others, overlaps another one,
        or leaves a gap.
    """
    return _layout(path, tuple(file_state(path)), header)


@functools.lru_cache(maxsize=256)
def _layout(path: Path, state: tuple[int, ...], header: Callable[[Path], TileHeader]) -> TileLayout:
    """See `tile_layout`. state : of the index, so that a changed one is read again."""
    del state
    named, shape = _named(path)
    missing = [tile.path for tile in named if not file_exists(tile.path)]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(f"{path} names the tile {missing[0].name}{more}, which is missing. {ADVICE}")
    tiles = tuple(PlacedTile(tile.path, tile.row, tile.col, header(tile.path)) for tile in named)
    for tile, said in zip(tiles, named, strict=True):
        first = tiles[0]
        alike = (tile.header.dtype, len(tile.header.colours)) == (first.header.dtype, len(first.header.colours))
        if not alike:
            raise InputError(f"{path}: {tile.path.name} has other bands or pixels than {first.path.name}. {ADVICE}")
        # Some writers give the last pixel, and some the one beyond it.
        if said.last is not None and said.last not in (tile.end, (tile.end[0] - 1, tile.end[1] - 1)):
            rows, cols = tile.header.shape
            raise InputError(
                f"{path} says that {tile.path.name} ends at row {said.last[0]} and column {said.last[1]} of the "
                f"product, but it has {rows} x {cols} pixels. {ADVICE}"
            )
    if tiles[0].header.dtype not in VRT_TYPES:
        raise InputError(f"{tiles[0].path} holds pixels of the type {tiles[0].header.dtype}, which are not read.")
    whole = shape or (max(tile.end[0] for tile in tiles), max(tile.end[1] for tile in tiles))
    _check_cover(path, tiles, whole)
    return TileLayout(whole, tiles)


def _check_cover(path: Path, tiles: Sequence[PlacedTile], shape: tuple[int, int]) -> None:
    """Refuse tiles that overlap, leave a gap, or leave the product."""
    first = np.array([(tile.row, tile.col) for tile in tiles], np.int64)
    end = np.array([tile.end for tile in tiles], np.int64)
    for number, tile in enumerate(tiles):
        if min(tile.row, tile.col) < 0 or tile.end[0] > shape[0] or tile.end[1] > shape[1]:
            raise InputError(
                f"{path}: {tile.path.name} leaves the product of {shape[0]} x {shape[1]} pixels: it begins at row "
                f"{tile.row} and column {tile.col}. {ADVICE}"
            )
        overlaps = ((first < end[number]) & (end > first[number])).all(axis=1)
        overlaps[number] = False
        if overlaps.any():
            other = tiles[int(overlaps.argmax())].path.name
            raise InputError(f"{path}: the tiles {tile.path.name} and {other} overlap. {ADVICE}")
    covered = int((end - first).prod(axis=1).sum())
    if covered != shape[0] * shape[1]:
        raise InputError(
            f"{path}: the tiles cover {covered} of the {shape[0]} x {shape[1]} pixels of the product, so some are "
            f"missing. {ADVICE}"
        )


def _add_source(band: Element, tile: PlacedTile, number: int, name: str) -> None:
    rows, cols = (str(side) for side in tile.header.shape)
    source = ElementTree.SubElement(band, "SimpleSource")
    ElementTree.SubElement(source, "SourceFilename", relativeToVRT="0").text = name
    ElementTree.SubElement(source, "SourceBand").text = str(number)
    ElementTree.SubElement(source, "SrcRect", xOff="0", yOff="0", xSize=cols, ySize=rows)
    ElementTree.SubElement(source, "DstRect", xOff=str(tile.col), yOff=str(tile.row), xSize=cols, ySize=rows)


def _named(path: Path) -> tuple[list[NamedTile], tuple[int, int] | None]:
    """The tiles that an index names, and rows and columns of the product, None where the index does not say."""
    named, shape = _from_til(path) if path.suffix.lower() == TIL_SUFFIX else _from_dimap(path)
    if not named:
        raise InputError(f"{path} names no file of pixels. {ADVICE}")
    if len(named) > MAX_TILES:
        raise InputError(f"{path} names {len(named)} tiles, and at most {MAX_TILES} are read. Give a part of it.")
    return named, shape


def _from_dimap(path: Path) -> tuple[list[NamedTile], tuple[int, int] | None]:
    root = read_xml(path)
    dimensions = root.find(".//Raster_Dimensions")
    files = root.find(".//Data_Access/Data_Files")
    if dimensions is None or files is None:
        raise InputError(f"{path} holds no Raster_Dimensions and Data_Files: it is not the index of an image. {ADVICE}")
    shape = (
        whole_number(dimensions.findtext("NROWS"), "NROWS", path),
        whole_number(dimensions.findtext("NCOLS"), "NCOLS", path),
    )
    size = dimensions.find("Tile_Set/Regular_Tiling/NTILES_SIZE")
    tile = shape if size is None else tuple(whole_number(size.get(name), name, path) for name in ("nrows", "ncols"))
    for name in ("OVERLAP_ROW", "OVERLAP_COL"):
        overlap = dimensions.findtext(f"Tile_Set/Regular_Tiling/{name}", "0").strip() or "0"
        if overlap != "0":
            raise InputError(f"{path} says that its tiles overlap by {quoted(overlap)}, which is not read. {ADVICE}")
    named = []
    for entry in files.iterfind("Data_File"):
        reference = entry.find("DATA_FILE_PATH")
        if reference is None:
            raise InputError(f"{path} holds a Data_File without a DATA_FILE_PATH. {ADVICE}")
        down, across = (whole_number(entry.get(name, "1"), name, path) for name in ("tile_R", "tile_C"))
        at = (down - 1) * tile[0], (across - 1) * tile[1]
        last = min(at[0] + tile[0], shape[0]) - 1, min(at[1] + tile[1], shape[1]) - 1
        named.append(NamedTile(named_file(path, reference.get("href", "")), *at, last))
    return named, shape


def _from_til(path: Path) -> tuple[list[NamedTile], tuple[int, int] | None]:
    named = []
    for group in read_groups(path).within("TILE"):
        row, col = (_offset(group, name, path) for name in ("ULRowOffset", "ULColOffset"))
        last = None
        if group.text("LRRowOffset") is not None:
            last = _offset(group, "LRRowOffset", path), _offset(group, "LRColOffset", path)
        named.append(NamedTile(named_file(path, group.text("filename") or ""), row, col, last))
    return named, None


def named_file(index: Path, name: str) -> Path:
    """The file that an index names, in or below its own folder.

    Raises
    ------
    InputError
        The name leaves that folder, or is an address.
    """
    at = PurePosixPath(name)
    leaves = at.is_absolute() or ".." in at.parts or "\\" in name or ":" in name
    if not name or leaves or any(ord(sign) < 32 for sign in name):
        raise InputError(f"{index} names the file {quoted(name)}, which does not lie below its folder. {ADVICE}")
    path = index.parent / at
    if not is_archived(path) and not path.resolve().is_relative_to(index.parent.resolve()):
        raise InputError(f"{index} names the file {path.name!r}, which is a link that leaves its folder. {ADVICE}")
    # Products are made on systems that do not tell capital letters from small ones.
    return file_beside(path, path.name) or path


def _offset(group: StatementGroup, name: str, path: Path) -> int:
    text = group.text(name) or ""
    if not re.fullmatch(r"\d{1,9}(?:\.0*)?", text, re.ASCII):
        raise InputError(f"{path}: {name} of {group.name} is {quoted(text)}, not a whole number. {ADVICE}")
    return int(float(text))


def whole_number(text: str | None, name: str, path: Path) -> int:
    """A whole number above 0 in a file.

    Raises
    ------
    InputError
        It is missing, or another value.
    """
    if not re.fullmatch(r"0*[1-9]\d{0,8}", (text or "").strip(), re.ASCII):
        raise InputError(f"{path}: {name} is {quoted(text or '')}, not a whole number above 0. {ADVICE}")
    return int((text or "").strip())
