"""finished.json: everything that a finished run depends on, and the checksums of its products."""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zlocus.core.errors import InputError
from zlocus.core.requests import EVENTS, FINISHED
from zlocus.io.run_record import finite_only, write_record
from zlocus.io.safe_documents import read_json
from zlocus.products.stac_item import PRODUCTS

ITEM = "item.json"
SCHEMA = 1
# Products of a cloud, and ends of the names of its maps.
CLOUD_COPC = "cloud.copc.laz"
OF_CLOUD = ("cloud.laz", "cloud.ply", CLOUD_COPC, "run.json")
MAPS_OF_IMAGES = ("_height.tif", "_depth.tif", "_quality.tif")
# The event log only informs, so it is not checked.
CHECKED = (*(product.name for product in PRODUCTS if product.name != EVENTS), ITEM)


@dataclass(frozen=True)
class Finished:
    """The record of a finished run.

    key : all that it depends on, by name, empty where the file is damaged; checksums : of each of its products, by the
    name of the file; shortcoming : why it is no success unless that is accepted, "" where it is one; n_redone : how
    often a part of it was redone since.
    """

    key: dict[str, Any]
    checksums: dict[str, str]
    shortcoming: str = ""
    n_redone: int = 0


def write_finished(
    out: Path, key: Mapping[str, Any], shortcoming: str = "", names: Iterable[str] = CHECKED, n_redone: int = 0
) -> None:
    """Say that the run in a folder is finished, with the checksums of all products that are there. key, shortcoming,
    n_redone : see `Finished`; names : of the products, by default those of a surface.

    Raises
    ------
    OutputError
        Where the file cannot be written.
    """
    checksums = {name: checksum(out / name) for name in names if (out / name).is_file()}
    _write(out, Finished(dict(key), checksums, shortcoming, n_redone))


def read_finished(out: Path) -> Finished | None:
    """Read the record that `write_finished` wrote; None where there is no such file."""
    if not (out / FINISHED).exists():
        return None
    damaged = Finished({}, {})
    try:
        found = read_json(out / FINISHED)
    except InputError:
        return damaged
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        return damaged
    key, checksums = found.get("key"), found.get("products")
    if not isinstance(key, dict) or not isinstance(checksums, dict):
        return damaged
    known = {
        name: str(digest)
        for name, digest in checksums.items()
        if name in (*CHECKED, *OF_CLOUD) or is_map_of_image(name)
    }
    n_redone = found.get("redone", 0)
    return Finished(key, known, str(found.get("shortcoming", "")), n_redone if isinstance(n_redone, int) else 0)


def is_map_of_image(name: str) -> bool:
    """Whether a name is that of a map of an image, as a cloud has them, in the folder itself."""
    return Path(name).name == name and name.endswith(MAPS_OF_IMAGES)


def update_finished(out: Path, names: Iterable[str]) -> None:
    """Record the checksums of products that were made again, if the folder holds a finished run; others stay.

    Raises
    ------
    OutputError
        Where the file cannot be written.
    """
    found = read_finished(out)
    if found is None or not found.key:
        return
    known = (*CHECKED, *OF_CLOUD)
    made = {name: checksum(out / name) for name in names if name in known and (out / name).is_file()}
    _write(out, replace(found, checksums=found.checksums | made))


def comparable(key: Mapping[str, Any]) -> dict[str, Any]:
    """A key in the form in which it is read from the file."""
    return dict(json.loads(json.dumps(finite_only(dict(key)))))


def checksum(path: Path) -> str:
    """SHA-256 of a product's bytes, or of a GeoPackage's rows, because its bytes change when programs only read it."""
    if path.suffix == ".gpkg" and (found := _checksum_of_layers(path)):
        return found
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _checksum_of_layers(path: Path) -> str:
    """SHA-256 of the rows of all layers of a GeoPackage; "" where it cannot be read as one."""
    digest = hashlib.sha256()
    try:
        # Read-only, without the journal of another program that may be writing.
        address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as database:
            layers = "SELECT table_name, srs_id FROM gpkg_contents WHERE data_type = 'features' ORDER BY table_name"
            for layer, srs in database.execute(layers).fetchall():
                name = str(layer).replace('"', '""')
                rows = database.execute(f'SELECT * FROM "{name}" ORDER BY rowid')
                digest.update(repr((layer, srs, [column[0] for column in rows.description])).encode())
                for row in rows:
                    digest.update(repr(row).encode())
    except sqlite3.Error:
        return ""
    return digest.hexdigest()


def _write(out: Path, finished: Finished) -> None:
    record = {"key": finished.key, "products": finished.checksums, "shortcoming": finished.shortcoming}
    redone = {"redone": finished.n_redone} if finished.n_redone else {}
    write_record(out / FINISHED, {"schema": SCHEMA, **record, **redone})
