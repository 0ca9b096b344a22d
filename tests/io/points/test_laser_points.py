"""Laser points: which are read from LAS, LAZ and COPC, and what is said of damaged files."""

from __future__ import annotations

from contextlib import suppress

import laspy
import numpy as np
import pytest

from point_files import cloud, copc
from zlocus.core.errors import ConfigError, InputError
from zlocus.io.points import laser_points
from zlocus.io.points.ground_points import KnownPoints, PointOptions
from zlocus.io.points.open_points import open_points

# Coordinates are stored in steps of a millimetre.
STEP_M = 0.001
N = 500


@pytest.fixture
def xyz():
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(461000, 461100, N), rng.uniform(5247000, 5247100, N), rng.uniform(400, 420, N)])


def read(paths, options=None, bounds=None):
    point_file = open_points(paths, options or PointOptions())
    parts = list(point_file.chunks(bounds))
    return point_file, KnownPoints.joined(parts) if parts else None


@pytest.mark.parametrize("name", ["p.las", "p.laz", "p.LAZ"])
def test_points_are_read_in_parts(tmp_path, xyz, name, monkeypatch):
    monkeypatch.setattr(laser_points, "POINTS_AT_A_TIME", 64)
    point_file, points = read([cloud(tmp_path / name, xyz)])
    assert np.abs(points.xyz - xyz).max() <= STEP_M
    assert point_file.crs.to_epsg() == 32632
    assert point_file.is_cloud
    assert point_file.cover_names == {2: "2 ground"}


def test_copc_is_read(tmp_path, xyz):
    path = copc(tmp_path / "p.copc.laz", xyz)
    with laspy.CopcReader.open(path) as reader:
        assert len(reader.query()) == N, "the test's file is a COPC file"
    _, points = read([path])
    assert np.abs(points.xyz - xyz).max() <= STEP_M


def test_noise_and_withheld_points_are_left_out_and_the_rest_by_option(tmp_path, xyz):
    classes, withheld = np.resize([2, 2, 5, 7, 18], N), np.arange(N) == 0
    number, of = np.resize([1, 2], N), 2
    path = cloud(tmp_path / "p.laz", xyz, classes, withheld=withheld, return_number=number, number_of_returns=of)
    point_file, points = read([path])
    assert set(points.cover) == {2, 5}
    assert point_file.left_out == {"noise or withheld": 2 * N // 5 + 1}
    point_file, points = read([path], PointOptions(laser_classes=(2,)))
    assert len(points) == 2 * N // 5 - 1
    assert point_file.left_out == {"noise or withheld": 1, "of other classes": 3 * N // 5}
    _, last = read([path], PointOptions(returns="last"))
    _, first = read([path], PointOptions(returns="first"))
    assert len(last) + len(first) == 3 * N // 5 - 1
    assert read([path], PointOptions(laser_classes=(9,)))[1] is None


def test_several_clouds_are_one_and_those_elsewhere_are_not_read(tmp_path, xyz):
    far = cloud(tmp_path / "far.laz", xyz + np.array([5000, 0, 0]))
    # Whatever a file outside of the bounds holds behind its header is not looked at.
    far.write_bytes(far.read_bytes()[:-500])
    point_file, points = read([cloud(tmp_path / "a.laz", xyz), far], bounds=(460000, 5240000, 462000, 5250000))
    assert len(points) == N
    assert point_file.left_out == {"in clouds outside of the surface": N}
    other = cloud(tmp_path / "b.laz", xyz, crs="EPSG:32633")
    with pytest.raises(InputError, match="have different CRS"):
        open_points([tmp_path / "a.laz", other], PointOptions())
    assert open_points([tmp_path / "a.laz", other], PointOptions(crs="EPSG:32632")).crs.to_epsg() == 32632
    with pytest.raises(ConfigError, match=r"2 references are given, and .*t.csv is a table"):
        open_points([tmp_path / "a.laz", tmp_path / "t.csv"], PointOptions())


@pytest.mark.parametrize("name", ["p.las", "p.laz"])
def test_truncated_clouds_are_refused(tmp_path, xyz, name):
    path = cloud(tmp_path / name, xyz)
    whole = path.read_bytes()
    for length in (0, 100, 300, len(whole) // 2, len(whole) - 200):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"is truncated|cannot be read as a cloud of points"):
            read([path])


def test_flipped_bytes_are_read_or_refused(tmp_path, xyz):
    path = cloud(tmp_path / "p.laz", xyz)
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    for _ in range(60):
        held = bytearray(whole)
        for at in rng.integers(0, len(held), 3):
            held[at] ^= int(rng.integers(1, 256))
        path.write_bytes(held)
        with suppress(InputError):
            read([path])


def test_other_files_and_empty_clouds_are_refused(tmp_path, xyz):
    (tmp_path / "p.las").write_text("x,y,z\n1,2,3\n")
    with pytest.raises(InputError, match=r"p.las cannot be read as a cloud of points"):
        read([tmp_path / "p.las"])
    with pytest.raises(InputError, match="There is no cloud of points"):
        read([tmp_path / "none.laz"])
    header = laspy.LasHeader(point_format=6, version="1.4")
    laspy.LasData(header).write(tmp_path / "empty.las")
    with pytest.raises(InputError, match="holds no points"):
        read([tmp_path / "empty.las"])
