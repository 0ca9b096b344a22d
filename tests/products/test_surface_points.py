"""surface.laz, read back with laspy."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS

from copc_format import checked_nodes
from las_format import check_laz
from zlocus.core.errors import InputError, OutputError
from zlocus.io.crs import local_frame
from zlocus.io.rasters import write_cog
from zlocus.products.surface_points import write_surface_copc, write_surface_points

CELL_M, WEST, NORTH = 0.5, 499999.0, 4000000.0
STEP_M = 0.0005 + 1e-9  # half of what the file can tell
RNG = np.random.default_rng(11)


def written(folder, *, rows=300, cols=40, dtype="uint8", crs="EPSG:32632", cell_m=CELL_M, bands=1):
    z = RNG.normal(200, 30, (rows, cols)).astype(np.float32)
    z[RNG.random(z.shape) < 0.3] = np.nan
    sigma = np.where(np.isfinite(z), RNG.uniform(0.1, 2, z.shape), np.nan).astype(np.float32)
    sigma[:, 3] = np.nan  # as where heights were interpolated
    views = np.where(np.isfinite(sigma), RNG.integers(2, 9, z.shape), 0).astype(np.uint8)
    ortho = RNG.integers(0, 255 if dtype == "uint8" else 900, (bands, rows, cols)).astype(dtype)
    grid = GeoBox(z.shape, Affine(cell_m, 0, WEST, 0, -cell_m, NORTH), crs)
    write_cog(folder / "dsm.tif", z, grid, nodata=np.nan)
    write_cog(folder / "sigma.tif", sigma, grid, nodata=np.nan)
    write_cog(folder / "views.tif", views, grid, nodata=0)
    write_cog(folder / "ortho.tif", ortho, grid, mask=np.isfinite(z))
    return z, sigma, views, ortho


def test_a_point_for_every_height(tmp_path):
    z, sigma, views, ortho = written(tmp_path)
    known = np.isfinite(z)
    assert write_surface_points(tmp_path, tmp_path / "surface.laz") == known.sum()
    laz = laspy.read(tmp_path / "surface.laz")
    row, col = np.nonzero(known)
    np.testing.assert_allclose(laz.x, WEST + (col + 0.5) * CELL_M, atol=STEP_M)
    np.testing.assert_allclose(laz.y, NORTH - (row + 0.5) * CELL_M, atol=STEP_M)
    np.testing.assert_allclose(laz.z, z[known], atol=STEP_M)
    np.testing.assert_array_equal(laz["sigma_m"], sigma[known])
    np.testing.assert_array_equal(laz["n_images"], views[known])
    for colour in (laz.red, laz.green, laz.blue):
        np.testing.assert_array_equal(colour, ortho[0][known].astype(np.uint16) * 257)
    assert (laz["sigma_m"].dtype, laz["n_images"].dtype) == (np.float32, np.uint8)
    header = laz.header
    check_laz(tmp_path / "surface.laz")
    assert (str(header.version), header.point_format.id, header.point_count) == ("1.4", 7, known.sum())
    assert header.parse_crs() == CRS("EPSG:32632")
    np.testing.assert_allclose(header.mins, [laz.x.min(), laz.y.min(), laz.z.min()])
    assert [d.description for d in header.point_format.extra_dimensions] == [
        "standard deviation of height, m", "images used",
    ]  # fmt: skip


@pytest.mark.parametrize("rows", [1, 37, 1000])
def test_strips_change_no_point(tmp_path, rows):
    written(tmp_path)
    write_surface_points(tmp_path, tmp_path / "surface.laz")
    write_surface_points(tmp_path, tmp_path / "other.laz", rows)
    one, other = laspy.read(tmp_path / "surface.laz"), laspy.read(tmp_path / "other.laz")
    assert one.points.array.tobytes() == other.points.array.tobytes()


def test_colours_of_other_images(tmp_path):
    z, *_, ortho = written(tmp_path, dtype="uint16", bands=3)
    write_surface_points(tmp_path, tmp_path / "surface.laz")
    laz, known = laspy.read(tmp_path / "surface.laz"), np.isfinite(z)
    seen = ortho[:, known]
    # Even numbers from 0 to 900 do not reach three deviations above their mean: the largest is white.
    np.testing.assert_array_equal(laz.red, np.rint(seen[0] / seen[0].max() * 65535).clip(0, 65535))
    assert laz.blue.max() == 65535
    assert not np.array_equal(laz.red, laz.blue)


def test_copc_has_the_same_points(tmp_path):
    written(tmp_path)
    n_points = write_surface_points(tmp_path, tmp_path / "surface.laz")
    assert write_surface_copc(tmp_path, tmp_path / "surface.copc.laz", 37) == n_points
    nodes = checked_nodes(tmp_path / "surface.copc.laz")
    check_laz(tmp_path / "surface.copc.laz")
    laz, copc = laspy.read(tmp_path / "surface.laz"), laspy.read(tmp_path / "surface.copc.laz")
    order = np.argsort(copc.points.array, order=["Y", "X"])
    want = laz.points.array[np.argsort(laz.points.array, order=["Y", "X"])]
    assert copc.points.array[order].tobytes() == want.tobytes()
    assert sum(len(node.points) for node in nodes) == n_points
    assert copc.header.parse_crs() == CRS("EPSG:32632")
    assert [d.name for d in copc.header.point_format.extra_dimensions] == ["sigma_m", "n_images"]


@pytest.mark.parametrize("write", [write_surface_points, write_surface_copc])
def test_in_a_local_frame_there_is_no_crs(tmp_path, write):
    written(tmp_path, rows=9, crs=local_frame().to_wkt())
    write(tmp_path, tmp_path / "surface.laz")
    assert laspy.read(tmp_path / "surface.laz").header.parse_crs() is None


@pytest.mark.parametrize("write", [write_surface_points, write_surface_copc])
def test_a_surface_without_heights(tmp_path, write):
    grid = GeoBox((4, 5), Affine(CELL_M, 0, WEST, 0, -CELL_M, NORTH), "EPSG:32632")
    nothing = np.full((4, 5), np.nan, np.float32)
    for name in ("dsm.tif", "sigma.tif"):
        write_cog(tmp_path / name, nothing, grid, nodata=np.nan)
    write_cog(tmp_path / "views.tif", np.zeros((4, 5), np.uint8), grid, nodata=0)
    write_cog(tmp_path / "ortho.tif", np.zeros((4, 5), np.uint16), grid, mask=np.zeros((4, 5), bool))
    assert write(tmp_path, tmp_path / "surface.laz") == 0
    assert len(laspy.read(tmp_path / "surface.laz").points) == 0
    check_laz(tmp_path / "surface.laz")


@pytest.mark.parametrize("write", [write_surface_points, write_surface_copc])
def test_what_cannot_be_written_leaves_nothing(tmp_path, write):
    written(tmp_path, rows=4, cell_m=600000.0)
    with pytest.raises(OutputError, match=r"further apart than 2147 km"):
        write(tmp_path, tmp_path / "surface.laz")
    (tmp_path / "views.tif").unlink()
    with pytest.raises(InputError, match=r"There is no raster .*views\.tif"):
        write(tmp_path, tmp_path / "surface.laz")
    written(tmp_path, rows=4)
    (tmp_path / "surface.laz").mkdir()
    with pytest.raises(OutputError, match=r"surface\.laz cannot be written"):
        write(tmp_path, tmp_path / "surface.laz")
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "dsm.tif", "ortho.tif", "sigma.tif", "surface.laz", "views.tif",
    ]  # fmt: skip
