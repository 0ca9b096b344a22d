"""Whole runs on small analytic scenes: the true height, the products, the options, and the same bytes however cut."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import rasterio
from rasterio.shutil import copy as copy_raster
from rasterio.transform import from_origin

import zlocus.pipeline.dsm
import zlocus.pipeline.tile_run
from rendered_scenes import (
    BLUNDER_M,
    CENTRE,
    GSD_M,
    HEIGHTS,
    LOOKS,
    PART,
    SMALL_TILES,
    camera,
    errors_of,
    read,
    rendered,
    run,
    truth_at,
    well_seen,
)  # fmt: skip
from rpc_fixtures import rpc_txt, write_image
from zlocus.core.errors import ConfigError, CoverageError, GeometryError
from zlocus.core.options import CheckOptions, ProductOptions, PyramidOptions, RunConfig
from zlocus.core.progress import progress_for
from zlocus.core.requests import DsmRequest
from zlocus.core.resources import held_bytes
from zlocus.io.cameras.rpc_text import rpc_from_fields
from zlocus.io.styles.file_names import OF_SURFACE, style_files
from zlocus.matching.quality import Quality, is_empty

REPORT_FILES = ("report.html", "footprints.geojson", "curves.json")
PRODUCTS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
MAPS = ("hillshade.tif", "dtm.tif")


def styles_of(products):
    """Names of the style files of products that have any."""
    return {name for product in products if product in OF_SURFACE for name in style_files(product)}


ALL_MAPS = ("hillshade", "contours", "dtm", "laz")
# Base-to-height about 0.6 and 0.5 m pixels: 0.05 m of height is 0.06 px.
BIAS_M, SPREAD_M = 0.02, {"plane": 0.05, "tilt": 0.06, "sine": 0.08, "step": 0.08}
BLUNDERS, RIM_BLUNDERS = 0.005, 0.02
PLANTED_PX = {"fore": (2.5, -1.5), "aft": (-3.0, 2.0)}
# A common translation of the ground moves all images along their loci; this much height may go with it.
LEFT_PX = 0.1


@pytest.fixture(scope="session")
def whole(images, tmp_path_factory):
    """A run over all of the sine, in tiles of 64 cells."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return run(images("sine"), out, SMALL_TILES, products=ALL_MAPS, report=True).out


def spread(error):
    """1.4826 median |e - median|."""
    return 1.4826 * np.median(np.abs(error - np.median(error)))


@pytest.mark.parametrize("kind", ["plane", "tilt", "sine"])
def test_true_height_of_smooth_ground(images, tmp_path, kind):
    result = run(images(kind), tmp_path / "out")
    error, seen = errors_of(result.out, kind)
    assert np.isfinite(error[seen]).mean() > 0.999
    # The rim of the images too: where two of them see a cell at a wrong height only, it is empty or close.
    assert (np.abs(error[np.isfinite(error)]) > BLUNDER_M).mean() < RIM_BLUNDERS
    error = error[seen & np.isfinite(error)]
    assert abs(np.median(error)) < BIAS_M
    assert spread(error) < SPREAD_M[kind]
    assert (np.abs(error) > BLUNDER_M).mean() < BLUNDERS
    assert result.coverage > 0.9


def test_a_vertical_step_stays_sharp(images, tmp_path):
    out = run(images("step"), tmp_path / "out").out
    error, seen = errors_of(out, "step")
    height, source = read(out / "dsm.tif")
    east = (source.transform * (np.arange(source.width) + 0.5, np.zeros(source.width)))[0] - CENTRE[0]
    # Windows that see both the roof and the street blur a rim of a few cells.
    for near, share in ((np.abs(east) > 2.0, 0.99), ((np.abs(east) > 0.6) & (np.abs(east) < 2.0), 0.55)):
        there = seen & near
        # No height counts as wrong.
        assert (np.abs(error[there]) < BLUNDER_M).mean() > share
    between = np.isfinite(height) & (np.abs(height - 57.5) < 6.0)
    assert between[seen].mean() < 0.03


def test_planted_pointing_errors_are_found(tmp_path):
    """The corrections take out what was put in, but for a common translation of the ground (3 unknowns of 6)."""
    images = rendered(tmp_path / "images", "sine", PLANTED_PX)
    out = run(images, tmp_path / "out").out
    views = json.loads((out / "run.json").read_text())["orientation"]["views"]
    left = np.array([np.add(views[name]["shift_px"], PLANTED_PX.get(name, (0.0, 0.0))) for name in LOOKS])
    at = np.array([[*CENTRE, 50.0]])
    moves = []
    for axis in np.eye(3):
        moves.append(np.concatenate([(camera(n).image_from_ground(at + axis) - camera(n).image_from_ground(at))[0]
                                     for n in LOOKS]))  # fmt: skip
    moves = np.array(moves).T
    translation = np.linalg.lstsq(moves, left.ravel(), rcond=None)[0]
    assert np.abs(left.ravel() - moves @ translation).max() < LEFT_PX
    assert views["fore"]["residual_after_px"]["median"] < 0.2
    height, source = read(out / "dsm.tif")
    seen = well_seen(source, truth_at("sine", source))
    error = (height - truth_at("sine", source, tuple(translation[:2])) + translation[2])[seen & np.isfinite(height)]
    assert abs(np.median(error)) < BIAS_M + LEFT_PX * GSD_M
    assert spread(error) < SPREAD_M["sine"]


def test_heights_are_found_from_ties(images, tmp_path):
    out = run(images("sine"), tmp_path / "out", heights=None, bounds=PART).out
    low, high = json.loads((out / "run.json").read_text())["heights"]["range_m"]
    assert low < 47.0
    assert high > 53.0
    error, seen = errors_of(out, "sine")
    assert np.nanmax(np.abs(error[seen])) < BLUNDER_M


def test_products(whole, images):
    from rio_cogeo import cog_validate

    height, dsm = read(whole / "dsm.tif")
    for name, dtype, nodata in (
        ("dsm.tif", "float32", np.nan), ("sigma.tif", "float32", np.nan), ("quality.tif", "uint16", None),
        ("views.tif", "uint8", 0), ("ortho.tif", "uint16", None), ("hillshade.tif", "uint8", 0),
        ("dtm.tif", "float32", np.nan),
    ):  # fmt: skip
        _, source = read(whole / name)
        assert source.dtypes == (dtype,)
        assert source.nodata is nodata if nodata is None else np.array_equal(source.nodata, nodata, equal_nan=True)
        assert (source.transform, source.shape, source.crs) == (dsm.transform, dsm.shape, dsm.crs)
        valid, problems, warnings = cog_validate(whole / name, strict=True)
        assert valid, (problems, warnings)
        with rasterio.open(whole / name) as file:
            assert "STATISTICS_MEAN" in file.tags(1)
    made = {
        *PRODUCTS, *MAPS, *REPORT_FILES, "contours.gpkg", "surface.laz", "ties.gpkg", "observations.npz", "run.json",
        "item.json", "metadata.xml", "events.jsonl", "finished.json",
    }  # fmt: skip
    made |= styles_of(made)
    assert {path.name for path in whole.iterdir()} == made
    quality, views = read(whole / "quality.tif")[0], read(whole / "views.tif")[0]
    np.testing.assert_array_equal(np.isnan(height), is_empty(quality))
    np.testing.assert_array_equal(np.isnan(height), views == 0)
    sigma = read(whole / "sigma.tif")[0]
    np.testing.assert_array_equal(np.isnan(height), np.isnan(sigma))
    assert np.nanmin(sigma) > 0
    assert set(np.unique(views)) <= {0, 2, 3}
    with rasterio.open(whole / "ortho.tif") as ortho:
        np.testing.assert_array_equal(ortho.read_masks(1) > 0, np.isfinite(height))
    assert (quality[0] & Quality.UNSEEN).all()
    assert dsm.crs.to_epsg() == 32632


def test_ortho_image_is_the_reference_image_on_the_surface(whole, images):
    """Grey values of the nadir image where the cells' true surface points fall in it."""
    grey, source = read(whole / "ortho.tif")
    truth = truth_at("sine", source)
    seen = well_seen(source, truth)
    row, col = np.nonzero(seen)
    x, y = source.transform * (col + 0.5, row + 0.5)
    xy = camera("nadir").image_from_ground(np.column_stack([x, y, truth[seen]]))
    pixels = read(images("sine").paths["nadir"])[0]
    nearest = pixels[np.rint(xy[:, 1]).astype(int), np.rint(xy[:, 0]).astype(int)].astype(float)
    assert np.corrcoef(nearest, grey[seen])[0, 1] > 0.9
    assert np.median(grey[seen] - nearest) == pytest.approx(0, abs=2)


def test_record(whole, images):
    record = json.loads((whole / "run.json").read_text())
    assert set(record) >= {"schema", "config", "versions", "inputs", "stages", "evaluations", "coverage"}
    assert record["schema"] == 2
    assert [entry["path"] for entry in record["inputs"]] == [str(path) for path in images("sine").inputs]
    assert all(len(entry["sha256"]) == 64 for entry in record["inputs"])
    stages = ["open", "orient", "setup", "match", "record", "write", "points", "curves", "products"]
    assert [stage["name"] for stage in record["stages"]] == stages
    assert all(set(stage) == {"name", "wall_s", "cpu_s", "peak_mb"} for stage in record["stages"])
    assert record["evaluations"]["done"] <= record["evaluations"]["all_images"]
    assert record["evaluations"]["done"] > 1e6
    assert record["image_dates"] == [None] * 3
    assert abs((datetime.now(UTC) - datetime.fromisoformat(record["created"])).total_seconds()) < 3600
    assert record["config"]["options"]["pyramid"]["tile"] == SMALL_TILES.pyramid.tile
    assert record["config"]["request"]["heights"] == list(HEIGHTS)
    height, quality = read(whole / "dsm.tif")[0], read(whole / "quality.tif")[0]
    seen = (quality & (Quality.UNSEEN | Quality.OUTSIDE)) == 0
    assert record["coverage"] == pytest.approx(np.isfinite(height).sum() / seen.sum(), abs=1e-6)


def test_record_of_cameras_beside_the_images(images, tmp_path):
    """An _RPC.TXT decides heights as much as an image does."""
    paths = []
    for path in images("plane").paths.values():
        paths.append(tmp_path / path.name)
        copy_raster(path, paths[-1], driver="GTiff")
    with rasterio.open(paths[1]) as source:
        tags = source.tags(ns="RPC")
    beside = tmp_path / f"{paths[1].stem}_RPC.TXT"
    beside.write_text(rpc_txt(rpc_from_fields(tags, paths[1])))
    out = run(tuple(paths), tmp_path / "out", bounds=PART).out
    record = json.loads((out / "run.json").read_text())
    assert [entry["path"] for entry in record["inputs"]] == [str(path) for path in (*paths, beside)]


def test_cells_finer_than_the_images_are_refused(images, tmp_path):
    """The message names what was given."""
    like = tmp_path / "like.tif"
    with rasterio.open(
        like, "w", driver="GTiff", width=40, height=40, count=1, dtype="uint8", crs="EPSG:32632",
        transform=from_origin(*CENTRE, 0.02, 0.02),
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, 40, 40), np.uint8))
    with pytest.raises(ConfigError, match=r"--like .*like\.tif: its cell of 0\.02 m is finer than a tenth"):
        run(images("plane"), tmp_path / "out", like=like)
    with pytest.raises(ConfigError, match=r"^--resolution 0\.03 m is finer than a tenth"):
        run(images("plane"), tmp_path / "out", resolution=0.03)
    assert not (tmp_path / "out").exists()


def test_same_bytes_with_two_workers(whole, images, tmp_path):
    other = run(images("sine"), tmp_path / "out", SMALL_TILES, workers=2, products=ALL_MAPS).out
    for name in (*PRODUCTS, *MAPS):
        assert (other / name).read_bytes() == (whole / name).read_bytes(), name


def test_same_bytes_for_another_order_of_tiles(whole, images, tmp_path, monkeypatch):
    plan = zlocus.pipeline.dsm.plan_tiles
    monkeypatch.setattr(zlocus.pipeline.dsm, "plan_tiles", lambda *given: plan(*given)[::-1])
    other = run(images("sine"), tmp_path / "out", SMALL_TILES, products=ALL_MAPS).out
    for name in (*PRODUCTS, *MAPS):
        assert (other / name).read_bytes() == (whole / name).read_bytes(), name


def test_another_run_leaves_no_map_of_the_one_before(images, tmp_path):
    out = run(images("plane"), tmp_path / "out", bounds=PART, products=("dtm", "laz")).out
    assert {"dtm.tif", "surface.laz", "item.json"} <= {path.name for path in out.iterdir()}
    run(images("plane"), out, bounds=PART, products=(), overwrite=True, report=True)
    assert {path.name for path in out.iterdir()} == styles_of((*PRODUCTS, *REPORT_FILES, "ties.gpkg")) | {
        *PRODUCTS,
        *REPORT_FILES,
        "ties.gpkg",
        "observations.npz",
        "run.json",
        "item.json",
        "metadata.xml",
        "events.jsonl",
        "finished.json",
    }


def test_contours_of_a_terrain_that_is_not_made_are_refused_at_once(images, tmp_path):
    with pytest.raises(ConfigError, match=r"Add dtm to --products"):
        run(images("plane"), tmp_path / "out", RunConfig(products=ProductOptions(contours_of="dtm")),
            products=("contours",))  # fmt: skip
    assert not (tmp_path / "out").exists()


def shared_cells(out, whole, name):
    """The cells of a raster, and the same cells of a larger one."""
    part, source = read(out / name)
    all_cells, larger = read(whole / name)
    col, row = (round(v) for v in ~larger.transform * (source.bounds.left, source.bounds.top))
    assert row >= 0
    assert col >= 0
    return part, all_cells[row : row + part.shape[0], col : col + part.shape[1]]


def test_same_heights_for_a_part_of_the_area(whole, images, tmp_path):
    out = run(images("sine"), tmp_path / "out", SMALL_TILES, bounds=PART).out
    assert read(out / "dsm.tif")[0].shape == (38, 52)
    for name in PRODUCTS:
        part, same = shared_cells(out, whole, name)
        np.testing.assert_array_equal(part, same)


def test_same_heights_on_the_grid_of_another_raster(whole, images, tmp_path):
    """--like on the same lattice: same cells; where it reaches beyond the ground seen, cells are empty."""
    like = tmp_path / "like.tif"
    with rasterio.open(
        like, "w", driver="GTiff", width=40, height=300, count=1, dtype="uint8", crs="EPSG:32632",
        transform=from_origin(CENTRE[0] - 10.0, CENTRE[1] + 90.0, GSD_M, GSD_M),
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, 300, 40), np.uint8))
    out = run(images("sine"), tmp_path / "out", SMALL_TILES, like=like).out
    height, source = read(out / "dsm.tif")
    assert (source.shape, source.transform) == ((300, 40), read(like)[1].transform)
    larger = read(whole / "dsm.tif")[1]
    down = round((source.bounds.top - larger.bounds.top) / GSD_M)
    assert down > 0
    col = round((source.bounds.left - larger.bounds.left) / GSD_M)
    inside = slice(down, down + larger.height)
    for name in PRODUCTS[:3]:
        mine, theirs = read(out / name)[0], read(whole / name)[0]
        np.testing.assert_array_equal(mine[inside], theirs[:, col : col + 40])
    assert np.isnan(height[:down]).all()
    assert (read(out / "quality.tif")[0][:down] & Quality.UNSEEN).all()


def test_a_grid_between_the_lattice(images, tmp_path):
    """--like with another phase and another resolution: heights belong to its own cell centres."""
    like = tmp_path / "like.tif"
    transform = from_origin(CENTRE[0] - 11.9, CENTRE[1] + 13.3, 0.7, 0.7)
    with rasterio.open(
        like, "w", driver="GTiff", width=34, height=31, count=1, dtype="uint8", crs="EPSG:32632", transform=transform
    ) as raster:
        raster.write(np.zeros((1, 31, 34), np.uint8))
    out = run(images("tilt"), tmp_path / "out", like=like).out
    height, source = read(out / "dsm.tif")
    assert source.transform == transform
    error = height - truth_at("tilt", source)
    assert abs(np.nanmedian(error)) < BIAS_M
    assert np.isfinite(error).mean() > 0.99


def polygon(path, bounds):
    """A GeoJSON of one rectangle in the scene's CRS."""
    xmin, ymin, xmax, ymax = bounds
    ring = [[xmin, ymin], [xmax, ymin], [xmax, ymax], [xmin, ymax], [xmin, ymin]]
    path.write_text(json.dumps({
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}},
        "features": [{"type": "Feature", "properties": {},
                      "geometry": {"type": "Polygon", "coordinates": [ring]}}],
    }))  # fmt: skip
    return path


def test_area_and_mask(whole, images, tmp_path):
    area = polygon(tmp_path / "area.geojson", (PART[0], PART[1], CENTRE[0], PART[3]))
    mask = polygon(tmp_path / "mask.geojson", (PART[0], PART[1], CENTRE[0] - 6.0, CENTRE[1]))
    result = run(images("sine"), tmp_path / "out", SMALL_TILES, bounds=PART, area=area, mask=mask)
    asked = np.zeros((38, 52), bool)
    asked[:, :24] = True
    asked[18:, :12] = False
    quality = read(result.out / "quality.tif")[0]
    np.testing.assert_array_equal((quality & Quality.OUTSIDE) == 0, asked)
    height, same = shared_cells(result.out, whole, "dsm.tif")
    np.testing.assert_array_equal(height[asked], same[asked])
    assert np.isnan(height[~asked]).all()
    assert result.coverage > 0.99
    views, same = shared_cells(result.out, whole, "views.tif")
    np.testing.assert_array_equal(views, np.where(asked, same, 0))


def test_an_area_elsewhere_is_refused(images, tmp_path):
    far = polygon(tmp_path / "far.geojson", (CENTRE[0] + 5000, CENTRE[1], CENTRE[0] + 5100, CENTRE[1] + 100))
    with pytest.raises(GeometryError, match="area"):
        run(images("sine"), tmp_path / "out", area=far)
    assert not (tmp_path / "out").exists()


def test_heights_around_a_dem(images, tmp_path):
    """A flat DEM 20 m too low, with a hole: the range reaches over the ground, and a hole searches everything."""
    dem = np.full((30, 30), 30.0, np.float32)
    dem[10:14, 10:14] = -9999
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=30, height=30, count=1, dtype="float32", nodata=-9999,
        crs="EPSG:32632", transform=from_origin(CENTRE[0] - 150.0, CENTRE[1] + 150.0, 10.0, 10.0),
    ) as raster:  # fmt: skip
        raster.write(dem, 1)
    out = run(images("sine"), tmp_path / "out", heights=None, dem=tmp_path / "dem.tif", bounds=PART).out
    error, seen = errors_of(out, "sine")
    assert (np.abs(error[seen]) < BLUNDER_M).mean() > 0.99
    assert json.loads((out / "run.json").read_text())["heights"]["range_m"] == [-20.0, 130.0]


def test_ortho_image_where_the_reference_image_sees_nothing(images, tmp_path):
    """The leading image, three times as bright, is cut off in the west: no cell shows another place's grey value, and
    grey values of another image are its own, or as bright as the leading one's."""
    paths = dict(images("plane").paths)
    with rasterio.open(paths["nadir"]) as source:
        pixels, rpc = source.read(1), source.rpcs
    paths["nadir"] = write_image(tmp_path / "nadir.tif", (pixels[:, :75] * 3).astype(np.uint16), None, rpcs=rpc)
    own = replace(SMALL_TILES, products=ProductOptions(ortho_levels="own"))
    levelled, out = (run(tuple(paths.values()), tmp_path / n, c).out for n, c in (("a", SMALL_TILES), ("b", own)))
    with rasterio.open(out / "ortho.tif") as source:
        grey, shown = source.read(1).astype(float), source.read_masks(1) > 0
        x, y = source.transform * (np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5))
    xyz = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 50.0)])
    east = ((x > CENTRE[0] + 4) & (x < CENTRE[0] + 28) & (np.abs(y - CENTRE[1]) < 25)).ravel()
    assert shown.ravel()[east].mean() > 0.9
    there = east & shown.ravel()
    known = []
    for name in ("fore", "aft"):
        xy = np.rint(camera(name).image_from_ground(xyz[there])).astype(int)
        known.append(read(paths[name])[0][xy[:, 1], xy[:, 0]].astype(float))
    away = np.min([np.abs(grey.ravel()[there] - values) for values in known], axis=0)
    assert np.median(away) < 20
    with rasterio.open(levelled / "ortho.tif") as source:
        brighter = source.read(1).astype(float).ravel()[there] / grey.ravel()[there]
    assert np.median(brighter) == pytest.approx(3.0, rel=0.03)


def test_without_the_semi_global_constraint(images, tmp_path):
    out = run(images("sine"), tmp_path / "out", method="mvll", bounds=PART).out
    error, seen = errors_of(out, "sine")
    assert abs(np.nanmedian(error[seen])) < BIAS_M
    assert (np.abs(error[seen]) < BLUNDER_M).mean() > 0.8


def test_reference_image(images, tmp_path):
    out = run(images("plane"), tmp_path / "out", reference="aft", views="all", bounds=PART).out
    assert json.loads((out / "run.json").read_text())["heights"]["reference_image"] == "aft"
    grey, source = read(out / "ortho.tif")
    x, y = source.transform * (20.5, 15.5)
    xy = camera("aft").image_from_ground(np.array([[x, y, 50.0]]))[0]
    near = read(images("plane").paths["aft"])[0][int(xy[1]) : int(xy[1]) + 2, int(xy[0]) : int(xy[0]) + 2]
    assert near.min() - 20 <= grey[15, 20] <= near.max() + 20
    with pytest.raises(ConfigError, match="--reference left is not a view"):
        run(images("plane"), tmp_path / "other", reference="left")
    assert not (tmp_path / "other").exists()


def test_two_images(images, tmp_path):
    """A pair: nothing to choose from, and no third image to mend anything."""
    pair = (images("sine").paths["nadir"], images("sine").paths["fore"])
    out = run(pair, tmp_path / "out", bounds=PART).out
    error, seen = errors_of(out, "sine")
    assert (np.abs(error[seen]) < BLUNDER_M).mean() > 0.97
    assert set(np.unique(read(out / "views.tif")[0])) <= {0, 2}


def test_memory_limits_the_tiles_at_a_time(images, tmp_path):
    with pytest.raises(ConfigError, match=r"--memory 0\.001 GB is too little"):
        run(images("sine"), tmp_path / "out", memory_gb=0.001)
    assert not (tmp_path / "out").exists()
    # This process and a tile, not two workers.
    enough = held_bytes() / 1e9 + 0.4
    out = tmp_path / "out"
    assert run(images("sine"), out, SMALL_TILES, workers=2, memory_gb=enough, bounds=PART).coverage > 0.99
    assert json.loads((out / "events.jsonl").read_text().splitlines()[0])["slots"] == 1


def test_too_little_matched_keeps_the_products(images, tmp_path):
    strict = RunConfig(checks=CheckOptions(min_ncc=0.9999))
    with pytest.raises(CoverageError, match="% of the cells seen by two images"):
        run(images("sine"), tmp_path / "out", strict, bounds=PART)
    height = read(tmp_path / "out" / "dsm.tif")[0]
    assert np.isnan(height).mean() > 0.5
    assert (read(tmp_path / "out" / "quality.tif")[0][np.isnan(height)] & Quality.NO_MATCH).all()
    assert json.loads((tmp_path / "out" / "run.json").read_text())["coverage"] < 0.5
    assert run(images("sine"), tmp_path / "other", strict, bounds=PART, partial=True).coverage < 0.5


def test_a_failing_tile_leaves_no_half_products(images, tmp_path, monkeypatch):
    def fail(*_):
        raise GeometryError("no.")

    monkeypatch.setattr(zlocus.pipeline.tile_run, "match_tile", fail)
    with pytest.raises(GeometryError):
        run(images("sine"), tmp_path / "new" / "out", bounds=PART)
    assert not list(tmp_path.iterdir())
    (tmp_path / "mine").mkdir()
    with pytest.raises(GeometryError):
        run(images("sine"), tmp_path / "mine" / "out", bounds=PART)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert not list((tmp_path / "mine").iterdir())
    (tmp_path / "mine" / "notes.txt").touch()
    with pytest.raises(GeometryError):
        run(images("sine"), tmp_path / "mine", bounds=PART)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("rounds", [1, 2])
def test_tiny_pyramids(images, tmp_path, rounds):
    """One level and blocks of 8 cells, the least that the options allow."""
    config = RunConfig(pyramid=PyramidOptions(max_levels=1, block=8, halo=8, tile=64, finest_level_rounds=rounds))
    out = run(images("plane"), tmp_path / "out", config, bounds=PART).out
    error, seen = errors_of(out, "plane")
    assert (np.abs(error[seen]) < BLUNDER_M).mean() > 0.95


def test_progress_and_defaults(images, tmp_path):
    """Without resolution, CRS and bounds: the images' pixel, their UTM zone, the ground that two see."""
    log = io.StringIO()
    request = DsmRequest(inputs=images("plane").inputs, out=tmp_path / "out", heights=HEIGHTS)
    result = zlocus.pipeline.dsm.run_dsm(request, RunConfig(), progress_for(log))
    _, source = read(result.out / "dsm.tif")
    assert source.crs.to_epsg() == 32632
    assert source.transform.a == pytest.approx(0.5, abs=0.02)
    assert (source.bounds.left / source.transform.a) % 1 == pytest.approx(0, abs=1e-6)
    assert "Matching" in log.getvalue()
    assert replace(request).workers is None


def test_gaps_filled_from_a_terrain_model(images, tmp_path):
    """A model 7 m above the ground: seen where nothing was matched, and nowhere else; and it counts as no height."""
    east, north = CENTRE
    dem = tmp_path / "dem.tif"
    with rasterio.open(
        dem, "w", driver="GTiff", width=200, height=200, count=1, dtype="float32", crs="EPSG:32632",
        transform=from_origin(east - 200.0, north + 200.0, 2.0, 2.0),
    ) as file:  # fmt: skip
        file.write(np.full((200, 200), 57.0, np.float32), 1)
    bounds = (east - 60.0, north - 20.0, east, north + 20.0)
    asked = {"heights": None, "dem": dem, "dem_vertical": "ellipsoid", "bounds": bounds, "report": False}
    plain = run(images("plane"), tmp_path / "plain", SMALL_TILES, **asked)
    result = run(images("plane"), tmp_path / "out", SMALL_TILES, fill="dem", workers=2, **asked)
    (before, _), (height, _), quality = (
        read(plain.out / "dsm.tif"),
        read(result.out / "dsm.tif"),
        read(result.out / "quality.tif")[0],
    )
    empty = np.isnan(before)
    assert 0.1 < empty.mean() < 0.9
    np.testing.assert_array_equal(height[~empty], before[~empty])
    np.testing.assert_allclose(height[empty], 57.0, rtol=0, atol=1e-4)
    np.testing.assert_array_equal((quality & Quality.FILLED) != 0, empty)
    assert result.coverage == plain.coverage
    with pytest.raises(ConfigError, match=r"--fill dem needs the heights of a terrain model\. Add --dem RASTER"):
        run(images("plane"), tmp_path / "no", fill="dem")
