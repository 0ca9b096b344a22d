"""A point cloud as Entwine Point Tiles, the only kind that QGIS 3.22 opens without PDAL, which Debian's lacks."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np

SIDE = 128


def write_ept(laz: Path, folder: Path) -> Path:
    """Write the points of a LAZ file as one tile, with their colours, and return the file that QGIS opens."""
    cloud = laspy.read(laz)
    steps = np.stack([cloud.X, cloud.Y, cloud.Z], axis=-1)
    colours = np.stack([cloud.red, cloud.green, cloud.blue], axis=-1)
    records = np.empty(len(steps), [("xyz", "<i4", 3), ("rgb", "<u2", 3)])
    records["xyz"], records["rgb"] = steps, colours
    for name in ("ept-data", "ept-hierarchy"):
        (folder / name).mkdir(parents=True)
    (folder / "ept-data" / "0-0-0-0.bin").write_bytes(records.tobytes())
    (folder / "ept-hierarchy" / "0-0-0-0.json").write_text(json.dumps({"0-0-0-0": len(steps)}))
    scales, offsets = cloud.header.scales.tolist(), cloud.header.offsets.tolist()
    low, high = (steps.min(axis=0) * scales + offsets), (steps.max(axis=0) * scales + offsets)
    cube = [*low.tolist(), *(low + (high - low).max()).tolist()]
    places = [
        {"name": name, "type": "signed", "size": 4, "scale": scale, "offset": offset}
        for name, scale, offset in zip("XYZ", scales, offsets, strict=True)
    ]
    tones = [
        {"name": name, "type": "unsigned", "size": 2, "minimum": int(tone.min()), "maximum": int(tone.max())}
        for name, tone in zip(("Red", "Green", "Blue"), colours.T, strict=True)
    ]
    crs = cloud.header.parse_crs()
    srs = {} if crs is None else {"wkt": crs.to_wkt("WKT1_GDAL")}
    described = {
        "bounds": cube, "boundsConforming": [*low.tolist(), *high.tolist()], "dataType": "binary",
        "hierarchyType": "json", "points": len(steps), "schema": [*places, *tones], "span": SIDE, "srs": srs,
        "version": "1.0.0",
    }  # fmt: skip
    (folder / "ept.json").write_text(json.dumps(described))
    return folder / "ept.json"
