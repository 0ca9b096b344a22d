"""Elements of XML for style files."""

from __future__ import annotations

import re
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

# Characters that XML 1.0 cannot hold.
NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def node(tag: str, /, *parts: Element | None, text: str | None = None, **attributes: str) -> Element:
    """An element with its parts that are not None, or with a text, and with attributes."""
    made = Element(tag, {key.rstrip("_"): NOT_XML.sub("?", value) for key, value in attributes.items()})
    made.text = None if text is None else NOT_XML.sub("?", text)
    made.extend(part for part in parts if part is not None)
    return made


def document(root: Element, has_declaration: bool = True) -> str:
    """A document, each element on a line. has_declaration : GDAL does not read its own files with one."""
    ElementTree.indent(root, " ")
    declaration = '<?xml version="1.0" encoding="UTF-8"?>\n' if has_declaration else ""
    return f"{declaration}{ElementTree.tostring(root, encoding='unicode')}\n"
