"""Files of points for tests: tables, vector files, Parquet, and laser clouds, COPC among them."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import shapely
from laspy.vlrs.vlr import VLR
from pyogrio.raw import write as write_vector
from pyproj import CRS


def csv(path, columns, separator=","):
    """A table with a header. columns : values by name."""
    rows = zip(*columns.values(), strict=True)
    lines = [separator.join(columns), *(separator.join(map(str, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def gpkg(path, xyz, columns=None, crs="EPSG:32632", geometry_type="Point Z"):
    """Points in a vector file. columns : attributes by name."""
    columns = columns or {}
    write_vector(
        path, shapely.to_wkb(shapely.points(xyz)), [np.asarray(values) for values in columns.values()], list(columns),
        geometry_type=geometry_type, crs=crs,
    )  # fmt: skip
    return path


def cloud(path, xyz, classes=2, crs="EPSG:32632", **fields):
    """A cloud of laser points, compressed where the name ends in .laz. fields : of each point, such as withheld."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.asarray(xyz).mean(axis=0))
    if crs is not None:
        header.add_crs(CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(xyz, float).T
    for name, values in {"classification": classes, "return_number": 1, "number_of_returns": 1, **fields}.items():
        las[name][:] = values
    las.write(path)
    return path


def copc(path, xyz, crs="EPSG:32632"):
    """A COPC file of one node: a LAZ whose first record says where the hierarchy is, and the hierarchy behind it."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.asarray(xyz).mean(axis=0))
    header.vlrs.append(VLR("copc", 1, "copc info", bytes(160)))
    header.add_crs(CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(xyz, float).T
    las["classification"][:], las["return_number"][:], las["number_of_returns"][:] = 2, 1, 1
    las.evlrs = laspy.vlrs.vlrlist.VLRList([VLR("copc", 1000, "EPT Hierarchy", bytes(32))])
    las.write(path)
    held = bytearray(path.read_bytes())
    with laspy.open(path) as reader:
        begin, evlrs = reader.header.offset_to_point_data, reader.header.start_of_first_evlr
    size = evlrs - begin - 8  # behind the offset of the table of chunks
    held[evlrs + 60 : evlrs + 92] = struct.pack("<iiiiQii", 0, 0, 0, 0, begin + 8, size, len(xyz))
    middle, half = np.mean(xyz, axis=0), float(np.ptp(xyz, axis=0).max())
    info = struct.pack("<5d2Q2d", *middle, half, half / 128, evlrs + 60, 32, 0.0, 0.0)
    held[375 + 54 : 375 + 54 + len(info)] = info
    path.write_bytes(held)
    return path
