"""The formats that can be imported. A new format is one module, and a line in `IMPORTERS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from zlocus.core.requests import ImportRequest
from zlocus.io.importers.base import ImportedCameras
from zlocus.io.importers.bundler import read_bundler
from zlocus.io.importers.colmap import read_colmap
from zlocus.io.importers.eo import read_eo
from zlocus.io.importers.metashape import read_metashape
from zlocus.io.importers.opensfm import read_opensfm


@dataclass(frozen=True)
class Importer:
    """An importable format. read : its reader; options : the options of `ImportRequest` that apply to it."""

    read: Callable[[ImportRequest], ImportedCameras]
    options: tuple[str, ...]


IMPORTERS = {
    "colmap": Importer(read_colmap, ("crs", "up", "north", "offset")),
    "opensfm": Importer(read_opensfm, ("crs", "local")),
    "metashape": Importer(read_metashape, ("crs", "up", "north")),
    "bundler": Importer(read_bundler, ("crs", "up", "north", "offset")),
    "eo": Importer(read_eo, ("crs", "up", "north", "offset", "focal", "camera", "earth")),
}
