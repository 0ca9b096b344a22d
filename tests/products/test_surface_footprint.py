"""The outline of a surface's heights, against the cells that have one."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from affine import Affine
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from shapely.geometry import shape

from zlocus.core.errors import InputError
from zlocus.io.rasters import write_cog
from zlocus.products import surface_footprint
from zlocus.products.surface_footprint import CLOSED_SHARE, CORNER_SHARE, footprint_of

CELL_M, WEST, NORTH = 2.0, 500000.0, 4000000.0
# Coordinates are rounded to 1e-7 degrees.
PLACE_DEG, PLACE_M = 1e-7, 0.02
DEGREE_M = 111_300.0


def written(folder, has_height, crs="EPSG:32632", cell_m=CELL_M, west=WEST, north=NORTH):
    grid = GeoBox(has_height.shape, Affine(cell_m, 0, west, 0, -cell_m, north), crs)
    heights = np.where(has_height, 100.0, np.nan).astype(np.float32)
    write_cog(folder / "dsm.tif", heights, grid, nodata=np.nan)
    return folder / "dsm.tif"


def cells_of(has_height, cell_m=CELL_M, west=WEST, north=NORTH):
    """Corners of the cells with a height, (n, 2) m."""
    rows, cols = np.nonzero(has_height)
    return np.concatenate([
        np.column_stack([west + (cols + dx) * cell_m, north - (rows + dy) * cell_m]) for dx in (0, 1) for dy in (0, 1)
    ])  # fmt: skip


def in_degrees(xy, crs="EPSG:32632"):
    return np.column_stack(Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*np.transpose(xy)))


def test_a_full_raster_has_the_outline_of_its_grid(tmp_path):
    found = footprint_of(written(tmp_path, np.ones((30, 40), bool), cell_m=500.0))
    assert shape(found.on_map).equals(shapely.box(500000, 3985000, 520000, 4000000))
    outline, ring = shape(found.geometry), np.array(shape(found.geometry).exterior.coords)
    corners = in_degrees([(500000, 4000000), (520000, 4000000), (520000, 3985000), (500000, 3985000)])
    for corner in corners:
        assert np.abs(ring - corner).max(axis=1).min() <= PLACE_DEG
    assert outline.exterior.is_ccw
    assert found.bbox == list(outline.bounds)
    # The southern side is a curve in degrees, some metres off the straight line between its corners.
    (middle,) = in_degrees([(510000, 3985000)])
    assert np.abs(corners[2:, 1].mean() - middle[1]) > 100 * PLACE_DEG
    assert shapely.Point(middle).distance(outline.exterior) < 10 * PLACE_DEG
    assert outline.is_valid


def some_cells(shape_, seed, n):
    """Cells in some boxes, as a surface in pieces has them."""
    rng, has_height = np.random.default_rng(seed), np.zeros(shape_, bool)
    for _ in range(n):
        row, col = rng.integers(0, shape_[0]), rng.integers(0, shape_[1])
        rows, cols = rng.integers(1, shape_[0] + 1), rng.integers(1, shape_[1] + 1)
        has_height[row : row + rows // 2 + 1, col : col + cols // 2 + 1] ^= True
    return has_height


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 999), st.integers(1, 4), st.sampled_from([(40, 30), (7, 90), (1, 1), (110, 130)]), st.booleans())
def test_every_height_lies_inside_and_little_else(tmp_path, seed, n, shape_, in_blocks):
    has_height = some_cells(shape_, seed, n)
    with pytest.MonkeyPatch.context() as patch:
        if in_blocks:
            patch.setattr(surface_footprint, "MAX_BLOCKS", 60)
        found = footprint_of(written(tmp_path, has_height))
    side, blocks = max(shape_), -(-max(shape_) // 60) if in_blocks else 1
    on_map, on_earth = shape(found.on_map), shape(found.geometry)
    assert on_map.is_valid
    assert on_earth.is_valid
    if not has_height.any():
        has_height[:] = True  # the whole raster
    corners = shapely.points(cells_of(has_height))
    assert shapely.covers(on_map.buffer(1e-6), corners).all()
    degrees = shapely.points(in_degrees(cells_of(has_height)))
    assert shapely.covers(on_earth.buffer(PLACE_M / DEGREE_M), degrees).all()
    # What lies outside by more than gaps and corners is left out.
    reach_m = (2 * side * (CLOSED_SHARE + 2 * CORNER_SHARE) + 2 * blocks) * CELL_M
    cells = shapely.union_all([shapely.box(x, y, x + CELL_M, y + CELL_M) for x, y in lower_left(has_height)])
    assert on_map.within(cells.buffer(reach_m))
    west, south, east, north = found.bbox
    assert shapely.covers(shapely.box(west, south, east, north).buffer(PLACE_DEG), on_earth)
    assert found.map_bbox == list(on_map.bounds)


def lower_left(has_height):
    rows, cols = np.nonzero(has_height)
    return np.column_stack([WEST + cols * CELL_M, NORTH - (rows + 1) * CELL_M])


def test_overviews_lose_no_height(tmp_path):
    """A single cell far from the others is inside, and the outline is that of all cells, within its tolerance."""
    has_height = np.zeros((700, 1300), bool)
    has_height[100:400, 50:600] = True
    has_height[699, 1299] = True
    path = written(tmp_path, has_height)
    found, with_overviews = footprint_of(path), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface_footprint, "_overview_factor", lambda file: with_overviews.append(file.overviews(1)))
        whole = footprint_of(path)
    assert with_overviews[0], "the raster has overviews"
    for each in (found, whole):
        assert shapely.covers(shape(each.on_map), shapely.points(cells_of(has_height)[::97])).all()
        assert len(shape(each.on_map).geoms) == 2
    assert shape(found.on_map).hausdorff_distance(shape(whole.on_map)) < 1300 * CORNER_SHARE * CELL_M + 2 * CELL_M


def test_a_slanted_outline_has_few_corners(tmp_path):
    row, col = np.mgrid[:400, :500]
    has_height = (np.abs(row - 200 + 0.3 * (col - 250)) < 100) & (np.abs(col - 250 - 0.3 * (row - 200)) < 170)
    outline = shape(footprint_of(written(tmp_path, has_height)).on_map)
    assert shapely.covers(outline.buffer(1e-6), shapely.points(cells_of(has_height))).all()
    assert len(outline.exterior.coords) < 20
    assert outline.area < 1.1 * has_height.sum() * CELL_M**2


def test_large_holes_stay_and_narrow_gaps_close(tmp_path):
    has_height = np.ones((400, 400), bool)
    has_height[100:200, 100:200] = False
    has_height[:, 300:303] = False
    outline = shape(footprint_of(written(tmp_path, has_height)).on_map)
    assert outline.geom_type == "Polygon"
    (hole,) = outline.interiors
    assert shapely.Polygon(hole).within(shapely.box(WEST + 200, NORTH - 400, WEST + 400, NORTH - 200))
    assert shapely.Polygon(hole).area > 0.8 * 200**2


def test_an_outline_across_the_date_line_is_cut(tmp_path):
    has_height = np.ones((30, 40), bool)
    has_height[:, 30:] = False
    has_height[:5] = False
    crs = "EPSG:32660"
    found = footprint_of(written(tmp_path, has_height, crs, 1000.0, 820000.0, 200000.0))
    west, south, east, north = found.bbox
    assert 179 < west < 180
    assert -180 < east < -179
    assert south < north
    parts = sorted(shape(found.geometry).geoms, key=lambda part: part.bounds[0])
    assert parts[0].bounds[0] == -180.0
    assert parts[1].bounds[2] == 180.0
    assert all(part.exterior.is_ccw and part.is_valid for part in parts)
    # 30 x 25 km near the equator
    assert sum(part.area for part in parts) == pytest.approx(30 * 25 / (DEGREE_M / 1000) ** 2, rel=0.02)


def test_two_parts_beside_the_date_line_are_boxed_together(tmp_path):
    has_height = np.zeros((30, 60), bool)
    has_height[:, :10] = has_height[:, 50:] = True
    found = footprint_of(written(tmp_path, has_height, "EPSG:32660", 1000.0, 805000.0, 200000.0))
    west, _, east, _ = found.bbox
    lon = in_degrees([(805000.0, 185000.0), (865000.0, 185000.0)], "EPSG:32660")[:, 0]
    assert lon[0] > 0 > lon[1]
    assert (west, east) == pytest.approx(tuple(lon), abs=0.01)
    for part in shape(found.geometry).geoms:
        assert part.bounds[2] - part.bounds[0] < 0.2


@pytest.mark.parametrize(("crs", "pole"), [("EPSG:3031", -90.0), ("EPSG:3413", 90.0)])
def test_an_outline_around_a_pole_reaches_it(tmp_path, crs, pole):
    found = footprint_of(written(tmp_path, np.ones((40, 40), bool), crs, 1000.0, -20000.0, 20000.0))
    outline = shape(found.geometry)
    assert outline.is_valid
    assert found.bbox[0] == -180.0
    assert found.bbox[2] == 180.0
    assert pole in (found.bbox[1], found.bbox[3])
    for lon in range(-170, 180, 20):
        assert outline.buffer(1e-6).covers(shapely.Point(lon, pole - np.sign(pole) * 0.1))


def test_a_compound_crs_lies_where_its_map_lies(tmp_path):
    has_height = some_cells((30, 40), 3, 3)
    one = footprint_of(written(tmp_path, has_height))
    assert footprint_of(written(tmp_path, has_height, CRS("EPSG:32632+5773").to_wkt())) == one


def test_a_missing_raster_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"There is no raster .*dsm\.tif"):
        footprint_of(tmp_path / "dsm.tif")
