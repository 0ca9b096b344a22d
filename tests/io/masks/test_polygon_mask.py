from __future__ import annotations

import pickle
import time

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from mask_files import box, geojson, mask_of, whole
from zlocus.core.errors import InputError
from zlocus.io.masks.polygon_mask import MIN_POINTS_TO_CUT, SQUARE_PX, SQUARES, PolygonMask, RasterisedSquares

SHAPE = (60, 90)
LIMIT_S = 5.0


def inside(shape, polygons):
    """Twin: pixels (r, c) whose centre lies inside a polygon, one by one."""
    found = np.zeros(shape, bool)
    for polygon in polygons:
        r, c = np.indices(shape)
        found |= shapely.contains_xy(polygon, c, r)
    return found


def part_of(shape, *polygons, is_outside=False, path="m.gpkg"):
    return PolygonMask.of(path, shape, np.array(polygons, object), is_outside)


def star(n, centre, radius, seed=0):
    """A jagged polygon, none of whose points lies at the centre of a pixel or on a line of them."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2 * np.pi, n, endpoint=False)
    r = radius * rng.uniform(0.6, 1.0, n)
    return shapely.Polygon(np.column_stack([centre[0] + r * np.cos(angle), centre[1] + r * np.sin(angle)]))


@given(st.data())
def test_a_pixel_is_masked_where_its_centre_lies_inside(data):
    coordinate = st.integers(-2000, 12000).map(lambda n: n / 100 + 0.0037)
    corners = data.draw(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=8, unique=True))
    hull = shapely.convex_hull(shapely.MultiPoint(corners))
    polygons = [hull] if hull.geom_type == "Polygon" else []
    row, col = (data.draw(st.integers(0, n - 1)) for n in SHAPE)
    rows, cols = data.draw(st.integers(1, SHAPE[0] - row)), data.draw(st.integers(1, SHAPE[1] - col))
    found = part_of(SHAPE, *polygons).covers(row, col, rows, cols)
    np.testing.assert_array_equal(found, inside(SHAPE, polygons)[row : row + rows, col : col + cols])


def test_holes_overlaps_parts_and_the_other_way_round():
    ring = shapely.Polygon(box(10.2, 5.2, 40.7, 30.7), [box(20.2, 10.2, 30.7, 20.7)])
    other, far = shapely.Polygon(box(25.3, 15.3, 50.6, 50.6)), shapely.Polygon(box(500.5, 500.5, 510.5, 510.5))
    parts = shapely.MultiPolygon([far, shapely.Polygon(box(60.1, 40.1, 70.9, 50.9))])
    expected = inside(SHAPE, [ring, other, parts])
    np.testing.assert_array_equal(part_of(SHAPE, ring, other, parts).covers(0, 0, *SHAPE), expected)
    np.testing.assert_array_equal(part_of(SHAPE, ring, other, parts, is_outside=True).covers(0, 0, *SHAPE), ~expected)


def test_windows_over_several_squares_are_parts_of_one_mask():
    """Over the corner that four squares share, and the sides of the polygon beyond it."""
    shape, top, left = (2 * SQUARE_PX, 2 * SQUARE_PX), SQUARE_PX - 40, SQUARE_PX - 30
    cloud = star(2 * MIN_POINTS_TO_CUT, (1.1 * SQUARE_PX, 0.9 * SQUARE_PX), 0.8 * SQUARE_PX)
    mask, r, c = part_of(shape, cloud), *np.indices(shape)[:, ::7, ::7]
    shapely.prepare(cloud)
    expected = shapely.contains_xy(cloud, c, r)
    np.testing.assert_array_equal(mask.covers(0, 0, *shape)[::7, ::7], expected)
    expected = shapely.contains_xy(cloud, *np.meshgrid(left + np.arange(90), top + np.arange(80)))
    np.testing.assert_array_equal(mask.covers(top, left, 80, 90), expected)
    sent = pickle.loads(pickle.dumps(mask))
    np.testing.assert_array_equal(sent.covers(top, left, 9, 9), expected[:9, :9])


def test_very_many_points_take_a_bounded_time_and_too_many_are_refused():
    cloud = star(300_000, (2000.3, 2000.3), 1900.0)
    begin = time.perf_counter()
    mask = part_of((4000, 4000), cloud)
    found = mask.covers(1500, 100, 300, 300)
    assert time.perf_counter() - begin < LIMIT_S
    r, c = np.indices((300, 300))
    prepared = shapely.clip_by_rect(cloud, 90, 1490, 410, 1810)
    np.testing.assert_array_equal(found, shapely.contains_xy(prepared, c + 100, r + 1500))
    with pytest.raises(InputError, match="has 4200014 points, more than the 4000000 that are read"):
        part_of((9, 9), *[cloud] * 14)


def test_coordinates_that_are_not_finite_are_refused():
    with np.errstate(invalid="ignore"):
        polygon = shapely.Polygon([(1, 1), (np.nan, 5), (7, 9)])
    with pytest.raises(InputError, match=r"m\.gpkg has polygons with coordinates that are not finite"):
        part_of(SHAPE, polygon)


def test_no_polygon_masks_nothing():
    assert not part_of(SHAPE).covers(0, 0, *SHAPE).any()
    assert part_of(SHAPE, is_outside=True).covers(0, 0, *SHAPE).all()


def test_squares_are_kept_as_far_as_their_memory_allows():
    squares, mask = RasterisedSquares(2 * SQUARE_PX * SQUARE_PX // 8), part_of(SHAPE, star(9, (30, 30), 20))
    first = squares.square(mask, 0, 0)
    np.testing.assert_array_equal(first, squares.square(mask, 0, 0))
    for left in (SQUARE_PX, 2 * SQUARE_PX):
        assert squares.square(mask, 0, left) is None
    assert len(squares._squares) == 2
    assert SQUARES.n_bytes >= 16 << 20


@pytest.mark.parametrize(
    ("options", "offset", "sign"),
    [
        ({"coordinates": "pixels"}, 0.0, 1),
        ({"coordinates": "pixel_corners"}, 0.5, 1),
        ({"coordinates": "pixels"}, 0.0, -1),
        ({"coordinates": "pixel_corners"}, 0.5, -1),
    ],
)
def test_polygons_count_from_the_centre_or_the_corner_and_rows_down_or_up(tmp_path, options, offset, sign):
    """Pixels of columns 10 to 19 and rows 5 to 24."""
    left, top, right, bottom = (edge + offset for edge in (9.5, 4.5, 19.5, 24.5))
    path = geojson(tmp_path / "m.geojson", [box(left, sign * top, right, sign * bottom)])
    expected = np.zeros(SHAPE, bool)
    expected[5:25, 10:20] = True
    np.testing.assert_array_equal(whole(mask_of(SHAPE, {"file": str(path)} | options)), expected)
