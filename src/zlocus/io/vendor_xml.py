"""Look things up in the XML of vendors, with or without namespaces."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from zlocus.io.safe_documents import read_xml


def plain_xml(path: Path) -> Element:
    """The root of an XML file, all of whose names have lost their namespaces.

    Raises
    ------
    InputError
        The file is no XML that is read, see `read_xml`.
    """
    root = read_xml(path)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    return root


def leaves(element: Element) -> Iterator[tuple[str, str]]:
    """Yield name, in small letters, and text of the elements without children, in the order of the file."""
    for each in element.iter():
        if len(each) == 0 and (text := (each.text or "").strip()):
            yield each.tag.lower(), text


def fields_of(element: Element) -> dict[str, str]:
    """The texts of the elements without children, by their names in small letters; of several, the first."""
    found: dict[str, str] = {}
    for name, text in leaves(element):
        found.setdefault(name, text)
    return found


def first_text(element: Element, names: Sequence[str]) -> str | None:
    """The text of the first element of one of the names; None where there is none."""
    fields = fields_of(element)
    return next((fields[name.lower()] for name in names if name.lower() in fields), None)
