"""Runs with water polygons: one level each over all tiles, the same bytes however made, wrong input refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyogrio.raw
import pytest
import rasterio
import shapely
from pyproj import CRS, Transformer
from rasterio.features import shapes
from typer.testing import CliRunner

from grid_input_files import write_water
from interrupted_runs import command
from rendered_scenes import CENTRE, SMALL_TILES, read, run
from zlocus.cli.app import app
from zlocus.core.errors import InputError, OutputError
from zlocus.core.height_range import HeightRange
from zlocus.core.options import ProductOptions
from zlocus.core.progress import KeptNotes
from zlocus.io.vertical import named_vertical_datum
from zlocus.io.water_polygons import WaterPolygons
from zlocus.matching.quality import Quality
from zlocus.matching.water_level import WaterLevel
from zlocus.pipeline.water import far_levels, note_water
from zlocus.products.rasters import WaterKind
from zlocus.products.water import LevelledSurface, WaterFound
from zlocus.synthetic.files import render_scene
from zlocus.synthetic.scenes import trouble_spec

RASTERS = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif")
X, Y = CENTRE
# Across the seams of the four tiles, with an island; a pond inside one tile; one far away.
LAKE = shapely.Polygon(
    [(X - 9, Y - 8), (X + 10, Y - 9), (X + 9, Y + 9), (X - 8, Y + 8)],
    [[(X - 2, Y - 2), (X + 2, Y - 2), (X + 2, Y + 2), (X - 2, Y + 2)]],
)
POND, FAR = shapely.box(X + 14, Y + 3, X + 20, Y + 9), shapely.box(X + 5000, Y, X + 5010, Y + 10)
POND_M = 51.25
UTM, ELLIPSOID = CRS.from_epsg(32632), named_vertical_datum("ellipsoid")
# The acceptance of this project: a lake is level within this, against the truth of a rendered scene.
LEVEL_M = 0.05
NO_REPORT = ("--crs", "EPSG:32632", "--resolution", "0.5", "--no-report", "--products", "none")


@pytest.fixture
def zl():
    """Run the command line in this process."""
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def in_degrees(shape):
    to_degrees = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    return shapely.transform(shape, lambda xy: np.column_stack(to_degrees.transform(*xy.T)))


@pytest.fixture(scope="module")
def water(tmp_path_factory):
    """A multipolygon in degrees whose level is to be found, and two polygons with a level."""
    path = tmp_path_factory.mktemp("water") / "water.gpkg"
    polygons = [in_degrees(shape) for shape in (shapely.multipolygons([LAKE]), POND, FAR)]
    return write_water(path, polygons, crs="EPSG:4326", level=[None, POND_M, 7.0])


def asked(water):
    return {"water": water, "water_level": "level", "workers": 1, "products": ("hillshade", "dtm", "contours")}


@pytest.fixture(scope="module")
def levelled(images, water, tmp_path_factory):
    """The sine with a lake and a pond, in four tiles."""
    config = replace(SMALL_TILES, products=ProductOptions(contour_interval_m=0.5))
    return run(images("sine"), tmp_path_factory.mktemp("levelled") / "out", config, report=True, **asked(water)).out


def cells_of(shape, source):
    col, row = np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
    return shapely.contains_xy(shape, *(source.transform * (col, row)))


def test_every_polygon_has_one_level_over_all_tiles(levelled):
    height, source = read(levelled / "dsm.tif")
    quality, kind = read(levelled / "quality.tif")[0], read(levelled / "water.tif")[0]
    lake, pond = cells_of(LAKE, source), cells_of(POND, source)
    record = json.loads((levelled / "run.json").read_text())
    assert record["plan"]["tiles"] == 4
    of_lake, of_pond = record["water"]["levelled"]
    (level,) = np.unique(height[lake])
    assert level == np.float32(of_lake["level_m"])
    assert set(height[pond]) == {np.float32(POND_M)}
    assert (of_lake["name"], of_lake["source"], of_pond["source"]) == ("polygon 1", "inside", "attribute")
    assert (of_lake["n_cells"], of_pond["n_cells"]) == (lake.sum(), pond.sum())
    assert (of_pond["sigma_m"], of_pond["n_used"]) == (None, 0)
    np.testing.assert_array_equal(kind == WaterKind.LEVELLED, lake | pond)
    np.testing.assert_array_equal((quality & Quality.WATER) == Quality.WATER, lake | pond)
    island = cells_of(shapely.Polygon(LAKE.interiors[0]), source)
    assert np.ptp(height[island]) > 0.3


def test_levelled_cells_are_not_among_the_matched_ones(levelled):
    """They count neither as matched nor as cells that should be."""
    height, quality = read(levelled / "dsm.tif")[0], read(levelled / "quality.tif")[0]
    water = (quality & Quality.WATER) == Quality.WATER
    seen = ((quality & np.uint16(Quality.UNSEEN | Quality.OUTSIDE)) == 0) & ~water
    record = json.loads((levelled / "run.json").read_text())
    assert record["coverage"] == round((seen & np.isfinite(height)).sum() / seen.sum(), 6)


def test_terrain_and_contours_keep_the_level(levelled):
    (height, source), terrain = read(levelled / "dsm.tif"), read(levelled / "dtm.tif")[0]
    water = read(levelled / "water.tif")[0] == WaterKind.LEVELLED
    np.testing.assert_array_equal(terrain[water], height[water])
    shade = read(levelled / "hillshade.tif")[0]
    inner = cells_of(LAKE.buffer(-1.2), source)
    assert len(np.unique(shade[inner])) == 1
    _, _, wkb, _ = pyogrio.raw.read(levelled / "contours.gpkg", layer="contours")
    lines = shapely.from_wkb(wkb)
    assert len(lines) > 5
    # A contour at the level follows the shore, through the outermost cells.
    assert not any(line.intersects(LAKE.buffer(-0.75)) for line in lines)


def test_report_and_item_say_it(levelled):
    page = (levelled / "report.html").read_text(encoding="utf-8")
    assert "2 water surfaces have one level each, not matched heights: polygon 1 at" in page
    assert f"polygon 2 at {POND_M:.2f} m" in page
    assert "water, levelled (WATER)" in page
    assets = json.loads((levelled / "item.json").read_text())["assets"]
    assert assets["water-tif"]["bands"][0]["description"] == "water surface"


def test_the_same_bytes_again_and_from_tasks(zl, images, water, levelled, tmp_path):
    done = zl("rerun", levelled, "-o", tmp_path / "again", "--workers", 2)
    assert done.exit_code == 0, done.output
    assert "All 6 rasters have the recorded bytes." in done.stdout
    words = command(images("sine"), tmp_path / "tasks", tmp_path)
    options = [*words[words.index("--crs") :], "--water", water, "--water-level", "level", "--products", "none"]
    assert zl("tiles", "plan", tmp_path / "tasks", *images("sine").inputs, "--tasks", 2, *options).exit_code == 0
    for number in (2, 1):
        assert zl("tiles", "run", tmp_path / "tasks", number).exit_code == 0
    assert zl("tiles", "assemble", tmp_path / "tasks").exit_code == 0
    for name in RASTERS:
        assert (tmp_path / "tasks" / name).read_bytes() == (levelled / name).read_bytes(), name


def test_another_water_file_is_another_run(images, water, levelled, tmp_path):
    """A finished surface is not taken where the content of the polygons differs."""
    config = replace(SMALL_TILES, products=ProductOptions(contour_interval_m=0.5))
    out, changed = Path(shutil.copytree(levelled, tmp_path / "out")), tmp_path / "other.gpkg"
    assert run(images("sine"), out, config, report=True, **asked(water)).was_finished
    write_water(changed, [POND], level=[50.0])
    with pytest.raises(OutputError, match=r"holds another run: .*water"):
        run(images("sine"), out, config, **asked(changed))
    record = json.loads((levelled / "run.json").read_text())
    assert str(water) in {each["path"] for each in record["inputs"]}


def test_a_dry_run_tells_the_polygons(zl, images, water, tmp_path):
    words = command(images("sine"), tmp_path / "out", tmp_path, "--water", str(water), "--dry-run")
    done = zl(*words[words.index("dsm") :])
    assert done.exit_code == 0, done.output
    assert f"Water: 2 polygons of {water} will be levelled." in done.stdout
    assert f"Polygon 3 of {water} lies outside the grid and has no effect." in done.stderr
    assert not (tmp_path / "out").exists()


def bad_field(folder):
    return write_water(folder / "w.gpkg", [POND], depth=[1.0]), "level", "and no attribute level"


def bad_text(folder):
    return write_water(folder / "w.gpkg", [POND], level=["deep"]), "level", "'deep' in level, which is no water level"


def far_away(folder):
    return write_water(folder / "w.gpkg", [FAR]), None, "No water polygon of"


def wrong_crs(folder):
    """Coordinates in metres that say they are of another zone."""
    return write_water(folder / "w.gpkg", [POND], crs="EPSG:32631"), None, "No water polygon of"


def damaged(folder):
    path = write_water(folder / "w.gpkg", [POND])
    path.write_bytes(path.read_bytes()[:1500])
    return path, None, "w.gpkg cannot be read as vector file"


def missing(folder):
    return folder / "none.gpkg", None, "none.gpkg"


@pytest.mark.parametrize("case", [bad_field, bad_text, far_away, wrong_crs, damaged, missing])
def test_wrong_polygons_are_one_sentence_before_matching(zl, images, tmp_path, case):
    path, field, said = case(tmp_path)
    words = command(images("sine"), tmp_path / "out", tmp_path, "--water", str(path))
    done = zl(*words[words.index("dsm") :], *([] if field is None else ["--water-level", field]))
    assert done.exit_code == 2, done.output
    assert said in " ".join(done.stderr.splitlines()[-1].split())
    assert "Matching" not in done.stderr
    assert not (tmp_path / "out").exists()


def of_level(level_m):
    return WaterPolygons(Path("w.gpkg"), np.array([POND], object), ("polygon 1",), np.array([level_m]))


@pytest.mark.parametrize(("level_m", "geoid_m"), [(10.0, 0.0), (60.0, 0.0), (np.nan, 0.0), (-35.0, 45.0)])
def test_levels_within_the_searched_heights_are_not_doubted(level_m, geoid_m):
    datum = SimpleNamespace(undulation=lambda xy, crs: np.full(len(xy), geoid_m))
    assert far_levels(of_level(level_m), HeightRange((20.0, 50.0), (10.0, 60.0)), UTM, datum) == []


@pytest.mark.parametrize("level_m", [9.0, -39.0, 109.0])
def test_levels_beside_the_searched_heights_are_said(level_m):
    (said,) = far_levels(of_level(level_m), HeightRange((20.0, 50.0), (10.0, 60.0)), UTM, ELLIPSOID)
    assert said.startswith(f"The level {level_m:.2f} m of polygon 1 in w.gpkg is outside the heights where the ground ")
    assert "is looked for, 10.0 to 60.0 m. Check" in said


@pytest.mark.parametrize("level_m", [-41.0, 111.0, 4850.0])
def test_levels_far_from_the_searched_heights_are_refused(level_m):
    """Further than the searched heights are wide."""
    with pytest.raises(InputError, match=rf"The level {level_m:.2f} m .*, 10\.0 to 60\.0 m\. Correct the level"):
        far_levels(of_level(level_m), HeightRange((20.0, 50.0), (10.0, 60.0)), UTM, ELLIPSOID)


def said_of(water_found, level_water=False):
    progress = KeptNotes()
    note_water(water_found, SimpleNamespace(level_water=level_water), progress)
    return "\n".join(progress.sentences)


@pytest.mark.parametrize(
    ("level", "said"),
    [
        (WaterLevel(5.0, 2.9, "inside", 90, 0.9), "Matched like land, which water is not: polygon 1 (over 90 %, with a "
                                                  "relief of 2.9 m)."),
        (WaterLevel(5.0, 2.9, "rim", 90), "whose level may be too high: polygon 1 (by 2.9 m)."),
        (WaterLevel(5.0, 0.2, "inside", 90, 0.9), None),
        (WaterLevel(5.0, np.nan, "attribute", 0), None),
    ],
)  # fmt: skip
def test_doubtful_levels_are_said_in_the_log_and_recorded(level, said):
    water_found = WaterFound([LevelledSurface("polygon 1", WaterKind.LEVELLED, level, 100)])
    log, recorded = said_of(water_found), water_found.as_dict()["doubts"]
    assert "Water levelled: polygon 1 at 5.00 m." in log
    assert len(recorded) == (said is not None)
    assert all(said in sentence and sentence in log for sentence in recorded)


def test_looking_for_water_where_there_is_none_is_said():
    water_found = WaterFound()
    assert "--level-water levels nothing" in said_of(water_found, level_water=True)
    assert "--level-water levels nothing" in water_found.as_dict()["doubts"][0]
    assert "levels nothing" not in said_of(WaterFound(n_possible=1), level_water=True) + said_of(WaterFound())


def test_a_level_without_polygons_is_refused(zl, images, tmp_path):
    words = command(images("sine"), tmp_path / "out", tmp_path, "--water-level", "level")
    done = zl(*words[words.index("dsm") :])
    assert done.exit_code == 2
    assert "--water-level level is given without --water" in " ".join(done.stderr.split())


def test_a_rendered_lake_is_level_and_at_its_true_level(zl, tmp_path):
    """From its outline, and as possible water, whose outline the images tell."""
    scene = render_scene(trouble_spec("lake-beach", 7, size=220), tmp_path / "scene")
    with rasterio.open(tmp_path / "scene" / "trouble.tif") as file:
        marked, transform = file.read(1), file.transform
    truth, classes = read(scene.truth_dsm)[0], read(scene.truth_class)[0]
    (true_m,) = np.unique(truth[(marked > 0) & (classes == 4)])
    ((outline, _),) = shapes(marked, mask=marked > 0, transform=transform)
    lake = shapely.geometry.shape(outline).buffer(0.05)  # so that no cell's centre lies on it
    water = write_water(tmp_path / "water.gpkg", [lake])
    for name, words in (("given", ("--water", water)), ("possible", ("--level-water",))):
        done = zl("dsm", *scene.inputs, "-o", tmp_path / name, *NO_REPORT, *words)
        assert done.exit_code == 0, done.output
        height, source = read(tmp_path / name / "dsm.tif")
        inside = cells_of(lake, source)
        kind = read(tmp_path / name / "water.tif")[0]
        levelled = np.isin(kind, (WaterKind.LEVELLED, WaterKind.POSSIBLE_LEVELLED))
        (level,) = np.unique(height[levelled])
        assert abs(level - true_m) < LEVEL_M
        assert (levelled == inside).all() if name == "given" else (levelled & inside).sum() > 0.98 * levelled.sum()
        assert levelled.sum() > 0.6 * inside.sum()
