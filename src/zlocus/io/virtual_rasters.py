"""Check virtual rasters (VRT): they may name files of pixels on this machine, but no server, archive or code.

A VRT is a list of other files, and GDAL opens whatever it names with all of its drivers. A VRT may come from people who
are not trusted, so its content is checked before GDAL opens it.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, fromstring

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.safe_documents import read_xml
from zlocus.io.stored_files import FIRST_BYTES

MARK = b"<vrtdataset"  # a VRT holds this, in any case, within the first bytes, at which GDAL looks
# GDAL's virtual file systems that may be read: files on servers, but nothing inside an archive.
REMOTE = ("vsicurl", "vsis3", "vsigs", "vsiaz", "vsiadls", "vsioss", "vsiswift", "vsihdfs", "vsiwebhdfs")
# First bytes of archives.
ARCHIVES = {b"PK\x03\x04": "ZIP", b"\x1f\x8b": "gzip", b"7z\xbc\xaf": "7-Zip", b"Rar!": "RAR", b"BZh": "bzip2"}
# Elements of a VRT whose text never names a file, including everything inside them.
ELEMENTS_WITHOUT_NAMES = frozenset((
    "categorynames", "colortable", "description", "expression", "gcplist", "gdalrasterattributetable", "histograms",
    "lut", "pixelfunctiontype", "srs", "unittype",
))  # fmt: skip
FILE_ELEMENTS = frozenset(("sourcefilename", "sourcedataset", "dempath", "x_dataset", "y_dataset"))
# GDAL names that are no plain file: virtual file systems, addresses, drivers such as WMS:..., inline documents.
NOT_A_FILE = re.compile(r"\s*(?:/vsi|[<{]|[A-Za-z][\w+.-]+:)")
ADVICE = "Give the images themselves, or a list of plain files that lie on this machine."


@dataclass(frozen=True)
class _VrtEntry:
    """A text in a VRT.

    name : its element or attribute, in lower case; inside : the element in which GDAL looks for its other properties.
    """

    name: str
    text: str
    inside: Element


def is_virtual(first: bytes) -> bool:
    """Whether GDAL takes a file for a VRT, by its first bytes."""
    return MARK in first[:FIRST_BYTES].lower()


def check_virtual(path: Path) -> None:
    """Check that a VRT names only files of pixels on this machine, or other VRTs that do.

    Raises
    ------
    InputError
        It names a server, an archive or a service, holds code, reads the bytes of any file as pixels, or is no XML.
    """
    state = path.stat()
    _check(path, state.st_size, state.st_mtime_ns, ())


def check_served(path: Path, text: str) -> None:
    """Check that a VRT on a server names only files on servers. text : its content, as GDAL has read it.

    Raises
    ------
    InputError
        It names anything else, holds code, or reads the bytes of any file as pixels.
    """
    servers = tuple(f"/{name}/" for name in REMOTE)
    for entry in _entries(fromstring(text)):
        if entry.name in FILE_ELEMENTS and not _is_relative(path, entry) and not entry.text.startswith(servers):
            raise InputError(f"{path} lies on a server and names {quoted(entry.text)}, which lies on none. {ADVICE}")
        _refuse_code(path, entry)
        if _is_raw(entry):
            raise InputError(f"{path} lies on a server and takes the bytes of files for pixels. {ADVICE}")


@functools.lru_cache(maxsize=1024)
def _check(path: Path, size: int, time_ns: int, above: tuple[Path, ...]) -> None:
    """See `check_virtual`. size, time_ns : of the file, so that a changed file is checked again; above : VRTs that
    name this one."""
    root = read_xml(path)
    for entry in _entries(root):
        if NOT_A_FILE.match(entry.text):
            raise InputError(f"{path} is a list of files and names {quoted(entry.text)}, which is none. {ADVICE}")
        if entry.name in FILE_ELEMENTS:
            _check_source(path, _source(path, entry), above)
        _refuse_code(path, entry)
        if _is_raw(entry):
            _check_raw(path, entry.inside)


def _entries(element: Element, above: Element | None = None) -> Iterator[_VrtEntry]:
    """Yield all texts of a VRT. GDAL treats an attribute like a child element."""
    name = _name(element.tag)
    if name in ELEMENTS_WITHOUT_NAMES or name.endswith("srs"):
        return
    if name == "mdi":
        # Metadata may hold any text, except the files from which coordinates are read.
        key = element.attrib.get("key", "").lower()
        if key in FILE_ELEMENTS and element.text:
            yield _VrtEntry(key, element.text.strip(), element)
        return
    if text := (element.text or "").strip():
        yield _VrtEntry(name, text, element if above is None or name in FILE_ELEMENTS else above)
    for key, value in element.attrib.items():
        yield _VrtEntry(_name(key), value.strip(), element)
    for child in element:
        yield from _entries(child, element)


def _source(path: Path, entry: _VrtEntry) -> Path:
    """The file that an entry names. Relative paths start at the VRT itself, not at a link to it, as GDAL has it."""
    return path.resolve().parent / entry.text if _is_relative(path, entry) else Path(entry.text)


def _is_relative(path: Path, entry: _VrtEntry) -> bool:
    """Whether the path of an entry is relative to the VRT."""
    flag = next((e.text for e in _entries(entry.inside) if e.name == "relativetovrt"), "0")
    if flag not in ("0", "1"):
        raise InputError(f"{path} is a list of files in which relativeToVRT is {quoted(flag)}, not 0 or 1. {ADVICE}")
    return flag == "1"


def _is_raw(entry: _VrtEntry) -> bool:
    return entry.name == "subclass" and entry.text.lower() == "vrtrawrasterband"


def _refuse_code(path: Path, entry: _VrtEntry) -> None:
    if entry.name == "pixelfunctionlanguage" and entry.text.lower() != "c":
        raise InputError(f"{path} is a list of files and holds code, which is not run. {ADVICE}")


def _check_source(path: Path, source: Path, above: tuple[Path, ...]) -> None:
    """Refuse a file that GDAL would open as a service, an archive, or a VRT that is refused itself."""
    try:
        with source.open("rb") as file:
            first = file.read(FIRST_BYTES)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} is a list of files and names {quoted(str(source))}, which cannot be read. Check its paths."
        ) from error
    if is_virtual(first):
        if source in above or source.resolve() == path.resolve():
            raise InputError(f"{path} is a list of files that names itself. {ADVICE}")
        state = source.stat()
        _check(source, state.st_size, state.st_mtime_ns, (*above, path))
        return
    text = first.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((b"<", b"{", *ARCHIVES)) or ".gti." in source.name.lower():
        raise InputError(
            f"{path} is a list of files and names {quoted(str(source))}, which holds no pixels itself. {ADVICE}"
        )


def _check_raw(path: Path, band: Element) -> None:
    """Refuse a band whose pixels are the bytes of a file outside the folder of the VRT."""
    for entry in _entries(band):
        if entry.name == "sourcefilename":
            source = _source(path, entry)
            if not source.resolve().is_relative_to(path.resolve().parent):
                raise InputError(
                    f"{path} is a list of files and takes the bytes of {quoted(str(source))} for pixels, which does "
                    f"not lie beside it. {ADVICE}"
                )


def _name(tag: str) -> str:
    """Name of an element or attribute as GDAL compares it: in lower case, without the XML namespace."""
    return str(tag).rpartition("}")[2].lower()
