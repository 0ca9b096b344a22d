"""The files of a cloud: read back, whole or not there."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from pyproj import CRS

from copc_format import checked_nodes
from las_format import check_laz
from zlocus.core.errors import OutputError
from zlocus.io.crs import local_frame
from zlocus.io.open_raster import open_raster
from zlocus.products.point_cloud import LAZ_STEP_M, PLY_POINT, PointCloud, file_names, write_cloud_copc, write_map

UTM = CRS.from_epsg(32632)
LAMBERT = CRS("+proj=lcc +lat_1=46 +lat_2=48 +lat_0=47 +lon_0=8 +datum=WGS84 +units=m")
XYZ = np.array([[462_000.1234, 5_247_000.5678, 431.25], [462_010.0, 5_247_020.0, -3.5], [461_990.5, 5_246_980.0, 0.0]])
RGB = np.array([[65535, 0, 256], [1000, 2000, 3000], [0, 0, 0]], np.uint16)

SIGMA_M, N_IMAGES = np.array([0.25, 1.5, 0.125]), np.array([2, 5, 3], np.uint8)


def written(folder, crs=UTM):
    with PointCloud(folder, crs) as cloud:
        cloud.write(1, XYZ[:2], RGB[:2], SIGMA_M[:2], N_IMAGES[:2])
        cloud.write(7, XYZ[2:], RGB[2:], SIGMA_M[2:], N_IMAGES[2:])
    return folder


def read_ply(path):
    header, body = path.read_bytes().split(b"end_header\n", 1)
    return header.decode("ascii").splitlines(), np.frombuffer(body, PLY_POINT)


def test_laz_holds_points_colours_source_and_crs(tmp_path):
    cloud = laspy.read(written(tmp_path) / "cloud.laz")
    check_laz(tmp_path / "cloud.laz")
    np.testing.assert_allclose(np.asarray(cloud.xyz), XYZ, rtol=0, atol=LAZ_STEP_M / 2 + 1e-9)
    np.testing.assert_array_equal(np.column_stack([cloud.red, cloud.green, cloud.blue]), RGB)
    np.testing.assert_array_equal(cloud.point_source_id, [1, 1, 7])
    assert cloud.header.are_points_compressed
    assert cloud.header.parse_crs() == UTM
    np.testing.assert_allclose(cloud.header.mins, XYZ.min(axis=0), atol=LAZ_STEP_M)


def test_laz_holds_precision_and_number_of_images(tmp_path):
    cloud = laspy.read(written(tmp_path) / "cloud.laz")
    np.testing.assert_array_equal(cloud["sigma_m"], SIGMA_M.astype(np.float32))
    np.testing.assert_array_equal(cloud["n_images"], N_IMAGES)
    assert (cloud["sigma_m"].dtype, cloud["n_images"].dtype) == (np.float32, np.uint8)
    about = {dimension.name: dimension.description for dimension in cloud.point_format.extra_dimensions}
    assert about == {"sigma_m": "standard deviation along ray, m", "n_images": "images used"}


@pytest.mark.parametrize("crs", [UTM, local_frame()])
def test_copc_holds_the_same(tmp_path, crs):
    assert write_cloud_copc(written(tmp_path, crs)) == len(XYZ)
    (node,) = checked_nodes(tmp_path / "cloud.copc.laz")
    laz, copc = laspy.read(tmp_path / "cloud.laz"), laspy.read(tmp_path / "cloud.copc.laz")
    assert node.points.tobytes() == laz.points.array.tobytes() == copc.points.array.tobytes()
    assert copc.header.parse_crs() == laz.header.parse_crs()
    assert copc.header.generating_software == laz.header.generating_software


def test_copc_of_no_points(tmp_path):
    with PointCloud(tmp_path, UTM):
        pass
    assert write_cloud_copc(tmp_path) == 0
    checked_nodes(tmp_path / "cloud.copc.laz")


def test_ply_holds_the_same(tmp_path):
    header, points = read_ply(written(tmp_path) / "cloud.ply")
    assert header[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 3" in header
    assert "comment crs EPSG:32632" in header
    np.testing.assert_array_equal(points["xyz"], XYZ)
    np.testing.assert_array_equal(points["rgb"], RGB >> 8)


def test_ply_names_a_crs_with_heights_or_without_a_code(tmp_path):
    for crs, expected in ((CRS("EPSG:32632+5773"), "EPSG:32632+5773"), (LAMBERT, 'PROJCRS["unknown",')):
        parts = CRS.from_wkt(crs.to_wkt())
        (line,) = [s for s in read_ply(written(tmp_path, parts) / "cloud.ply")[0] if s.startswith("comment crs")]
        assert line.startswith(f"comment crs {expected}")
        assert laspy.read(tmp_path / "cloud.laz").header.parse_crs().sub_crs_list == parts.sub_crs_list


def test_a_local_frame_has_no_crs(tmp_path):
    cloud = laspy.read(written(tmp_path, local_frame()) / "cloud.laz")
    assert cloud.header.parse_crs() is None
    assert not any("crs" in line for line in read_ply(tmp_path / "cloud.ply")[0])


def test_no_points_make_an_empty_cloud(tmp_path):
    with PointCloud(tmp_path, UTM):
        pass
    assert len(laspy.read(tmp_path / "cloud.laz")) == 0
    assert len(read_ply(tmp_path / "cloud.ply")[1]) == 0


def test_a_failure_leaves_nothing(tmp_path):
    def interrupted():
        with PointCloud(tmp_path, UTM) as cloud:
            cloud.write(1, XYZ, RGB, SIGMA_M, N_IMAGES)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_said(tmp_path):
    with (
        pytest.raises(OutputError, match=r"cloud\.laz cannot be written"),
        PointCloud(tmp_path / "no", UTM) as cloud,
    ):
        cloud.write(1, XYZ, RGB, SIGMA_M, N_IMAGES)
    far = np.add(XYZ, [[0, 0, 0], [0, 0, 0], [0, 5e6, 0]])
    with pytest.raises(OutputError, match="narrower --heights"), PointCloud(tmp_path, UTM) as cloud:
        cloud.write(1, far, RGB, SIGMA_M, N_IMAGES)
    assert list(tmp_path.iterdir()) == []


def test_maps_have_the_rows_and_columns_of_their_image(tmp_path):
    values = np.array([[1.5, np.nan, 3.0], [4.0, 5.0, 6.0]], np.float32)
    write_map(tmp_path / "a_height.tif", values.shape, (values[:1], values[1:]), "height", "m")
    with open_raster(tmp_path / "a_height.tif") as source:
        np.testing.assert_array_equal(source.read(1), values)
        assert np.isnan(source.nodata)
        assert source.crs is None
        assert source.transform.is_identity
        assert (source.descriptions, source.units) == (("height",), ("m",))


def test_names_of_views_become_names_of_files():
    assert file_names(["im2", "a/b", "a_b", "A B", "..", "é1"]) == ["im2", "a_b", "a_b_2", "A_B_3", "view", "é1"]
