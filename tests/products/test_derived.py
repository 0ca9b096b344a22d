"""Which products are made of a surface, by a run and by `zlocus products`."""

from __future__ import annotations

import json
import os

import laspy
import numpy as np
import pyogrio
import pytest
import rasterio
from affine import Affine
from odc.geo.geobox import GeoBox
from pyproj import CRS
from rio_cogeo.cogeo import cog_validate
from typer.testing import CliRunner

import zlocus.products.derived as maps
from las_format import check_laz
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, OutputError
from zlocus.core.options import ProductOptions, RunConfig
from zlocus.core.progress import SilentProgress
from zlocus.core.requests import DEFAULT_PRODUCTS, PRODUCTS, added_products, product_names
from zlocus.io.config import config_as_dict
from zlocus.io.crs import local_frame
from zlocus.io.rasters import write_cog
from zlocus.io.styles.file_names import OF_SURFACE, style_files
from zlocus.products.derived import FILES, link_all, remove_derived, write_derived

GRID = GeoBox((60, 80), Affine(1.0, 0, 500000, 0, -1.0, 4000000), "EPSG:32632")
SURFACE = {"dsm.tif", "ortho.tif", "quality.tif", "sigma.tif", "views.tif"}


@pytest.fixture
def surface(tmp_path):
    return written(tmp_path, GRID)


def written(folder, grid):
    row, col = np.mgrid[:60, :80]
    z = (100 + 0.05 * row + 0.1 * col).astype(np.float32)
    z[20:30, 30:45] += 8
    z[:4] = np.nan
    write_cog(folder / "dsm.tif", z, grid, nodata=np.nan, units="m")
    write_cog(folder / "sigma.tif", np.full_like(z, 0.2), grid, nodata=np.nan, units="m")
    write_cog(folder / "quality.tif", np.zeros(z.shape, np.uint16), grid)
    write_cog(folder / "views.tif", np.full(z.shape, 3, np.uint8), grid, nodata=0)
    write_cog(folder / "ortho.tif", np.full(z.shape, 90, np.uint8), grid, mask=np.isfinite(z))
    return folder


def names_in(folder):
    return set(os.listdir(folder))


@pytest.mark.parametrize("wanted", [(), *[(name,) for name in PRODUCTS], PRODUCTS])
def test_what_is_asked_for_is_made_and_linked(surface, wanted):
    write_derived(surface, wanted, ProductOptions(), SilentProgress())
    link_all(surface, SilentProgress())
    made = {FILES[name] for name in wanted}
    assert names_in(surface) == SURFACE | made | {"item.json"}
    assets = json.loads((surface / "item.json").read_text())["assets"].values()
    assert {asset["href"].removeprefix("./") for asset in assets} == SURFACE | made


def test_every_product_opens_and_is_valid(surface):
    write_derived(surface, PRODUCTS, ProductOptions(), SilentProgress())
    rasters = sorted(surface.glob("*.tif"))
    assert len(rasters) == 7
    for path in rasters:
        assert cog_validate(path, strict=True) == (True, [], []), path
        with rasterio.open(path) as file:
            assert file.read(1).shape == (60, 80)
            assert {f"STATISTICS_{name}" for name in ("MINIMUM", "MAXIMUM", "MEAN", "STDDEV")} <= set(file.tags(1))
    assert pyogrio.read_info(surface / "contours.gpkg")["features"] > 10
    for name in ("surface.laz", "surface.copc.laz"):
        with laspy.open(surface / name) as laz:
            assert laz.header.point_count == 56 * 80


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32632+5773"])
def test_products_have_the_crs_of_their_surface(tmp_path, crs):
    written(tmp_path, GRID)
    with rasterio.open(tmp_path / "dsm.tif") as file:
        z, profile = file.read(), file.profile
    for name in ("driver", "blockxsize", "blockysize", "tiled", "interleave"):
        profile.pop(name, None)
    with rasterio.open(tmp_path / "dsm.tif", "w", **(profile | {"driver": "COG", "crs": crs})) as file:
        file.write(z)
    write_derived(tmp_path, PRODUCTS, ProductOptions(), SilentProgress())
    with rasterio.open(tmp_path / "dtm.tif") as file:
        assert CRS(file.crs.to_wkt()) == CRS(crs)
    # A hillshade holds no heights.
    with rasterio.open(tmp_path / "hillshade.tif") as file:
        assert CRS(file.crs.to_wkt()) == CRS("EPSG:32632")
        assert file.units == (None,)
    with laspy.open(tmp_path / "surface.laz") as laz:
        assert laz.header.parse_crs() == CRS(crs)
    # What elevation_m is above.
    assert CRS(pyogrio.read_info(tmp_path / "contours.gpkg")["crs"]) == CRS(crs)
    check_laz(tmp_path / "surface.laz")


def test_a_map_that_fails_costs_no_other(surface, monkeypatch):
    def broken(*_):
        raise ConfigError("no luck")

    monkeypatch.setitem(maps._MAKERS, "hillshade", broken)
    with pytest.raises(ConfigError, match="no luck"):
        write_derived(surface, PRODUCTS, ProductOptions(), SilentProgress())
    assert {"dtm.tif", "contours.gpkg", "surface.laz"} <= {path.name for path in surface.iterdir()}
    assert not (surface / "hillshade.tif").exists()


def test_contours_of_the_terrain_need_it(surface):
    options = ProductOptions(contours_of="dtm", contour_interval_m=1.0)
    with pytest.raises(ConfigError, match=r"Add dtm to --products"):
        write_derived(surface, ("contours",), options, SilentProgress())
    assert names_in(surface) == SURFACE
    write_derived(surface, ("contours", "dtm"), options, SilentProgress())
    of_terrain = pyogrio.read_info(surface / "contours.gpkg")["features"]
    write_derived(surface, ("contours",), options, SilentProgress())
    assert pyogrio.read_info(surface / "contours.gpkg")["features"] == of_terrain
    write_derived(surface, ("contours",), ProductOptions(contour_interval_m=1.0), SilentProgress())
    # The house of 8 m adds at least its seven heights.
    assert pyogrio.read_info(surface / "contours.gpkg")["features"] >= of_terrain + 7


def test_in_a_local_frame_a_note_says_why_there_is_no_item(tmp_path, capsys):
    written(tmp_path, GeoBox(GRID.shape, GRID.transform, local_frame().to_wkt()))
    said = []
    progress = SilentProgress()
    progress.note = said.append
    write_derived(tmp_path, PRODUCTS, ProductOptions(), progress)
    link_all(tmp_path, progress)
    assert said == ["No item.json: the frame is local, and STAC is about places on the Earth."]
    assert names_in(tmp_path) == SURFACE | set(FILES.values())


def test_maps_of_an_earlier_surface_go(surface):
    write_derived(surface, PRODUCTS, ProductOptions(), SilentProgress())
    (surface / "notes.txt").write_text("mine")
    remove_derived(surface)
    assert names_in(surface) == SURFACE | {"notes.txt"}
    remove_derived(surface)
    (surface / "dtm.tif").mkdir()
    with pytest.raises(OutputError, match=r"dtm\.tif is of an earlier run and cannot be removed"):
        remove_derived(surface)


def test_names_of_products():
    assert product_names("none") == ()
    assert product_names("laz, hillshade") == ("hillshade", "laz")
    assert product_names(",".join(PRODUCTS)) == PRODUCTS
    assert added_products("laz,dtm") == ("hillshade", "dtm", "laz")
    assert added_products("hillshade") == DEFAULT_PRODUCTS
    assert added_products("none") == ()
    assert set(FILES) == set(PRODUCTS) >= set(DEFAULT_PRODUCTS)
    for wrong in ("", "hillshade,", "shade", "none,laz"):
        with pytest.raises(ConfigError, match=r"--products .*is not known; choose from hillshade, contours, dtm, laz"):
            product_names(wrong)


def run(*arguments):
    return CliRunner().invoke(app, ["products", *map(str, arguments)])


def test_the_command(surface, tmp_path_factory):
    config = tmp_path_factory.mktemp("config") / "c.toml"
    config.write_text("[products]\nsun_azimuth_deg = 90.0\n")
    done = run(surface, "--products", "hillshade")
    assert (done.exit_code, done.stdout) == (0, f"{surface}: hillshade.tif made.\n")
    before = (surface / "hillshade.tif").read_bytes()
    assert run(surface, "--config", config).exit_code == 0
    assert (surface / "hillshade.tif").read_bytes() != before
    made = SURFACE | set(FILES.values())
    styles = {name for product in made if product in OF_SURFACE for name in style_files(product)}
    assert names_in(surface) == made | styles | {"item.json"}
    assert "no map made" in run(surface, "--products", "none").stdout


def test_the_command_takes_the_options_of_the_run(surface, tmp_path_factory):
    def hillshade(*arguments):
        done = run(surface, "--products", "hillshade", *arguments)
        assert done.exit_code == 0, done.stderr
        return (surface / "hillshade.tif").read_bytes()

    config = tmp_path_factory.mktemp("config") / "c.toml"
    config.write_text("")
    options = RunConfig(products=ProductOptions(sun_azimuth_deg=90.0))
    by_default, record = hillshade(), surface / "run.json"
    text = json.dumps({"config": {"options": config_as_dict(options)}})
    record.write_text(text)
    assert hillshade() != by_default
    assert record.read_text() == text
    assert hillshade("--config", config) == by_default
    # Those of other stages are no matter here, and neither is a record without any.
    record.write_text('{"config": {"options": {"pyramid": {"of_old": 1}}}}')
    assert hillshade() == by_default
    record.write_text('{"config": {"options": {"products": {"of_old": 1}}}}')
    done = run(surface, "--products", "hillshade")
    assert (done.exit_code, len(done.stderr.splitlines())) == (2, 1)
    assert "run.json: products.of_old is not an option" in done.stderr
    assert done.stderr.endswith("Or give the options with --config.\n")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--products", "shade"), "--products shade is not known"),
        (("--config", "none.toml"), "none.toml"),
    ],
)
def test_what_the_command_refuses(surface, arguments, sentence):
    done = run(surface, *arguments)
    assert done.exit_code == 2
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1 or "Products" in done.stderr
    assert names_in(surface) == SURFACE


def test_the_command_needs_a_surface(tmp_path):
    done = run(tmp_path)
    assert done.exit_code == 2
    assert "There is no surface" in done.stderr
