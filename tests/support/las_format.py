"""Check the bytes of a LAS file against the rules of LAS 1.4 R15."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np

HEADER_BYTES, VLR_BYTES, EXTRA_BYTES = 375, 54, 192
# Of point format 7, compressed.
FORMAT_7, FORMAT_7_BYTES, COMPRESSED = 7, 36, 0x80
WKT_BIT = 1 << 4
# Sizes of the data types of extra bytes, by their number.
EXTRA_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 8, 8: 8, 9: 4, 10: 8}


def check_laz(path: Path) -> None:
    """Fails where a rule of the format is broken: sizes, offsets, counts, bounds, the CRS as WKT 1, extra bytes."""
    content = path.read_bytes()
    assert content[:4] == b"LASF"
    assert content[24:26] == b"\x01\x04"
    header_size, offset, n_vlrs = struct.unpack_from("<HII", content, 94)
    assert header_size == HEADER_BYTES
    point_format, point_bytes = struct.unpack_from("<BH", content, 104)
    assert point_format == FORMAT_7 | COMPRESSED
    # Counts of 32 bits are for formats below 6.
    assert content[107:131] == bytes(24)
    records, at = {}, HEADER_BYTES
    for _ in range(n_vlrs):
        user, number, length = struct.unpack_from("<16sHH", content, at + 2)
        records[user.rstrip(b"\0").decode("ascii"), number] = content[at + VLR_BYTES : at + VLR_BYTES + length]
        at += VLR_BYTES + length
    assert at <= offset <= len(content)
    assert ("laszip encoded", 22204) in records
    check_crs(struct.unpack_from("<H", content, 6)[0], records.get(("LASF_Projection", 2112)))
    assert point_bytes == FORMAT_7_BYTES + check_extra_bytes(records.get(("LASF_Spec", 4), b""))
    bounds = np.array(struct.unpack_from("<6d", content, 179)).reshape(3, 2)[:, ::-1]
    (n_points,) = struct.unpack_from("<Q", content, 247)
    by_return = struct.unpack_from("<15Q", content, 255)
    points = laspy.read(path)
    assert (n_points, sum(by_return)) == (len(points), len(points))
    for (low, high), values in zip(bounds, (points.x, points.y, points.z), strict=True):
        if n_points:
            assert (np.min(values), np.max(values)) == (low, high)
    assert (np.asarray(points.return_number) <= np.asarray(points.number_of_returns)).all()


def check_crs(encoding: int, wkt: bytes | None) -> None:
    """A CRS, where there is one, is WKT 1 that ends with a zero byte, and the header says so."""
    assert bool(encoding & WKT_BIT) == (wkt is not None)
    if wkt is not None:
        assert wkt.endswith(b"\0")
        assert wkt.startswith((b"PROJCS[", b"COMPD_CS[")), wkt[:40]


def check_extra_bytes(record: bytes) -> int:
    """Descriptions of the extra bytes hold together; the bytes that they add to a point."""
    assert len(record) % EXTRA_BYTES == 0
    size = 0
    for start in range(0, len(record), EXTRA_BYTES):
        kind, name = record[start + 2], record[start + 4 : start + 36]
        assert name.rstrip(b"\0").isascii()
        size += EXTRA_SIZES[kind]
    return size
