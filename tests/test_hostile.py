"""Inputs from people who mean harm: nothing is written elsewhere, nothing of theirs runs, no archive is followed."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import yaml
from pyproj import CRS
from shapely import box
from typer.testing import CliRunner

from rendered_scenes import HEIGHTS, SMALL_TILES, run
from zlocus.cli import app
from zlocus.errors import ConfigError, InputError
from zlocus.execution.store import DONE, FOLDER, TileStore
from zlocus.io.images import open_image
from zlocus.io.reference import read_dem, read_polygons
from zlocus.io.scene_file import open_scene

NAMES = (
    "../../escaped",
    "/tmp/escaped",
    "a/../../escaped",
    "..\\escaped",
    "con\nescaped",
    ".escaped",
    "escaped\x1b[2J",
)


class Evil:
    """Leaves a file where it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return (os.mkdir, (self.path,))


def below(folder):
    """All files and folders below a folder, with what they hold."""
    return {p.relative_to(folder): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}


def scene_of(images, folder, names):
    """A scene file whose views have other names."""
    folder.mkdir(parents=True)
    views = [
        {"name": name, "image": os.path.relpath(path, folder), "camera": {"kind": "rpc"}}
        for name, path in zip(names, images("sine").inputs, strict=False)
    ]
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump({"schema": 1, "frame": {"crs": "EPSG:32632"}, "views": views}))
    return path


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("command", ["dsm", "cloud", "orient", "ties", "rank"])
def test_names_of_views_lead_nowhere_else(images, tmp_path, command, name):
    scene = scene_of(images, tmp_path / "deep" / "scene", [name, "plain", "third"])
    out = tmp_path / "deep" / "out"
    before = below(tmp_path)
    words = [command, str(scene), "-o", str(out), "--heights", *map(str, HEIGHTS)]
    words += ["--resolution", "4", "--no-report"] if command == "dsm" else []
    words += ["--resolution", "4"] if command == "rank" else []
    result = CliRunner().invoke(app, words)
    assert result.exit_code in (0, 2, 3), result.output
    after = {
        path: content for path, content in below(tmp_path).items() if Path("deep/out") not in (path, *path.parents)
    }
    assert after == before
    assert not Path("/tmp/escaped").exists()
    assert not list(Path("/tmp").glob("escaped*"))
    assert "\x1b" not in result.output


@pytest.mark.parametrize(
    "prefix", ["/vsizip/", "/vsitar/", "/vsigzip/", "/vsi7z/", "/vsizip//vsicurl/http://127.0.0.1:9/"]
)
def test_archives_are_not_followed(images, tmp_path, prefix):
    path = images("sine").inputs[0]
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.write(path, path.name)
    with tarfile.open(tmp_path / "a.tar", "w") as file:
        file.add(path, path.name)
    archive = tmp_path / ("a.tar" if "tar" in prefix else "a.zip")
    inside = Path(f"{prefix}{archive}/{path.name}")
    with pytest.raises(InputError, match="archive"):
        open_image(inside)
    with pytest.raises(InputError, match="archive"):
        open_scene([inside, images("sine").inputs[1]])


@pytest.mark.parametrize("name", ["a.zip", "zip.tif", "a.shz", "a.gpkg.zip"])
def test_an_archive_under_any_name_is_no_input(images, tmp_path, name):
    area = tmp_path / "area.gpkg"
    pyogrio.raw.write(area, np.array([box(0, 0, 9, 9).wkb], object), [], [], geometry_type="Polygon", crs="EPSG:32632")
    with zipfile.ZipFile(tmp_path / name, "w") as file:
        file.write(images("sine").inputs[0], "img.tif")
        file.write(area, "area.gpkg")
    with pytest.raises(InputError):
        open_image(tmp_path / name)
    with pytest.raises(InputError):
        read_polygons(tmp_path / name, CRS.from_epsg(32632))


VRT = """<VRTDataset rasterXSize="4" rasterYSize="4"><SRS>EPSG:32632</SRS>
<GeoTransform>0, 1, 0, 4, 0, -1</GeoTransform><VRTRasterBand dataType="Byte" band="1">
<SimpleSource><SourceFilename relativeToVRT="0">{}</SourceFilename><SourceBand>1</SourceBand></SimpleSource>
</VRTRasterBand></VRTDataset>"""
WMS = """<GDAL_WMS><Service name="TMS"><ServerUrl>http://127.0.0.1:9/${z}/${x}/${y}.png</ServerUrl></Service>
<DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>4</UpperLeftY><LowerRightX>4</LowerRightX><LowerRightY>0</LowerRightY>
<SizeX>256</SizeX><SizeY>256</SizeY></DataWindow><BandsCount>1</BandsCount></GDAL_WMS>"""


def test_a_list_of_other_files_is_one_by_its_name_only(images, tmp_path):
    """A virtual raster reads what it names: a user may mean that, and then calls it .vrt."""
    text = VRT.format(images("sine").inputs[0])
    for name in ("img.vrt", "img.tif", "img"):
        (tmp_path / name).write_text(text)
    assert open_image(tmp_path / "img.vrt").shape == (4, 4)
    for name in ("img.tif", "img"):
        with pytest.raises(InputError, match=r"\.vrt"):
            open_image(tmp_path / name)


@pytest.mark.parametrize("name", ["img.tif", "img.xml", "img.vrt", "img.wms"])
def test_no_service_is_asked(tmp_path, name):
    (tmp_path / name).write_text(WMS)
    with pytest.raises(InputError):
        open_image(tmp_path / name)


OGR_VRT = (
    """<OGRVRTDataSource><OGRVRTLayer name="a"><SrcDataSource>{}</SrcDataSource></OGRVRTLayer></OGRVRTDataSource>"""
)


@pytest.mark.parametrize("name", ["area.vrt", "area.gpkg", "area.geojson"])
def test_polygons_lie_in_the_file_itself(tmp_path, name):
    (tmp_path / "other").mkdir()
    pyogrio.raw.write(
        tmp_path / "other" / "a.gpkg", np.array([box(0, 0, 9, 9).wkb], object), [], [], layer="a",
        geometry_type="Polygon", crs="EPSG:32632",
    )  # fmt: skip
    (tmp_path / name).write_text(OGR_VRT.format(tmp_path / "other" / "a.gpkg"))
    with pytest.raises(InputError):
        read_polygons(tmp_path / name, CRS.from_epsg(32632))


@pytest.mark.parametrize(
    "tag", ["!!python/object/apply:os.mkdir", "!!python/object/new:os.mkdir", "!!python/name:os.mkdir"]
)
@pytest.mark.parametrize("file", ["scene.yaml", "config.yaml"])
def test_yaml_makes_no_objects(tmp_path, tag, file):
    made = tmp_path / "made"
    (tmp_path / file).write_text(f"schema: 1\nviews: {tag} ['{made}']\n")
    words = ["dsm", str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "out")]
    if file == "config.yaml":
        words += ["--config", str(tmp_path / file)]
    assert CliRunner().invoke(app, words).exit_code == 2
    assert not made.exists()
    assert not (tmp_path / "out").exists()


def test_tiles_are_not_unpickled(images, tmp_path):
    """Whoever can write into OUT can make tiles, with their checksums, but none that runs."""
    out = tmp_path / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TileStore, "remove", lambda self: None)
        run(images("sine"), out, SMALL_TILES, workers=1, report=False)
    lines = (out / FOLDER / DONE).read_text().splitlines()
    made, content = tmp_path / "made", io.BytesIO()
    np.savez(content, height=np.array([Evil(made)], object))
    name = json.loads(lines[0])["tile"]
    for evil in (content.getvalue(), pickle.dumps(Evil(made))):
        import hashlib

        (out / FOLDER / f"{name}.npz").write_bytes(evil)
        changed = json.dumps({"tile": name, "sha256": hashlib.sha256(evil).hexdigest()})
        (out / FOLDER / DONE).write_text("\n".join([changed, *lines[1:]]) + "\n")
        store = TileStore(out / FOLDER, {}, {name: hashlib.sha256(evil).hexdigest()})
        assert store.load(name) is None
        assert not made.exists()


@pytest.mark.parametrize("name", ["../escaped", "/tmp/escaped", "..", "a/b", "x\0y"])
def test_names_of_tiles_lead_nowhere(tmp_path, name):
    (tmp_path / "out" / FOLDER).mkdir(parents=True)
    (tmp_path / "escaped.npz").write_bytes(b"PK")
    store = TileStore(tmp_path / "out" / FOLDER, {}, {name: "0" * 64})
    assert store.load(name) is None


def test_a_dem_in_an_archive_is_no_dem(tmp_path):
    from odc.geo.geobox import GeoBox

    grid = GeoBox.from_bbox((0, 0, 8, 8), "EPSG:32632", resolution=1)
    with pytest.raises((InputError, ConfigError), match="archive"):
        read_dem(Path(f"/vsizip/{tmp_path}/a.zip/dem.tif"), grid)


def test_a_link_is_read_as_what_it_leads_to(images, tmp_path):
    """Links of inputs are the user's own; products replace links, never what they lead to."""
    target = tmp_path / "precious.tif"
    shutil.copy(images("sine").inputs[0], target)
    out = tmp_path / "out"
    out.mkdir()
    (out / "dsm.tif").symlink_to(target)
    before = target.read_bytes()
    run(images("sine"), out, SMALL_TILES, workers=1, report=False, overwrite=True)
    assert target.read_bytes() == before
    assert not (out / "dsm.tif").is_symlink()
    with rasterio.open(out / "dsm.tif") as file:
        assert file.count == 1
