"""Validation by the XML schemas of ISO/TC 211, which are not part of this project: their repository states no licence.

ZLOCUS_ISO_SCHEMAS names a folder that holds a checkout of https://github.com/ISO-TC211/XML (`schemas.isotc211.org/`),
and beside it `xlink.xsd` and `xml.xsd` of the W3C.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = "schemas.isotc211.org/19115/-3/mds/2.0/mds.xsd"
# Where addresses in the schemas lie in the folder. GML of the OGC is that of ISO 19136.
PLACES = {
    "https://schemas.isotc211.org/": "schemas.isotc211.org",
    "http://schemas.isotc211.org/": "schemas.isotc211.org",
    "https://schemas.opengis.net/gml/3.2.1/": "schemas.isotc211.org/19136/-/gml/1.0",
    "https://schemas.opengis.net/": "schemas.opengis.net",
}


def iso_schema():
    """The schema of ISO 19115-3 metadata; the test is skipped where the schemas or lxml are not there."""
    folder = os.environ.get("ZLOCUS_ISO_SCHEMAS")
    if not folder:
        pytest.skip("ZLOCUS_ISO_SCHEMAS is not set: no schemas of ISO/TC 211 to validate by")
    etree = pytest.importorskip("lxml.etree", reason="lxml is not installed, which validates by schemas")
    place = Path(folder)
    if not (place / ROOT).is_file():
        pytest.fail(f"ZLOCUS_ISO_SCHEMAS is {folder}, which holds no {ROOT}")

    class Local(etree.Resolver):
        """Finds every address of the schemas in the folder, so that nothing is loaded from a network."""

        def resolve(self, url, public_id, context):
            for name in ("xlink.xsd", "xml.xsd"):
                if url.endswith(name) and "w3.org" in url:
                    return self.resolve_filename(str(place / name), context)
            for start, to in PLACES.items():
                if url.startswith(start):
                    return self.resolve_filename(str(place / to / url[len(start) :]), context)
            return None

    parser = etree.XMLParser(no_network=True)
    parser.resolvers.add(Local())
    return etree.XMLSchema(etree.parse(str(place / ROOT), parser))


def faults_of(schema, path):
    """What is wrong with a file by a schema, as sentences; none where it is valid."""
    from lxml import etree

    schema.validate(etree.parse(str(path)))
    return [f"line {fault.line}: {fault.message}" for fault in schema.error_log]
