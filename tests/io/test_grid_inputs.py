from __future__ import annotations

import re
import warnings

import numpy as np
import pytest
import rasterio
import shapely
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from rasterio.transform import from_origin

from grid_input_files import write_polygons, write_raster
from rpc_fixtures import write_image
from zlocus.core.errors import ConfigError, InputError
from zlocus.io import vertical
from zlocus.io.grid_inputs import cells_inside, dem_datum, read_dem, read_geobox, read_polygons
from zlocus.io.rasters import write_cog
from zlocus.io.vertical import grid_crs, named_vertical_datum

GRID = GeoBox.from_bbox((690000, 4790000, 690400, 4790300), crs="EPSG:32631", resolution=2)
DEGREE_PLANE_M = 0.02


def cell_centres(grid: GeoBox = GRID):
    """Easting and northing of every cell, each (r, c)."""
    rows, cols = np.indices(tuple(grid.shape))
    return grid.transform * (cols + 0.5, rows + 0.5)


def geographic_centres():
    return Transformer.from_crs(32631, 4326, always_xy=True).transform(*cell_centres())


def degree_plane(path, slope_lon=1000.0, slope_lat=2000.0, **profile):
    """A DEM in degrees whose height is slope_lon * longitude + slope_lat * latitude: bilinear gives it back exactly."""
    step, west, north = 0.001, 5.2, 43.4
    lon = west + (np.arange(400) + 0.5) * step
    lat = north - (np.arange(300) + 0.5) * step
    cells = (slope_lon * lon + slope_lat * lat[:, np.newaxis]).astype(np.float64)
    crs = profile.pop("crs", "EPSG:4326")
    return write_raster(path, cells, from_origin(west, north, step, step), crs, **profile), cells


def test_the_grid_of_a_product_is_read_back(tmp_path):
    write_cog(tmp_path / "a.tif", np.zeros(GRID.shape, np.float32), GRID)
    assert read_geobox(tmp_path / "a.tif") == GRID


def test_heights_of_a_dem_may_be_scaled(tmp_path):
    path = write_raster(tmp_path / "dem.tif", np.full(GRID.shape, 254, np.int16), GRID.transform, "EPSG:32631")
    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.1,), (10.0,)
    np.testing.assert_allclose(read_dem(path, GRID), 35.4, atol=1e-5)


def test_rasters_that_are_no_grid(tmp_path):
    cells = np.zeros((5, 6), np.float32)
    north_up = from_origin(690000, 4790000, 1, 1)
    degrees = write_raster(tmp_path / "degrees.tif", cells, from_origin(5, 43, 0.001, 0.001), "EPSG:4326")
    with pytest.raises(ConfigError, match="is geographic"):
        read_geobox(degrees)
    for path, message in (
        (tmp_path / "none.tif", "There is no raster"),
        (write_image(tmp_path / "image.tif", cells), r"image\.tif has no CRS"),
        (
            write_raster(tmp_path / "r.tif", cells, north_up @ north_up.rotation(10), "EPSG:32631"),
            "rotated or not north-up",
        ),
        (write_raster(tmp_path / "s.tif", cells, north_up @ north_up.scale(1, -1), "EPSG:32631"), "not north-up"),
    ):
        with pytest.raises(InputError, match=message):
            read_geobox(path)


@pytest.mark.parametrize("row", [(np.nan, 0.0), (np.inf, 0.0), (1e300, 0.0), (2.0, -2.0)])
def test_a_dem_whose_cells_have_no_place(tmp_path, row):
    """Nor, where rows and columns run the same way, a size."""
    with warnings.catch_warnings(action="ignore"):
        path = write_raster(tmp_path / "dem.tif", np.zeros((4, 5)), Affine(*row, 5.0, 1.0, -1.0, 43.0), "EPSG:4326")
        with pytest.raises(
            InputError, match=re.escape(f"The cells of {path} lie nowhere: its transform is ({row[0]}, ")
        ):
            read_dem(path, GRID, dem_datum(path, None))


def test_dem_is_bilinear_at_the_cell_centres(tmp_path):
    path, _ = degree_plane(tmp_path / "dem.tif")
    lon, lat = geographic_centres()
    heights = read_dem(path, GRID)
    assert (heights.shape, heights.dtype) == (tuple(GRID.shape), np.float32)
    np.testing.assert_allclose(heights, 1000 * lon + 2000 * lat, atol=DEGREE_PLANE_M)


def test_nodata_of_a_dem_is_nan_and_not_mixed_in(tmp_path):
    path, cells = degree_plane(tmp_path / "dem.tif", nodata=-32768)
    lon, lat = geographic_centres()
    col, row = int((lon.mean() - 5.2) / 0.001), int((43.4 - lat.mean()) / 0.001)
    with rasterio.open(path, "r+") as file:
        cells[row, col] = -32768
        file.write(cells, 1)
    heights = read_dem(path, GRID)
    hole = np.isnan(heights)
    assert 0 < hole.sum() < hole.size / 2
    assert np.nanmin(heights) > 0
    in_hole = (np.abs((lon - 5.2) / 0.001 - col - 0.5) < 0.4) & (np.abs((43.4 - lat) / 0.001 - row - 0.5) < 0.4)
    assert hole[in_hole].all()


def test_heights_above_a_geoid_become_ellipsoidal(tmp_path):
    path, _ = degree_plane(tmp_path / "dem.tif")
    geoid, _ = degree_plane(tmp_path / "geoid.tif", slope_lon=10.0, slope_lat=0.0)
    lon, _ = geographic_centres()
    difference = read_dem(path, GRID, named_vertical_datum(str(geoid))) - read_dem(path, GRID)
    np.testing.assert_allclose(difference, 10 * lon, atol=DEGREE_PLANE_M)


def test_dem_that_says_its_heights_are_above_a_geoid(tmp_path, monkeypatch):
    """Its grid is used where it is there; else heights are no guess, unless the user says what they are above."""
    monkeypatch.setattr(vertical, "proj_folders", lambda: [tmp_path])
    path, _ = degree_plane(tmp_path / "dem.tif", crs="EPSG:4326+5773")
    with pytest.raises(ConfigError, match=r"dem\.tif has EGM96 heights by its CRS, which needs .*us_nga_egm96"):
        read_dem(path, GRID)
    plain, lon = read_dem(path, GRID, dem_datum(path, "ellipsoid")), geographic_centres()[0]
    geoid, _ = degree_plane(tmp_path / "us_nga_egm96_15.tif", slope_lon=10.0, slope_lat=0.0)
    assert dem_datum(path).files == (geoid,)
    np.testing.assert_allclose(read_dem(path, GRID) - plain, 10 * lon, atol=DEGREE_PLANE_M)
    feet, _ = degree_plane(tmp_path / "feet.tif", crs="EPSG:4326+6360")
    for datum in (None, dem_datum(path)):
        with pytest.raises(InputError, match=r"heights of .*feet\.tif are in US survey foot"):
            read_dem(feet, GRID, datum)


def test_dem_in_feet_by_its_band_or_with_fills_that_are_not_declared(tmp_path):
    plane, cells = degree_plane(tmp_path / "plane.tif")
    with rasterio.open(plane, "r+") as file:
        file.units = ("us-ft",)
    with pytest.raises(InputError, match=r"heights of .*plane\.tif are in us-ft\. Convert them to metres"):
        read_dem(plane, GRID)
    whole = read_dem(degree_plane(tmp_path / "whole.tif")[0], GRID)
    transform = from_origin(5.2, 43.4, 0.001, 0.001)
    # Without the first column that the grid touches.
    lon, _ = geographic_centres()
    cells[:, : int((lon.min() - 5.2) / 0.001) + 1] = -9999
    empty = read_dem(write_raster(tmp_path / "fills.tif", cells, transform, "EPSG:4326"), GRID)
    assert 0.5 < np.isfinite(empty).mean() < 1
    np.testing.assert_allclose(empty[np.isfinite(empty)], whole[np.isfinite(empty)], atol=2.0)


def test_national_heights_of_the_aerial_block(shared_data):
    """EGM2008 without a code of its own, in a map without one."""
    dem = shared_data / "aerial_ngi_dmc" / "reference" / "dem_24m_egm2008.tif"
    if not any((folder / "us_nga_egm08_25.tif").is_file() for folder in vertical.proj_folders()):
        with pytest.raises(ConfigError, match=r"has EGM2008 heights by its CRS, which needs .*us_nga_egm08_25\.tif"):
            dem_datum(dem)
    assert dem_datum(dem, "ellipsoid").geoid is None


def test_a_dem_that_does_not_cover_the_grid_is_refused(tmp_path):
    path, _ = degree_plane(tmp_path / "dem.tif")
    for bounds in ((600000, 4790000, 600400, 4790300), (690000, 5790000, 690400, 5790300)):
        away = GeoBox.from_bbox(bounds, crs="EPSG:32631", resolution=2)
        with pytest.raises(InputError, match=r"dem\.tif has no height anywhere on the grid \(E 6\d+ to"):
            read_dem(path, away)
    with pytest.raises(InputError, match=r"b\.tif has no CRS"):
        read_dem(write_image(tmp_path / "b.tif", np.zeros((4, 4), np.float32)), GRID)


def test_srtm_under_the_ventoux_pair(shared_data):
    """The centre of image 1 lies between posts of 459, 455, 476 and 482 m, 0.17 right and 0.34 below the first."""
    reference = shared_data / "pleiades_pair_ventoux" / "reference"
    grid = GeoBox.from_bbox((675380, 4897230, 675382, 4897232), crs="EPSG:32631", resolution=2)
    srtm = reference / "srtm3_v2_egm96_heights.tif"
    assert read_dem(srtm, grid)[0, 0] == pytest.approx(464.7, abs=0.2)
    # EGM96 is +50.9 m here (README of the data).
    geoid = named_vertical_datum(str(reference / "geoid_egm96_15min.tif"))
    assert read_dem(srtm, grid, geoid)[0, 0] == pytest.approx(464.7 + 50.9, abs=0.3)


@pytest.mark.parametrize(
    ("name", "driver"), [("a.geojson", "GeoJSON"), ("a.gpkg", "GPKG"), ("a.shp", "ESRI Shapefile")]
)
def test_area_of_each_format(tmp_path, name: str, driver: str):
    outer = shapely.box(690100, 4790050, 690300, 4790250)
    ring = outer - shapely.box(690150, 4790100, 690200, 4790200)
    crs = "EPSG:4326" if driver == "GeoJSON" else "EPSG:32631"
    transformer = Transformer.from_crs(32631, crs, always_xy=True)
    polygon = shapely.transform(shapely.segmentize(ring, 1.0), lambda xy: np.column_stack(transformer.transform(*xy.T)))
    path = write_polygons(tmp_path / name, polygon, crs=crs, driver=driver)
    x, y = cell_centres()
    np.testing.assert_array_equal(
        cells_inside(read_polygons(path, grid_crs(GRID)), GRID), shapely.contains_xy(ring, x, y)
    )


def test_edges_are_straight_in_the_crs_of_their_file(tmp_path):
    """The 30 km long southern edge of a box in degrees bends by 10 m in UTM."""
    box = shapely.box(5.2, 43.1, 5.6, 43.4)
    path = write_polygons(tmp_path / "a.geojson", box, crs="EPSG:4326", driver="GeoJSON")
    south = Transformer.from_crs(4326, 32631, always_xy=True).transform(5.4, 43.1)
    grid = GeoBox.from_bbox(
        (south[0] - 50, south[1] - 50, south[0] + 50, south[1] + 50), crs="EPSG:32631", resolution=1
    )
    inside = cells_inside(read_polygons(path, grid_crs(grid)), grid)
    _, lat = Transformer.from_crs(32631, 4326, always_xy=True).transform(*cell_centres(grid))
    assert (inside != (lat > 43.1)).mean() < 0.005


def test_an_area_outside_the_grid_is_empty(tmp_path):
    path = write_polygons(tmp_path / "a.gpkg", shapely.box(0, 0, 1, 1), driver="GPKG")
    assert not cells_inside(read_polygons(path, grid_crs(GRID)), GRID).any()


def test_vector_files_without_an_area_are_refused(tmp_path):
    (tmp_path / "notes.geojson").write_text("not a vector file")
    (tmp_path / "empty.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    points = write_polygons(tmp_path / "p.gpkg", shapely.points([[1.0, 2.0]]), geometry_type="Point", driver="GPKG")
    two = tmp_path / "two.gpkg"
    for layer in ("fields", "roads"):
        write_polygons(two, shapely.box(0, 0, 1, 1), driver="GPKG", layer=layer, append=two.exists())
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        nowhere = write_polygons(tmp_path / "n.shp", shapely.box(0, 0, 1, 1), crs=None, driver="ESRI Shapefile")
    for path, message in (
        (tmp_path / "none.gpkg", "There is no vector file"),
        (tmp_path / "notes.geojson", r"its format is not known\. Give GeoJSON, GeoPackage or Shapefile\.$"),
        (tmp_path / "empty.geojson", r"empty\.geojson holds no polygons\. Give a file with polygons\.$"),
        (points, "holds Point features, not polygons"),
        (two, r"has 2 layers \(fields, roads\)"),
        (nowhere, r"n\.shp has no CRS"),
    ):
        with pytest.raises(InputError, match=message):
            cells_inside(read_polygons(path, grid_crs(GRID)), GRID)


def test_grid_crs_is_kept_as_its_code(tmp_path):
    write_cog(tmp_path / "a.tif", np.zeros(GRID.shape, np.float32), GRID)
    assert CRS.from_user_input(read_geobox(tmp_path / "a.tif").crs) == CRS.from_epsg(32631)


def test_coordinates_in_metres_without_a_crs_are_no_longitudes_and_latitudes(tmp_path):
    """GeoJSON without a CRS is in degrees."""
    path = tmp_path / "utm.geojson"
    path.write_text(shapely.to_geojson(shapely.box(461984.5, 5246991.0, 462014.5, 5247011.0)))
    with pytest.raises(InputError, match=r"utm\.geojson has polygons at .*, which are no longitudes and latitudes"):
        read_polygons(path, grid_crs(GRID))


def test_coordinates_beyond_their_crs_are_refused(tmp_path):
    far = write_polygons(tmp_path / "far.gpkg", shapely.box(1e8, 1e8, 2e8, 2e8), crs="EPSG:32632", driver="GPKG")
    with pytest.raises(InputError, match=r"far\.gpkg has polygons from 1e\+08.*, which WGS 84 / UTM zone 32N does not"):
        read_polygons(far, grid_crs(GRID))
