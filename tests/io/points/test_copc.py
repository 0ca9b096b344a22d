"""COPC files, read by the text of the format, by laspy, by copclib and by copc.js."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import laspy
import lazrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laspy.copc import Bounds, CopcReader
from pyproj import CRS

from copc_format import checked_nodes
from zlocus.core.errors import OutputError
from zlocus.io.points import copc, octree
from zlocus.io.points.copc import StepBounds, write_copc
from zlocus.products.point_cloud import add_crs, add_precision

STEP_M, OFFSET = 0.001, np.array([500000.0, 4000000.0, 100.0])
# Small enough that some hundred points make several levels, buckets and pages.
SMALL = {"NODE_POINTS": 20, "BUCKET_POINTS": 60, "CELL_BITS": 2, "SPLIT_LEVELS": 2}
JS = "ZLOCUS_COPC_JS"
# Reads all nodes of a file with copc.js, and prints what it found as JSON.
SCRIPT = """
const { Copc } = require('copc')
async function main(file) {
  const copc = await Copc.create(file)
  const nodes = {}, pages = [copc.info.rootHierarchyPage]
  while (pages.length) {
    const found = await Copc.loadHierarchyPage(file, pages.pop())
    Object.assign(nodes, found.nodes)
    pages.push(...Object.values(found.pages))
  }
  let sum = 0, count = 0, sigma = 0
  for (const node of Object.values(nodes)) {
    const view = await Copc.loadPointDataView(file, copc, node)
    const [x, s] = [view.getter('X'), view.getter('sigma_m')]
    for (let k = 0; k < view.pointCount; k++) { sum += x(k); sigma += s(k) }
    count += view.pointCount
  }
  console.log(JSON.stringify({ sum, count, sigma, nodes: Object.keys(nodes).length, wkt: copc.wkt, info: copc.info }))
}
main(process.argv[1]).catch(error => { console.error(error); process.exit(1) })
"""


@pytest.fixture
def small(monkeypatch):
    for name, value in SMALL.items():
        monkeypatch.setattr(octree, name, value)
    monkeypatch.setattr(copc, "PAGE_NODES", 30)
    monkeypatch.setattr(copc, "PAGE_LEVELS", 2)
    monkeypatch.setattr(copc, "PENDING_POINTS", 100)


def las_header(point_format=7, crs="EPSG:32632"):
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales, header.offsets = np.full(3, STEP_M), OFFSET
    add_precision(header, "standard deviation of height, m")
    add_crs(header, CRS.from_user_input(crs))
    return header


def records(steps, seed=1, point_format=7):
    """Points at whole steps (n, 3), with other fields at random, and their header."""
    header, rng = las_header(point_format), np.random.default_rng(seed)
    points = laspy.ScaleAwarePointRecord.zeros(len(steps), header=header)
    points.X, points.Y, points.Z = np.asarray(steps, np.int64).T
    points.return_number[:], points.number_of_returns[:] = 1, 1
    points.point_source_id[:] = rng.integers(0, 9, len(steps))
    if point_format >= 7:
        points.red[:] = rng.integers(0, 65536, len(steps))
    sigma = rng.uniform(0, 2, len(steps)).astype(np.float32)
    sigma[::3] = np.nan
    points["sigma_m"], points["n_images"] = sigma, rng.integers(0, 255, len(steps)).astype(np.uint8)
    return points.array, header


def written(path, points, header, batch=37):
    steps = np.column_stack([points[name] for name in "XYZ"]).astype(np.int64)
    bounds = StepBounds(*((steps.min(0), steps.max(0)) if len(steps) else (np.zeros(3, int), np.zeros(3, int))))
    parts = (points[k : k + batch] for k in range(0, len(points), batch))
    kept = list(parts)
    assert write_copc(path, header, bounds, lambda: iter(kept)) == len(points)
    return path


def rows_of(points):
    """The points as bytes in an order that does not depend on theirs."""
    return sorted(points[k].tobytes() for k in range(len(points)))


def clouds():
    """Whole steps of points: few, in one place, in a plane, at the ends of what a file can hold, or spread."""
    spreads = st.sampled_from([0, 1, 5, 300, 100_000, 2**31 - 1])
    return st.builds(
        lambda n, spread, seed: (
            np.random.default_rng(seed).integers(-np.array(spread) - 1, np.array(spread) + 1, (n, 3), endpoint=False)
        ),
        st.integers(1, 300), st.tuples(spreads, spreads, spreads), st.integers(0, 1000),
    )  # fmt: skip


@settings(max_examples=20, deadline=None)
@given(clouds())
def test_every_point_is_once_in_the_cube_of_its_node(steps):
    points, header = records(steps)
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        for name, value in SMALL.items():
            patch.setattr(octree, name, value)
        patch.setattr(copc, "PAGE_NODES", 10)
        patch.setattr(copc, "PAGE_LEVELS", 2)
        path = written(Path(folder) / "p.copc.laz", points, header)
        found = checked_nodes(path)
        assert rows_of(np.concatenate([node.points for node in found])) == rows_of(points)
        las = laspy.read(path)
    # Extra bytes, NaN among them, have the same bits.
    assert rows_of(las.points.array) == rows_of(points)
    np.testing.assert_array_equal(las.header.mins, steps.min(axis=0) * STEP_M + OFFSET)
    np.testing.assert_array_equal(las.header.maxs, steps.max(axis=0) * STEP_M + OFFSET)


def hilly(n=1500, seed=3):
    """Points of hills, in a random order."""
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 200_000, (2, n))
    return np.column_stack([x, y, (8000 * np.sin(x / 30_000) * np.cos(y / 25_000)).astype(int)])


def test_nodes_above_others_have_a_point_in_each_cell(small, tmp_path):
    points, header = records(hilly())
    found = checked_nodes(written(tmp_path / "p.copc.laz", points, header))
    parents = {(level - 1, x // 2, y // 2, z // 2) for (level, x, y, z) in (node.key for node in found) if level}
    below = dict.fromkeys(parents, 0)
    places = {}
    for node in found:
        cells = 2 ** SMALL["CELL_BITS"]
        side = (node.cube[1] - node.cube[0]) / cells
        xyz = np.column_stack([node.points[name] * STEP_M for name in "XYZ"]) + OFFSET
        places[node.key] = {tuple(cell) for cell in np.floor((xyz - node.cube[0]) / side).astype(int)}
        if node.key in parents:
            assert len(places[node.key]) == len(node.points)
    # A cell with points below has one in the node itself, or above it.
    for level, x, y, z in (node.key for node in found if node.key[0] == 1):
        below[0, x // 2, y // 2, z // 2] += len(places[level, x, y, z])
        cells = 2 ** SMALL["CELL_BITS"]
        half = np.array([x, y, z]) % 2 * cells
        assert {tuple((np.array(cell) + half) // 2) for cell in places[level, x, y, z]} <= places[0, 0, 0, 0]
    assert len(places[0, 0, 0, 0]) > 10
    assert below[0, 0, 0, 0]


def test_the_bytes_depend_on_the_points_alone(small, tmp_path):
    points, header = records(hilly(900))
    one = written(tmp_path / "one.copc.laz", points, header).read_bytes()
    assert written(tmp_path / "two.copc.laz", points, header, batch=901).read_bytes() == one
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize("point_format", [6, 7, 8])
def test_laspy_finds_points_by_place_and_level(small, tmp_path, point_format):
    points, header = records(hilly(), point_format=point_format)
    path = written(tmp_path / "p.copc.laz", points, header)
    with CopcReader.open(path) as reader:
        assert rows_of(reader.query().array) == rows_of(points)
        by_level = [reader.query(level=level) for level in range(12)]
        low, high = np.array([500020.0, 4000030.0]), np.array([500090.5, 4000110.25])
        inside = reader.query(bounds=Bounds(low, high))
        coarse = reader.query(resolution=reader.copc_info.spacing)
    x, y = points["X"] * STEP_M + OFFSET[0], points["Y"] * STEP_M + OFFSET[1]
    wanted = points[(x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])]
    assert rows_of(inside.array) == rows_of(wanted)
    assert sum(map(len, by_level)) == len(points)
    assert len(by_level[0]) == len(coarse) < len(by_level[2])
    assert len([level for level in by_level if len(level)]) > 3


@pytest.mark.parametrize("n", [1, 2, 500])
def test_points_in_one_place(small, tmp_path, n):
    points, header = records(np.full((n, 3), (7, -9, 123)))
    (node,) = checked_nodes(written(tmp_path / "p.copc.laz", points, header))
    assert node.key == (0, 0, 0, 0)
    assert rows_of(node.points) == rows_of(points)


def test_places_with_many_points_and_two_far_ones(small, tmp_path):
    """The octree is as deep as its codes allow; buckets are split again and again."""
    steps = np.concatenate([np.full((200, 3), 5), np.full((200, 3), 6), [[2**30, 0, 0], [0, 2**30, 2**30]]])
    points, header = records(steps)
    found = checked_nodes(written(tmp_path / "p.copc.laz", points, header))
    assert rows_of(np.concatenate([node.points for node in found])) == rows_of(points)
    assert max(node.key[0] for node in found) == octree.MAX_BITS - SMALL["CELL_BITS"]


def test_no_points(tmp_path):
    points, header = records(np.empty((0, 3)))
    (node,) = checked_nodes(written(tmp_path / "p.copc.laz", points, header))
    assert len(node.points) == 0
    assert len(laspy.read(tmp_path / "p.copc.laz").points) == 0


def test_what_cannot_be_written_leaves_nothing(small, tmp_path, monkeypatch):
    points, header = records(hilly(300))
    path = tmp_path / "p.copc.laz"

    def failing(error):
        def fail(*_):
            raise error

        return fail

    for module, name, error, sentence in (
        (os, "posix_fallocate", OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (lazrs, "read_chunk_table", lazrs.LazrsError("no luck."), "no luck"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, failing(error))
            with pytest.raises(OutputError, match=rf"p\.copc\.laz cannot be written: {sentence}\. Check the folder"):
                written(path, points, header)
    assert list(tmp_path.iterdir()) == []
    path.mkdir()
    with pytest.raises(OutputError, match=r"p\.copc\.laz cannot be written"):
        written(path, points, header)
    assert list(tmp_path.iterdir()) == [path]


def lattice():
    """Points on the borders of cubes of all levels."""
    row, col = np.mgrid[:20, :65]
    return np.column_stack([137 + 700 * col.ravel(), 29 + 700 * row.ravel(), 1000 * (row % 5).ravel()])


@pytest.mark.parametrize("steps", [hilly(), lattice()], ids=["hills", "lattice"])
def test_copclib_reads_it(small, tmp_path, steps):
    copclib = pytest.importorskip("copclib", reason="copclib is not installed: no second opinion on COPC files")
    points, header = records(steps)
    path = written(tmp_path / "p.copc.laz", points, header)
    reader = copclib.FileReader(str(path))
    assert reader.ValidateSpatialBounds()
    found = reader.GetAllPoints()
    assert len(found) == len(points)
    np.testing.assert_allclose(np.sort(found.x), np.sort(points["X"] * STEP_M + OFFSET[0]), atol=STEP_M / 10)
    assert len(reader.GetAllNodes()) == len(checked_nodes(path))
    assert len(reader.copc_config.extra_bytes_vlr.items) == 2
    assert "UTM zone 32N" in reader.copc_config.wkt


def test_copc_js_reads_it(small, tmp_path):
    """Needs Node.js, and the folder in which `npm install copc` was run in ZLOCUS_COPC_JS."""
    if JS not in os.environ or shutil.which("node") is None:
        pytest.skip(f"{JS} does not name a folder with npm's copc, or there is no node: copc.js is not tried")
    points, header = records(hilly())
    points["sigma_m"] = np.nan_to_num(points["sigma_m"])
    path = written(tmp_path / "p.copc.laz", points, header)
    done = subprocess.run(
        ["node", "-e", SCRIPT, str(path)], cwd=os.environ[JS], capture_output=True, text=True, check=True
    )
    found = json.loads(done.stdout)
    assert found["count"] == len(points)
    assert found["nodes"] == len(checked_nodes(path))
    assert found["sum"] == pytest.approx((points["X"] * STEP_M + OFFSET[0]).sum(), abs=STEP_M)
    assert found["sigma"] == pytest.approx(points["sigma_m"].sum(dtype=float), abs=STEP_M)
    assert "UTM zone 32N" in found["wkt"]
