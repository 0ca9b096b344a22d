"""Whole runs above a geoid: what is written, what is searched, and what terrain models and control points say."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import laspy
import numpy as np
import pyogrio.raw
import pytest
import rasterio
from pyproj import CRS, Transformer
from rasterio.transform import from_origin
from shapely import from_wkb, get_coordinates
from typer.testing import CliRunner

from bundle_scenes import views_of
from geoids import write_geoid
from rendered_scenes import CENTRE, HEIGHTS, PART, SMALL_TILES, UTM, read, run
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, GeometryError, InputError
from zlocus.core.footprints import shared_ground
from zlocus.core.options import RunConfig
from zlocus.core.orient_request import OrientRequest
from zlocus.core.progress import SilentProgress, progress_for
from zlocus.core.requests import CloudRequest, DsmRequest
from zlocus.evaluation.comparison import Comparison
from zlocus.evaluation.evaluate import evaluate
from zlocus.io.control_points import read_control
from zlocus.io.grid_inputs import dem_datum
from zlocus.io.scene_file import open_scene
from zlocus.io.vertical import named_vertical_datum
from zlocus.matching.pair_labels import LabelledTies
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.height_range import with_heights
from zlocus.pipeline.messages import note_dem
from zlocus.pipeline.orient import control_datum, control_points, run_orient, terrain_heights
from zlocus.products.tie_layers import write_ranking
from zlocus.synthetic.terrain import analytic_height

# Steeper than any geoid, so that a cell's neighbour would be seen: 4 mm over a cell, 1 m over the posts.
AT_CENTRE_M, EAST_SLOPE, NORTH_SLOPE = 48.0, 8e-3, -4e-3
POST_M = 100.0
# Three images are ranked too.
RANKED = replace(SMALL_TILES, selection=replace(SMALL_TILES.selection, min_images=1))
EXACT_M = 1e-9
# float32 heights, of which an undulation is taken.
FLOAT_M = 2e-5
ACCEPTED_M = 0.01


class Notes(SilentProgress):
    """Keeps what is said."""

    def __init__(self):
        self.said = []

    def note(self, sentence):
        self.said.append(sentence)


def undulation(x, y):
    return AT_CENTRE_M + EAST_SLOPE * (x - CENTRE[0]) + NORTH_SLOPE * (y - CENTRE[1])


@pytest.fixture(scope="session")
def geoid(tmp_path_factory):
    """A plane on a map, which bilinear interpolation gives back exactly."""
    west, north = CENTRE[0] - 1000.0, CENTRE[1] + 1000.0
    at = POST_M * (np.arange(20) + 0.5)
    posts = undulation(west + at, (north - at)[:, None])
    path = tmp_path_factory.mktemp("geoid") / "slope.tif"
    return write_geoid(path, posts, from_origin(west, north, POST_M, POST_M), UTM.to_wkt())


def centres(source):
    col, row = np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
    return source.transform * (col, row)


@pytest.fixture(scope="session")
def both(images, geoid, tmp_path_factory):
    """The same surface, ellipsoidal and above the geoid, in other tiles."""
    folder = tmp_path_factory.mktemp("both")
    asked = {"heights": None, "bounds": PART}
    plain = run(images("sine"), folder / "plain", SMALL_TILES, **asked).out
    return plain, run(images("sine"), folder / "geoid", SMALL_TILES, vertical=str(geoid), **asked).out


def test_a_surface_is_the_ellipsoidal_one_less_the_geoid(both):
    (height, source), (above, its) = (read(out / "dsm.tif") for out in both)
    assert np.isfinite(height).sum() > 1000
    np.testing.assert_allclose(above, height - undulation(*centres(source)), rtol=0, atol=FLOAT_M)
    assert its.transform == source.transform
    assert its.crs != source.crs
    for name in ("sigma.tif", "quality.tif", "views.tif", "ortho.tif"):
        assert (both[0] / name).read_bytes() == (both[1] / name).read_bytes(), name


def test_run_json_says_what_heights_are_above(both, geoid):
    plain, above = (json.loads((out / "run.json").read_text()) for out in both)
    assert plain["vertical"] == {"heights_above": "the ellipsoid"}
    name = "height above the geoid of slope.tif"
    assert above["vertical"] == {"heights_above": "the geoid of slope.tif", "crs": name, "geoid": str(geoid)}
    assert str(geoid) in [entry["path"] for entry in above["inputs"]]
    assert above["heights"] == plain["heights"]


@pytest.mark.parametrize("name", ["ties", "ranking"])
def test_points_are_above_the_same(images, geoid, tmp_path, name):
    asked = {"heights": None, "bounds": PART}
    above = {"plain": "ellipsoid", "above": str(geoid)}
    folders = [
        run(images("sine"), tmp_path / f, RANKED, vertical=v, selection="guided", **asked).out for f, v in above.items()
    ]
    (plain, plain_crs), (above, crs) = (points_in(out / f"{name}.gpkg") for out in folders)
    assert len(plain) > 20
    np.testing.assert_array_equal(above[:, :2], plain[:, :2])
    expected = plain[:, 2:] - undulation(*plain[:, :2].T)[:, None]
    np.testing.assert_allclose(above[:, 2:], expected, rtol=0, atol=EXACT_M)
    assert not plain_crs.is_compound
    assert crs.is_compound
    assert crs.sub_crs_list[1].name == f"height above the geoid of {geoid.name}"


def test_points_where_a_geoid_has_no_value_are_left_out(tmp_path, geoid):
    east, north = CENTRE
    xyz = np.array([[east, north, 60.0], [east + 900.0, north, 60.0], [east + 5000.0, north, 60.0]])
    ranked = LabelledTies(xyz, np.ones((3, 2, 2), np.int8), np.arange(2))
    write_ranking(tmp_path / "ranking.gpkg", [ranked], ["a", "b"], UTM, named_vertical_datum(str(geoid)))
    found, _ = points_in(tmp_path / "ranking.gpkg")
    assert len(found) == 4  # two references each
    np.testing.assert_allclose(found[::2, 2], 60.0 - undulation(*xyz[:2, :2].T), rtol=0, atol=EXACT_M)


def points_in(path):
    """Points of a GeoPackage (n, 4): x, y, z and the column of heights, and its CRS."""
    meta, _, wkb, columns = pyogrio.raw.read(path)
    heights = columns[list(meta["fields"]).index("height_m")]
    return np.column_stack([get_coordinates(from_wkb(wkb), include_z=True), heights]), CRS.from_user_input(meta["crs"])


def test_a_surface_above_a_geoid_is_judged_and_gives_its_grid(both, images, tmp_path):
    found = evaluate(both[1] / "dsm.tif", Comparison(both[1] / "dsm.tif", margin_m=0.0)).statistics
    assert found.median == 0.0
    assert found.completeness > 0.95
    again = run(images("sine"), tmp_path / "again", SMALL_TILES, like=both[1] / "dsm.tif", heights=HEIGHTS).out
    with rasterio.open(again / "dsm.tif") as mine, rasterio.open(both[0] / "dsm.tif") as plain:
        assert (mine.crs, mine.transform, mine.shape) == (plain.crs, plain.transform, plain.shape)


def test_heights_asked_for_are_above_the_same(images, geoid, tmp_path):
    asked = (HEIGHTS[0] - AT_CENTRE_M, HEIGHTS[1] - AT_CENTRE_M)
    out = run(images("sine"), tmp_path / "out", SMALL_TILES, heights=asked, bounds=PART, vertical=str(geoid)).out
    record = json.loads((out / "run.json").read_text())
    assert record["config"]["request"]["heights"] == list(asked)
    # The geoid is 0.28 m lower and higher at the corners of the part.
    corners = [undulation(x, y) - AT_CENTRE_M for x in PART[::2] for y in PART[1::2]]
    expected = HEIGHTS[0] + min(corners), HEIGHTS[1] + max(corners)
    assert record["heights"]["range_m"] == pytest.approx(expected, abs=0.01)
    height, source = read(out / "dsm.tif")
    x, y = centres(source)
    truth = analytic_height("sine", x - CENTRE[0], y - CENTRE[1])
    assert np.nanmedian(height + undulation(x, y) - truth) == pytest.approx(0.0, abs=0.03)


def test_heights_asked_for_hold_wherever_two_views_see_the_ground(images, geoid):
    scene, datum = open_scene(images("sine").inputs, UTM), named_vertical_datum(str(geoid))
    asked = (HEIGHTS[0] - AT_CENTRE_M, HEIGHTS[1] - AT_CENTRE_M)
    west, south, east, north = shared_ground(scene, asked)
    spans = {
        None: (undulation(west, north), undulation(east, south)),
        PART: (undulation(PART[0], PART[3]), undulation(PART[2], PART[1])),
        # Of bounds that reach beyond, what two views see.
        (west - 500.0, south + 5.0, east + 500.0, north + 400.0): (
            undulation(west, north), undulation(east, south + 5.0)
        ),
    }  # fmt: skip
    for bounds, (low, high) in spans.items():
        found = with_heights(scene, asked, datum, bounds).heights
        assert found == pytest.approx((asked[0] + low, asked[1] + high), abs=1e-6)
        if bounds == PART:
            assert with_heights(replace(scene, bounds=PART), asked, datum).heights == found
    assert with_heights(scene, None, datum) is scene
    assert with_heights(scene, asked, named_vertical_datum("ellipsoid")).heights == asked


def write_dem(path, geoid_too, crs):
    """The true sine, ellipsoidal or above the geoid."""
    west, north = CENTRE[0] - 100.0, CENTRE[1] + 100.0
    at = 2.0 * (np.arange(100) + 0.5)
    x, y = np.meshgrid(west + at, north - at)
    z = analytic_height("sine", x - CENTRE[0], y - CENTRE[1]) - (undulation(x, y) if geoid_too else 0.0)
    with rasterio.open(
        path, "w", driver="GTiff", width=100, height=100, count=1, dtype="float32", crs=crs,
        transform=from_origin(west, north, 2.0, 2.0),
    ) as file:  # fmt: skip
        file.write(z.astype(np.float32), 1)
    return path


def test_a_terrain_model_above_a_geoid(images, geoid, tmp_path):
    plain = write_dem(tmp_path / "plain.tif", False, UTM.to_wkt())
    above = write_dem(tmp_path / "above.tif", True, UTM.to_wkt())
    scene = open_scene(images("sine").inputs)
    z = [
        terrain_heights(dem, replace(scene, heights=HEIGHTS), name).z
        for dem, name in ((plain, None), (above, str(geoid)), (above, None))
    ]
    # Bilinear heights of cells of 8 m, of which the plane is exact.
    np.testing.assert_allclose(z[1], z[0], rtol=0, atol=1e-3)
    assert np.nanmedian(z[2] - z[0]) == pytest.approx(-AT_CENTRE_M, abs=0.5)
    out = run(
        images("sine"), tmp_path / "out", SMALL_TILES, heights=None, dem=above, dem_vertical=str(geoid), bounds=PART
    ).out
    height, source = read(out / "dsm.tif")
    x, y = centres(source)
    assert np.nanmax(np.abs(height - analytic_height("sine", x - CENTRE[0], y - CENTRE[1]))) < 0.5
    assert str(geoid) in [entry["path"] for entry in json.loads((out / "run.json").read_text())["inputs"]]


def test_what_a_terrain_model_is_taken_to_be_above_is_said(tmp_path):
    plain, ours, above, deep = (tmp_path / f"{name}.tif" for name in ("plain", "ours", "above", "deep"))
    for path, crs in ((plain, UTM.to_wkt()), (ours, UTM.to_wkt()), (above, "EPSG:32632+5773"), (deep, "EPSG:4979")):
        write_dem(path, False, crs)
    with rasterio.open(ours, "r+") as file:
        file.set_band_description(1, "height above the ellipsoid")
    notes = Notes()
    for dem, given in ((None, None), (plain, "ellipsoid"), (ours, None), (above, None), (deep, None)):
        note_dem(dem, given, notes)
    assert notes.said == []
    note_dem(plain, None, notes)
    (sentence,) = notes.said
    assert sentence.startswith(f"{plain} does not name its vertical datum: its heights are taken to be ellipsoidal.")
    assert "--dem-vertical egm96|egm2008|FILE" in sentence


def test_runs_say_what_a_terrain_model_is_taken_to_be_above(images, tmp_path):
    dem = write_dem(tmp_path / "dem.tif", False, UTM.to_wkt())
    inputs = images("sine").inputs
    dsm, orient = Notes(), Notes()
    request = DsmRequest(inputs, tmp_path / "dsm", crs="EPSG:32632", dem=dem, bounds=PART, report=False)
    run_dsm(request, SMALL_TILES, dsm)
    run_orient(OrientRequest(inputs, tmp_path / "oriented", crs="EPSG:32632", dem=dem), RunConfig(), orient)
    for notes in (dsm, orient):
        assert sum("does not name its vertical datum" in sentence for sentence in notes.said) == 1


def test_geoids_may_be_written_in_capitals(tmp_path, monkeypatch):
    west, north = 0.0, 90.0
    monkeypatch.setattr("zlocus.io.vertical.proj_folders", lambda: [tmp_path])
    write_geoid(tmp_path / "us_nga_egm96_15.tif", np.full((13, 25), 30.0), from_origin(west, north, 15, 15))
    asked = {"vertical": "EGM96", "dem": tmp_path / "dem.tif", "dem_vertical": "EGM2008"}
    assert DsmRequest((tmp_path / "a.tif", tmp_path / "b.tif"), tmp_path / "out", **asked).vertical == "EGM96"
    with pytest.raises(ConfigError, match=r"--dem-vertical EGM2008 needs PROJ's grid us_nga_egm08_25\.tif"):
        dem_datum(tmp_path / "dem.tif", asked["dem_vertical"])
    control = OrientRequest(
        (tmp_path / "a.tif", tmp_path / "b.tif"), tmp_path / "o", control=tmp_path / "c.csv", control_vertical="EGM96"
    )  # fmt: skip
    assert control_datum(control).name == "egm96"


def test_a_terrain_model_whose_geoid_is_missing_is_refused(images, tmp_path, monkeypatch):
    monkeypatch.setattr("zlocus.io.vertical.proj_folders", lambda: [tmp_path])
    dem = write_dem(tmp_path / "dem.tif", True, "EPSG:32632+5773")
    with pytest.raises(ConfigError, match=r"dem\.tif has EGM96 heights by its CRS, which needs .*--dem-vertical FILE"):
        run(images("sine"), tmp_path / "out", heights=None, dem=dem, bounds=PART)
    assert not (tmp_path / "out").exists()


def test_control_points_above_a_geoid(geoid, tmp_path):
    x, y = CENTRE[0] + 20.0, CENTRE[1] - 30.0
    table = tmp_path / "points.csv"
    table.write_text(
        f"name,x,y,z,image,column,row\np,{x},{y},5.25,view0,4,5\np,{x},{y},5.25,view1,4,5\nq,{x},{y + 50},6,view0,9,9\n"
    )
    views = views_of([None, None], (100, 80))
    found = read_control(table, views, named_vertical_datum(str(geoid)), UTM)
    assert found.names == ("p", "q")
    expected = [5.25 + undulation(x, y), 6.0 + undulation(x, y + 50)]
    np.testing.assert_allclose(found.xyz[:, 2], expected, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found.xyz[:, :2], [[x, y], [x, y + 50]])
    scene = replace(open_scene_of(views), crs=UTM)
    request = OrientRequest(inputs=(tmp_path / "scene.yaml",), out=tmp_path, control=table, control_vertical=str(geoid))
    np.testing.assert_array_equal(control_points(request, scene).xyz, found.xyz)
    np.testing.assert_array_equal(control_points(replace(request, control_vertical=None), scene).xyz[:, 2], [5.25, 6])


def open_scene_of(views):
    from zlocus.core.scene import Scene
    from zlocus.io.crs import local_frame

    return Scene(tuple(views), local_frame())


def test_nothing_is_above_a_geoid_in_a_local_frame(geoid, tmp_path, monkeypatch):
    scene = open_scene_of(views_of([None, None], (100, 80)))
    monkeypatch.setattr("zlocus.pipeline.setup.open_scene", lambda inputs, crs, chosen: chosen(scene))
    inputs, above = (tmp_path / "scene.yaml",), str(geoid)
    says = r"frame is local, where no place is above the geoid of slope\.tif\. Leave --vertical out"
    with pytest.raises(GeometryError, match=says):
        run_dsm(DsmRequest(inputs, tmp_path / "o", vertical=above), RunConfig(), progress_for(io.StringIO()))
    with pytest.raises(GeometryError, match=says):
        run_cloud(CloudRequest(inputs, tmp_path / "o", vertical=above), RunConfig(), SilentProgress())
    request = OrientRequest(inputs, tmp_path / "o", control=tmp_path / "points.csv", control_vertical=above)
    with pytest.raises(GeometryError, match="Leave --control-vertical out"):
        control_points(request, scene)
    assert not (tmp_path / "o").exists()


def test_a_geoid_of_another_place_is_refused_before_the_first_tile(images, tmp_path, monkeypatch):
    def no_tile(*_):
        raise AssertionError("a tile was begun")

    monkeypatch.setattr("zlocus.pipeline.tile_run.match_tile", no_tile)
    monkeypatch.setattr("zlocus.pipeline.cloud.matched_tiles", no_tile)
    away = write_geoid(tmp_path / "away.tif", np.zeros((4, 4), np.float32), from_origin(5, 44, 0.25, 0.25))
    for asked in (None, HEIGHTS):
        with pytest.raises(InputError, match=r"away\.tif does not cover 46\d+"):
            run(images("sine"), tmp_path / "out", SMALL_TILES, heights=asked, bounds=PART, vertical=str(away))
    with pytest.raises(InputError, match=r"away\.tif does not cover 46\d+"):
        run_cloud(
            CloudRequest(images("step").inputs, tmp_path / "out", crs="EPSG:32632", vertical=str(away)),
            RunConfig(), SilentProgress(),
        )  # fmt: skip
    assert not (tmp_path / "out").exists()


def test_a_cloud_above_a_geoid(images, geoid, tmp_path):
    found = []
    for name in ("ellipsoid", str(geoid)):
        out = tmp_path / str(len(found))
        request = CloudRequest(
            images("step").inputs, out, references=("nadir",), crs="EPSG:32632", vertical=name, partial=True
        )
        run_cloud(request, RunConfig(), SilentProgress())
        with rasterio.open(out / "nadir_height.tif") as file:
            found.append((laspy.read(out / "cloud.laz"), file.read(1), file.descriptions[0]))
    (plain, plain_map, said), (above, above_map, its) = found
    assert (said, its) == tuple(
        f"height above {what} of what the pixel shows" for what in ("the ellipsoid", "the geoid of slope.tif")
    )
    xyz = np.asarray(plain.xyz)
    expected = xyz[:, 2] - undulation(xyz[:, 0], xyz[:, 1])
    # Both in steps of 1 mm; positions too, over which the plane changes by less.
    np.testing.assert_allclose(np.asarray(above.xyz)[:, 2], expected, rtol=0, atol=1.1e-3)
    np.testing.assert_array_equal(np.asarray(above.xyz)[:, :2], xyz[:, :2])
    known = np.isfinite(plain_map)
    np.testing.assert_allclose(above_map[known], expected, rtol=0, atol=1.1e-3)
    crs = above.header.parse_crs()
    assert crs.to_2d().to_epsg() == 32632
    assert [part.name for part in crs.sub_crs_list][1] == "height above the geoid of slope.tif"
    record = json.loads((tmp_path / "1" / "run.json").read_text())
    assert record["vertical"]["heights_above"] == "the geoid of slope.tif"
    assert str(geoid) in [entry["path"] for entry in record["inputs"]]


@pytest.mark.parametrize(
    ("name", "bounds"),
    [
        ("pleiades_triplet_calanques", (698_250.0, 4_792_750.0, 698_370.0, 4_792_870.0)),
        ("pleiades_pair_ventoux", (675_290.0, 4_897_070.0, 675_410.0, 4_897_180.0)),
    ],
)
def test_real_surfaces_above_the_geoid_that_came_with_them(shared_data, tmp_path, name, bounds):
    """The acceptance line: 1 cm. The geoid is read and interpolated here by other code, post by post."""
    folder = shared_data / name
    geoid = folder / "reference" / "geoid_egm96_15min.tif"
    inputs = tuple(sorted(folder.glob("*.tif")))
    outs = []
    for vertical in ("ellipsoid", str(geoid)):
        asked = {"crs": "EPSG:32631", "resolution": 1.0, "bounds": bounds, "heights": None, "partial": True}
        outs.append(run(inputs, tmp_path / str(len(outs)), vertical=vertical, **asked).out)
    (plain, source), (above, its) = (read(out / "dsm.tif") for out in outs)
    known = np.isfinite(plain)
    assert known.sum() > 1000
    np.testing.assert_array_equal(np.isfinite(above), known)
    lon, lat = Transformer.from_crs(32631, 4326, always_xy=True).transform(*centres(source))
    with rasterio.open(geoid) as file:
        posts, transform = file.read(1).astype(float), file.transform
    col, row = (lon - transform.c) / transform.a - 0.5, (lat - transform.f) / transform.e - 0.5
    c, r = int(col.min()), int(row.min())
    assert (c, r) == (int(col.max()), int(row.max())), "one square of posts holds the area"
    corners = posts[r : r + 2, c : c + 2]
    expected = sum(
        corners[i, j] * np.abs(1 - i - (row - r)) * np.abs(1 - j - (col - c)) for i in (0, 1) for j in (0, 1)
    )
    assert np.abs(plain - expected - above)[known].max() < ACCEPTED_M
    assert 45 < expected.mean() < 55
    assert CRS.from_user_input(its.crs).is_compound


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["dsm", "--vertical", "moon"], "--vertical moon is neither ellipsoid, egm96, egm2008 nor the file of a geoid"),
        (["cloud", "--vertical", "moon"], "--vertical moon is neither"),
        (["dsm", "--dem", "d.tif", "--dem-vertical", "moon"], "--dem-vertical moon is neither"),
        (["dsm", "--dem-vertical", "egm96"], "--dem-vertical egm96 is given without --dem"),
        (["orient", "--dem-vertical", "egm96"], "--dem-vertical egm96 is given without --dem"),
        (["orient", "--control-vertical", "egm96"], "--control-vertical egm96 is given without --control"),
    ],
)
def test_requests_that_make_no_sense(tmp_path, arguments, says):
    command, *rest = arguments
    result = CliRunner().invoke(app, [command, "a.tif", "b.tif", "-o", str(tmp_path / "out"), *rest])
    assert result.exit_code == 2
    assert says in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_missing_grid_ends_the_command_line_before_anything_is_written(images, tmp_path, monkeypatch):
    monkeypatch.setattr("zlocus.io.vertical.proj_folders", lambda: [tmp_path])
    paths = [str(path) for path in images("sine").inputs]
    result = CliRunner().invoke(app, ["dsm", *paths, "-o", str(tmp_path / "out"), "--vertical", "egm2008"])
    assert result.exit_code == 2
    assert "pyproj sync --file us_nga_egm08_25.tif" in result.stderr
    assert not (tmp_path / "out").exists()
