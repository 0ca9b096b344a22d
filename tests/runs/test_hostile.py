"""Malicious inputs: nothing is written outside the output folder, no code runs, and no archive is opened."""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import shutil
import zipfile
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import httpx
import numpy as np
import pyogrio
import pytest
import rasterio
import yaml
from pyproj import CRS
from shapely import box
from typer.testing import CliRunner

import zlocus.inspector
from inspected import served
from rendered_scenes import CENTRE, HEIGHTS, SMALL_TILES, run
from zlocus.cli.app import app
from zlocus.core.errors import ConfigError, InputError
from zlocus.io.grid_inputs import read_dem, read_polygons
from zlocus.io.images import open_image
from zlocus.io.scene_file import open_scene
from zlocus.pipeline.execution.checkpoint import DONE, FOLDER, TileCheckpoint

# Of the three views of a scene. A name that is refused stands alone, for nothing is made of the others.
NAMES = (
    ("../../escaped", "/tmp/escaped", "a/../../escaped"),
    ("..\\escaped", ".escaped", "third"),
    ("con\nescaped", "plain", "third"),
    ("escaped\x1b[2J", "plain", "third"),
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


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("command", ["dsm", "cloud", "orient", "ties", "rank"])
def test_names_of_views_lead_nowhere_else(images, tmp_path, command, names):
    scene = scene_of(images, tmp_path / "deep" / "scene", names)
    out = tmp_path / "deep" / "out"
    before = below(tmp_path)
    words = [command, str(scene), "-o", str(out), "--heights", *map(str, HEIGHTS)]
    words += ["--resolution", "4", "--no-report"] if command == "dsm" else []
    words += ["--resolution", "4"] if command == "rank" else []
    result = CliRunner().invoke(app, words)
    is_refused = any(not name.isprintable() for name in names)
    assert result.exit_code == (2 if is_refused else 0), result.output
    after = {
        path: content for path, content in below(tmp_path).items() if Path("deep/out") not in (path, *path.parents)
    }
    assert after == before
    assert not Path("/tmp/escaped").exists()
    assert not list(Path("/tmp").glob("escaped*"))
    assert "\x1b" not in result.output


# Names that are code for a page, a template, a drawing or a terminal.
CODE = {
    "script": ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "';alert(1)//</style>"),
    "template": ("{{7*7}}", "{% for %}", "]]></svg><svg onload=alert(1)>"),
    "formula": ("$\\frac{$", "a$b$c", "\\$_{"),
}


class Shown(HTMLParser):
    """What a page is made of, and what can be read on it."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.text = [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [name for name, _ in attrs]

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("kind", CODE)
def test_names_of_views_are_shown_and_do_not_run(images, tmp_path, kind):
    """In the report, in drawings, and in what the inspector answers, which its page never takes for HTML."""
    scene, out = scene_of(images, tmp_path / "scene", CODE[kind]), tmp_path / "out"
    words = [str(scene), "--heights", *map(str, HEIGHTS)]
    at = ["--at", *map(str, CENTRE), "--crs", "EPSG:32632"]
    for command in (["dsm", *words, "--resolution", "1", "-o", str(out)],
                    ["curves", str(scene), *at, "-o", str(tmp_path / "curves")],
                    ["doctor", *words, "-o", str(tmp_path / "doctor")]):  # fmt: skip
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        assert "not made" not in result.output
    page = Shown((out / "report.html").read_text())
    assert page.tags.count("script") == 1
    assert not [name for name in page.attributes if name.startswith("on")]
    assert all(name in page.text for name in CODE[kind])
    drawn = [cell["svg"] for cell in json.loads((out / "curves.json").read_text())["cells"] if cell.get("svg")]
    for svg in drawn:
        assert all(each.tag.rpartition("}")[2] != "script" for each in ElementTree.fromstring(svg).iter())
    named = {text for svg in drawn for text in ElementTree.fromstring(svg).itertext()}
    assert named & set(CODE[kind])
    with served(out) as (_, address):
        answer = httpx.get(f"{address}api/surface")
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert all(name in answer.text.encode().decode("unicode_escape") for name in CODE[kind])


TAKEN_FOR_HTML = (
    r"\.(?:inner|outer)HTML|insertAdjacentHTML|document\.write|DOMParser|createContextualFragment|srcdoc|\.html\("
    r"|\beval\(|new Function"
)


def test_the_inspector_inserts_texts_as_text_only():
    """All that its page shows is put there as text."""
    scripts = sorted((Path(zlocus.inspector.__file__).parent / "static" / "js").glob("*.js"))
    assert len(scripts) > 5
    assert [(path.name, found) for path in scripts for found in re.findall(TAKEN_FOR_HTML, path.read_text())] == []


@pytest.mark.parametrize(
    "prefix",
    [
        "/vsigzip/", "/vsi7z/", "/vsirar/", "/vsicached?file=/vsizip/", "/vsisubfile/0_999999,/vsizip/", "/vsisparse/",
        "/vsicrypt/key=a,file=", "/vsimem/", "/vsistdin/", "/vsistdout/", "/vsicurl_streaming/http://127.0.0.1:9/",
        "/vsis3_streaming/", "/vsi", "/vsi/",
    ],
)  # fmt: skip
def test_streams_and_other_archives_are_not_followed(images, tmp_path, prefix):
    path = images("sine").inputs[0]
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.write(path, path.name)
    inside = Path(f"{prefix}{tmp_path / 'a.zip'}/{path.name}")
    with pytest.raises(InputError, match="names a stream or an archive of a kind that is not followed"):
        open_image(inside)
    with pytest.raises(InputError, match="names a stream or an archive of a kind that is not followed"):
        open_scene([inside, images("sine").inputs[1]])


def test_archives_on_servers_are_not_followed(images):
    inside = Path("/vsizip//vsicurl/http://127.0.0.1:9/a.zip/a.tif")
    with pytest.raises(InputError, match="There is no archive on the path"):
        open_scene([inside, images("sine").inputs[1]])


@pytest.mark.parametrize("name", ["a.zip", "zip.tif", "a.shz", "a.gpkg.zip"])
def test_an_archive_is_refused_whatever_its_name(images, tmp_path, name):
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


def test_a_virtual_raster_is_read_only_with_the_suffix_vrt(images, tmp_path):
    """A virtual raster reads what it names: a user may mean that, and then calls it .vrt."""
    text = VRT.format(images("sine").inputs[0])
    for name in ("img.vrt", "img.tif", "img"):
        (tmp_path / name).write_text(text)
    assert open_image(tmp_path / "img.vrt").shape == (4, 4)
    for name in ("img.tif", "img"):
        with pytest.raises(InputError, match=r"\.vrt"):
            open_image(tmp_path / name)


@pytest.mark.parametrize("name", ["img.tif", "img.xml", "img.vrt", "img.wms"])
def test_no_service_is_contacted(tmp_path, name):
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
        patch.setattr(TileCheckpoint, "remove", lambda self: None)
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
        store = TileCheckpoint(out / FOLDER, {}, {name: hashlib.sha256(evil).hexdigest()})
        assert store.load(name) is None
        assert not made.exists()


@pytest.mark.parametrize("name", ["../escaped", "/tmp/escaped", "..", "a/b", "x\0y"])
def test_names_of_tiles_lead_nowhere(tmp_path, name):
    (tmp_path / "out" / FOLDER).mkdir(parents=True)
    (tmp_path / "escaped.npz").write_bytes(b"PK")
    store = TileCheckpoint(tmp_path / "out" / FOLDER, {}, {name: "0" * 64})
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
