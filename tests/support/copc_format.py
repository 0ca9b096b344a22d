"""Read a COPC file node by node, by the text of COPC 1.0, and check its rules."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import laspy
import lazrs
import numpy as np

INFO_AT, ENTRY_BYTES = 375 + 54, 32
# Rounding of coordinates in double precision, m.
ROUNDING_M = 2e-9


@dataclass(frozen=True)
class CopcNode:
    """A node: its key (level, x, y, z), the cube that the file states, (2, 3) m, and its points, structured."""

    key: tuple[int, int, int, int]
    cube: np.ndarray
    points: np.ndarray


def checked_nodes(path: Path) -> list[CopcNode]:
    """The nodes of a file, those of each page in their order. Fails where a rule of the format is broken."""
    content = path.read_bytes()
    assert content[377:381] == b"copc", "the record of COPC begins at byte 375"
    assert content[393:395] == b"\x01\x00", "version 1"
    x, y, z, half, spacing, root, root_bytes, gps_low, gps_high = struct.unpack_from("<5d2Q2d", content, INFO_AT)
    assert content[INFO_AT + 72 : INFO_AT + 160] == bytes(88), "reserved"
    assert half > 0
    assert spacing > 0
    assert (gps_low, gps_high) == (0, 0)
    with laspy.open(path) as reader:
        header = reader.header
        laszip = header.vlrs.get("LasZipVlr")[0].record_data
    assert header.point_format.id in (6, 7, 8)
    chunks = chunk_table(content, header.offset_to_point_data, laszip)
    low, found = np.array([x, y, z]) - half, []
    dtype = header.point_format.dtype()
    for key, offset, size, count in entries(content, header.start_of_first_evlr, root, root_bytes):
        side = 2 * half / 2 ** key[0]
        corner = low + side * np.array(key[1:])
        points = np.empty(count, dtype)
        if count:
            assert chunks.pop(offset) == (count, size), "the table of chunks says the same"
            data = np.frombuffer(content[offset : offset + size], np.uint8)
            lazrs.decompress_points_with_chunk_table(data, laszip, points.view(np.uint8), [(count, size)])
        else:
            assert (offset, size) == (0, 0)
        found.append(CopcNode(key, np.array([corner, corner + side]), points))
    assert not chunks, "every chunk is a node"
    assert sum(len(node.points) for node in found) == header.point_count
    keys = {node.key for node in found}
    assert len(keys) == len(found)
    assert all(not level or (level - 1, x // 2, y // 2, z // 2) in keys for level, x, y, z in keys)
    for node in found:
        places = [node.points[name] * header.scales[axis] + header.offsets[axis] for axis, name in enumerate("XYZ")]
        xyz = np.column_stack(places)
        inside = (xyz >= node.cube[0] - ROUNDING_M) & (xyz <= node.cube[1] + ROUNDING_M)
        assert inside.all(), f"{node.key}: all points lie inside the cube"
    return found


def chunk_table(content: bytes, at: int, laszip: bytes) -> dict[int, tuple[int, int]]:
    """Number of points and bytes of each chunk, by its offset."""
    table, offset = {}, at + 8
    (where,) = struct.unpack_from("<q", content, at)
    source = BytesIO(content)
    source.seek(where)
    for count, size in lazrs.read_chunk_table_only(source, lazrs.LazVlr(laszip)):
        table[offset] = (count, size)
        offset += size
    assert offset == where, "chunks stand without gaps up to their table"
    return table


def entries(content, evlr, root, root_bytes):
    """Key, offset, size and number of points of each node; pages are followed and lie inside their record."""
    reserved, user, number, length = struct.unpack_from("<H16sHQ", content, evlr)
    assert (reserved, user.rstrip(b"\0"), number) == (0, b"copc", 1000)
    begin, end = evlr + 60, evlr + 60 + length
    assert end == len(content)
    pages, read = [(root, root_bytes)], 0
    while pages:
        offset, size = pages.pop(0)
        assert begin <= offset
        assert offset + size <= end
        read += size
        for at in range(offset, offset + size, ENTRY_BYTES):
            *key, where, n_bytes, count = struct.unpack_from("<4iQ2i", content, at)
            if count == -1:
                pages.append((where, n_bytes))
            else:
                yield tuple(key), where, n_bytes, count
    assert read == length, "every page is used once"
