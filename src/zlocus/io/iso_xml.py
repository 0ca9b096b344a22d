"""Elements of metadata by ISO 19115-3 and ISO 19157-2 (XML): names, texts, numbers, codes and times."""

from __future__ import annotations

import json
import re
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

ISO = "http://standards.iso.org/iso"
NAMESPACES = {
    **{name: f"{ISO}/19115/-3/{name}/1.0" for name in ("gco", "gex", "lan", "mcc", "mco", "mri", "mrs", "mrd")},
    **{name: f"{ISO}/19115/-3/{name}/2.0" for name in ("cit", "mdb", "mrl", "msr")},
    "mdq": f"{ISO}/19157/-2/mdq/1.0",
    "gml": "http://www.opengis.net/gml/3.2",
    "xlink": "http://www.w3.org/1999/xlink",
    "xsi": "http://www.w3.org/2001/XMLSchema-instance",
}
CODE_LISTS = "https://schemas.isotc211.org/19115/resources/Codelist/cat/codelists.xml"
SCHEMA_LOCATION = f"{NAMESPACES['mdb']} https://schemas.isotc211.org/19115/-3/mds/2.0/mds.xsd"
# Units of figures: metres and pixels.
UNITS = {"m": "http://www.opengis.net/def/uom/UCUM/m", "px": "http://www.opengis.net/def/uom/UCUM/%7Bpixel%7D"}
# Characters that XML 1.0 cannot hold.
NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def element(name: str, *parts: Element | None, **attributes: str) -> Element:
    """An element with a prefix of `NAMESPACES`, its parts that are not None, and attributes (`gml_id` for gml:id)."""
    made = Element(_full(name), {_full(key.replace("_", ":", 1)): value for key, value in attributes.items()})
    made.extend(part for part in parts if part is not None)
    return made


def text(name: str, value: str, kind: str = "gco:CharacterString") -> Element:
    """A property that holds a text. kind : of the value."""
    inner = Element(_full(kind))
    inner.text = NOT_XML.sub("?", value)
    return element(name, inner)


def number(name: str, value: float, kind: str = "gco:Real", **attributes: str) -> Element:
    """A property that holds a number, with the digits that JSON writes. kind : of the value."""
    made = text(name, json.dumps(value), kind)
    made[0].attrib.update(attributes)
    return made


def code(name: str, kind: str, value: str) -> Element:
    """A property that holds a value of a code list. kind : of the list, with its prefix."""
    inner = element(kind, codeList=f"{CODE_LISTS}#{kind.partition(':')[2]}", codeListValue=value)
    inner.text = value
    return element(name, inner)


def typed_date(name: str, when: str, kind: str) -> Element:
    """A property that holds a date with its meaning. when : ISO 8601, with a time or without; kind : creation..."""
    what = "gco:DateTime" if "T" in when else "gco:Date"
    return element(
        name, element("cit:CI_Date", text("cit:date", when, what), code("cit:dateType", "cit:CI_DateTypeCode", kind))
    )


def instant(name: str, when: str, number_of: str) -> Element:
    """A property that holds a moment. when : ISO 8601; number_of : tells it from other moments of the document."""
    position = Element(_full("gml:timePosition"))
    position.text = when
    return element(name, element("gml:TimeInstant", position, gml_id=f"time-{number_of}"))


def citation(name: str, title: str, *more: Element | None) -> Element:
    """A property that holds a citation. more : what follows the title, in the order of the schema."""
    return element(name, element("cit:CI_Citation", text("cit:title", title), *more))


def identifier(name: str, value: str, space: str | None = None) -> Element:
    """A property that holds an identifier. space : what it is unique in."""
    of_space = None if space is None else text("mcc:codeSpace", space)
    return element(name, element("mcc:MD_Identifier", text("mcc:code", value), of_space))


def document(root: Element) -> bytes:
    """The XML of a root element, with a line for each element."""
    for prefix, address in NAMESPACES.items():
        ElementTree.register_namespace(prefix, address)
    root.set(_full("xsi:schemaLocation"), SCHEMA_LOCATION)
    ElementTree.indent(root)
    content: Any = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return bytes(content) + b"\n"


def _full(name: str) -> str:
    """A name with its namespace, in the form of the library."""
    prefix, colon, rest = name.partition(":")
    return f"{{{NAMESPACES[prefix]}}}{rest}" if colon else name
