"""Vertical datums: their names, installed and missing grids, CRSs of files, and heights of cells and points."""

from __future__ import annotations

import os
import warnings

import numpy as np
import pytest
import rasterio
from odc.geo.geobox import GeoBox
from pyproj import CRS, Transformer
from pyproj.transformer import TransformerGroup
from rasterio.shutil import copy as copy_raster
from rasterio.transform import from_origin
from rio_cogeo import cog_validate

from geoids import around_the_earth, write_geoid, write_proj_grid
from zlocus.core.errors import ConfigError, InputError
from zlocus.io import vertical
from zlocus.io.grid_inputs import read_geobox
from zlocus.io.rasters import write_cog
from zlocus.io.vertical import ELLIPSOIDAL, KNOWN_GEOIDS, check_heights, declared_vertical_datum, named_vertical_datum
from zlocus.products.rasters import SurfaceRasters

UTM = CRS.from_epsg(32631)
GRID = GeoBox((70, 90), from_origin(690_000.3, 4_798_000.1, 3.7, 3.7), UTM)
# The step of a float32 at 500 m is 0.03 mm.
FLOAT_M = 5e-5
PROJ_M = 1e-4


@pytest.fixture
def no_grids(tmp_path, monkeypatch):
    """A machine without PROJ's grids; the only folder where they are looked for."""
    folder = tmp_path / "share"
    folder.mkdir()
    monkeypatch.setattr(vertical, "proj_folders", lambda: [folder])
    return folder


@pytest.fixture
def proj_grid(no_grids):
    """A machine with the grid of EGM96, or what stands for it."""
    return write_proj_grid(no_grids / "us_nga_egm96_15.tif")


@pytest.fixture
def geoid(tmp_path):
    """A geoid of 15 minutes under the grid."""
    cells = around_the_earth()[180:190, 735:745]
    return write_geoid(tmp_path / "my geoid.tif", cells, from_origin(3.625, 45.125, 0.25, 0.25))


def centres(geobox):
    rows, cols = np.indices(tuple(geobox.shape))
    x, y = geobox.transform * (cols + 0.5, rows + 0.5)
    return np.column_stack([x.ravel(), y.ravel()])


def test_the_ellipsoid_needs_no_file():
    datum = named_vertical_datum("ellipsoid")
    assert datum == ELLIPSOIDAL
    assert (datum.crs, datum.files, datum.surface_name) == (None, (), "the ellipsoid")
    assert not datum.undulation(centres(GRID), UTM).any()
    heights = np.ones(GRID.shape, np.float32)
    assert datum.heights_from_ellipsoidal(heights, GRID) is heights
    assert datum.compound_crs(UTM) == UTM
    assert datum.as_dict() == {"heights_above": "the ellipsoid"}
    datum.check_covers((0, 0, 1, 1), UTM)


@pytest.mark.parametrize("name", KNOWN_GEOIDS)
def test_a_missing_grid_is_an_error(no_grids, name):
    """Also where a file of that name would be found by PROJ over the network."""
    with pytest.raises(ConfigError) as error:
        named_vertical_datum(name)
    message = str(error.value)
    grid = KNOWN_GEOIDS[name].grids[0]
    assert f"--vertical {name} needs PROJ's grid {grid}, which is not in {no_grids}" in message
    assert f"pyproj sync --file {grid}" in message
    # Debian's proj-data has EGM96 as egm96_15.gtx, and not EGM2008.
    assert ("proj-data of Debian" in message) == (name == "egm96")
    assert "--vertical FILE" in message


@pytest.mark.parametrize("name", KNOWN_GEOIDS)
def test_proj_names_the_same_grids(name):
    """And that without its grid, its best conversion leaves heights as they are, which is why it is not asked."""
    known = KNOWN_GEOIDS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup("EPSG:4979", f"EPSG:4326+{known.epsg}", always_xy=True)
    missing = {grid.short_name for operation in group.unavailable_operations for grid in operation.grids}
    usable = [operation for transformer in group.transformers for operation in transformer.operations or ()]
    assert known.grids[0] in missing | {grid.short_name for operation in usable for grid in operation.grids}
    height = group.transformers[0].transform(5.0, 44.0, 100.0)[2]
    assert (height == 100.0) == (known.grids[0] in missing)
    vertical_crs = CRS.from_epsg(known.epsg)
    assert vertical_crs.datum.name == known.datum


def test_a_grid_that_is_there_is_what_proj_uses(proj_grid):
    datum = named_vertical_datum("egm96")
    assert named_vertical_datum("EGM96") == named_vertical_datum("Egm96") == datum
    assert named_vertical_datum("Ellipsoid") is ELLIPSOIDAL
    xy = centres(GRID)
    lon, lat = Transformer.from_crs(UTM, 4326, always_xy=True).transform(*xy.T)
    by_proj = Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +inv +proj=vgridshift +grids={proj_grid} "
        "+multiplier=1"
    ).transform(lon, lat, np.full(len(lon), 300.0))[2]
    np.testing.assert_allclose(300.0 - datum.undulation(xy, UTM), by_proj, rtol=0, atol=PROJ_M)
    assert datum.files == (proj_grid,)
    assert datum.as_dict() == {"heights_above": "the EGM96 geoid", "crs": "EPSG:5773", "geoid": str(proj_grid)}


def test_grids_are_looked_for_where_proj_does(tmp_path, monkeypatch):
    monkeypatch.setenv("PROJ_DATA", os.pathsep.join([str(tmp_path / "a"), str(tmp_path / "b")]))
    folders = vertical.proj_folders()
    assert {tmp_path / "a", tmp_path / "b"} <= set(folders)
    (tmp_path / "b").mkdir()
    write_proj_grid(tmp_path / "b" / "us_nga_egm08_25.tif")
    if not any((folder / "us_nga_egm08_25.tif").is_file() for folder in folders if folder != tmp_path / "b"):
        assert named_vertical_datum("egm2008").files == (tmp_path / "b" / "us_nga_egm08_25.tif",)


def test_cells_lose_the_undulation_of_their_centre(geoid):
    heights = np.random.default_rng(1).uniform(100, 500, GRID.shape).astype(np.float32)
    heights[3, 5:9] = np.nan
    datum = named_vertical_datum(str(geoid))
    found = datum.heights_from_ellipsoidal(heights, GRID)
    undulation = datum.undulation(centres(GRID), UTM).reshape(GRID.shape)
    np.testing.assert_allclose(found, heights - undulation, rtol=0, atol=FLOAT_M)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(heights))
    np.testing.assert_allclose(datum.ellipsoidal_from_heights(found, GRID), heights, rtol=0, atol=2 * FLOAT_M)


def test_cells_are_the_same_however_they_are_cut(geoid):
    heights = np.random.default_rng(2).uniform(100, 500, GRID.shape).astype(np.float32)
    datum = named_vertical_datum(str(geoid))
    whole = datum.heights_from_ellipsoidal(heights, GRID)
    pieces = np.full_like(heights, np.nan)
    for row in range(0, 70, 13):
        for col in range(0, 90, 17):
            part = np.s_[row : row + 13, col : col + 17]
            pieces[part] = datum.heights_from_ellipsoidal(heights[part], GRID, row, col)
    assert pieces.tobytes() == whole.tobytes()


def test_an_area_is_looked_at_before_the_work(geoid, tmp_path):
    datum = named_vertical_datum(str(geoid))
    xmin, ymin, xmax, ymax = GRID.boundingbox.bbox
    low, high = datum.undulation_range((xmin, ymin, xmax, ymax), UTM)
    undulation = datum.undulation(centres(GRID), UTM)
    assert low <= undulation.min() < undulation.max() <= high
    with pytest.raises(InputError, match=r"my geoid\.tif does not cover"):
        datum.check_covers((xmin, ymin, xmax, ymax + 300_000), UTM)
    # One post of a finer geoid is missing, far from the area's middle and its rim.
    posts = np.full((400, 400), 50.0)
    posts[50, 333] = np.nan
    holed = write_geoid(tmp_path / "holed.tif", posts, from_origin(690_000, 4_798_000, 10, 10), "EPSG:32631")
    with pytest.raises(InputError, match=r"holed\.tif has no value \(nodata\) around 6933"):
        named_vertical_datum(str(holed)).check_covers((690_010, 4_794_010, 693_990, 4_797_990), UTM)


def test_the_datum_of_a_file_is_in_its_crs(proj_grid, tmp_path):
    def of(crs):
        return declared_vertical_datum(CRS.from_user_input(crs), tmp_path / "dem.tif", "--dem-vertical")

    assert of("EPSG:32631") is ELLIPSOIDAL
    assert of("EPSG:4979") is ELLIPSOIDAL
    assert of(UTM.to_3d()) is ELLIPSOIDAL
    assert of("EPSG:32631+5773").files == (proj_grid,)
    with pytest.raises(ConfigError, match=r"dem\.tif has EGM2008 heights by its CRS, which needs PROJ's grid us_nga_"):
        of("EPSG:4326+3855")
    with pytest.raises(
        InputError, match=r"no geoid for \(NAVD88 height, by its CRS\)\. Give its geoid with --dem-vert"
    ):
        of("EPSG:4269+5703")
    for crs, says in (("EPSG:4326+6360", "in US survey foot"), ("EPSG:32631+5831", "go down")):
        with pytest.raises(InputError, match=says):
            check_heights(CRS.from_user_input(crs), tmp_path / "dem.tif")


@pytest.mark.parametrize("name", ["egm96", "egm2008", "file"])
def test_files_say_what_heights_are_above(tmp_path, no_grids, geoid, name):
    """The CRS comes back from the GeoTIFF alone, is a valid COG, and the grid is one for --like."""
    if name != "file":
        write_proj_grid(no_grids / KNOWN_GEOIDS[name].grids[0])
    datum = named_vertical_datum(str(geoid) if name == "file" else name)
    path = tmp_path / "out" / "dsm.tif"
    path.parent.mkdir()
    write_cog(path, np.zeros(GRID.shape, np.float32), datum.compound_geobox(GRID))
    assert [p.name for p in path.parent.iterdir()] == ["dsm.tif"]
    assert cog_validate(path, quiet=True) == (True, [], [])
    with rasterio.open(path) as file:
        crs = CRS.from_user_input(file.crs)
    assert crs.is_compound
    assert crs.to_2d().to_epsg() == 32631
    (height,) = [part for part in crs.sub_crs_list if part.is_vertical]
    if name == "file":
        assert height.name == "height above the geoid of my geoid.tif"
        with pytest.raises(InputError, match="no geoid for"):
            declared_vertical_datum(crs, path, "--dem-vertical")
    else:
        assert height.to_epsg() == KNOWN_GEOIDS[name].epsg
        assert declared_vertical_datum(crs, path, "--dem-vertical").files == datum.files
    assert read_geobox(path) == GRID
    with rasterio.open(path) as file:
        assert GeoBox.from_rio(file).crs.proj.name == datum.compound_geobox(GRID).crs.proj.name


def test_a_projected_crs_with_ellipsoidal_heights_needs_a_second_file(tmp_path):
    """Why ellipsoidal heights are written with the horizontal CRS alone."""
    path = tmp_path / "a.tif"
    with rasterio.open(
        path, "w", driver="GTiff", height=4, width=4, count=1, dtype="float32", crs=UTM.to_3d().to_wkt(),
        transform=from_origin(690_000, 4_798_000, 1, 1),
    ) as file:  # fmt: skip
        file.write(np.zeros((1, 4, 4), np.float32))
    copy_raster(path, tmp_path / "b.tif", driver="COG")
    beside = tmp_path / "b.tif.aux.xml"
    is_beside = beside.exists()
    beside.unlink(missing_ok=True)
    with rasterio.open(tmp_path / "b.tif") as file:
        # Where a GDAL keeps it in the GeoTIFF, nothing lies beside that.
        assert (file.crs is None) == is_beside


def test_names_that_geotiff_cannot_hold(tmp_path, geoid):
    datum = named_vertical_datum(str(geoid.rename(tmp_path / 'gé"oid|1.tif')))
    write_cog(tmp_path / "dsm.tif", np.zeros(GRID.shape, np.float32), datum.compound_geobox(GRID))
    with rasterio.open(tmp_path / "dsm.tif") as file:
        names = [part.name for part in CRS.from_user_input(file.crs).sub_crs_list]
    assert names == ["WGS 84 / UTM zone 31N", "height above the geoid of g__oid_1.tif"]


def test_of_the_rasters_only_heights_are_above_something(tmp_path, geoid):
    datum = named_vertical_datum(str(geoid))
    (tmp_path / "out").mkdir()
    with SurfaceRasters(tmp_path / "out", GRID, "uint8", datum):
        pass
    for path in (tmp_path / "out").iterdir():
        with rasterio.open(path) as file:
            crs = CRS.from_user_input(file.crs)
            assert crs.is_compound == (path.name == "dsm.tif"), path.name
            if path.name == "dsm.tif":
                assert file.descriptions == ("height above the geoid of my geoid.tif",)
