"""Images on a server: read by window, never as a whole."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from places import SUPPORT
from rendered_scenes import PART, SMALL_TILES, read, run
from zlocus.core.errors import InputError
from zlocus.io.images import open_image
from zlocus.io.open_raster import gdal_name
from zlocus.io.stored_files import is_remote


@pytest.fixture
def served(images):
    """Address of the folder of the images."""
    folder = images("sine").inputs[0].parent
    words = [sys.executable, str(SUPPORT / "range_server.py"), str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        yield f"http://127.0.0.1:{server.stdout.readline().strip()}"
        server.kill()


def test_names_as_gdal_takes_them():
    for name in ("/vsicurl/https://a.b/c.tif", "/vsis3/bucket/c.tif", "/vsigs/b/http/c.tif"):
        assert is_remote(Path(name))
    assert gdal_name(Path("/vsicurl/https://a.b/c.tif")) == "/vsicurl/https://a.b/c.tif"
    assert gdal_name(Path("/vsicurl/http://a.b:80/c//d.tif")) == "/vsicurl/http://a.b:80/c/d.tif"
    assert gdal_name(Path("/vsis3/bucket/c.tif")) == "/vsis3/bucket/c.tif"
    assert gdal_name(Path("a/b.tif")) == "a/b.tif"
    assert not is_remote(Path("vsicurl/a.tif"))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_surface_of_images_elsewhere(images, served, tmp_path, workers):
    inputs = tuple(Path(f"/vsicurl/{served}/{path.name}") for path in images("sine").inputs)
    out = run(inputs, tmp_path / "out", SMALL_TILES, bounds=PART, workers=workers).out
    here = run(images("sine"), tmp_path / "here", SMALL_TILES, bounds=PART, report=False).out
    np.testing.assert_array_equal(read(out / "dsm.tif")[0], read(here / "dsm.tif")[0])
    record = json.loads((out / "run.json").read_text())
    assert [each["path"] for each in record["inputs"]] == [gdal_name(path) for path in inputs]
    assert {each["sha256"] for each in record["inputs"]} == {None}


VRT = """<VRTDataset rasterXSize="{columns}" rasterYSize="{rows}"><VRTRasterBand dataType="UInt16" band="1">
<SimpleSource><SourceFilename relativeToVRT="{is_relative}">{source}</SourceFilename><SourceBand>1</SourceBand>
</SimpleSource></VRTRasterBand></VRTDataset>"""


@pytest.mark.parametrize("where", ["beside it", "on a server", "here"])
def test_a_list_of_images_on_their_server(images, served, where):
    """It may name what lies beside it or on another server, and nothing on this machine."""
    path = images("sine").inputs[0]
    pixels, here = open_image(path), path.parent / f"{where.replace(' ', '_')}.vrt"
    source = {"beside it": path.name, "on a server": f"/vsicurl/{served}/{path.name}", "here": path}[where]
    rows, columns = pixels.shape
    here.write_text(VRT.format(rows=rows, columns=columns, source=source, is_relative=int(where == "beside it")))
    name = Path(f"/vsicurl/{served}/{here.name}")
    try:
        if where == "here":
            with pytest.raises(InputError, match="which lies on none"):
                open_image(name)
        else:
            assert (open_image(name).read(0, 0, 9, 9).pixels == pixels.read(0, 0, 9, 9).pixels).all()
    finally:
        here.unlink()


def test_a_missing_remote_file_is_named(served):
    with pytest.raises(InputError, match=r"nothing\.tif cannot be opened as a raster"):
        open_image(Path(f"/vsicurl/{served}/nothing.tif"))
