"""Rules of STAC's extensions, from their texts: projection 2.0, classification 2.0, raster 2.0, file 2.1.

Their schemas are on the network only. `validated` checks an item by the rules, by the schemas of STAC's core, which
pystac brings, and by those of the extensions where ZLOCUS_STAC_SCHEMAS names a folder that holds them: each in a file
whose path is its address without `https://`.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pystac
import pystac.validation
from pystac.validation.stac_validator import JsonSchemaSTACValidator

SCHEMAS = "ZLOCUS_STAC_SCHEMAS"
CORE = "https://schemas.stacspec.org/v1.1.0/item-spec/json-schema/item.json"
BASE = "https://stac-extensions.github.io"
EXTENSIONS = {
    "proj": f"{BASE}/projection/v2.0.0/schema.json", "classification": f"{BASE}/classification/v2.0.0/schema.json",
    "raster": f"{BASE}/raster/v2.0.0/schema.json", "file": f"{BASE}/file/v2.1.0/schema.json",
}  # fmt: skip
NAME = re.compile(r"[0-9A-Za-z_-]+")


def validated(item: dict) -> dict:
    """The item, which keeps all rules."""
    assert pystac.validation.validate_dict(item, extensions=[]) == [CORE]
    groups = [item["properties"], *item["assets"].values()]
    used = {name.partition(":")[0] for fields in groups for name in fields if ":" in name} - {"zlocus"}
    assert set(item["stac_extensions"]) == {EXTENSIONS[prefix] for prefix in used}
    for fields in groups:
        check_projection(fields)
        check_raster(fields)
    for asset in item["assets"].values():
        check_file(asset)
        check_classification(asset)
        for band in asset.get("bands", []):
            assert not {name.partition(":")[0] for name in band if ":" in name}, "fields stand at the asset"
    if SCHEMAS in os.environ:
        check_schemas(item)
    return item


def check_schemas(item: dict) -> None:
    """Fails where an item is not valid by a schema of its extensions, which ZLOCUS_STAC_SCHEMAS holds."""
    validator = JsonSchemaSTACValidator()
    for address in item["stac_extensions"]:
        schema = Path(os.environ[SCHEMAS]) / address.removeprefix("https://")
        validator.schema_cache[address] = json.loads(schema.read_text(encoding="utf-8"))
        assert validator.validate_extension(item, pystac.STACObjectType.ITEM, "1.1.0", address) == address


def only(fields: dict, prefix: str, known: set[str]) -> None:
    unknown = {name for name in fields if name.startswith(f"{prefix}:")} - {f"{prefix}:{name}" for name in known}
    assert not unknown


def check_projection(fields: dict) -> None:
    only(fields, "proj", {"code", "wkt2", "projjson", "geometry", "bbox", "centroid", "shape", "transform"})
    if "proj:code" in fields and fields["proj:code"] is None:
        assert fields["proj:wkt2"].startswith(("PROJCRS[", "COMPOUNDCRS[", "BOUNDCRS["))
    elif "proj:code" in fields:
        assert re.fullmatch(r"[A-Za-z0-9_]+:[A-Za-z0-9_]+", fields["proj:code"])
    if "proj:shape" in fields:
        assert [type(size) for size in fields["proj:shape"]] == [int, int]
        assert len(fields["proj:transform"]) in (6, 9)
    if "proj:bbox" in fields:
        xmin, ymin, xmax, ymax = fields["proj:bbox"]
        assert xmin <= xmax
        assert ymin <= ymax
    if "proj:geometry" in fields:
        assert fields["proj:geometry"]["type"] in ("Polygon", "MultiPolygon")


def check_raster(fields: dict) -> None:
    only(fields, "raster", {"sampling", "bits_per_sample", "spatial_resolution", "scale", "offset", "histogram"})
    assert isinstance(fields.get("raster:spatial_resolution", 0.0), float)


def check_file(fields: dict) -> None:
    only(fields, "file", {"byte_order", "checksum", "header_size", "size", "values", "local_path"})
    size = fields.get("file:size", 0)
    assert type(size) is int
    assert size >= 0


def check_classification(fields: dict) -> None:
    only(fields, "classification", {"classes", "bitfields"})
    bitfields = fields.get("classification:bitfields", [])
    if "classification:classes" in fields:
        check_classes(fields["classification:classes"])
    bits = [bit for each in bitfields for bit in range(each["offset"], each["offset"] + each["length"])]
    assert len(bits) == len(set(bits)), "fields of bits do not overlap"
    for each in bitfields:
        assert set(each) <= {"offset", "length", "classes", "roles", "description", "name"}
        assert NAME.fullmatch(each["name"])
        assert each["offset"] >= 0
        assert each["length"] >= 1
        check_classes(each["classes"])
        assert all(0 <= kind["value"] < 2 ** each["length"] for kind in each["classes"])


def check_classes(classes: list[dict]) -> None:
    assert classes
    assert len({kind["value"] for kind in classes}) == len({kind["name"] for kind in classes}) == len(classes)
    for kind in classes:
        assert set(kind) <= {"value", "name", "title", "description", "color_hint", "nodata", "percentage", "count"}
        assert type(kind["value"]) is int
        assert NAME.fullmatch(kind["name"])
