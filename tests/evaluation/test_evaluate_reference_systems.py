"""Judging across CRS and heights above different things: converted or refused, never compared as they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

from evaluation_rasters import CRS, NORTH, WEST, grid, moved, rolling, write
from zlocus.core.errors import ConfigError, InputError
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.evaluation.files import write_evaluation
from zlocus.evaluation.frame import frame_of, in_metres, points_on
from zlocus.evaluation.heights import read_heights
from zlocus.evaluation.table import evaluation_table
from zlocus.evaluation.truth import truth_blocks
from zlocus.io.vertical import named_vertical_datum

N = 240
# Two ways through PROJ, and the curvature of a map over ten metres.
PLACE_TOLERANCE_M = 1e-4
# Ground of 15 m radius between the cells of two grids, and scales of two maps that differ by 1 in 2500 over 6 m.
SHIFT_TOLERANCE_M = 0.02
HEIGHT_TOLERANCE_M = 0.01
# The nearest cell is up to 0.35 m away, on slopes of up to 40 degrees.
NEAREST_TOLERANCE_M = 0.3
DEGREE_CELLS = (6.6e-6, 4.5e-6)
EGM96, EGM2008 = "EPSG:32632+5773", "EPSG:32632+3855"
ELLIPSOIDAL = "EPSG:4979"


def in_degrees(path, crs="EPSG:4326", z_of=rolling, cells=DEGREE_CELLS, shape=(260, 300)):
    """The ground on half-metre cells of degrees, over the middle of the ground in the map."""
    middle = Transformer.from_crs(CRS, 4326, always_xy=True).transform(WEST + 60, NORTH - 60)
    at = from_origin(middle[0] - cells[0] * shape[1] / 2, middle[1] + cells[1] * shape[0] / 2, *cells)
    col, row = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    x, y = Transformer.from_crs(4326, CRS, always_xy=True).transform(at.c + at.a * col, at.f + at.e * row)
    return write(path, z_of(x - WEST, NORTH - y).astype(np.float32), at, crs)


def flat(path, height, crs=CRS):
    return write(path, np.full((80, 80), height, np.float32), crs=crs)


def geoid(path, undulation=45.0, reach=0.1):
    """A geoid that lies at one height around the ground, in cells of degrees."""
    lon, lat = Transformer.from_crs(CRS, 4326, always_xy=True).transform(WEST, NORTH)
    at = from_origin(lon - reach, lat + reach, reach / 4, reach / 4)
    return write(path, np.full((8, 8), undulation, np.float32), at, "EPSG:4326")


def test_a_reference_in_degrees_is_judged_by_metres(tmp_path):
    reference, dsm = in_degrees(tmp_path / "r.tif"), moved(tmp_path / "d.tif", N, (0, 0, 0.2))
    result = evaluate(dsm, Comparison(reference))
    # Half-metre blocks over 149 x 130 m, less a rim of 10 m, of which the surface covers 120 x 120 m.
    assert result.statistics.n == pytest.approx(260 * 220, rel=0.02)
    assert result.statistics.completeness == pytest.approx(240 * 220 / (260 * 220), rel=0.02)
    assert result.statistics.median == pytest.approx(0.2, abs=0.02)
    assert result.statistics.nmad < NEAREST_TOLERANCE_M
    # Where the slopes are those of the map.
    x, y = grid(N)
    slopes = np.degrees(np.arctan(np.hypot(*np.gradient(rolling(x, y), 0.5))))
    assert result.slope_statistics["15-30"].n / result.statistics.n == pytest.approx(
        np.mean((slopes >= 15) & (slopes < 30)), abs=0.05
    )


@pytest.mark.parametrize("coregister", [None, "nuth-kaab"], ids=["search", "nuth-kaab"])
def test_a_shift_is_in_metres_whichever_side_is_in_degrees(tmp_path, coregister):
    planted = (1.4, -0.9, 0.6)
    options = {"align": coregister is None, "coregister": coregister}
    reference, dsm = in_degrees(tmp_path / "r.tif"), moved(tmp_path / "d.tif", N, planted)
    shift = evaluate(dsm, Comparison(reference, **options)).shift
    tolerance = SHIFT_TOLERANCE_M if coregister else 0.05
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx(planted, abs=tolerance)
    back = evaluate(reference, Comparison(dsm, **options)).shift
    assert (back.east_m, back.north_m, back.up_m) == pytest.approx([-part for part in planted], abs=tolerance)


def test_a_shift_between_two_surfaces_in_degrees(tmp_path):
    reference = in_degrees(tmp_path / "r.tif")
    dsm = in_degrees(tmp_path / "d.tif", z_of=lambda x, y: rolling(x - 1.4, y - 0.9) + 0.6)
    shift = evaluate(dsm, Comparison(reference, coregister="nuth-kaab")).shift
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx((1.4, -0.9, 0.6), abs=SHIFT_TOLERANCE_M)


def test_a_shift_between_two_zones_is_that_of_the_surfaces_map(tmp_path):
    # At the edge of a zone its north is off by two degrees: 6 m north are 0.2 m east in the zone beside.
    reference = moved(tmp_path / "r.tif", N, (0, 0, 0))
    west, north = Transformer.from_crs(CRS, 32633, always_xy=True).transform(WEST, NORTH)
    at = from_origin(west - 20, north + 40, 0.5, 0.5)
    col, row = np.meshgrid(np.arange(420) + 0.5, np.arange(420) + 0.5)
    there = at.c + 0.5 * col, at.f - 0.5 * row
    x, y = Transformer.from_crs(32633, CRS, always_xy=True).transform(there[0] - 0.5, there[1] - 6.0)
    dsm = write(tmp_path / "d.tif", rolling(x - WEST, NORTH - y).astype(np.float32), at, "EPSG:32633")
    shift = evaluate(dsm, Comparison(reference, coregister="nuth-kaab")).shift
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx((0.5, 6.0, 0), abs=SHIFT_TOLERANCE_M)


def test_web_mercator_is_no_frame(tmp_path):
    reference = moved(tmp_path / "r.tif", N, (0, 0, 0))
    west, north = Transformer.from_crs(CRS, 3857, always_xy=True).transform(WEST, NORTH)
    dsm = write(
        tmp_path / "d.tif", rolling(*grid(N)).astype(np.float32), from_origin(west, north, 0.7, 0.7), "EPSG:3857"
    )
    surface, heights = read_heights(dsm), read_heights(reference)
    assert frame_of(surface, heights) == heights.horizontal
    frame = frame_of(surface, surface)
    assert frame.to_epsg() == 32632
    # Metres of the map are 0.68 of metres on the ground here.
    slope = truth_blocks(surface, 10, None, frame).slope_deg
    cell_m = 0.7 * np.cos(np.radians(46.9))
    truly = np.degrees(np.arctan(np.hypot(*np.gradient(rolling(*grid(N)), cell_m))))
    rim = round(10 / cell_m)
    assert np.median(slope) == pytest.approx(np.median(truly[rim:-rim, rim:-rim]), abs=0.05)
    # And so are those of the rim.
    assert len(slope) == pytest.approx((N - 2 * rim) ** 2, rel=0.02)


def test_points_move_by_metres(tmp_path):
    surface, heights = (
        read_heights(in_degrees(tmp_path / "d.tif")),
        read_heights(moved(tmp_path / "r.tif", N, (0, 0, 0))),
    )
    frame = frame_of(surface, heights)
    # The last is far from the middle of the zone, where north of the map is two degrees off.
    xy = np.array([[WEST + 20, NORTH - 30], [WEST + 100, NORTH - 90], [WEST + 250_000, NORTH]])
    points = points_on(surface, heights, frame, xy)
    to_map = Transformer.from_crs(4326, frame, always_xy=True)
    np.testing.assert_allclose(
        np.column_stack(to_map.transform(*points.moved((3.0, -4.0)).T)), np.add(xy, (3, -4)), atol=PLACE_TOLERANCE_M
    )
    assert not in_metres(surface.horizontal)


def test_degrees_beside_a_file_without_crs_are_refused(tmp_path):
    degrees, bare = in_degrees(tmp_path / "g.tif"), write(tmp_path / "b.tif", rolling(*grid(80)), crs=None)
    for pair in ((degrees, bare), (bare, degrees)):
        with pytest.raises(InputError, match=r"g\.tif is in degrees and .*b\.tif has no CRS"):
            evaluate(pair[0], Comparison(pair[1]))
    assert evaluate(bare, Comparison(bare, margin_m=2)).statistics.rmse == 0


def test_coordinates_compared_as_they_are_are_said(tmp_path):
    bare, placed = (write(tmp_path / f"{n}.tif", rolling(*grid(80)), crs=crs) for n, crs in (("b", None), ("p", CRS)))
    for pair, says in (((placed, bare), f"{bare} has"), ((bare, placed), f"{bare} has"), ((bare, bare), "have")):
        result = evaluate(pair[0], Comparison(pair[1], margin_m=2))
        line = f"{says} no CRS: coordinates were compared as they are"
        assert line in evaluation_table(result)
        assert line in result.as_dict()["places_assumed"]
    assert evaluate(placed, Comparison(placed, margin_m=2)).as_dict()["places_assumed"] is None


def test_a_local_map_beside_one_of_the_earth_is_refused(tmp_path):
    local = 'LOCAL_CS["site",UNIT["metre",1]]'
    site, earth = (write(tmp_path / f"{n}.tif", rolling(*grid(80)), crs=crs) for n, crs in (("s", local), ("e", CRS)))
    with pytest.raises(InputError, match=r"s\.tif has the CRS .* which cannot be converted"):
        evaluate(site, Comparison(earth))
    result = evaluate(site, Comparison(site, margin_m=2, align=True))
    assert result.shift.east_m == 0
    write_evaluation(tmp_path / "out", result)
    with rasterio.open(tmp_path / "out" / "error.tif") as source:
        assert source.crs == read_heights(site).crs


def test_places_outside_of_their_map_are_refused_unless_both_are_there(tmp_path):
    away = write(tmp_path / "away.tif", rolling(*grid(80)), from_origin(1e9, NORTH, 0.5, 0.5))
    other = write(tmp_path / "other.tif", rolling(*grid(80)), crs="EPSG:32633")
    with pytest.raises(InputError, match=r"away\.tif lies outside of its CRS WGS 84 / UTM zone 32N"):
        evaluate(other, Comparison(away))
    assert evaluate(away, Comparison(away, margin_m=2)).statistics.rmse == 0


def test_heights_above_different_things_are_refused(tmp_path):
    pairs = (
        (EGM96, EGM2008, "EGM96 height.*EGM2008 height"),
        (ELLIPSOIDAL, EGM96, "the ellipsoid.*EGM96 height"),
    )
    for mine, theirs, says in pairs:
        dsm = in_degrees(tmp_path / "d.tif", mine) if mine == ELLIPSOIDAL else flat(tmp_path / "d.tif", 1, mine)
        with pytest.raises(InputError, match=rf"d\.tif are above {says}\. Add the geoid's heights with --geoid"):
            evaluate(dsm, Comparison(flat(tmp_path / "r.tif", 1, theirs)))
    same = [flat(tmp_path / f"{name}.tif", 1, EGM96) for name in "dr"]
    assert evaluate(same[0], Comparison(same[1], margin_m=2)).statistics.rmse == 0


def test_a_missing_vertical_datum_is_taken_from_the_other_raster_and_noted(tmp_path):
    said, unsaid = flat(tmp_path / "said.tif", 1, EGM96), flat(tmp_path / "unsaid.tif", 1)
    for pair, heights in (((said, unsaid), ("EGM96 height", None)), ((unsaid, said), (None, "EGM96 height"))):
        result = evaluate(pair[0], Comparison(pair[1], margin_m=2))
        assert result.statistics.rmse == 0
        line = f"{unsaid} does not state its vertical datum: taken to be EGM96 height, as of the other raster"
        assert line in evaluation_table(result).splitlines()
        assert (result.as_dict()["dsm_heights"], result.as_dict()["reference_heights"]) == heights
    for pair in ((said, said), (unsaid, unsaid)):
        assert "does not state" not in evaluation_table(evaluate(pair[0], Comparison(pair[1], margin_m=2)))


def test_a_geoid_is_added_to_what_is_above_it(tmp_path):
    up = geoid(tmp_path / "geoid.tif", 45.0)
    above, ellipsoidal = flat(tmp_path / "above.tif", 100, EGM96), flat(tmp_path / "ellipsoidal.tif", 145.3)
    result = evaluate(ellipsoidal, Comparison(above, geoid=up, margin_m=2))
    assert result.statistics.median == pytest.approx(0.3, abs=HEIGHT_TOLERANCE_M)
    assert result.geoid_added_to == above
    assert result.assumed_datum is None
    assert f"the geoid's heights were added to those of {above}" in evaluation_table(result)
    assert result.as_dict()["geoid_added_to"] == str(above)
    # The same where the surface is the one above the geoid, and where no file says anything: then the reference is.
    result = evaluate(above, Comparison(ellipsoidal, geoid=up, margin_m=2))
    assert result.statistics.median == pytest.approx(-0.3, abs=HEIGHT_TOLERANCE_M)
    assert result.geoid_added_to == above
    plain = flat(tmp_path / "plain.tif", 100)
    assert evaluate(ellipsoidal, Comparison(plain, geoid=up, margin_m=2)).statistics.median == pytest.approx(
        0.3, abs=HEIGHT_TOLERANCE_M
    )


def test_a_geoid_may_be_named_in_capitals(tmp_path, monkeypatch):
    monkeypatch.setattr("zlocus.io.vertical.proj_folders", lambda: [tmp_path])
    geoid(tmp_path / "us_nga_egm96_15.tif", 45.0)
    above, ellipsoidal = flat(tmp_path / "above.tif", 100, EGM96), flat(tmp_path / "ellipsoidal.tif", 145.3)
    result = evaluate(ellipsoidal, Comparison(above, geoid=Path("EGM96"), margin_m=2))
    assert result.statistics.median == pytest.approx(0.3, abs=HEIGHT_TOLERANCE_M)


def test_a_geoid_that_does_not_help_is_refused(tmp_path):
    up = geoid(tmp_path / "geoid.tif")
    one, other, third = (flat(tmp_path / f"{n}.tif", 1, crs) for n, crs in (("a", EGM96), ("b", EGM96), ("c", EGM2008)))
    with pytest.raises(ConfigError, match=r"geoid\.tif is not needed: .* both above EGM96 height"):
        evaluate(one, Comparison(other, geoid=up))
    with pytest.raises(ConfigError, match="--geoid Ellipsoid is no geoid"):
        evaluate(flat(tmp_path / "p.tif", 1), Comparison(one, geoid=Path("Ellipsoid")))
    with pytest.raises(InputError, match="one geoid is not enough"):
        evaluate(one, Comparison(third, geoid=up))
    plain = flat(tmp_path / "p.tif", 1)
    small = geoid(tmp_path / "small.tif", reach=0.0004)
    with pytest.raises(InputError, match=r"The geoid .*small\.tif does not cover"):
        evaluate(plain, Comparison(plain, geoid=small, margin_m=2))
    bare = flat(tmp_path / "bare.tif", 1, None)
    with pytest.raises(InputError, match=r"bare\.tif has no CRS, so no geoid"):
        evaluate(plain, Comparison(bare, geoid=up, margin_m=2))


def test_a_geoid_is_read_as_geoids_are_everywhere(tmp_path):
    """Whole numbers with a scale, longitudes from 0 to 360, and nothing that is no geoid."""
    surface, above = flat(tmp_path / "surface.tif", 145.3), flat(tmp_path / "above.tif", 100, EGM96)
    lon, lat = Transformer.from_crs(CRS, 4326, always_xy=True).transform(WEST, NORTH)
    at = from_origin(lon + 360 - 0.1, lat + 0.1, 0.025, 0.025)
    scaled = write(tmp_path / "scaled.tif", np.full((8, 8), 4500, np.int16), at, "EPSG:4326")
    with rasterio.open(scaled, "r+") as file:
        file.scales = (0.01,)
    result = evaluate(surface, Comparison(above, geoid=scaled, margin_m=2))
    assert result.statistics.median == pytest.approx(0.3, abs=HEIGHT_TOLERANCE_M)
    with pytest.raises(InputError, match=r"surface\.tif is no geoid: it holds 145\.3 m"):
        evaluate(surface, Comparison(above, geoid=surface, margin_m=2))


def test_a_surface_of_ours_says_that_it_is_ellipsoidal(tmp_path):
    ours = flat(tmp_path / "ours.tif", 100)
    with rasterio.open(ours, "r+") as file:
        file.set_band_description(1, "height above the ellipsoid")
    with pytest.raises(InputError, match=r"ours\.tif are above the ellipsoid and .* above EGM2008 height"):
        evaluate(ours, Comparison(flat(tmp_path / "r.tif", 100, EGM2008)))
    result = evaluate(ours, Comparison(flat(tmp_path / "plain.tif", 100), margin_m=2))
    assert result.as_dict()["dsm_heights"] == "ellipsoid"
    assert "plain.tif does not state its vertical datum: taken to be the ellipsoid" in result.as_dict()["assumed"]


def test_a_geoid_of_a_file_is_no_ellipsoid_whatever_its_name(tmp_path):
    name = geoid(tmp_path / "N_above_ellipsoid.tif")
    crs = named_vertical_datum(str(name)).compound_crs(pyproj.CRS(CRS)).to_wkt()
    with pytest.raises(InputError, match="are above the geoid of N_above_ellipsoid"):
        evaluate(flat(tmp_path / "d.tif", 100, crs), Comparison(in_degrees(tmp_path / "r.tif", ELLIPSOIDAL)))


def test_depths_are_refused(tmp_path):
    depths = flat(tmp_path / "depths.tif", 1, "EPSG:32632+5715")
    with pytest.raises(InputError, match=r"depths\.tif go down"):
        evaluate(depths, Comparison(depths))


def test_heights_may_be_whole_numbers_with_a_scale_and_an_offset(tmp_path):
    scaled = write(tmp_path / "scaled.tif", np.full((80, 80), 254, np.int16))
    with rasterio.open(scaled, "r+") as file:
        file.scales, file.offsets = (0.1,), (10.0,)
    assert evaluate(scaled, Comparison(flat(tmp_path / "r.tif", 35), margin_m=2)).statistics.median == pytest.approx(
        0.4, abs=1e-5
    )


def test_heights_in_feet_are_refused(tmp_path):
    feet = flat(tmp_path / "feet.tif", 1, "EPSG:32632+6360")
    with pytest.raises(InputError, match=r"feet\.tif are in US survey foot\. Convert them to metres"):
        evaluate(feet, Comparison(feet))


@pytest.mark.parametrize("unit", ["ft", "feet", "us-ft", "US survey foot", "international foot", "Foot", "cm"])
def test_heights_whose_unit_is_no_metre_are_refused(tmp_path, unit):
    feet, metres = flat(tmp_path / "feet.tif", 1), flat(tmp_path / "metres.tif", 1)
    with rasterio.open(feet, "r+") as file:
        file.units = (unit,)
    for pair in ((feet, metres), (metres, feet)):
        with pytest.raises(InputError, match=rf"feet\.tif are in {unit}\. Convert them to metres"):
            evaluate(pair[0], Comparison(pair[1]))


@pytest.mark.parametrize("unit", ["", "m", "metre", "Meters", "1", "elevation", "m asl"])
def test_other_units_are_metres(tmp_path, unit):
    path = flat(tmp_path / "metres.tif", 1)
    with rasterio.open(path, "r+") as file:
        file.units = (unit,)
    assert evaluate(path, Comparison(path, margin_m=2)).statistics.rmse == 0


def test_real_heights_above_a_geoid_in_degrees(tmp_path, shared_data):
    # SRTM lies in degrees above EGM96; made ellipsoidal in a map by another way, it must agree with itself.
    folder = shared_data / "pleiades_pair_ventoux" / "reference"
    srtm, up = folder / "srtm3_v2_egm96_heights.tif", folder / "geoid_egm96_15min.tif"
    with rasterio.open(srtm) as source, rasterio.open(up) as undulations:
        at, shape = from_origin(674200, 4900500, 45, 45), (180, 140)
        z = np.full(shape, np.nan, np.float32)
        profile = {"dst_transform": at, "dst_crs": "EPSG:32631", "resampling": rasterio.warp.Resampling.cubic}
        rasterio.warp.reproject(rasterio.band(source, 1), z, dst_nodata=np.nan, **profile)
        n = np.zeros(shape, np.float32)
        rasterio.warp.reproject(rasterio.band(undulations, 1), n, **profile | {"resampling": 1})
    assert np.isfinite(z).mean() > 0.8
    dsm = write(tmp_path / "d.tif", z + n, at, "EPSG:32631")
    result = evaluate(dsm, Comparison(srtm, geoid=up, coregister="nuth-kaab", threshold_m=10))
    assert np.hypot(result.shift.east_m, result.shift.north_m) < 1.0  # of cells of 93 m
    assert abs(result.shift.up_m) < 0.2
    assert result.statistics.nmad < 1.0
    assert evaluate(dsm, Comparison(srtm)).statistics.median == pytest.approx(np.median(n), abs=0.5)
